"""Compile a function in another thread, while this one computes something else.

A command that fits and then forecasts would compile first the one, then the other, and
leave a core idle through both. Only the compiler runs in the thread (XLA works without
the interpreter's lock); nothing is executed there, for programs that run side by side
have deadlocked on few cores.

What a compiler has freed, glibc keeps: `give_back_freed` returns it to the system.
"""

import ctypes
import functools
import sys
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Generic, ParamSpec, TypeVar

import equinox as eqx
import jax
import numpy as np

from sim2gp.types import in_float64

P = ParamSpec("P")
R = TypeVar("R")

_COMPILER = ThreadPoolExecutor(1, thread_name_prefix="compiler")


class compile_async(Generic[P, R]):
    """A jitted function of arrays and static values that can be compiled in advance.

    Called with what was announced by `compile_for`, it waits for that compilation and
    uses it; called with anything else, it is `equinox.filter_jit`. Programs have the
    `options` of XLA, which it takes for whole programs only.
    """

    def __init__(self, function: Callable[P, R]):
        functools.update_wrapper(self, function)
        self._function = function
        self._within: Any = eqx.filter_jit(function)  # another program
        self._announced: dict[Any, Future[Callable[P, R]]] = {}

    @functools.cached_property
    def _jitted(self) -> Any:
        jit: Any = eqx.filter_jit  # its types do not say what it hands on to JAX
        return jit(self._function, compiler_options=options())

    @in_float64
    def compile_for(self, *args: P.args, **kwargs: P.kwargs) -> None:
        """Start to compile, in float64, for arguments of these shapes and types."""
        key = _signature((args, kwargs))
        if key not in self._announced:

            @in_float64
            def work() -> Callable[P, R]:
                compiled: Callable[P, R] = self._jitted.lower(*args, **kwargs).compile()
                return compiled

            self._announced[key] = _COMPILER.submit(work)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        if self._announced:  # the signature costs time; most programs announce nothing
            found = self._announced.get(_signature((args, kwargs)))
            if found is not None:
                return found.result()(*args, **kwargs)
        jitted = self._within if _is_traced(args, kwargs) else self._jitted
        return jitted(*args, **kwargs)


@functools.cache
def options() -> dict[str, bool]:
    """XLA's options for the large programs of fits, where it knows them.

    Its newer fusion of loops on CPUs takes longer to compile them, by half or more, and
    they run longer, too (docs/decisions.md).
    """
    found = {"xla_cpu_use_fusion_emitters": False}
    try:
        jax.jit(lambda: 0, compiler_options=found).lower().compile()
    except jax.errors.JaxRuntimeError:
        return {}
    return found


def _is_traced(*given: Any) -> bool:
    """Whether what is called with this is part of a program, or differentiated."""
    also = jax.lax.iota(np.int32, 1)  # in a program even a constant is traced
    leaves = jax.tree.leaves((given, also))
    return any(isinstance(x, jax.core.Tracer) for x in leaves)


def give_back_freed() -> None:
    """Return freed memory to the system, where the C library keeps it (glibc).

    After a fit is compiled that is hundreds of MiB; it takes some tens of milliseconds.
    """
    if sys.platform == "linux":  # musl has no such function
        trim = getattr(ctypes.CDLL(None), "malloc_trim", lambda keep: 0)
        trim(0)


def _signature(tree: Any) -> Any:
    """What a compilation depends on: structure, static values, shapes and types."""
    leaves, structure = jax.tree.flatten(tree)
    return structure, tuple(
        jax.typeof(leaf) if eqx.is_array(leaf) else leaf for leaf in leaves
    )
