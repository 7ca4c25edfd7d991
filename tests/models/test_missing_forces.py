"""A simulator that finds the force it lacks, and none where nothing is missing."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sim2gp as sg
from sim2gp.data.one_step import estimate_forces
from sim2gp.data.transitions import Transitions
from sim2gp.errors import Sim2GPWarning
from sim2gp.inference.convergence import STALLED
from sim2gp.models import missing_forces
from sim2gp.studies.learners import misfit_of_belief
from sim2gp.systems import Furuta, Machine, Spring

KEY = jax.random.key(0)
DT, ROWS, STIFFNESS = 0.02, 200, 0.02
NOISE = np.asarray([1e-3, 1e-3, 0.02, 0.02])
REACH = {"theta": 2.0, "theta.velocity": 15.0, "alpha.velocity": 25.0}
MODEL = sg.MissingForces(sg.Sim2GP(Furuta()), reach=REACH)


def recorded(parts, seed=0, arm=1.5) -> Transitions:
    """Steps of a machine from states all over, under random inputs."""
    rng = np.random.default_rng(seed)
    machine = Machine(Furuta(), effects=parts)
    s = rng.uniform(-1.0, 1.0, (ROWS, 4)) * [arm, 3.0, 8.0, 12.0]
    a = rng.uniform(-5.0, 5.0, (ROWS, 1))
    with jax.enable_x64(True):
        # Twice as finely as the model is, as a true machine with effects.
        half = machine.bind(machine.nominal(), 0.5 * DT)
        step = jax.jit(jax.vmap(lambda s, a: half(half(s, a), a)))
        s2 = np.asarray(step(jnp.asarray(s), jnp.asarray(a)))
    return Transitions.of(s, a, s2 + NOISE * rng.normal(size=s.shape))


def on(belief) -> list[str]:
    """The forces that a fit has turned on."""
    return list(belief.system.parameters.groups)


@pytest.fixture(scope="module")
def with_spring():
    data = recorded([Spring("theta", STIFFNESS)])
    return MODEL.fit(MODEL.init(KEY), data, key=KEY), data


def test_before_data_it_is_the_simulator():
    plain = sg.Sim2GP(Furuta())
    s, a = jnp.asarray([0.3, 1.0, 2.0, -3.0]), jnp.asarray([2.0])
    ours, theirs = (m.init(KEY).predict(s, a) for m in (MODEL, plain))
    np.testing.assert_allclose(ours.mean, theirs.mean, atol=1e-9)
    with jax.enable_x64(True):
        np.testing.assert_allclose(ours.sd(), theirs.sd(), rtol=1e-5)
    assert on(MODEL.init(KEY)) == []
    assert len(MODEL.system.parameters.groups) == 8


def test_a_spring_is_found_as_a_force_of_the_arms_position(with_spring):
    """By that group alone, with the noise that there is, and as the right curve."""
    belief, data = with_spring
    assert on(belief) == ["theta.position_force"]
    np.testing.assert_allclose(belief.noise, NOISE, rtol=0.25)
    assert not misfit_of_belief(belief, data).alarm

    table, (force,) = belief.system.parameters, belief.system.effects
    at = table.groups[force.name]
    # Torques and masses are known up to one factor: what it does is comparable.
    with jax.enable_x64(True):
        values = table.values(belief.posterior.mean)
        M = Furuta().mass_matrix(Furuta().record(values), jnp.zeros(2))
        true = Furuta().mass_matrix(Furuta().nominal(), jnp.zeros(2))
        ratio = float(M[0, 0] / true[0, 0])
        for angle in (-1.2, -0.5, 0.6, 1.3):
            w = belief.posterior.mean[at]
            got = force.basis.value(w, jnp.asarray(angle)) / ratio
            features = force.basis.slope(jnp.zeros_like(w), jnp.asarray(angle))
            assert float(features) == 0.0
            assert float(got) == pytest.approx(-STIFFNESS * angle, abs=1.5e-3)


def test_a_fit_that_ends_nowhere_is_the_simulators_own(
    with_spring, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What no force of one variable can be may keep a descent from its end."""
    _, data = with_spring

    def stalled(*args):
        found = estimate_forces(*args)
        status = lambda f: f.convergence.status  # noqa: E731
        return eqx.tree_at(status, found, jnp.full_like(status(found), STALLED))

    monkeypatch.setattr(missing_forces, "estimate_forces", stalled)
    with pytest.warns(Sim2GPWarning, match="W204"):
        belief = MODEL.fit(MODEL.init(KEY), data, key=KEY)
    plain = sg.Sim2GP(Furuta())
    alone = plain.fit(plain.init(KEY), data, key=KEY)
    np.testing.assert_array_equal(belief.posterior.mean, alone.posterior.mean)
    assert on(belief) == []


@pytest.mark.nightly  # 15 s; the curve is compared by day
def test_it_predicts_what_the_simulator_alone_cannot(with_spring):
    """Steps that it has not seen: the simulator alone calls the spring noise."""
    belief, data = with_spring
    plain = sg.Sim2GP(Furuta())
    alone = plain.fit(plain.init(KEY), data, key=KEY)
    new = recorded([Spring("theta", STIFFNESS)], seed=1)
    s, a = jnp.asarray(new.state[:20]), jnp.asarray(new.action[:20])

    def error(b):
        with jax.enable_x64(True):
            got = jax.vmap(lambda s, a: b.predict(s, a).mean)(s, a)
        return np.sqrt(np.mean((np.asarray(got) - new.next_state[:20])[:, 2] ** 2))

    assert error(belief) < 1.3 * NOISE[2]
    assert error(alone) > 3.0 * error(belief)
    assert float(belief.log_evidence) > float(alone.log_evidence) + 100.0
    assert misfit_of_belief(alone, data).alarm


