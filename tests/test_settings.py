"""What of the settings can be, and where they are not checked.

Those that nothing real can have are in `bad_settings`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sim2gp as sg
from linear_system import linear
from mass_task import mass_task, single
from sim2gp import checks
from sim2gp import systems as sy
from sim2gp.errors import InputError
from tests.catalogue.bad_settings import INF, box, ode, task


def test_what_can_be_is_taken() -> None:
    """The edges of what is allowed; a machine without noise, an input that is fixed."""
    box([0.0], [0.0])
    sg.Channel("q", "rad", low=0.0)
    task(noise=single(0.0, 0.0), start_sd=single(0.0, 0.0), state_bound=single(INF, 1))
    ode(max_substep=INF)
    sg.ICEM(samples=2, elites=2, reuse=0.0, smoothing=1.0, finest=1.0)
    sg.SAC(discount=1.0, rate=0.0, hidden=())
    sg.NLM(linear(2, 2), steps=0, refit_steps=0)
    sy.Coulomb("theta", 0.0)
    sy.Delay("voltage", 0.0)


def test_numbers_that_nobody_knows_yet_are_not_checked() -> None:
    """Tasks, boxes and learners are made inside compiled functions."""

    def limited(x):
        made = task(
            noise=x * jnp.ones(2),
            actions=sg.Box(-x[None], x[None]),
            start=x * jnp.ones(2),
        )
        rate = sg.SAC(rate=x, discount=x).rate
        return made.limit(jnp.asarray([9.0])) + rate

    found = jax.jit(jax.vmap(limited))(jnp.asarray([1.0, 2.0]))
    np.testing.assert_array_equal(found, [[2.0], [4.0]])
    reversed_ = jax.jit(lambda x: sg.Box(x, -x))(jnp.ones(1))
    assert float(reversed_.high[0]) == -1.0


def test_what_is_put_together_again_is_not_checked() -> None:
    """JAX fills a tree with anything."""
    leaves, tree = jax.tree.flatten(mass_task())
    empty = jax.tree.unflatten(tree, [object() for _ in leaves])
    assert isinstance(empty.noise, object)
    moved = eqx.tree_at(lambda t: t.noise, mass_task(), single(-1.0, 0.0))
    assert float(moved.noise[0]) == -1.0


@pytest.mark.parametrize("rule", ["positive", "count", "share", "deviation", "finite"])
def test_what_is_no_number_is_refused(rule) -> None:
    for value in ("1", True, [1, "2"], {"a": 1}, 1j):
        with pytest.raises(InputError):
            getattr(checks, rule)("here", value=value)
    getattr(checks, rule)("here", value=1, other=None, third=np.ones(3, int))
