"""Functions of users: how they are checked; `bad_functions` has what is refused."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from double_integrator import Linear, Quadratic
from double_integrator import world as world_of
from sim2gp import checks
from sim2gp import systems as sy
from sim2gp.errors import InputError
from tests.catalogue.bad_functions import Pull, arm, host, inertia_of, ode


def test_what_a_function_raised_is_the_cause() -> None:
    with pytest.raises(InputError) as caught:
        ode(lambda s: {}["mass"])
    assert isinstance(caught.value.__cause__, KeyError)


def test_what_is_right_is_taken() -> None:
    """Whole numbers too of a function on the host, which is an array to NumPy."""
    assert sy.Machine(sy.Furuta(), [Pull(lambda q: -q)]).effects
    assert host(lambda s: np.asarray([1, 2])).states
    assert arm(inertia_of, jnp.sin).states[0].name == "q1"


def test_a_function_is_traced_once_for_its_kind(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Another draw of the same machine is new data, and no new trace."""
    monkeypatch.setattr(checks, "_KNOWN", {})  # what is known is forgotten when full
    traced = []

    class Counted(Linear):
        def __call__(self, s, a):
            traced.append(1)
            return super().__call__(s, a)

    A, B = jnp.eye(2), jnp.ones((2, 1))
    worlds = [world_of(Counted(x * A, B)) for x in (1.0, 2.0, 3.0)]
    assert len(worlds) == 3
    assert traced == [1]


def test_worlds_are_made_inside_compiled_functions() -> None:
    """Of numbers that nobody knows yet, shapes are known."""

    def best(x):
        w = world_of(Linear(x * jnp.eye(2), jnp.ones((2, 1))))
        return w.step(jnp.ones(2), jnp.ones(1))[0]

    found = jax.jit(jax.vmap(best))(jnp.asarray([1.0, 2.0]))
    np.testing.assert_array_equal(found, [[2.0, 2.0], [3.0, 3.0]])
    with pytest.raises(InputError, match=r"^E140 .*got shape \(1,\)"):
        jax.jit(lambda x: world_of(lambda s, a: x * s[:1]).horizon)(1.0)


def test_names_are_the_users() -> None:
    def reach(s, a, s2):
        return s2[0]

    for function, name in (
        (functools.partial(reach, 1.0), "reach"),
        (Quadratic(), "Quadratic"),
        (jnp.sin, "sin"),
    ):
        assert checks.name_of(function).endswith(name)
