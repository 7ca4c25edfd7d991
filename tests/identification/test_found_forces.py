"""Forces that are found: their sizes against closed forms, and planted ones."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import planted_forces as study
from sim2gp.data.one_step import OneStepLikelihood
from sim2gp.data.split_log import cut
from sim2gp.data.transitions import Transitions
from sim2gp.errors import NotFinite, error
from sim2gp.identification.missing_physics import forces
from sim2gp.identification.missing_physics.curves import Curve
from sim2gp.identification.missing_physics.data import (
    FREE,
    OneStepData,
    WindowData,
)
from sim2gp.identification.missing_physics.forces import (
    EXCLUDED,
    SHARE,
    FoundForces,
    _largest,
    _Linear,
    _of_free_size,
    _with_free_sizes,
    find_forces,
)
from sim2gp.inference.convergence import CONVERGED, NOT_FINITE, STALLED
from sim2gp.inference.estimate import Estimate, estimate
from sim2gp.inference.groups import Start, best_ended, estimate_groups
from sim2gp.inference.parameters import Parameter, Parameters
from sim2gp.inference.prior import ParameterPrior
from sim2gp.inference.relevance import OFF, TRIED
from sim2gp.systems import ODE, CartPole, Channel, UniformRodArm
from sim2gp.systems.effects.missing import missing_forces

COUNT, SD = 12, 0.02
SHAPE = np.random.default_rng(0).normal(size=(400, COUNT)) / 4.0
LARGE = 1.0  # one weight of all; the others are zero
MACHINES = Parameters(
    (
        Parameter("mass", "kg", "", "log", 0.0, np.inf, 0.0, 0.4),
        *(Parameter(f"w{k}", "N", "", "identity", group="w") for k in range(COUNT)),
    )
)


def pushed(weight: float = LARGE) -> OneStepLikelihood:
    """A mass that twelve weights push, of which one is there.

    Weights over the mass are what data determine; the mass has its prior.
    """
    rng = np.random.default_rng(1)
    after = SHAPE[:, 0] * weight + SD * rng.normal(size=400)

    def slope(k, s, a):
        weights = jnp.stack([k[f"w{i}"] for i in range(COUNT)])
        return jnp.stack([(a @ weights) / k["mass"]])

    states = (Channel("v", "m/s"),)
    actions = tuple(Channel(f"u{i}", "N", low=-5.0, high=5.0) for i in range(COUNT))
    system = ODE(slope, MACHINES, states, actions, max_substep=1.0)
    rows = Transitions.of(np.zeros((400, 1)), SHAPE, after[:, None])
    return OneStepLikelihood(system, jax.tree.map(jnp.asarray, rows), 1.0)


@pytest.mark.usefixtures("float64")
def test_free_sizes_are_not_drawn_to_zero_with_the_mass() -> None:
    """Data tell force over mass. The mass keeps its prior where sizes are free."""
    likelihood = pushed()
    about = ParameterPrior(MACHINES.prior(), MACHINES, jnp.ones(1))
    zero = jnp.zeros((1, COUNT + 1))
    best = jax.jit(lambda z: estimate(likelihood, about, starts=z))(zero)
    scale = np.diag(best.prior.scale)[1:2]
    assert 0.1 < float(scale[0]) < 0.5  # of twelve weights one is there
    drawn = float(best.posterior.mean[0])
    prior = about.scaled(jnp.asarray(scale / 0.1))
    wide = _with_free_sizes(likelihood, best, prior, np.inf)
    mass = wide.posterior.mean[0], wide.posterior.sd()[0]
    # log mass: prior 0 +- 0.4, drawn by twelve of its variances before.
    assert drawn < -0.4
    assert float(mass[0]) == pytest.approx(0.0, abs=0.05)
    assert float(mass[1]) == pytest.approx(0.4, rel=0.05)
    ratio = float(wide.posterior.mean[1]) / np.exp(float(mass[0]))
    assert ratio == pytest.approx(LARGE, abs=0.02)
    # The band of the weight has the mass's.
    assert float(wide.posterior.sd()[1]) == pytest.approx(0.4, rel=0.1)


@pytest.mark.usefixtures("float64")
def test_a_force_that_is_off_has_the_band_that_data_leave() -> None:
    """At the largest scale that costs no more than two nats: both by closed forms."""
    likelihood = pushed(0.0)
    about = ParameterPrior(MACHINES.prior(), MACHINES, jnp.full(1, OFF))
    zero = jnp.zeros((1, COUNT + 1))
    found = jax.jit(lambda z: estimate(likelihood, about, starts=z))(zero)
    off, prior_sd = about.scaled(about.scales_in(found.prior)), MACHINES.free[1].sd
    assert float(off.scales[0]) == pytest.approx(OFF)
    y, sd = np.asarray(likelihood.data.next_state)[:, 0], float(found.noise.sd[0])

    def gain(scale: float) -> float:
        C = sd**2 * np.eye(len(y)) + (scale * prior_sd) ** 2 * SHAPE @ SHAPE.T
        log = scipy.stats.multivariate_normal(cov=C).logpdf(y)
        return float(log - scipy.stats.norm(scale=sd).logpdf(y).sum())

    largest = float(_largest(found, off, 1.0)[0])
    assert largest == max(t for t in TRIED if gain(t) >= -EXCLUDED)
    assert float(_largest(found, off, 4.0)[0]) > largest
    wider = np.where(np.arange(COUNT + 1) > 0, largest / OFF, 1.0)
    data = OneStepData(likelihood.system, [(np.zeros((401, 1)), SHAPE)])
    linear = _Linear.of(data, likelihood, found)
    band, alike = linear.posterior(np.arange(COUNT + 1), wider)
    precision = SHAPE.T @ SHAPE / sd**2 + np.eye(COUNT) / (largest * prior_sd) ** 2
    covariance = np.linalg.inv(precision)
    np.testing.assert_allclose(band.covariance()[1:, 1:], covariance, rtol=1e-3)
    mean = covariance @ SHAPE.T @ y / sd**2
    np.testing.assert_allclose(band.mean[1:], mean, rtol=1e-3, atol=1e-6)
    assert alike == 1.0


@pytest.mark.usefixtures("float64")
def test_of_several_fits_the_one_that_ended_best_is_taken() -> None:
    """Then by evidence; what has stalled hides no start that was not taken."""
    likelihood = pushed()
    prior = ParameterPrior(MACHINES.prior(), MACHINES, jnp.ones(1))
    fit = estimate(likelihood, prior, starts=jnp.zeros((1, COUNT + 1)))
    skipped, nan = -1, np.nan

    def ended(k: int, status: int, evidence: float) -> Estimate:
        how = replace(fit.convergence, status=jnp.asarray(status), steps=jnp.asarray(k))
        return replace(fit, convergence=how, log_evidence=jnp.asarray(evidence))

    def taken(status: list[int], evidence: list[float]) -> int:
        pairs = zip(status, evidence, strict=True)
        each = [ended(k, *pair) for k, pair in enumerate(pairs)]
        several = jax.tree.map(lambda *x: jnp.stack([*map(jnp.asarray, x)]), *each)
        return int(best_ended(several).convergence.steps)

    assert taken([CONVERGED, CONVERGED, skipped], [1.0, 2.0, 3.0]) == 1
    assert taken([CONVERGED, STALLED, skipped], [1.0, 2.0, 3.0]) == 0
    assert taken([NOT_FINITE, STALLED, STALLED], [nan, -3.0, -2.0]) == 2
    assert taken([CONVERGED, STALLED, skipped], [nan, -3.0, 3.0]) == 1


def test_without_a_fit_there_are_no_forces(monkeypatch: pytest.MonkeyPatch) -> None:
    """The search for effects of the library has its answer all the same."""

    def fails(*args: object) -> FoundForces:
        raise error("fit_not_finite", NotFinite, where="the data")

    monkeypatch.setattr(forces, "_fitted", fails)
    states, inputs = np.random.default_rng(0).normal(size=(2, 9, 4)) / 9.0
    data = OneStepData(CartPole(), [(states, inputs[1:, :1])])
    found = find_forces(data, data.fit())
    assert (found.curves, found.each) == ((), {})
    assert "E203" in found.failure


def test_a_force_is_as_probable_as_the_functions_it_is_the_sum_of() -> None:
    def curve(where: str, mean: float) -> Curve:
        at, root = np.linspace(-1.0, 1.0, 21), 0.01 * np.eye(21)
        kinds = ("position_force", "ripple")
        return Curve(where, where, "N m", "rad", kinds, at, mean * np.sin(9 * at), root)

    both = curve("q1", 1.0), curve("q2", 1.0), curve("q3", 0.0)
    one = FoundForces({"": 0.1, "q1.ripple": 0.8, "q2.ripple": 0.2}, both)
    assert [c.name for c in one.found] == ["q1 by q1"]
    of_all = FoundForces({"": 0.1, "ripple": 0.8, "dry_friction": 0.9}, both)
    assert [c.name for c in of_all.found] == ["q1 by q1", "q2 by q2"]
    assert of_all.probability(both[0]) == 0.8


def test_other_shapes_of_a_force_are_part_of_its_curve() -> None:
    """A share of its size: of those of the same joint and variable, and of no other."""
    plant = UniformRodArm()
    names = [c.name for c in (*plant.states, *plant.actions)]
    each = missing_forces(plant, dict.fromkeys(names, (-1.0, 2.0)), closely=True)
    scales = np.asarray([0.2 if f.name == "q1.dry_friction" else OFF for f in each])
    found = zip(each, _of_free_size(scales, each), strict=True)
    size = {f.name: scale * f.magnitude for f, scale in found}
    friction = 0.2 * next(f for f in each if f.name == "q1.dry_friction").magnitude
    assert size.pop("q1.dry_friction") == pytest.approx(friction / FREE)
    for name in ("q1.velocity_force", "q1.detail.velocity_force"):
        assert size.pop(name) == pytest.approx(SHARE * friction)
    assert max(size.values()) == OFF * max(f.magnitude for f in each)


@pytest.mark.nightly
def test_a_detent_is_drawn_and_nothing_is_not() -> None:
    """The study in small: a detent on a cart's rail, and a cart without one."""
    found = study.inside_band(study.Case("cartpole", "notch", 4))
    assert found["reported"] == ["x by x"]
    assert found["inside"] > 0.9
    assert found["error"] < 0.2 * found["size"]
    data, _, _ = study.data_for(study.Case("cartpole", study.NOTHING, 4))
    assert find_forces(data, data.fit()).found == ()


