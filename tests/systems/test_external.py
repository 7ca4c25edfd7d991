"""Simulators on the host: values, derivatives both ways, batches, precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2gp.systems.plants.external import AbstractSimulator, Differences, flow
from sim2gp.types import in_float64

THETA = np.array([1.3, 0.2])
S, A, H = np.array([0.4, -0.7]), np.array([0.5]), np.array(0.01)


class Pendulum(AbstractSimulator):
    """``w' = w + h (a - g sin q - c w), q' = q + h w'``; counts its calls."""

    def __init__(self) -> None:
        self.differences = Differences(np.ones(2), np.zeros(2), np.full(2, np.inf))
        self.rows: list[int] = []

    def flow(self, theta, s, a, h):
        assert theta.dtype == s.dtype == a.dtype == h.dtype == np.float64
        assert (theta >= self.differences.low).all()
        self.rows.append(len(s))
        return np.stack(formula(np, theta.T, s.T, a.T, h), axis=1)


def formula(xp, theta, s, a, h):
    w = s[1] + h * (a[0] - theta[0] * xp.sin(s[0]) - theta[1] * s[1])
    return s[0] + h * w, w


def exact(theta, s, a, h):
    return jnp.stack(formula(jnp, theta, s, a, h))


def arguments(dtype=float):
    return tuple(jnp.asarray(x, dtype) for x in (THETA, S, A, H))


@in_float64
def test_values_are_the_simulators_to_the_last_bit() -> None:
    """Through `jit`, whatever thread its callback runs in."""
    host = Pendulum()
    expected = host.flow(THETA[None], S[None], A[None], H[None])[0]
    f = jax.jit(lambda *x: flow(host, *x))
    for _ in range(3):
        np.testing.assert_array_equal(f(*arguments()), expected)
    np.testing.assert_array_equal(flow(host, *arguments()), expected)


def test_float32_is_computed_in_float64_and_rounded_once() -> None:
    host = Pendulum()
    x = arguments(jnp.float32)
    expected = host.flow(*(np.asarray(v, float)[None] for v in x))[0]
    found = jax.jit(lambda *x: flow(host, *x))(*x)
    assert found.dtype == jnp.float32
    np.testing.assert_array_equal(found, expected.astype(np.float32))


@in_float64
def test_derivatives_are_right_forward_and_reverse() -> None:
    """In constants, state and input, against those of the formula."""
    host = Pendulum()
    for i in range(3):
        expected = jax.jacfwd(exact, i)(*arguments())
        for mode in (jax.jacfwd, jax.jacrev):
            found = jax.jit(mode(lambda *x: flow(host, *x), i))(*arguments())
            np.testing.assert_allclose(found, expected, rtol=2e-8, atol=1e-9)


@in_float64
def test_a_scan_of_a_batch_is_one_call_a_step() -> None:
    """A derivative of a batch of rollouts: each step asks once, for all points."""
    host = Pendulum()

    def rollout(f, theta, s):
        def step(s, _):
            s2 = f(theta, s, *arguments()[2:])
            return s2, s2

        return jax.lax.scan(step, s, None, length=5)[1]

    batch = jnp.asarray(S + 0.1 * np.arange(6.0)[:, None])
    slope = jax.jit(jax.vmap(jax.jacfwd(rollout, 1), (None, None, 0)), static_argnums=0)
    mine = lambda *x: flow(host, *x)  # noqa: E731
    found = slope(mine, jnp.asarray(THETA), batch)
    np.testing.assert_allclose(
        found, slope(exact, jnp.asarray(THETA), batch), rtol=1e-7, atol=1e-10
    )
    assert host.rows == [6 * (1 + 2 * 5)] * 5


@in_float64
def test_differences_do_not_cross_a_bound() -> None:
    """At its edge the derivative is the one from inside (asserted in `Pendulum`)."""
    host = Pendulum()
    theta = jnp.asarray([1.3, 0.0])
    found = jax.jacfwd(lambda t: flow(host, t, *arguments()[1:]))(theta)
    expected = jax.jacfwd(lambda t: exact(t, *arguments()[1:]))(theta)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("rows", [1, 40_000])
def test_large_batches_come_back(rows: int) -> None:
    """Several megabytes: JAX copies those in another thread, and may wait for it."""
    host = Pendulum()
    theta, _, a, h = arguments(jnp.float32)
    many = jnp.asarray(
        np.zeros((rows, 2)) + 1e-4 * np.arange(rows)[:, None], jnp.float32
    )
    f = jax.jit(jax.vmap(lambda s: flow(host, theta, s, a, h)))
    for _ in range(3):
        found = f(many)
    expected = jax.vmap(lambda s: exact(theta, s, a, h))(many)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
