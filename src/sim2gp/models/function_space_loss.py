"""The loss of a last layer that agrees with data and, elsewhere, with physics.

    q(W) = prod_k N(m_k, L_k L_k^T),   mu_q = m^T phi,   V_q = diag_k ||L_k^T phi||^2

    max  1/N sum_n sum_k E_q log N(y_nk | W_k^T phi, sig_k^2)
         - lam/N E_X KL[ N(mu_q(X), V_q(X) + Se_q) || N(mu_p(X), K_p(X) + Se_sim) ]

(paper, eq. 4), over sets ``X`` of ``b`` inputs from a box and around the data. With
noise, because the divergence between degenerate Gaussians is infinite; over sets,
because marginals say nothing of correlations, and function samples need them. The
targets do not depend on what is trained: their whitening is computed once, in float64.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sim2gp.data.transitions import Transitions
from sim2gp.inference.gaussian import LOG_2PI, log_det_factor, lower_factor
from sim2gp.inference.linalg import solve_triangular
from sim2gp.models import features
from sim2gp.models.features import Encoding, Network
from sim2gp.types import Key, Scalar

NOISE_FLOOR = 3e-3  # while training, in units of the output's scale
POINTS = 64  # inputs compared at each step
REPLAY = 3  # one input in so many is near the data, the others fill the box
JITTER = 0.1  # of the half-width of the box, about replayed inputs


class Objective(eqx.Module):
    """What is maximised, and how large a set is.

    weight: lam. sets: b, inputs whose values are compared jointly. own_noise: whether
    the comparison may move the noise; if it may, it inflates it.
    """

    weight: float = eqx.field(static=True)
    sets: int = eqx.field(static=True)
    own_noise: bool = eqx.field(static=True)


#: As the paper prints it, and as it works.
OBJECTIVES = {
    "literal": Objective(1.0, 1, True),
    "recommended": Objective(100.0, 8, False),
}


class Variational(eqx.Module):
    """What is trained: features, layer and noise; float32 but for the noise."""

    network: Network
    mean: Float[Array, "d m"]
    factor: Float[Array, "d m m"]  # lower triangle of L
    log_noise: Float[Array, " d"]

    @property
    def noise(self) -> Float[Array, " d"]:
        """Noise sd while training, in units of the output's scale."""
        return jnp.sqrt(NOISE_FLOOR**2 + jnp.exp(2.0 * self.log_noise))

    def spread(self, Phi: Float[Array, "N m"]) -> Float[Array, "d N m"]:
        """``Phi L_k``: rows whose products are the covariances of outputs."""
        return jnp.einsum("nm,dmj->dnj", Phi, jnp.tril(self.factor))


class Targets(eqx.Module):
    """The other side of the divergence, on a pool of sets of inputs."""

    X: Float[Array, "G b e"]
    mean: Float[Array, "G b d"]
    whiten: Float[Array, "G bd b d"]  # inverse lower factor of the covariance
    log_det: Float[Array, " G"]  # of that factor


def inputs(
    key: Key, encoding: Encoding, data: Transitions, count: int
) -> tuple[Float[Array, "M n"], Float[Array, "M a"]]:
    """``count`` states and actions: two in three fill the box, one is near the data."""
    box, near, pick, which = jax.random.split(key, 4)
    n, m = data.state.shape[1], data.action.shape[1]
    low, high = jnp.asarray(encoding.low), jnp.asarray(encoding.high)
    filled = jax.random.uniform(box, (count, n + m), low.dtype, low[None], high[None])
    table = jnp.concatenate([data.state, data.action], axis=1)
    rows = features.Minibatches.shuffled(pick, data.mask)
    index = rows.order[jnp.arange(count) % jnp.maximum(rows.count, 1)]
    width = 0.5 * JITTER * (high - low)
    moved = table[index] + width[None] * jax.random.normal(near, (count, n + m))
    some = jax.random.uniform(which, (count, 1)) < 1.0 / REPLAY
    x = jnp.where(some & jnp.any(data.mask), moved, filled)
    return x[:, :n], x[:, n:]


