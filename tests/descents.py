"""Descents as tests ask for them, and estimates that they put together themselves."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sim2gp.inference.arrowhead import Blocks, Noise
from sim2gp.inference.convergence import Convergence, converged
from sim2gp.inference.descent import NOTHING, multi_start
from sim2gp.inference.estimate import Estimate
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.laplace import Laplace, laplace
from sim2gp.inference.least_squares import factor, prior_rows
from sim2gp.inference.likelihood import AbstractLikelihood
from sim2gp.inference.prior import AbstractPrior
from sim2gp.types import AnyArray


class Standard(AbstractPrior):
    """A standard normal prior of parameters without bounds."""

    gaussian: Gaussian

    @property
    def linear(self) -> tuple[int, ...]:
        return ()

    def moved(self, z: Float[AnyArray, " p"], dz: Float[AnyArray, " p"]) -> AnyArray:
        return z + dz

    def rows(self, z: Float[Array, " p"]) -> Float[Array, "q p1"]:
        return prior_rows(z)

    def curvature(
        self, z: Float[Array, " p"], gradient: Float[Array, " p"]
    ) -> Float[Array, "p p"]:
        return jnp.zeros((z.size, z.size))


def standard(p: int) -> Standard:
    return Standard(Gaussian(jnp.zeros(p), jnp.eye(p)))


class Whitened(AbstractLikelihood):
    """Residuals of unit noise without nuisances: one window, one channel."""

    counts: Float[Array, "1 1"]
    floor: Float[Array, " 1"]
    residual: Callable = eqx.field(static=True)

    @property
    def n_nuisances(self) -> int:
        return 0

    def first_noise(self) -> Noise:
        return Noise(jnp.ones(1), jnp.ones(len(self.counts)))

    def blocks(
        self, tt: Float[Array, " p"], e: Float[Array, "1 0"], scale: Float[Array, "p p"]
    ) -> Blocks:
        J, r = jax.jacfwd(self.residual)(tt), self.residual(tt)
        return factor(J @ scale, r)[None, None]


def whitened(residual: Callable) -> Whitened:
    return Whitened(jnp.ones((1, 1)), jnp.zeros(1), residual)


def curves(z, e):
    """Three windows, two channels, four samples: nonlinear in ``z`` and each ``e``."""
    t = jnp.linspace(0.0, 1.0, 4)[None] + 0.3 * jnp.arange(3.0)[:, None]
    first = jnp.sin(z[0] * t + e[:, :1]) * jnp.exp(0.3 * e[:, 1:])
    second = z[1] * t**2 + e[:, 1:] ** 2 * t - z[0]
    target = jnp.stack([jnp.cos(3.0 * t), t], axis=-1)
    return jnp.stack([first, second], axis=-1) - target


def some_noise():
    return Noise(jnp.asarray([0.2, 0.05]), jnp.asarray([1.0, 0.6, 2.0]))


def stacked(x):
    """All whitened rows, priors included, of ``x = (z, e)``: one dense problem."""
    z, e = x[:2], x[2:].reshape(3, 2)
    noise = some_noise()
    weight = jnp.sqrt(noise.weights)[:, None, None] / noise.sd[None, None]
    return jnp.concatenate([(curves(z, e) * weight).reshape(-1), x])


class Curves(AbstractLikelihood):
    """The same as a likelihood."""

    counts: jax.Array
    floor: jax.Array
    n_nuisances = 2

    def first_noise(self):
        return some_noise()

    def blocks(self, z, e, scale):
        def one(w):
            r = lambda z, own: curves(z, e.at[w].set(own))[w]  # noqa: E731
            by_z, by_e = jax.jacfwd(r, argnums=(0, 1))(z, e[w])
            J = jnp.concatenate([by_e, by_z], axis=-1)
            return jax.vmap(factor, in_axes=1)(J, r(z, e[w]))

        return jnp.stack([one(w) for w in range(3)])


class Found(eqx.Module):
    """Where a descent ended."""

    about: Laplace
    noise: Noise
    costs: Float[Array, " starts"]
    ended: Convergence

    @property
    def z(self) -> Array:
        return self.about.at.z

    @property
    def e(self) -> Array:
        return self.about.at.e

    @property
    def cost(self) -> Array:
        return self.about.at.cost


def descend(likelihood, starts, e, noise, learning=NOTHING, prior=None) -> Found:
    """The best of several descents."""
    prior = standard(starts.shape[1]) if prior is None else prior
    found = multi_start(likelihood, prior, starts, e, noise, learning)
    at, noise, _, steps, costs = found
    about = laplace(at, noise)
    return Found(about, noise, costs, about.convergence(steps))


def minimise(
    likelihood: AbstractLikelihood,
    start: Float[Array, " p"],
    e: Float[Array, "W n"],
    noise: Noise,
    prior: AbstractPrior | None = None,
) -> Found:
    """One descent."""
    return descend(likelihood, start[None], e, noise, prior=prior)


def estimate_of(
    prior: Gaussian,
    posterior: Gaussian,
    noise: Noise,
    nuisances: Float[Array, "W n"],
    log_evidence: float = 0.0,
) -> Estimate:
    """What a fit would have found, without data."""
    p = prior.mean.size
    return Estimate(
        prior,
        posterior,
        noise,
        nuisances,
        jnp.zeros((p, p)),
        jnp.zeros((len(nuisances), p)),
        jnp.asarray(log_evidence),
        converged(p),
    )
