"""Information gain: log determinants, Kalman's telescoping sum, nested Monte Carlo."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2gp.inference.information import Seen, increments, joint

pytestmark = pytest.mark.usefixtures("float64")

SHAPES = [(6, 2, 3, 5), (6, 2, 3, 0), (6, 3, 0, 4), (1, 2, 3, 4), (9, 1, 2, 3)]


def rows(T: int, d: int, p: int, m: int, seed: int = 0):
    """Sensitivities, and the same as one matrix over all coordinates."""
    rng = np.random.default_rng(seed)
    shared, own = rng.standard_normal((T, d, p)), rng.standard_normal((T, d, m))
    A = np.zeros((T, d, p + d * m))
    A[:, :, :p] = shared
    for k in range(d):
        A[:, k, p + k * m : p + (k + 1) * m] = own[:, k]
    return jnp.asarray(shared), jnp.asarray(own), A


def nats(A: np.ndarray) -> float:
    A = A.reshape(-1, A.shape[-1])
    return 0.5 * float(np.linalg.slogdet(np.eye(len(A)) + A @ A.T)[1])


@pytest.mark.parametrize("shape", SHAPES)
def test_a_trajectory_tells_the_log_determinant(shape):
    shared, own, A = rows(*shape)
    assert float(joint(shared, own)) == pytest.approx(nats(A), rel=1e-12)


@pytest.mark.parametrize("shape", SHAPES)
def test_steps_tell_what_those_before_them_left(shape):
    shared, own, A = rows(*shape)
    totals = [nats(A[: t + 1]) for t in range(shape[0])]
    steps = np.diff([0.0, *totals])
    np.testing.assert_allclose(increments(shared, own), steps, rtol=1e-11)
    single = increments(shared.astype(jnp.float32), own.astype(jnp.float32))
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single, steps, rtol=1e-4)


@pytest.mark.parametrize("shape", SHAPES)
def test_what_was_done_leaves_less_to_learn(shape):
    """Seen in any order, then planned: the same as planned in one piece."""
    T, d, p, m = shape
    shared, own, A = rows(*shape)
    seen, total = Seen.nothing(d, p, m), 0.0
    after, gains = eqx.filter_jit(Seen.after), eqx.filter_jit(increments)
    for t in reversed(range(T)):
        if t in (0, T // 2):  # what was not done yet
            answer = float(jnp.sum(gains(*seen.left(shared[: t + 1], own[: t + 1]))))
            assert answer == pytest.approx(nats(A) - nats(A[t + 1 :]), abs=1e-11)
        total += float(gains(*seen.left(shared[t : t + 1], own[t : t + 1]))[0])
        seen = after(seen, shared[t], own[t])
    assert total == pytest.approx(nats(A), rel=1e-12)


def test_a_second_look_without_noise_tells_nothing_more():
    """Rounding is not information: float32, rows of 300 noise sd, seen 30 times."""
    shared, own, _ = rows(1, 2, 3, 4)
    many = [
        jnp.repeat(300.0 * x, 30, axis=0).astype(jnp.float32) for x in (shared, own)
    ]
    answer = np.asarray(increments(*many))
    assert np.all(answer >= 0.0)
    assert answer[0] > 10.0
    # The k-th look at one direction tells log sqrt(k / (k - 1)) of each output.
    assert np.sum(answer[1:]) == pytest.approx(np.log(30.0), rel=0.02)


@pytest.mark.nightly
def test_closed_form_against_nested_monte_carlo():
    """``E log p(y|x,e) - log p(y|x)``, the inner mean over 4096 draws."""
    shared, own, A = rows(2, 2, 2, 1, seed=3)
    A = 0.7 * A.reshape(4, -1)
    closed = float(joint(0.7 * shared, 0.7 * own))
    outer, inner = jax.random.split(jax.random.key(0))
    e = jax.random.normal(outer, (4000, A.shape[1]))
    y = e @ A.T + jax.random.normal(jax.random.fold_in(outer, 1), (4000, 4))
    others = jax.random.normal(inner, (4096, A.shape[1])) @ A.T

    def log_density(y, mean):
        return -0.5 * jnp.sum((y - mean) ** 2, axis=-1)

    marginal = jax.vmap(lambda y: jax.nn.logsumexp(log_density(y[None], others)))(y)
    gains = log_density(y, e @ A.T) - (marginal - np.log(4096))
    error = float(jnp.std(gains)) / np.sqrt(4000)
    assert abs(float(jnp.mean(gains)) - closed) < 4.0 * error
    assert error < 0.05 * closed
