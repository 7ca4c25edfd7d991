"""Factorisations of JAX's arrays and of NumPy's, each in its own library.

Of JAX's they wait for no other: under `vmap`, one matrix after the other.

jaxlib cuts a large batch of matrices into tasks for the thread pool that its programs
themselves run on, and waits for them there. As many such batches at once as the pool
has threads wait for each other for ever: on two cores no fit of RES-FS came to its end
(jaxlib 0.10.2, where a batch of less than 2e5 operations is not cut).
Where processes have a core each, which is how studies run, a loop costs little.

A descent that asks a simulator on the host holds NumPy arrays: nothing is traced or
compiled, which would take longer than the whole descent.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import numpy as np
from jax.custom_batching import sequential_vmap
from jaxtyping import Float
from scipy.linalg.lapack import dtrtrs

from sim2gp.types import AnyArray


def library(*arrays: Any) -> Any:
    """JAX's NumPy where one of these is its array, else NumPy."""
    return jnp if any(isinstance(x, jax.Array) for x in arrays) else np


def each_window(f: Callable[..., Any], *arrays: AnyArray) -> Any:
    """``f`` of one row of each array, for all rows."""
    if library(*arrays) is np:
        return np.stack([f(*rows) for rows in zip(*arrays, strict=True)])
    return jax.vmap(f)(*arrays)


def one_by_one(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, as a loop under `vmap`; derivatives are the function's own."""
    looped = jax.custom_jvp(sequential_vmap(function))
    looped.defjvp(lambda primals, tangents: jax.jvp(function, primals, tangents))
    return looped


def qr(A: Float[AnyArray, "N k"]) -> Float[AnyArray, "_ k"]:
    """``R`` of the QR decomposition, ``min(N, k)`` rows, signs as LAPACK has them."""
    return np.linalg.qr(A, mode="r") if library(A) is np else _qr(A)


def triangular(rows: Float[AnyArray, "N k"]) -> Float[AnyArray, "k k"]:
    """``R`` of the QR decomposition, square, with non-negative diagonal."""
    xp, (N, k) = library(rows), rows.shape
    if N < k:
        rows = xp.concatenate([rows, xp.zeros((k - N, k), rows.dtype)])
    return trapezoidal(rows)


def trapezoidal(rows: Float[AnyArray, "N k"]) -> Float[AnyArray, "_ k"]:
    """The same in ``min(N, k)`` rows."""
    R = qr(rows)
    return library(R).where(library(R).diag(R) < 0.0, -1.0, 1.0)[:, None] * R


def cholesky(A: Float[AnyArray, "n n"]) -> Float[AnyArray, "n n"]:
    """Lower-triangular; NaN where ``A`` is not positive definite."""
    return _cholesky(A)


def eigh(
    A: Float[AnyArray, "n n"],
) -> tuple[Float[AnyArray, " n"], Float[AnyArray, "n n"]]:
    """Eigenvalues, ascending, and eigenvectors as columns of a symmetric matrix."""
    if library(A) is np:
        if not np.isfinite(A).all():  # NumPy raises where JAX has no number
            return np.full(len(A), np.nan), np.full(A.shape, np.nan)
        found = np.linalg.eigh(A)
        return found.eigenvalues, found.eigenvectors
    values, vectors = _eigh(A)
    return values, vectors


def solve_triangular(
    R: Float[AnyArray, "n n"],
    B: Float[AnyArray, "n *k"],
    *,
    lower: bool = False,
    transposed: bool = False,
) -> Float[AnyArray, "n *k"]:
    """``R^-1 B``, or ``R^-T B``; upper-triangular unless ``lower``."""
    if library(R, B) is np:
        if not B.size:
            return np.zeros(B.shape)
        found, singular = dtrtrs(R, B, lower=lower, trans=int(transposed))
        return np.full(B.shape, np.nan) if singular else found
    return _SOLVE[lower, transposed](R, B)


_qr = one_by_one(partial(jnp.linalg.qr, mode="r"))
_cholesky = one_by_one(jnp.linalg.cholesky)
_eigh = one_by_one(lambda A: tuple(jnp.linalg.eigh(A)))
_SOLVE = {
    (lower, transposed): one_by_one(
        partial(jsl.solve_triangular, lower=lower, trans=int(transposed))
    )
    for lower in (False, True)
    for transposed in (False, True)
}


def sine_to(
    others: Float[np.ndarray, "k p"], column: Float[np.ndarray, " k"]
) -> tuple[float, Float[np.ndarray, " p"]]:
    """Sine of a column's angle to the others' span, and their shares of it.

    All at unit length; zeros for a column that is nothing.
    """
    length = np.linalg.norm(column)
    if length == 0.0:
        return 0.0, np.zeros(others.shape[1])
    size = np.maximum(np.linalg.norm(others, axis=0), 1e-300)
    share, *_ = np.linalg.lstsq(others / size, column / length, rcond=1e-10)
    return float(np.linalg.norm(column / length - others / size @ share)), share
