"""Checks: of settings and functions, once where users give them, and of results.

Settings are numbers that something real must be able to have: a period is positive, a
standard deviation is not negative, bounds are in order. Only numbers that are known are
checked. Inside a compiled function they are not, and JAX does not construct what it
puts together again from its leaves: call these from ``__init__`` or from equinox's
``__check_init__``, which do not run then.

Functions of JAX arrays are traced, for shapes alone (`jax.eval_shape`): nothing is
compiled, and functions of one kind are traced once.
"""

import functools
from collections.abc import Callable, Iterable
from typing import Any

import equinox as eqx
import jax
import numpy as np

from sim2gp.errors import InputError, NotFinite, Sim2GPError, error, nearest

#: What calls return that were traced already; more than so many are forgotten.
_KNOWN: dict[Any, Any] = {}
_MOST_KNOWN = 64


# ------------------------------------------------------------------------- settings
def positive(where: str, /, **settings: Any) -> None:
    """E148 for what is not a positive, finite number (of an array: each)."""
    expected = "a positive, finite number"
    _each(
        where, settings, _out_of_range, expected, lambda x: (x > 0.0) & np.isfinite(x)
    )


def positive_or_infinite(where: str, /, **settings: Any) -> None:
    """E148 for what is not a positive number; it may be infinite."""
    _each(where, settings, _out_of_range, "a positive number", lambda x: x > 0.0)


def not_negative(where: str, /, **settings: Any) -> None:
    """E148 for what is negative or not finite."""
    expected = "a finite number, zero or more"
    _each(
        where, settings, _out_of_range, expected, lambda x: (x >= 0.0) & np.isfinite(x)
    )


def finite(where: str, /, **settings: Any) -> None:
    """E148 for what is not finite."""
    _each(where, settings, _out_of_range, "a finite number", np.isfinite)


def share(where: str, /, **settings: Any) -> None:
    """E148 for what is not between 0 and 1."""
    expected = "a number from 0 to 1"
    _each(where, settings, _out_of_range, expected, lambda x: (x >= 0.0) & (x <= 1.0))


def positive_share(where: str, /, **settings: Any) -> None:
    """E148 for what is not above 0 and up to 1."""
    expected = "a number above 0, at most 1"
    _each(where, settings, _out_of_range, expected, lambda x: (x > 0.0) & (x <= 1.0))


def count(where: str, /, **settings: Any) -> None:
    """E148 for what is not a whole number from 1."""
    _each(
        where, settings, _out_of_range, "a whole number from 1", lambda x: _whole(x, 1)
    )


def whole(where: str, /, **settings: Any) -> None:
    """E148 for what is not a whole number from 0."""
    _each(
        where, settings, _out_of_range, "a whole number from 0", lambda x: _whole(x, 0)
    )


def index(where: str, size: int, /, **settings: Any) -> None:
    """E148 for what is not a whole number from 0 to below ``size``."""
    expected = f"a whole number from 0 to {size - 1}"
    _each(where, settings, _out_of_range, expected, lambda x: _whole(x, 0) & (x < size))


def at_most(where: str, /, most: str, **settings: Any) -> None:
    """E148 for a setting that is above another one, the one that ``most`` names."""
    highest = _numbers(settings.pop(most))
    if highest is not None:
        expected = f"{most} ({highest:g}) at most"
        _each(where, settings, _out_of_range, expected, lambda x: x <= highest)


def deviation(where: str, /, **settings: Any) -> None:
    """E144 for a standard deviation that is not positive and finite."""
    expected = "a positive, finite standard deviation"
    _each(
        where, settings, _no_deviation, expected, lambda x: (x > 0.0) & np.isfinite(x)
    )


def deviation_or_zero(where: str, /, **settings: Any) -> None:
    """E144 for a standard deviation that is negative or not finite."""
    expected = "a finite standard deviation, zero or more"
    _each(
        where, settings, _no_deviation, expected, lambda x: (x >= 0.0) & np.isfinite(x)
    )


def moments(where: str, mean: Any, sd: Any) -> None:
    """E144 for a mean that is not finite, or a standard deviation that cannot be."""
    a, b = _numbers(mean), _numbers(sd)
    if a is None or b is None:
        return
    if not (np.isfinite(a) & (b > 0.0) & np.isfinite(b)).all():
        raise error("wrong_moments", where=where, got=f"mean {a:g}, sd {b:g}")


def bounds(
    where: str, low: Any, high: Any, *, unbounded: bool = False, empty: bool = False
) -> None:
    """E141 for bounds that are not ``low < high`` and finite.

    ``unbounded`` ones may be infinite, and ``empty`` ones equal.
    """
    a, b = _numbers(low), _numbers(high)
    if a is None or b is None:
        return
    good = (a <= b) if empty else (a < b)
    words = "low <= high" if empty else "low < high"
    if not unbounded:
        good, words = good & np.isfinite(a) & np.isfinite(b), f"finite, {words}"
    if not np.all(good):
        got = f"low = {_shown(low)}, high = {_shown(high)}"
        raise error("wrong_bounds", where=where, got=got, expected=words)


def one_of(where: str, known: Iterable[str], /, **settings: str) -> None:
    """E145 for a word that is none of the known ones."""
    known = tuple(known)
    for name, word in settings.items():
        if word not in known:
            close = nearest(word, known) if isinstance(word, str) else None
            fix, names = f"did you mean {close}?" if close else "", ", ".join(known)
            raise error(
                "unknown_word", where=where, got=word, fix=fix, name=name, known=names
            )


def same_shape(where: str, shape: tuple[int, ...], /, **settings: Any) -> None:
    """E140 for an array of another shape; shapes are known of traced arrays too."""
    for name, value in settings.items():
        if value is not None and np.shape(value) != shape:
            raise another_shape(name, where, np.shape(value), shape)


