"""A function compiled in advance is the same function, traced once."""

import threading
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2gp.compilation import compile_async, options
from sim2gp.types import in_float64


class Traced:
    """A decorated function that notes in which thread it was traced."""

    def __init__(self) -> None:
        self.threads: list[str] = []

        @compile_async
        def power(x: Any, n: int) -> Any:
            """x to the n."""
            self.threads.append(threading.current_thread().name)
            return x**n

        self.power = power


@in_float64
def test_announced_arguments_are_traced_once_and_elsewhere() -> None:
    traced, x = Traced(), np.linspace(0.5, 2.0, 7)
    traced.power.compile_for(jnp.zeros(7), 3)
    traced.power.compile_for(jnp.ones(7), 3)
    for factor in (1.0, 2.0):
        found = traced.power(jnp.asarray(factor * x), 3)
        assert found.dtype == jnp.float64
        np.testing.assert_allclose(found, (factor * x) ** 3, rtol=1e-15)
    assert len(traced.threads) == 1
    assert traced.threads[0].startswith("compiler")


@pytest.mark.parametrize(
    ("shape", "dtype", "n"), [((8,), "float64", 3), ((7,), "float32", 3)]
)
def test_other_arguments_are_compiled_when_called(
    shape: tuple[int, ...], dtype: str, n: int
) -> None:
    traced = Traced()
    traced.power.compile_for(np.zeros(7), 3)

    @in_float64
    def call() -> Any:
        return traced.power(jnp.full(shape, 2.0, dtype), n)

    found = call()
    assert found.shape == shape
    assert found.dtype == dtype
    assert np.all(np.asarray(found) == 8.0)
    assert threading.current_thread().name in traced.threads


@in_float64
def test_another_static_value_is_another_function() -> None:
    traced = Traced()
    traced.power.compile_for(jnp.zeros(7), 3)
    assert float(traced.power(jnp.full(7, 2.0), 2)[0]) == 4.0


@in_float64
def test_what_compilation_raises_reaches_the_caller() -> None:
    @compile_async
    def broken(x: Any) -> Any:
        raise ValueError("not today")

    broken.compile_for(jnp.zeros(2))
    with pytest.raises(ValueError, match="not today"):
        broken(jnp.zeros(2))


def test_the_function_keeps_its_name() -> None:
    assert Traced().power.__doc__ == "x to the n."  # type: ignore[attr-defined]


@in_float64
def test_within_another_program_it_is_a_part_of_it() -> None:
    """JAX takes options for whole programs only; constants do not say where one is."""
    traced = Traced()

    @jax.jit
    def whole(x: Any) -> Any:
        return traced.power(x, 3) + traced.power(jnp.ones(2), 3)

    np.testing.assert_array_equal(whole(jnp.arange(2.0)), [1.0, 2.0])
    at = jnp.arange(2.0)
    np.testing.assert_array_equal(jax.vmap(lambda x: traced.power(x, 3))(at), at**3)
    assert float(jax.grad(lambda x: traced.power(x, 3))(2.0)) == 12.0


def test_an_xla_without_these_options_compiles_as_it_does(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    jit = jax.jit

    def older(f: Any, compiler_options: dict[str, bool] | None = None) -> Any:
        unknown = {
            f"{name}_of_later": x for name, x in (compiler_options or {}).items()
        }
        return jit(f, compiler_options=unknown)

    assert options()
    options.cache_clear()
    monkeypatch.setattr(jax, "jit", older)
    assert options() == {}
    monkeypatch.undo()
    options.cache_clear()
    assert float(Traced().power(jnp.full(7, 2.0), 2)[0]) == 4.0
