"""Inputs that arrive late: earlier inputs explain what forces leave over."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sim2gp as sg
from sim2gp.data.one_step import OneStepLikelihood
from sim2gp.data.transitions import Transitions
from sim2gp.models import late_inputs
from sim2gp.models.late_inputs import arrive_late
from sim2gp.systems import Coulomb, DeadZone, Delay, Furuta, Machine

DT, NOISE = 0.02, np.asarray([1e-3, 1e-3, 0.02, 0.02])
REACH = {"theta": 2.0, "theta.velocity": 15.0, "alpha.velocity": 25.0}


def episode(machine: Machine, steps: int = 250) -> Transitions:
    """Of a feedback that holds the arm near zero, under other inputs as well."""
    rng, m = np.random.default_rng(0), machine.history
    with jax.enable_x64(True):
        step = eqx.filter_jit(machine.bind(machine.nominal(), DT))
        s, rows = np.zeros(4 + m), []
        for _ in range(steps):
            a = np.clip(-6.0 * s[:1] - 0.4 * s[2:3] + rng.normal(size=1) * 2.0, -5, 5)
            s2 = np.array(step(jnp.asarray(s), jnp.asarray(a)))
            s2[:4] += NOISE * rng.normal(size=4)
            rows.append((s[:4], a, s2[:4]))
            s = s2
    return Transitions.of(*(np.stack(x) for x in zip(*rows, strict=True)))


def late(data: Transitions) -> bool:
    """Of the simulator alone, at the prior's mean."""
    with jax.enable_x64(True):
        prior = Furuta().parameters.prior()
        likelihood = OneStepLikelihood(Furuta(), data, DT)
        return arrive_late(likelihood, prior, prior)


def test_a_delay_shows_in_earlier_inputs_and_friction_does_not() -> None:
    delayed = Machine(Furuta(), actuators=[Delay("voltage", 0.01)], period=DT)
    assert late(episode(delayed))
    assert not late(episode(Machine(Furuta())))
    assert not late(episode(Machine(Furuta(), effects=[Coulomb("theta", 2e-3)])))


def test_the_test_is_that_of_a_linear_regression(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """F ratio and share by their textbook's sums; a share alone is not enough."""
    rng = np.random.default_rng(1)
    J, past = rng.normal(size=(60, 3)), rng.normal(size=(60, 2))
    r = J @ [1.0, 2.0, -1.0] + past @ [0.5, 0.2] + rng.normal(size=60)
    Q, _ = np.linalg.qr(J)
    e, P = r - Q @ (Q.T @ r), past - Q @ (Q.T @ past)
    gained = float(e @ P @ np.linalg.solve(P.T @ P, P.T @ e))
    ratio = gained / 2 / ((float(e @ e) - gained) / 55)
    p = float(jax.scipy.special.betainc(27.5, 1.0, 55 / (55 + 2 * ratio)))
    assert late_inputs._explain(past, r, J, 1.01 * p)
    assert not late_inputs._explain(past, r, J, 0.99 * p)
    monkeypatch.setattr(late_inputs, "SHARE", 1.01 * gained / float(e @ e))
    assert not late_inputs._explain(past, r, J, 1.01 * p)


@pytest.mark.nightly  # two minutes
@pytest.mark.parametrize(
    ("machine", "forces"),
    [
        (Machine(Furuta(), effects=[Coulomb("theta", 2e-3)]), ["theta.dry_friction"]),
        (Machine(Furuta(), effects=[DeadZone("voltage", 1.2)]), ["voltage.dead_zone"]),
        (Machine(Furuta(), actuators=[Delay("voltage", 0.01)], period=DT), []),
    ],
    ids=["friction", "dead zone", "delay"],
)
def test_what_turns_suddenly_is_found_alone(machine: Machine, forces: list) -> None:
    """At the noise that there is; and under a delay no force is."""
    model, data = sg.MissingForces(sg.Sim2GP(Furuta()), reach=REACH), episode(machine)
    belief = model.fit(model.init(jax.random.key(0)), data, key=jax.random.key(0))
    assert list(belief.system.parameters.groups) == forces
    if forces:
        np.testing.assert_allclose(belief.noise, NOISE, rtol=0.2)