@pytest.mark.nightly
def test_fits_without_a_force_need_their_evidence_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each ends away from its MAP here; the fit that is drawn does not."""

    def ends(
        likelihood: Any, prior: ParameterPrior, last: Start, freedom: float
    ) -> Estimate:
        fit = estimate_groups(likelihood, prior, last, freedom)
        if not bool(last.enough):  # the first
            return fit
        how = {"status": jnp.asarray(STALLED), "newton_step_sd": jnp.asarray(0.1)}
        return replace(fit, convergence=replace(fit.convergence, **how))

    monkeypatch.setattr(forces, "estimate_groups", ends)
    found = study.inside_band(study.Case("cartpole", "notch", 4))
    assert found["reported"] == ["x by x"]


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("shape", "index"), [("cable", 1001), ("stribeck", 1010), ("stribeck", 1061)]
)
def test_a_force_on_an_arm_is_within_its_band(shape: str, index: int) -> None:
    """In windows of a log: a cable, and friction of another shape than ours."""
    found = study.inside_band(study.Case(study.ARM, shape, index))
    assert found["named"]
    assert found["inside"] > 0.9


@pytest.mark.nightly
def test_a_weak_cable_is_likely_and_within_its_band() -> None:
    """Its band is as wide as it is large, and has zero in it: it has no name."""
    found = study.inside_band(study.Case(study.ARM, "cable", 1016))
    assert found["probability"]["q1.pull.position_force"] > 0.95
    assert found["inside"] > 0.9


@pytest.mark.nightly
@pytest.mark.parametrize("robust", [True, False])
def test_pushes_hide_no_force_where_the_fit_is_robust(robust: bool) -> None:
    """A detent on an arm, and errors of four of fifty windows that are as large."""
    log, _ = study.arm_log_of(study.Case(study.ARM, "notch", 5))
    q1 = log.channels["q1"].copy()
    for row in (105, 345, 585, 825):
        q1[row : row + 10] += 0.5 * np.sin(np.pi * np.arange(10) / 9.0)
    pushed = replace(log, channels=log.channels | {"q1": q1})

    def windows(machine: Any) -> Any:
        return cut([pushed], machine, window=study.WINDOW)[0]

    one = np.zeros(50, int)
    data = WindowData(UniformRodArm(), windows, np.arange(50) // 5, one, robust=robust)
    found = find_forces(data, data.fit())
    assert [c.name for c in found.found] == ["q1 by q1"] * robust