def _each(
    where: str,
    settings: dict[str, Any],
    refusal: Callable[[str, str, str, str], InputError],
    expected: str,
    good: Callable[[np.ndarray], Any],
) -> None:
    for name, value in settings.items():
        found = _numbers(value)
        if found is not None and not np.all(good(found)):
            raise refusal(name, where, _shown(value), expected)


def _out_of_range(name: str, where: str, got: str, expected: str) -> InputError:
    return error(
        "number_out_of_range", where=where, got=got, expected=expected, name=name
    )


def _no_deviation(name: str, where: str, got: str, expected: str) -> InputError:
    return error("wrong_deviation", where=where, got=got, expected=expected, name=name)


def _numbers(value: Any) -> np.ndarray | None:
    """The numbers of a setting: None where they are not known, NaN for no numbers."""
    if value is None or isinstance(value, jax.core.Tracer | jax.ShapeDtypeStruct):
        return None
    found = np.asarray(value)
    return found if found.dtype.kind in "fiu" else np.asarray(np.nan)


def _whole(x: np.ndarray, least: int) -> Any:
    return (x >= least) if x.dtype.kind in "iu" else np.zeros(x.shape, bool)


def _shown(value: Any) -> str:
    found = np.asarray(value)
    if found.dtype.kind not in "fiu":
        return repr(value)[:60]
    if found.ndim == 0:
        return f"{found:g}" if found.dtype.kind == "f" else str(found)
    return np.array2string(found, precision=4, threshold=8, separator=", ")


# ------------------------------------------------------------------------ functions
def returns(
    what: str,
    function: Callable[..., Any],
    arguments: tuple[Any, ...],
    shape: tuple[int, ...],
    *,
    name: str = "",
    meaning: str = "",
) -> None:
    """That a user's function of JAX arrays answers with one real array of a shape.

    ``what`` it returns, ``meaning`` whose shape that is, ``name`` what the user calls
    the function: for the message. ``arguments`` may be `jax.ShapeDtypeStruct`. Raises
    `InputError` E140 for another shape or several arrays, E123 for what are no real
    numbers, E173 with what the function raised.
    """
    name = name or name_of(function)
    found = shapes(function, *arguments, name=name)
    if not isinstance(found, jax.ShapeDtypeStruct):
        leaves = jax.tree.leaves(found)
        got = f"a {type(found).__name__} of {len(leaves)}" if leaves else "nothing"
        raise another_shape(what, name, got, shape, meaning, "return jnp.stack([...])")
    if found.shape != shape:
        raise another_shape(what, name, found.shape, shape, meaning)
    if found.dtype.kind != "f":
        raise no_real_numbers(what, name, f"{found.dtype}")


def shapes(function: Callable[..., Any], *arguments: Any, name: str = "") -> Any:
    """What a user's function returns, as `jax.ShapeDtypeStruct` (E173)."""
    kind = _kind((function, arguments))
    if kind is not None and kind in _KNOWN:
        return _KNOWN[kind]
    dynamic, static = eqx.partition((function, arguments), _is_array)

    def call(dynamic: Any) -> Any:
        function, arguments = eqx.combine(dynamic, static)
        return function(*arguments)

    try:
        found = jax.eval_shape(call, dynamic)
    except Sim2GPError:
        raise  # a part of ours says what is wrong itself
    except Exception as error:
        raise raised("the function", name or name_of(function), error) from error
    if kind is not None:
        if len(_KNOWN) >= _MOST_KNOWN:
            _KNOWN.clear()
        _KNOWN[kind] = found
    return found


def another_shape(
    what: str,
    name: str,
    got: tuple[int, ...] | str,
    expected: tuple[int, ...],
    meaning: str = "",
    fix: str = "",
) -> InputError:
    """E140: what a function returned, or an array that was given, has another shape."""
    words = f"shape {expected}" + (f", {meaning}" if meaning else "")
    shown = got if isinstance(got, str) else f"shape {got}"
    return error(
        "another_shape", where=name, got=shown, expected=words, fix=fix, what=what
    )


def no_real_numbers(what: str, name: str, got: str) -> InputError:
    """E123: a function returned something else than real numbers."""
    return error("no_real_numbers", where=name, got=got, what=what)


def raised(what: str, name: str, caught: Exception, fix: str = "") -> InputError:
    """E173: a user's function raised; its own message, as far as its first blank line.

    (JAX goes on with advice.) Chain the error itself.
    """
    said = str(caught).split("\n\n")[0]
    got = f"{type(caught).__name__}: {said}"
    return error("function_raised", where=name, got=got, fix=fix, what=what)


def name_of(function: Any) -> str:
    """What the user calls a function."""
    if isinstance(function, functools.partial):
        return name_of(function.func)
    return getattr(function, "__qualname__", type(function).__name__)


def _is_array(leaf: Any) -> bool:
    return eqx.is_array(leaf) or isinstance(leaf, jax.ShapeDtypeStruct)


def _kind(called: Any) -> Any:
    """What calls that trace alike have in common; None where it has no hash."""
    leaves, tree = jax.tree.flatten(called)
    each = ((x.shape, x.dtype) if _is_array(x) else x for x in leaves)
    kind = tree, *each, jax.numpy.result_type(float)
    try:
        hash(kind)
    except TypeError:
        return None
    return kind


# -------------------------------------------------------------------------- results
def finite_results(where: str, what: str, A: np.ndarray) -> None:
    """E203 (`NotFinite`) for an array of results with entries that are not finite."""
    bad = int(np.sum(~np.isfinite(A)))
    if bad:
        got = f"{bad} of {A.size}"
        raise error("results_not_finite", NotFinite, where=where, got=got, what=what)
