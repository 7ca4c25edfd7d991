"""The period of a log and the step of a model, against C MuJoCo itself."""

import itertools
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import servo_arm
from sim2gp.data.clock import (
    clock_lines,
    clock_warnings,
    on_even_clock,
    step_between,
)
from sim2gp.data.grid import evaluation_windows
from sim2gp.data.logs import Log
from sim2gp.data.split_log import cut
from sim2gp.data.windows_likelihood import WindowsLikelihood
from sim2gp.systems import CartPole, Machine, MuJoCo
from sim2gp.systems.actuators import Delay
from sim2gp.types import in_float64

mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is absent")

HERTZ, STEPS = (100, 125, 250, 500), (0.001, 0.002, 0.004, 0.005)
#: By day a period that the step divides, one that it does not, and a shorter one.
BY_DAY = ((100, 0.002), (125, 0.005), (500, 0.004))
CLOCKS = [
    pytest.param(*pair, marks=() if pair in BY_DAY else pytest.mark.nightly)
    for pair in itertools.product(HERTZ, STEPS)
]
SERVO = (
    '<mujoco><option timestep="{step}" integrator="implicitfast"/><worldbody><body>'
    '<joint name="q" axis="0 1 0" damping="{damping}" armature=".05"/>'
    '<geom type="capsule" size=".02 .1" mass="1"/></body></worldbody><actuator>'
    '<position name="servo" joint="q" kp="500" kv="100"/></actuator></mujoco>'
)


def arm(step: float) -> MuJoCo:
    text = servo_arm.model_text(step)
    paths = [f"joint/joint{k}/damping" for k in range(1, 7)]
    return MuJoCo(mujoco.MjModel.from_xml_string(text), paths)


def log_of(period: float, rows: int = 101) -> Log:
    """Targets that change at every row; what is measured does not matter."""
    time, rng = period * np.arange(rows), np.random.default_rng(3)
    y = {name: np.sin(3.0 * time) for name in servo_arm.NAMES}
    u = {f"servo{k}": rng.uniform(-0.3, 0.3, rows) for k in range(1, 7)}
    return Log("a", "a.csv", time, y, u, dict.fromkeys(y, time >= 0))


def spans_of(log: Log, system: MuJoCo | Machine) -> np.ndarray:
    windows, _ = cut([log], system, window=0.2)
    spans = np.asarray(windows.span)
    return np.unique(np.round(spans[spans > 0.0], 9))


@pytest.mark.parametrize(("hertz", "step"), CLOCKS)
def test_a_row_is_a_whole_number_of_the_models_steps(hertz: int, step: float) -> None:
    """The model's own where they divide the period, else the longest that do."""
    period = 1.0 / hertz
    count = int(np.ceil(round(period / step, 9)))
    (span,) = spans_of(log_of(period), arm(step))
    assert span == pytest.approx(period / count)
    (line,) = clock_lines([log_of(period)], arm(step))
    assert ("as in its file: parameters" in line) == (abs(span - step) > 1e-9)
    assert (f'timestep="{span:.6g}"' in line) == (abs(span - step) > 1e-9)
    assert bool(clock_warnings([log_of(period)], arm(step))) == (
        abs(span - step) > 1e-9
    )


@in_float64
@pytest.mark.parametrize(("period", "step"), [(0.01, 0.002), (0.008, 0.005)])
def test_delayed_inputs_arrive_in_the_steps_of_mujoco(
    period: float, step: float
) -> None:
    """Oracle: `mj_step` under each step's own mean of the delayed target."""
    plant, late = arm(step), 0.5 * step_between(period, step)
    delays = [Delay(c.name, late, tie="servo1") for c in plant.actions[1:]]
    machine = Machine(plant, actuators=(Delay("servo1", late), *delays))
    fixed = machine.parameters.replace(**{"servo1.delay": late})
    machine = replace(machine, parameters=fixed)
    log = log_of(period)
    windows, _ = cut([log], machine, window=0.2)
    likelihood = WindowsLikelihood(machine, windows)
    table = machine.parameters
    nominal = [table.nominal()[name] for name in table.names]
    tt = table.unconstrain(jnp.asarray(nominal))
    run = likelihood.trial(
        np.asarray(tt), np.zeros(windows.start.shape), np.eye(len(tt))
    )
    model = mujoco.MjModel.from_xml_string(servo_arm.model_text(step))
    model.opt.timestep = h = step_between(period, step)
    data, cost = mujoco.MjData(model), np.zeros(6)
    data.qpos[:], data.qvel[:] = np.split(np.asarray(windows.start)[0], 2)
    u = log.commanded([c.name for c in machine.actions])
    rows = int(np.asarray(windows.mask)[0].any(axis=1).sum())
    y = log.measured(servo_arm.NAMES)[0]
    for k in range(rows):
        cost += (data.qpos - y[k]) ** 2
        for i in range(round(period / h)):
            data.ctrl[:] = 0.5 * (u[k] + u[max(k - 1, 0)]) if i == 0 else u[k]
            mujoco.mj_step(model, data)
    np.testing.assert_allclose(run.squares[0], cost, rtol=1e-9)