def test_where_nothing_is_missing_all_forces_go_off():
    """And the simulator's own fit is what is left."""
    data = recorded([])
    belief = MODEL.fit(MODEL.init(KEY), data, key=KEY)
    assert on(belief) == []
    plain = sg.Sim2GP(Furuta())
    alone = plain.fit(plain.init(KEY), data, key=KEY)
    assert float(belief.log_evidence) == pytest.approx(
        float(alone.log_evidence), abs=1.0
    )
    (mean, sd), (theirs, _) = belief.parameters(), alone.parameters()
    assert mean.shape == theirs.shape == (8,)
    np.testing.assert_allclose((mean - theirs) / sd, 0.0, atol=0.3)


def test_an_update_narrows_the_forces_that_are_on(with_spring):
    """Transition by transition, as the linearised model says."""
    belief, _ = with_spring
    s, a = jnp.asarray([1.0, 0.2, 1.0, -2.0]), jnp.asarray([1.0])
    with jax.enable_x64(True):
        s, a = jnp.asarray(s, float), jnp.asarray(a, float)
        updated = MODEL.update(belief, s, a, belief.predict(s, a).mean)
        before, after = belief.latent(s, a).sd(), updated.latent(s, a).sd()
    assert (after < before).all()
    assert int(updated.count) == int(belief.count) + 1


def test_of_the_simulator_alone_the_forces_are_averaged(with_spring):
    """Marginals, and the Schur complement of the information: in covariances."""
    belief, _ = with_spring
    alone = belief.without_functions()
    own = slice(0, 8)
    pairs = (belief.posterior, alone.posterior), (belief.prior, alone.prior)
    for whole, part in pairs:
        np.testing.assert_array_equal(part.mean, whole.mean[own])
        root, got = np.asarray(whole.scale), np.asarray(part.scale)
        C = (root @ root.T)[own, own]
        unit = np.sqrt(np.outer(np.diag(C), np.diag(C)))
        np.testing.assert_allclose(got @ got.T / unit, C / unit, atol=1e-9)
    L0 = np.asarray(belief.prior.scale)
    C = np.linalg.solve(L0, np.asarray(belief.posterior.scale))
    precision = np.linalg.inv((C @ C.T)[own, own]) - np.eye(8)
    A = np.asarray(alone.information)
    np.testing.assert_allclose(A.T @ A, precision, rtol=1e-4, atol=1e-6)


def test_reaches_grow_until_functions_hold_the_data():
    """By doubling, of channels that do not turn, where data are far beyond."""
    s = np.zeros((40, 4))
    s[7] = [7.9, 90.0, 18.0, -49.0]
    model = MODEL.holding(Transitions.of(s, np.zeros((40, 1)), s))
    wider = {"theta": 8.0, "alpha.velocity": 50.0}
    assert dict(model.reach) == REACH | wider
    forces = {f.name: f.basis for f in model.forces}
    same = [f.name for f in MODEL.forces if forces[f.name] == f.basis]
    assert len(forces) == len(MODEL.forces) == len(same) + 2
    inside = Transitions.of(s[:5], np.zeros((5, 1)), s[:5])
    assert MODEL.holding(inside) is MODEL


def test_a_spring_is_found_far_beyond_the_reach(with_spring):
    """By the same program; once the data are near again, as the narrower function."""
    compiled = estimate_forces._jitted._cached._cache_size()
    data = recorded([Spring("theta", 0.1 * STIFFNESS)], arm=20.0)
    belief = MODEL.fit(MODEL.init(KEY), data, key=KEY)
    assert on(belief) == ["theta.position_force"]
    np.testing.assert_allclose(belief.noise, NOISE, rtol=0.3)
    draw, s = belief.sample(KEY), jnp.asarray([18.0, 0.2, 1.0, -2.0])
    shared, ours = MODEL.shared(draw), MODEL.shared(with_spring[0].sample(KEY))
    np.testing.assert_allclose(shared(s, s[:1]), draw(s, s[:1]), rtol=1e-5)
    assert jax.tree.structure(shared) == jax.tree.structure(ours)
    near = MODEL.fit(belief, recorded([Spring("theta", STIFFNESS)]), key=KEY)
    assert on(near) == ["theta.position_force"]
    np.testing.assert_allclose(near.noise, NOISE, rtol=0.3)
    assert near.system.effects[0].basis.span == MODEL.forces[0].basis.span
    assert estimate_forces._jitted._cached._cache_size() == compiled


def test_a_draw_is_the_same_with_all_forces(with_spring):
    """Of the machine with one force, and of the one with all: the same function."""
    belief, _ = with_spring
    draw = belief.sample(KEY)
    shared = MODEL.shared(draw)
    assert len(shared.tt) > len(draw.tt)
    wide = jax.tree.structure(MODEL.wide.system)  # no friction is on
    assert jax.tree.structure(shared.system) == wide
    s, a = jnp.asarray([1.0, 0.2, 1.0, -2.0]), jnp.asarray([1.0])
    np.testing.assert_allclose(shared(s, a), draw(s, a), rtol=1e-5)
    plain = MODEL.init(KEY).sample(KEY)
    assert jax.tree.structure(MODEL.shared(plain)) == jax.tree.structure(shared)
