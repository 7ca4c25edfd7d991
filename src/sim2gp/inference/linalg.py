"""Factorisations that wait for no other: under `vmap`, one matrix after the other.

jaxlib cuts a large batch of matrices into tasks for the thread pool that its programs
themselves run on, and waits for them there. As many such batches at once as the pool
has threads wait for each other for ever: on two cores no fit of RES-FS came to its end
(jaxlib 0.10.2, where a batch of less than 2e5 operations is not cut).
Where processes have a core each, which is how studies run, a loop costs little.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
from jax.custom_batching import sequential_vmap
from jaxtyping import Array, Float


def one_by_one(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, as a loop under `vmap`; derivatives are the function's own."""
    looped = jax.custom_jvp(sequential_vmap(function))
    looped.defjvp(lambda primals, tangents: jax.jvp(function, primals, tangents))
    return looped


def qr(A: Float[Array, "N k"]) -> Float[Array, "_ k"]:
    """``R`` of the QR decomposition, ``min(N, k)`` rows, signs as LAPACK has them."""
    return _qr(A)


def triangular(rows: Float[Array, "N k"]) -> Float[Array, "k k"]:
    """``R`` of the QR decomposition, square, with non-negative diagonal."""
    N, k = rows.shape
    if N < k:
        rows = jnp.concatenate([rows, jnp.zeros((k - N, k), rows.dtype)])
    R = qr(rows)
    return jnp.where(jnp.diag(R) < 0.0, -1.0, 1.0)[:, None] * R


def cholesky(A: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Lower-triangular; NaN where ``A`` is not positive definite."""
    return _cholesky(A)


def eigh(A: Float[Array, "n n"]) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """Eigenvalues, ascending, and eigenvectors as columns of a symmetric matrix."""
    values, vectors = _eigh(A)
    return values, vectors


def solve_triangular(
    R: Float[Array, "n n"],
    B: Float[Array, "n *k"],
    *,
    lower: bool = False,
    transposed: bool = False,
) -> Float[Array, "n *k"]:
    """``R^-1 B``, or ``R^-T B``; upper-triangular unless ``lower``."""
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
