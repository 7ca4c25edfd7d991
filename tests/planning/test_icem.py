"""iCEM's parts: budget, memory, execution, the shares of its noise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from double_integrator import KEY, S0, act, world
from sim2gp.planning import ICEM, MPC, Plan


class Recorder:
    """Evaluates sequences by a linear score and keeps what it was shown."""

    def __init__(self, direction: Array) -> None:
        self.direction, self.seen = direction, []

    def __call__(self, U: Array) -> tuple[Array, Array]:
        returns = jnp.einsum("ntm,tm->n", U, self.direction)
        self.seen.append((np.asarray(U), np.asarray(returns)))
        return returns, jnp.ones(len(U), bool)


def test_icem_budget_memory_and_execution() -> None:
    rule = ICEM(samples=40, iterations=3, elites=8, decay=1.0 + 1e-12)  # not scanned
    w = world()
    direction = jax.random.normal(jax.random.key(5), (25, 1))
    plan = Plan(
        jnp.full((25, 1), 0.2),
        jax.random.uniform(KEY, (8, 25, 1), minval=-1.0),
        jnp.asarray(40),
    )
    recorder = Recorder(direction)
    sequence, after = rule.improve(plan, recorder, w, key=KEY)
    shapes = [U.shape for U, _ in recorder.seen]
    assert shapes == [(40, 25, 1), (39, 25, 1), (39, 25, 1)]
    for U, _ in recorder.seen:
        assert np.abs(U).max() <= 1.0
    # Elites of the step before compete first; the best of a round in the next round.
    np.testing.assert_array_equal(recorder.seen[0][0][-2:], plan.elites[:2])
    U, returns = recorder.seen[1]
    best = U[np.argsort(-returns)[:2]]
    np.testing.assert_array_equal(recorder.seen[2][0][-2:], best)
    # The best sequence ever seen is executed.
    everything = max(float(returns.max()) for _, returns in recorder.seen)
    value = float(jnp.sum(sequence * direction))
    assert value == pytest.approx(everything, rel=1e-6)
    np.testing.assert_array_equal(sequence, after.elites[0])
    # The mean competes in the last round, and only there.
    U, returns = recorder.seen[1]
    elites = U[np.argsort(-returns)[:8]]
    # Reconstructed from the outside: mean_2 = .1 mean_1 + .9 mean(elites_2).
    first_U, first_returns = recorder.seen[0]
    mean_1 = 0.02 + 0.9 * first_U[np.argsort(-first_returns)[:8]].mean(axis=0)
    mean_2 = 0.1 * mean_1 + 0.9 * elites.mean(axis=0)
    np.testing.assert_allclose(recorder.seen[2][0][0], mean_2, atol=1e-6)


def test_scanned_and_unrolled_iterations_agree() -> None:
    scanned, unrolled = (
        act(MPC(ICEM(decay=decay)), plan, world(), S0, key=KEY)
        for decay in (1.0, 1.0 - 1e-13)
        for plan in [MPC(ICEM()).init(world(), key=KEY)]
    )
    np.testing.assert_allclose(scanned[0], unrolled[0], atol=1e-5)
    np.testing.assert_allclose(scanned[1].plan.mean, unrolled[1].plan.mean, atol=1e-5)


@pytest.mark.nightly
def test_decay_shrinks_the_population_down_to_two_elites() -> None:
    rule = ICEM(samples=128, iterations=4, elites=10, decay=2.0)
    recorder = Recorder(jnp.ones((25, 1)))
    rule.improve(rule.init(25, 1, jnp.dtype("float32")), recorder, world(), key=KEY)
    assert [len(U) for U, _ in recorder.seen] == [128, 64, 32, 20]


def test_noise_falls_geometrically_from_the_first_sequence_to_the_last() -> None:
    rule = ICEM(  # not scanned
        samples=20, iterations=1, elites=10, sd=0.1, finest=0.2, decay=1.0 + 1e-12
    )
    plan = rule.init(25, 1, jnp.dtype("float32"))
    drawn = []
    for key in jax.random.split(KEY, 60):
        recorder = Recorder(jnp.ones((25, 1)))
        rule.improve(plan, recorder, world(), key=key)
        drawn.append(recorder.seen[0][0])
    rms = np.sqrt(np.mean(np.square(drawn), axis=(0, 2, 3)))
    # The first one is the mean (last round), three of the end are old elites.
    share = 0.1 * 0.2 ** (np.arange(20) / 19)
    np.testing.assert_allclose(rms[1:17], share[1:17], rtol=0.3)