def targets(
    X: Float[Array, "M e"],
    mean: Float[Array, "M d"],
    scale: Float[Array, "M d p"],
    noise: Float[Array, " d"],
    sets: int,
) -> Targets:
    """Cut the pool into sets and whiten each: ``K_p = A A^T + Se_sim``, by QR."""
    (M, e), (_, d, p) = X.shape, scale.shape
    groups = M // sets
    A = scale.reshape(groups, sets * d, p)
    Se = jnp.diag(jnp.tile(noise, sets))

    def whitened(A: Array) -> tuple[Array, Array]:
        C = lower_factor(jnp.concatenate([A, Se], axis=1))
        inverse = solve_triangular(C, jnp.eye(sets * d, dtype=C.dtype), lower=True)
        return inverse.reshape(sets * d, sets, d), log_det_factor(C)

    whiten, log_det = jax.vmap(whitened)(A)
    return Targets(
        X.reshape(groups, sets, e).astype(jnp.float32),
        mean.reshape(groups, sets, d).astype(jnp.float32),
        whiten.astype(jnp.float32),
        log_det,
    )


def divergence(
    q: Variational, noise: Float[Array, " d"], target: Targets, g: Int[Array, ""]
) -> Scalar:
    """``KL[q || p]`` on set ``g``, nats, both sides with their noise."""
    Phi = jax.vmap(q.network)(target.X[g])
    (b, d), white = target.mean[g].shape, target.whiten[g]
    U = q.spread(Phi)
    e = jnp.einsum("ibd,bd->i", white, Phi @ q.mean.T - target.mean[g])
    mixed = jnp.einsum("ibd,dbj->dij", white, U)
    own = jnp.sum(white**2, axis=(0, 1)).astype(noise.dtype)
    quadratic = (jnp.sum(mixed**2) + e @ e).astype(noise.dtype) + own @ noise**2
    # Small, and differences of large numbers: in double precision.
    U = U.astype(noise.dtype)
    K = jnp.einsum("dij,dkj->dik", U, U)
    K = K + (noise**2)[:, None, None] * jnp.eye(b, dtype=noise.dtype)[None]
    # Too small a batch to be cut (`sim2gp.inference.linalg`).
    C = jnp.linalg.cholesky(K)
    log_det = jnp.sum(jnp.log(jnp.diagonal(C, axis1=1, axis2=2)))
    return 0.5 * (quadratic - b * d) + target.log_det[g] - log_det


def mean_divergence(
    q: Variational, target: Targets, objective: Objective, key: Key
) -> Scalar:
    """Average over this step's sets."""
    count = max(1, POINTS // objective.sets)
    g = jax.random.randint(key, (count,), 0, len(target.X))
    noise = q.noise if objective.own_noise else jax.lax.stop_gradient(q.noise)
    return jnp.mean(jax.vmap(lambda g: divergence(q, noise, target, g))(g))


def expected_log_likelihood(
    q: Variational,
    X: Float[Array, "B e"],
    Y: Float[Array, "B d"],
    valid: Bool[Array, " B"],
) -> Scalar:
    """``E_q log p(y | x)`` per row, nats, in units of the outputs' scale."""
    Phi = jax.vmap(q.network)(X)
    variance = jnp.sum(q.spread(Phi) ** 2, axis=2).T.astype(Y.dtype)
    error = Y - (Phi @ q.mean.T).astype(Y.dtype)
    sd = q.noise[None]
    each = -jnp.log(sd) - 0.5 * LOG_2PI - 0.5 * (error**2 + variance) / sd**2
    rows = jnp.maximum(jnp.sum(valid, dtype=Y.dtype), 1.0)
    return jnp.sum(jnp.where(valid[:, None], each, 0.0)) / rows
