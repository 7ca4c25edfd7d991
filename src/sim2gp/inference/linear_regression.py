"""Bayesian linear regression on features, one output at a time, by QR.

    y_k = W[:, k]^T phi(x) + eps_k,
    W[:, k] ~ N(0, I / alpha_k),       eps_k ~ N(0, sig_k^2)

Outputs have very different signal-to-noise ratios (a position's increment, a
velocity's), so each has its own noise and prior scale. The factor of ``[Phi Y]`` is
taken once; a posterior for any noise is a small QR of ``[R / sig ; sqrt(alpha) I]``.
A Cholesky of ``Phi^T Phi`` with jitter is not exact to 1e-10, this is.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sim2gp.inference.gaussian import LOG_2PI, Gaussian
from sim2gp.inference.least_squares import over
from sim2gp.inference.linalg import solve_triangular, triangular
from sim2gp.types import Scalar

#: Variances, in units of the output's scale squared, tried when noise is recalibrated.
NOISE_GRID = (1e-7, 4.0, 120)
#: Prior sd of the log variance of the noise about its value in training.
ANCHOR = 1.0


class LastLayer(eqx.Module):
    """``W[:, k] = mean_k + shared_k e_0 + scale_k e_k`` with ``e`` standard normal.

    ``e_0`` (p,) also draws the physical parameters: ``shared`` is what the layer's
    posterior has in common with theirs, zero where they are independent.
    """

    mean: Float[Array, "d m"]
    shared: Float[Array, "d m p"]
    scale: Float[Array, "d m m"]

    @classmethod
    def prior(cls, d: int, m: int, p: int, alpha: Float[Array, " d"]) -> "LastLayer":
        """``N(0, I / alpha_k)``, independent of the ``p`` parameters."""
        eye = jnp.eye(m, dtype=alpha.dtype)
        scale = eye[None] / jnp.sqrt(alpha)[:, None, None]
        zeros = jnp.zeros((d, m, p), alpha.dtype)
        return cls(jnp.zeros((d, m), alpha.dtype), zeros, scale)

    def scaled(self, factors: Float[Array, " d"]) -> "LastLayer":
        """The layer whose outputs are multiplied by ``factors``."""
        return jax.tree.map(
            lambda x: x * factors.reshape(-1, *[1] * (x.ndim - 1)), self
        )


def data_factor(
    Phi: Float[Array, "N m"], Y: Float[Array, "N d"], rows: Bool[Array, " N"]
) -> Float[Array, "md md"]:
    """Triangular factor of ``[Phi Y]`` over the chosen rows."""
    table = jnp.where(rows[:, None], jnp.concatenate([Phi, Y], axis=1), 0.0)
    return triangular(table)


def regression(
    R: Float[Array, "md md"],
    count: Scalar,
    noise: Float[Array, " d"],
    alpha: Float[Array, " d"],
) -> tuple[LastLayer, Float[Array, " d"]]:
    """Exact posterior and log evidence (nats) of each output, given the data's factor.

    ``log ev = -N/2 log(2 pi sig^2) - rho^2/2 + m/2 log(alpha) - log det R_k`` with
    ``rho^2 = ||y - Phi m||^2 / sig^2 + alpha ||m||^2``, the factor's last corner.
    """
    d = noise.size
    m = R.shape[1] - d
    eye = jnp.eye(m, m + 1, dtype=R.dtype)

    def one(y: Array, sd: Array, a: Array) -> tuple[Array, Array, Array]:
        rows = jnp.concatenate([R[:, :m], y[:, None]], axis=1) / sd
        full = triangular(jnp.concatenate([rows, jnp.sqrt(a) * eye]))
        Rk, c, rho = full[:m, :m], full[:m, m], full[m:, m]
        scale = solve_triangular(Rk, jnp.eye(m, dtype=R.dtype))
        evidence = 0.5 * m * jnp.log(a) - jnp.sum(jnp.log(jnp.diag(Rk)))
        evidence = evidence - 0.5 * jnp.sum(rho**2)
        evidence = evidence - count * (jnp.log(sd) + 0.5 * LOG_2PI)
        return solve_triangular(Rk, c), scale, evidence

    mean, scale, evidence = jax.vmap(one)(R[:, m:].T, noise, alpha)
    return LastLayer(mean, jnp.zeros((d, m, 0), R.dtype), scale), evidence


def moments(
    layer: LastLayer, phi: Float[Array, " m"]
) -> tuple[Float[Array, " d"], Float[Array, "d p"], Float[Array, "d m"]]:
    """Mean of ``W^T phi``, and its scale along ``e_0`` and along each ``e_k``."""
    return (
        layer.mean @ phi,
        jnp.einsum("dmp,m->dp", layer.shared, phi),
        jnp.einsum("dmj,m->dj", layer.scale, phi),
    )


def joint_regression(
    Phi: Float[Array, "N m"],
    J: Float[Array, "N d p"],
    Y: Float[Array, "N d"],
    rows: Bool[Array, " N"],
    noise: Float[Array, " d"],
    alpha: Float[Array, " d"],
    prior: Gaussian,
    output_scale: Float[Array, " d"],
) -> tuple[Gaussian, LastLayer]:
    """Exact posterior over ``[z ; vec W]`` of ``Y_k = J_k z + c_k W_k^T phi + eps_k``.

    ``noise`` in the units of ``Y``. Each ``W_k`` is eliminated by its own QR: what
    remains of output ``k`` is information about ``z`` alone, so nothing larger than
    ``(m + p)`` is ever factored.
    """
    m, p = Phi.shape[1], prior.mean.size
    valid = rows[:, None]

    def one(Jk: Array, y: Array, sd: Array, a: Array, c: Array) -> tuple[Array, Array]:
        table = jnp.concatenate([c * Phi, Jk, y[:, None]], axis=1) / sd
        prior_rows = jnp.sqrt(a) * jnp.eye(m, m + p + 1, dtype=Phi.dtype)
        stacked = jnp.concatenate([jnp.where(valid, table, 0.0), prior_rows])
        full = triangular(stacked)
        return full[:m], full[m:, m:]

    top, left = jax.vmap(one, in_axes=(1, 1, 0, 0, 0))(J, Y, noise, alpha, output_scale)
    # z = mean0 + L0 u: the prior's rows in u are [I 0].
    left = left.reshape(-1, p + 1)
    u_rows = left[:, :p] @ prior.scale
    target = left[:, p] - left[:, :p] @ prior.mean
    eye = jnp.eye(p, p + 1, dtype=Phi.dtype)
    table = jnp.concatenate([u_rows, target[:, None]], axis=1)
    R = triangular(jnp.concatenate([table, eye]))
    u = solve_triangular(R[:p, :p], R[:p, p])
    scale = over(prior.scale, R[:p, :p])
    z = Gaussian(prior.mean + prior.scale @ u, scale)

    def back(block: Array) -> tuple[Array, Array, Array]:
        right = jnp.concatenate(
            [
                (block[:, -1] - block[:, m:-1] @ z.mean)[:, None],
                -block[:, m:-1] @ z.scale,
                jnp.eye(m, dtype=Phi.dtype),
            ],
            axis=1,
        )
        solved = solve_triangular(block[:, :m], right)
        return solved[:, 0], solved[:, 1 : p + 1], solved[:, p + 1 :]

    return z, LastLayer(*jax.vmap(back)(top))


def condition(
    z: Gaussian,
    layer: LastLayer,
    J: Float[Array, "d p"],
    phi: Float[Array, "d m"],
    residual: Float[Array, " d"],
    noise: Float[Array, " d"],
) -> tuple[Gaussian, LastLayer]:
    """One observation ``residual_k = J_k (z - E z) + phi_k^T (W_k - E W_k) + eps_k``.

    A square-root Kalman update (Potter 1963), output after output, ``O(d m^2)``. It is
    exact for the joint Gaussian, for any correlation of the layer and the parameters.
    ``phi`` may differ between outputs by their scale.
    """
    d = noise.size

    def along(h: Array) -> tuple[Array, Array]:
        """Gain and contraction of a standard normal seen through ``h`` in unit noise.

        ``I - h small^T`` is a square root of ``(I + h h^T)^-1``.
        """
        root = jnp.sqrt(1.0 + h @ h)
        return h / root**2, h / (root * (root + 1.0))

    def output(carry: tuple, k: Array) -> tuple[tuple, None]:
        z, layer = carry
        shift = residual[k] + J[k] @ (start.mean - z.mean)
        shift = shift + phi[k] @ (first.mean[k] - layer.mean[k])
        h0 = (z.scale.T @ J[k] + layer.shared[k].T @ phi[k]) / noise[k]
        hk = (layer.scale[k].T @ phi[k]) / noise[k]
        # First e_k given e_0, whose own view of the observation is noisier by q.
        gain_k, small_k = along(hk)
        root = jnp.sqrt(1.0 + hk @ hk)
        g0, t = h0 / root, shift / noise[k]
        gain_0, small_0 = along(g0)
        u = gain_0 * (t / root)

        def contract(S: Array) -> Array:
            return S - jnp.einsum("...p,p,q->...q", S, g0, small_0)

        scale_k, shared_k = layer.scale[k], layer.shared[k]
        mean = layer.mean + layer.shared @ u
        mean = mean.at[k].add(scale_k @ gain_k * (t - h0 @ u))
        row = shared_k - (scale_k @ gain_k)[:, None] * h0[None]
        shared = contract(layer.shared.at[k].set(row))
        smaller = scale_k - (scale_k @ hk)[:, None] * small_k[None]
        scale = layer.scale.at[k].set(smaller)
        z = Gaussian(z.mean + z.scale @ u, contract(z.scale))
        return (z, LastLayer(mean, shared, scale)), None

    start, first = z, layer
    (z, layer), _ = jax.lax.scan(output, (z, layer), jnp.arange(d))
    return z, layer


def recalibrated(
    variance: Float[Array, "N d"],
    residual: Float[Array, "N d"],
    held_out: Bool[Array, " N"],
    noise: Float[Array, " d"],
) -> tuple[Float[Array, " d"], Float[Array, " d"]]:
    """Noise that best predicts held-out rows, and their mean log loss (nats) with it.

    Minimises ``mean[ log(V + s)/2 + r^2 / (2 (V + s)) ]`` over a log grid of ``s``,
    with a log-normal prior about the trained noise, worth less than one row: two
    held-out rows that happen to fit must not make the noise vanish. All in units of the
    outputs' scale.
    """
    low, high, points = NOISE_GRID
    grid = jnp.geomspace(low, high, points, dtype=noise.dtype)
    count = jnp.maximum(jnp.sum(held_out, dtype=noise.dtype), 1.0)

    def loss(V: Array, r: Array, s: Array) -> Scalar:
        total = V + s
        each = 0.5 * (jnp.log(total) + r**2 / total + LOG_2PI)
        return jnp.sum(jnp.where(held_out, each, 0.0)) / count

    def one(V: Array, r: Array, sd: Array) -> tuple[Array, Array]:
        losses = jax.lax.map(lambda s: loss(V, r, s), grid)
        away = (jnp.log(grid) - 2.0 * jnp.log(sd)) / ANCHOR
        anchor = 0.5 * away**2 / count
        best = jnp.argmin(jnp.where(jnp.isfinite(losses), losses + anchor, jnp.inf))
        return jnp.sqrt(grid[best]), losses[best]

    return jax.vmap(one, in_axes=(1, 1, 0))(variance, residual, noise)
