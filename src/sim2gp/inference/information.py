"""The information that transitions are expected to give, in nats, before they are made.

A belief sees the next state through standard normal coordinates ``e``: those that all
outputs share, ``e_0`` (the parameters), and each output's own ``e_k`` (its last layer),

    s'_k / sig_k = mean + shared_k(x)^T e_0 + own_k(x)^T e_k + noise of sd 1

(`AbstractBelief.sensitivity`). For any outcome a linear-Gaussian belief learns

    IG(X) = 1/2 logdet(I + A A^T),       A = all rows [shared | 0 .. own_k .. 0] of X.

Stacking a trajectory's rows removes redundancy: what a second visit to one place
repeats is not counted twice. `joint` is the exact form, by QR; `increments` the same
for one trajectory among thousands, step by step, in single precision and without
LAPACK; `Seen` is what remains to be learned in the middle of an episode.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sim2gp.inference import linear_regression as last_layer
from sim2gp.inference.gaussian import Gaussian, log_det_factor
from sim2gp.inference.linalg import qr, triangular
from sim2gp.inference.linear_regression import LastLayer
from sim2gp.types import Scalar

#: ``shared (d, p)`` and ``own (d, features)`` of one transition, in noise sd.
Sensitivity = tuple[Float[Array, "d p"], Float[Array, "d features"]]


def joint(shared: Float[Array, "T d p"], own: Float[Array, "T d features"]) -> Scalar:
    """``1/2 logdet(I + A A^T)`` of all rows, by QR: each output's own part first."""
    p, m = shared.shape[2], own.shape[2]

    def eliminated(own: Array, shared: Array) -> tuple[Array, Array]:
        rows = jnp.concatenate([own, shared], axis=1)
        prior = jnp.eye(m, rows.shape[1], dtype=rows.dtype)
        R = triangular(jnp.concatenate([rows, prior]))
        return log_det_factor(R[:m, :m]), R[m:, m:]

    logs, left = jax.vmap(eliminated, in_axes=1)(own, shared)
    gain = jnp.sum(logs)
    if p:
        rows = jnp.concatenate([left.reshape(-1, p), jnp.eye(p, dtype=left.dtype)])
        gain = gain + log_det_factor(qr(rows))
    # Rounding may leave log|1 - eps|; information is never negative.
    return jnp.maximum(gain, 0.0)


def increments(
    shared: Float[Array, "T d p"], own: Float[Array, "T d features"]
) -> Float[Array, " T"]:
    """Nats of each step given those before it; their sum is `joint`.

    An output's own coordinates are integrated out of the T x T Gram matrix of its rows,
    of which there are fewer than features; the shared ones by Potter's square-root
    downdate. Pivots are at least the noise: rounding cannot make information negative.
    """
    T, d, p = shared.shape
    logs = jnp.zeros((d, T), shared.dtype)
    rows = jnp.swapaxes(shared, 0, 1)
    if own.shape[2]:
        logs, rows = jax.vmap(_integrated_out, in_axes=1)(own, shared)
    gains = jnp.sum(logs, axis=0)
    if not p:
        return gains

    def condition(M: Array, row: Array) -> tuple[Array, Array]:
        h = M.T @ row
        root = jnp.sqrt(1.0 + h @ h)
        return M - jnp.outer(M @ h, h / (root * (root + 1.0))), jnp.log(root)

    flat = jnp.swapaxes(rows, 0, 1).reshape(T * d, p)
    _, each = jax.lax.scan(condition, jnp.eye(p, dtype=shared.dtype), flat)
    return gains + jnp.sum(each.reshape(T, d), axis=1)


def _integrated_out(
    own: Float[Array, "T features"], shared: Float[Array, "T p"]
) -> tuple[Float[Array, " T"], Float[Array, "T p"]]:
    """Log sd of each innovation, and the shared rows that it leaves, in its units."""
    T = len(own)
    gram = jnp.eye(T, dtype=own.dtype) + own @ own.T

    def pivot(table: Array, t: Array) -> tuple[Array, tuple[Array, Array]]:
        row = table[t]
        variance = jnp.maximum(row[t], 1.0)
        # Rows up to t are left as they fall: nobody reads them again.
        table = table - jnp.outer(table[:, t] / variance, row)
        return table, (0.5 * jnp.log(variance), row[T:] / jnp.sqrt(variance))

    table = jnp.concatenate([gram, shared], axis=1)
    return jax.lax.scan(pivot, table, jnp.arange(T))[1]


class Seen(eqx.Module):
    """What is left of a belief's coordinates after some transitions: ``S S^T <= I``.

    Only spreads: what came out of them moves means, which no information depends on.
    """

    z: Gaussian
    layer: LastLayer

    @classmethod
    def nothing(cls, d: int, p: int, m: int) -> "Seen":
        """Before any transition: d outputs, p shared coordinates, m of each output."""
        z = Gaussian(jnp.zeros(p), jnp.eye(p))
        return cls(z, LastLayer.prior(d, m, p, jnp.ones(d)))

    def left(
        self, shared: Float[Array, "*T d p"], own: Float[Array, "*T d features"]
    ) -> tuple[Float[Array, "*T d p"], Float[Array, "*T d features"]]:
        """The sensitivities to what is still unknown."""
        common = jnp.einsum("...dm,dmp->...dp", own, self.layer.shared)
        own = jnp.einsum("...dm,dmj->...dj", own, self.layer.scale)
        return shared @ self.z.scale + common, own

    def after(
        self, shared: Float[Array, "d p"], own: Float[Array, "d features"]
    ) -> "Seen":
        """One more transition."""
        nothing, unit = jnp.zeros(len(own), own.dtype), jnp.ones(len(own), own.dtype)
        z, layer = last_layer.condition(self.z, self.layer, shared, own, nothing, unit)
        return Seen(z, layer)
