"""`sim2gp design` for a machine that C MuJoCo moves: worth, limits, and the search."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sim2gp.experiment_design as d
from sim2gp.experiment_design import by_samples, search
from sim2gp.experiment_design.experiment import sensitivity_at
from sim2gp.experiment_design.forces import forces_shown
from sim2gp.experiment_design.limits import excess, servo_rates
from sim2gp.experiment_design.search import DesignResult
from sim2gp.inference.prior import ParameterPrior
from sim2gp.inference.relevance import EARNED
from sim2gp.systems import Delay, Machine, MuJoCo, Spring
from sim2gp.systems.assemble import free_parts

mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is not installed")

import servo_arm  # noqa: E402
from tests.commands.test_explain_mujoco import MODEL  # noqa: E402

pytestmark = pytest.mark.usefixtures("float64")
PERIOD, STEPS = 0.01, 50


def experiment_with(*parts: Any) -> d.Experiment:
    """Half a second with a pendulum whose motor is late, or has something else."""
    with jax.enable_x64(True):
        plant = MuJoCo(mujoco.MjModel.from_xml_string(MODEL))
        system = free_parts(Machine(plant), [Delay("torque", 0.03), *parts])
        table = system.parameters
        return d.Experiment(
            system,
            ParameterPrior(table.prior(), table).at_mode(),
            jnp.asarray([1e-3]),
            jnp.zeros(2),
            jnp.asarray([0.1, 1.0]),
            (0,),
            PERIOD,
            STEPS,
            20,
            system.window_substep,
        )


def box_of(experiment: d.Experiment, reach: float = 1.0) -> d.LimitBox:
    stated = {"hinge": (-reach, reach)}
    return d.LimitBox.of(experiment.system, stated, {}, start=np.zeros(2))


def commands(experiment: d.Experiment, size: float = 0.1) -> Any:
    signal = d.MultisineCommands(PERIOD, STEPS)
    C = size * signal.random(jax.random.key(1), 1)
    return signal.commands(C, box_of(experiment))


@pytest.mark.nightly
def test_worth_is_that_of_the_definition() -> None:
    """States, information and predictions as JAX finds them step by step."""
    experiment = experiment_with(Spring("hinge", 2.0))
    U, p = commands(experiment), experiment.belief.mean.size
    z = 0.3 * np.ones(p)
    tt = experiment.belief.at(jnp.asarray(z))
    states = d.trajectory(experiment, tt, U)
    found = by_samples.states_of(experiment, np.asarray(U), np.asarray(tt)[None])[0]
    np.testing.assert_allclose(found, states, rtol=0.0, atol=1e-9)
    A = d.information(experiment, jnp.asarray(z), U, states)
    scale = d.posterior_scale(experiment.belief, A)
    goal = d.DOptimal()
    nats, answer = by_samples.worth_at(experiment, goal, z, np.asarray(U))
    expected = goal.nats(experiment.belief.scale, scale)
    assert nats == pytest.approx(float(expected), rel=1e-6)
    np.testing.assert_allclose(answer @ answer.T, scale @ scale.T, rtol=1e-5, atol=1e-9)
    ahead = by_samples.sensitivity_at(experiment, U, 12)
    expected = sensitivity_at(experiment, U, 12)
    size = float(jnp.abs(expected).max())
    np.testing.assert_allclose(ahead, expected, rtol=0.0, atol=1e-6 * size)


@pytest.mark.nightly  # 7 s; of a bundled machine by day
def test_forces_that_its_motion_shows() -> None:
    """Counted by the engine's own slopes: of a motion, and at rest."""
    experiment = experiment_with()
    for size, shows in ((3.0, True), (0.0, False)):
        U = np.asarray(size * commands(experiment))
        mean = np.asarray(experiment.belief.mean)
        states = by_samples.states_of(experiment, U, mean[None])[0]
        scale = np.eye(mean.size)
        found = DesignResult(U, 0.0, scale, states, states, states, 0.0, 1)
        shown = forces_shown(experiment, found)
        entry = shown["hinge by hinge.velocity"]
        assert entry["unit"] == "N m"
        assert (entry["nats"] > EARNED) is shows
        # Of a turn, half a second covers too little.
        assert shown["hinge by hinge"]["nats"] == 0.0


@pytest.mark.nightly
def test_the_search_keeps_its_limits_and_beats_random_motions(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name, value in {"ROUNDS": 3, "SAMPLES": 8, "ELITES": 3, "CHECKED": 60}.items():
        monkeypatch.setattr(by_samples, name, value)
    experiment = experiment_with()
    box, goal, key = box_of(experiment), d.DOptimal(), jax.random.key(0)
    signal, p = d.MultisineCommands(PERIOD, STEPS), experiment.belief.mean.size
    best = d.optimise_commands(experiment, goal, box, signal, key=key, draws=2)
    assert best.violations <= search.ALLOWED
    assert (np.abs(best.commands) <= 3.0).all()
    assert best.checked == 60
    # The states that are returned are those of its own commands, and within the limits.
    states = d.trajectory(
        experiment, experiment.plausible.mean, jnp.asarray(best.commands)
    )
    np.testing.assert_allclose(best.states, states, rtol=0.0, atol=1e-9)
    assert float(excess(box, states)) <= 0.0
    # Others, made as large as the same draws allow.
    held_out = np.asarray(jax.random.normal(jax.random.key(7), (60, p)))
    random = []
    for k in jax.random.split(jax.random.key(5), 3):
        U = signal.commands(0.3 * signal.random(k, 1), box)
        U, _, _ = search._kept(
            lambda U: by_samples.states_and_excess(
                experiment, box, np.asarray(U), held_out
            ),
            U,
        )
        nats, _ = by_samples.worth_at(experiment, goal, np.zeros(p), np.asarray(U))
        random.append(nats)
    U = best.commands
    assert by_samples.worth_at(experiment, goal, np.zeros(p), U)[0] > np.median(random)


def test_targets_of_servos_move_slowly_unless_stated(tmp_path: Path) -> None:
    """A third of the range in a second; motors have no such default."""
    arm = MuJoCo(mujoco.MjModel.from_xml_string(servo_arm.model_text()))
    rates = servo_rates(arm)
    spans = {c.name: c.high - c.low for c in arm.actions}
    assert rates == {name: span / 3.0 for name, span in spans.items()}
    # Of a target that may leave its joint's range, the joint's counts.
    wide = servo_arm.model_text().replace('ctrlrange="-3.1 3.1"', 'ctrlrange="-9 9"')
    assert servo_rates(MuJoCo(mujoco.MjModel.from_xml_string(wide))) == rates
    assert servo_rates(MuJoCo(mujoco.MjModel.from_xml_string(MODEL))) == {}
