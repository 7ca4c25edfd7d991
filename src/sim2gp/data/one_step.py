"""The likelihood of exact states: independent noise on each increment.

y_n = s'_n - s_n = f(x_n, tt) + eps_n,   eps ~ N(0, diag(sig^2))
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sim2gp.compilation import compile_async
from sim2gp.data.transitions import Transitions
from sim2gp.inference import linearized
from sim2gp.inference.arrowhead import Blocks, Noise
from sim2gp.inference.estimate import Estimate
from sim2gp.inference.groups import Start, estimate_groups
from sim2gp.inference.least_squares import factor
from sim2gp.inference.likelihood import AbstractLikelihood
from sim2gp.inference.prior import ParameterPrior
from sim2gp.systems.base import AbstractSystem
from sim2gp.types import in_float64

FLOOR = 1e-3  # prior guess of the noise, relative to each channel's rms change


class OneStepLikelihood(AbstractLikelihood):
    """Transitions of a machine every ``dt`` s, as one window without nuisances."""

    system: AbstractSystem
    data: Transitions
    counts: Float[Array, "1 d"]
    floor: Float[Array, " d"]
    dt: float = eqx.field(static=True)

    @in_float64
    def __init__(self, system: AbstractSystem, data: Transitions, dt: float) -> None:
        self.system, self.dt = system, dt
        self.data = jax.tree.map(jnp.asarray, data)
        d = len(system.physical_states)
        self.counts = jnp.full((1, d), jnp.sum(self.data.mask, dtype=float))
        self.floor = FLOOR * _rms_change(self.data, d)

    @property
    def n_nuisances(self) -> int:
        return 0

    def rows(
        self, tt: Float[Array, " p"], scale: Float[Array, "p q"]
    ) -> tuple[Float[Array, "N d"], Float[Array, "N d q"]]:
        """Residuals ``f - y`` and their Jacobian along each column of ``scale``.

        Masked rows are zero.
        """
        system, d = self.system, len(self.system.physical_states)

        def one(
            s: Array, a: Array, s2: Array, valid: Array, which: Array | None
        ) -> tuple[Array, Array]:
            def f(x: Array) -> Array:
                return system.transition(tt + scale @ x, s, a, self.dt, which)[:d]

            nowhere = jnp.zeros(scale.shape[1])
            value, J = linearized.value_and_jacobian(f, nowhere)
            return jnp.where(valid, value - s2[:d], 0.0), jnp.where(valid, J, 0.0)

        data = self.data
        rows = data.state, data.action, data.next_state, data.mask, data.configuration
        return linearized.in_blocks(jax.vmap(one), rows, data.mask)

    def blocks(
        self,
        tt: Float[Array, " p"],
        e: Float[Array, "1 0"],
        scale: Float[Array, "p q"],
    ) -> Blocks:
        del e
        r, J = self.rows(tt, scale)
        return jax.vmap(factor, in_axes=1)(J, r)[None]

    def thinned(self, count: int) -> "OneStepLikelihood":
        """That of so many of the transitions, evenly spread; of fewer, of each."""
        N = jnp.sum(self.data.mask)
        places = jnp.arange(count) * jnp.maximum(N, count) // count
        some = jax.tree.map(lambda x: x[places], self.data)
        return OneStepLikelihood(self.system, some, self.dt)

    def first_noise(self) -> Noise:
        """The states' own change in a step."""
        d = self.floor.size
        return Noise(_rms_change(self.data, d), jnp.ones(1))


@compile_async
def compiled_rows(
    likelihood: OneStepLikelihood, tt: Float[Array, " p"], scale: Float[Array, "p q"]
) -> tuple[Float[Array, "N d"], Float[Array, "N d q"]]:
    """`OneStepLikelihood.rows`, for callers on the host."""
    return likelihood.rows(tt, scale)


@compile_async
def estimate_forces(
    system: AbstractSystem,
    data: Transitions,
    dt: float,
    prior: ParameterPrior,
    last: Start,
) -> Estimate:
    """Of a machine whose forces are groups of parameters: `estimate_groups`."""
    likelihood = OneStepLikelihood(system, data, dt)
    return estimate_groups(likelihood, prior, last)


def _rms_change(data: Transitions, d: int) -> Float[Array, " d"]:
    """Of each physical state in one step; 1 where nothing moves."""
    N = jnp.sum(data.mask, dtype=float)
    y = jnp.where(data.mask[:, None], data.delta()[:, :d], 0.0)
    change = jnp.sqrt(jnp.sum(y**2, axis=0) / jnp.maximum(N, 1.0))
    return jnp.where(change > 0.0, change, 1.0)
