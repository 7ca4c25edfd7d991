"""Networks of off-policy learning: layers, twin critics, a squashed Gaussian.

    u = tanh(mu(o) + sigma(o) eps),        log pi = log N - sum log(1 - u^2)

Policies act in the unit box ``[-1, 1]^m``; `Policy` maps it to the machine's.
"""

import itertools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sim2gp.inference.gaussian import LOG_2PI
from sim2gp.planning.mpc import from_unit
from sim2gp.planning.world import Observation
from sim2gp.types import Action, Box, Key, Scalar, State

#: Bounds of a policy's log sd, which its network moves between.
LOG_SD = (-5.0, 2.0)


class MLP(eqx.Module):
    """Layers of ReLU; the last one is linear."""

    weights: tuple[Float[Array, "_ _"], ...]
    biases: tuple[Float[Array, " _"], ...]

    @classmethod
    def random(cls, key: Key, sizes: tuple[int, ...]) -> "MLP":
        """Weights and biases uniform within ``1 / sqrt(inputs)``, in float32."""
        weights, biases = [], []
        for inputs, outputs in itertools.pairwise(sizes):
            key, a, b = jax.random.split(key, 3)
            most = 1.0 / math.sqrt(inputs)
            shape = (inputs, outputs)
            weights.append(jax.random.uniform(a, shape, jnp.float32, -most, most))
            biases.append(jax.random.uniform(b, (outputs,), jnp.float32, -most, most))
        return cls(tuple(weights), tuple(biases))

    def __call__(self, x: Float[Array, " i"]) -> Float[Array, " o"]:
        for W, b in zip(self.weights[:-1], self.biases[:-1], strict=True):
            x = jax.nn.relu(x @ W + b)
        return x @ self.weights[-1] + self.biases[-1]


#: Two, of which the lower one is believed (Fujimoto et al. 2018).
Critics = tuple[MLP, MLP]


def random_critics(key: Key, observed: int, m: int, hidden: tuple[int, ...]) -> Critics:
    """Two that have nothing in common."""
    one, other = jax.random.split(key)
    sizes = (observed + m, *hidden, 1)
    return MLP.random(one, sizes), MLP.random(other, sizes)


def values(
    critics: Critics, o: Float[Array, " o"], u: Float[Array, " m"]
) -> Float[Array, " two"]:
    """What each critic expects of an action."""
    x = jnp.concatenate([o, u])
    return jnp.concatenate([critic(x) for critic in critics])


def squashed(
    actor: MLP, o: Float[Array, " o"], key: Key
) -> tuple[Float[Array, " m"], Scalar]:
    """A drawn action in the unit box, and its log density."""
    mean, raw = jnp.split(actor(o), 2)
    low, high = LOG_SD
    log_sd = low + 0.5 * (high - low) * (jnp.tanh(raw) + 1.0)
    eps = jax.random.normal(key, mean.shape, mean.dtype)
    x = mean + jnp.exp(log_sd) * eps
    normal = -0.5 * eps**2 - log_sd - 0.5 * LOG_2PI
    # log(1 - tanh^2 x), where tanh has rounded to one as well.
    slope = 2.0 * (math.log(2.0) - x - jax.nn.softplus(-2.0 * x))
    return jnp.tanh(x), jnp.sum(normal - slope)


class Policy(eqx.Module):
    """A state's action, without noise: all that a machine needs of what was trained."""

    actor: MLP
    observe: Observation
    box: Box

    def __call__(self, s: State) -> Action:
        mean, _ = jnp.split(self.actor(self.observe(s)), 2)
        return from_unit(jnp.tanh(mean)[None], self.box)[0]
