"""Corrected intervals of MuJoCo models: the forces are torques, as in a bundled arm."""

from typing import Any

import jax
import numpy as np
import pytest

import payload_arm
from interval_arms import CONDITIONS, Recordings, recordings
from interval_mujoco import mujoco_arm
from sim2gp.data import windows_likelihood
from sim2gp.data.split_log import cut
from sim2gp.data.windows_likelihood import WindowsLikelihood
from sim2gp.identification.fit import fit_windows
from sim2gp.identification.intervals import pulls
from sim2gp.identification.intervals.discrepancy import corrected_windows
from sim2gp.identification.missing_physics.at_zero import at_zero, forces_of
from sim2gp.systems import UniformRodArm, free_parts
from sim2gp.systems.effects.bases import Sign
from sim2gp.systems.effects.forces import MissingForce
from sim2gp.types import in_float64

pytest.importorskip("mujoco", reason="the extra `mujoco` is not installed")

FRICTION = CONDITIONS["mujoco_friction20"]


def arms(condition: Any = FRICTION) -> Recordings:
    """Three hidden arms, moved by MuJoCo itself."""
    return recordings(condition, 3, 0)


def fitted(system: Any, log: Any) -> tuple[WindowsLikelihood, Any, np.ndarray]:
    windows, of = cut([log], system, window=0.2)
    found = fit_windows(system, windows, key=jax.random.key(0))
    return WindowsLikelihood(system, windows), found, np.asarray([k for k, _ in of])


@in_float64
@pytest.mark.nightly  # 15 s; also a row of benchmarks/intervals.py
def test_friction_that_the_model_lacks_is_found_and_the_truth_is_inside() -> None:
    """The plain interval of a damping is tens of sd away from its truth."""
    data, system = arms(), mujoco_arm()
    likelihood, found, group = fitted(system, data.log(1))
    corrected = corrected_windows(at_zero(likelihood, found, group))
    assert max(corrected.each, key=corrected.each.__getitem__) == "dry_friction"
    apart = np.abs(corrected.posterior.mean - data.truth[1])
    assert np.all(apart < 3.0 * corrected.posterior.sd())
    apart = np.abs(found.posterior.mean - data.truth[1])
    assert np.max(apart / found.posterior.sd()) > 6.0
    curve = next(c for c in corrected.found if c.name == "q1 by q1.velocity")
    assert curve.unit == "N m"
    # Against the velocity, of 20 mN m, to two sd of the curve.
    fast = np.abs(curve.at) > 0.3 * np.max(curve.at)
    expected = -FRICTION.friction * np.sign(curve.at)
    assert np.all(np.abs(curve.mean - expected)[fast] < 2.5 * curve.sd[fast])


@pytest.mark.nightly  # 7 s; missing friction is found by day
@in_float64
def test_a_fit_has_a_free_force_on_the_host() -> None:
    """Its prior is as wide as it says: the host keeps the scale."""
    data = arms()
    forces = [
        MissingForce(q, 0.05, Sign((FRICTION.width,)), of_velocity=True, what="dry")
        for q in ("q1", "q2")
    ]
    system = free_parts(mujoco_arm(), forces)
    _, found, _ = fitted(system, data.log(2))
    p = len(mujoco_arm().parameters)
    size, sd = (np.asarray(x)[p:] for x in (found.posterior.mean, found.posterior.sd()))
    assert np.all(np.abs(size - FRICTION.friction) < 3.0 * sd)
    assert np.all(sd < 0.5 * FRICTION.friction)


@pytest.mark.nightly  # 12 s
@in_float64
def test_windows_at_a_time_say_the_same_as_all_at_once(monkeypatch: Any) -> None:
    likelihood, found, _ = fitted(mujoco_arm(), arms().log(0))
    tt, group = found.posterior.mean, np.zeros(len(likelihood.windows), int)
    whole = pulls.rows_of(likelihood, found, tt, group)
    e, scale = (np.asarray(x) for x in (found.nuisances, found.prior.scale))
    trial = likelihood.trial(np.asarray(tt), e, scale)
    blocks = trial.blocks()
    monkeypatch.setattr(windows_likelihood, "TOGETHER", 1)
    parts = pulls.rows_of(likelihood, found, tt, group)
    grams = (np.swapaxes(x.factors, 1, 2) @ x.factors for x in (parts, whole))
    np.testing.assert_allclose(*grams, atol=1e-9 * np.max(whole.factors) ** 2)
    np.testing.assert_allclose(parts.costs, whole.costs, rtol=1e-9)
    again = likelihood.trial(np.asarray(tt), e, scale)
    np.testing.assert_allclose(again.squares, trial.squares, rtol=1e-12)
    np.testing.assert_allclose(again.blocks(), blocks, atol=1e-12 * np.max(blocks))


@in_float64
def test_forces_are_of_plants_that_take_them() -> None:
    box = dict.fromkeys(["q1", "q2", "q1.velocity", "q2.velocity"], (-1.0, 1.0))
    box |= dict.fromkeys(["torque1", "torque2"], (-1.0, 1.0))
    mine, bundled = (forces_of(x, box) for x in (mujoco_arm(), UniformRodArm()))
    assert [f.name for f in mine] == [f.name for f in bundled]
    names = ("q1", "q2")
    for one, other in zip(mine, bundled, strict=True):
        # Those of the same motors on the same arm, but for what the other motor moves.
        share = one.magnitude / other.magnitude
        assert 0.3 < share < 3.0 if one.where in names else share == 1.0
        if one.where in names:
            assert one.unit(mujoco_arm()) == other.unit(UniformRodArm())
    assert forces_of(payload_arm.arm(), box) == ()
