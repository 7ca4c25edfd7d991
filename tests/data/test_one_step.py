"""Rows of a run that has room for more: as many are computed as there are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import linear_system
from sim2gp.data.one_step import OneStepLikelihood
from sim2gp.data.transitions import Transitions
from sim2gp.inference.linearized import BLOCK, in_blocks


@pytest.mark.parametrize("count", [7, BLOCK, BLOCK + 1, 3 * BLOCK - 2])
def test_blocks_are_the_whole(count: int) -> None:
    """Each row as alone; a block that is masked is zero, whatever stands in it."""
    rng = np.random.default_rng(0)
    x = jnp.asarray(rng.standard_normal((count, 2)))
    mask = jnp.ones(count, bool).at[BLOCK : 2 * BLOCK].set(False)
    x = x.at[BLOCK : 2 * BLOCK].set(jnp.nan)

    def f(x, y):
        return jnp.sin(x) @ jnp.ones((2, 3)), y * x[:, 0]

    for got, whole in zip(
        in_blocks(f, (x, 2.0 * x[:, 1]), mask), f(x, 2.0 * x[:, 1]), strict=True
    ):
        assert got.shape == whole.shape
        expected = np.where(np.isnan(whole), 0.0, whole)
        np.testing.assert_allclose(got, expected, rtol=1e-6)


def test_room_for_more_episodes_changes_no_estimate() -> None:
    """The same factor of the data, with and without empty rows."""
    rng, system = np.random.default_rng(1), linear_system.linear(3, 2)
    J, y = rng.standard_normal((40, 6)), rng.standard_normal((40, 2))
    with jax.enable_x64(True):
        prior = system.parameters.prior()
        found = []
        for room in (40, 2 * BLOCK + 10):
            data = Transitions.empty(room, 2, 6).extend(0.0 * y, J, y)
            likelihood = OneStepLikelihood(system, data, 1.0)
            blocks = likelihood.blocks(prior.mean, jnp.zeros((1, 0)), prior.scale)
            found.append(np.asarray(blocks))
    np.testing.assert_allclose(found[0], found[1], atol=1e-6)