def test_jitter_of_the_stamps_is_none_of_the_steps() -> None:
    """With 1 % and 8 % of jitter and a lost row, on a clock that began long ago."""
    system, plain = arm(0.005), log_of(0.01)
    keep = np.delete(np.arange(len(plain)), 40)
    for share, since in ((0.01, 0.0), (0.08, 3.0), (0.01, 1.7e9)):
        rng = np.random.default_rng(0)
        moved = plain.time + share * 0.01 * rng.uniform(-1.0, 1.0, len(plain)) + since
        pick = {n: x[keep] for n, x in plain.channels.items()}
        log = replace(
            plain,
            time=moved[keep],
            channels=pick,
            inputs={n: x[keep] for n, x in plain.inputs.items()},
            mask={n: x[keep] for n, x in plain.mask.items()},
        )
        assert spans_of(log, system) == pytest.approx([0.005], rel=1e-3)
        (line,) = clock_lines([log], system)
        assert "2 steps of the model, 5" in line
        assert "taken as even" in line
        even = on_even_clock(log, system).time
        apart = even - even[0] - plain.time[keep]
        assert np.abs(apart).max() < 5e-4
    assert on_even_clock(plain, CartPole()) is plain  # an equation has no step


def test_uneven_stamps_have_few_steps() -> None:
    """Rounded to a tenth of the period, in order, and said."""
    system, log = arm(0.005), log_of(0.01)
    rng = np.random.default_rng(0)
    log = replace(log, time=log.time + 0.003 * rng.uniform(-1.0, 1.0, len(log)))
    moved = on_even_clock(log, system)
    assert len(np.unique(np.round(np.diff(moved.time), 9))) < 16
    assert np.diff(moved.time).min() > 0.0
    away = moved.time - log.time
    assert np.ptp(away) < 1.1e-3
    assert "stamps are uneven" in clock_lines([log], system)[0]


def test_a_step_may_be_a_little_longer_than_the_files() -> None:
    engine = arm(0.005).engine
    assert engine.substeps(np.asarray([0.005, 0.00501, 0.0053])).tolist() == [1, 1, 2]


def test_forecasts_take_the_steps_of_the_fit() -> None:
    """Not 2 ms of their grid, nor 4 ms: rows of 10 ms are two steps of 5."""
    for step, period, every in (
        (0.005, 0.01, 5),
        (0.005, 0.008, 2),
        (0.005, 0.012, 2),
        (0.002, 0.01, 5),
        (0.005, 0.002, 1),
    ):
        grid = evaluation_windows([log_of(period, 201)], arm(step), longest=0.1)
        assert grid.every == every


def test_windows_of_two_periods_are_two_calls() -> None:
    """Oracle: each by itself, row by row."""
    engine, rng = arm(0.005).engine, np.random.default_rng(1)
    theta = np.tile([x[5] for x in servo_arm.LINKS], (3, 1)).astype(float)
    x0, u = 0.1 * rng.normal(size=(3, 12)), 0.1 * rng.normal(size=(3, 8, 6))
    span = np.full((3, 8), 0.005)
    span[1] = 0.004
    span[:, 0] = 0.0
    span[2, 3:] = 0.0
    found = engine.rollout(theta, x0, u, span)
    x = x0
    for k in range(8):
        x = engine.flow(theta, x, u[:, k], span[:, k])
        np.testing.assert_allclose(found[:, k], x, atol=1e-12)


def test_a_servos_damping_depends_on_the_step() -> None:
    """kp h / 2 of it: at twice the step as much more damping moves alike."""

    def rolled(step: float, damping: float) -> np.ndarray:
        text = SERVO.format(step=step, damping=damping)
        model = mujoco.MjModel.from_xml_string(text)
        data, out = mujoco.MjData(model), []
        for k in range(round(1.0 / step)):
            if k % round(0.02 / step) == 0:
                out.append(data.qpos[0])
                t = k * step
            data.ctrl[0] = 0.5 * np.sin(5.0 * t)
            mujoco.mj_step(model, data)
        return np.asarray(out)

    fine, plain = rolled(0.002, 1.0), rolled(0.004, 1.0)
    alike = rolled(0.004, 1.0 + 0.5 * 500 * 0.002)
    assert np.abs(alike - fine).max() < 0.2 * np.abs(plain - fine).max()
