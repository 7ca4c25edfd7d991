"""Open-loop predictions of a belief: its best function, and draws of it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from jaxtyping import Key as KeyArray

from sim2gp.belief import AbstractBelief
from sim2gp.data.one_step_log import Steps
from sim2gp.types import Action, Dynamics, Key, State, in_float64


class Ensemble(eqx.Module):
    """Open-loop predictions at some steps: the best single one, and draws."""

    point: Float[np.ndarray, "W R c"]
    draws: Float[np.ndarray, "D W R c"]

    def finite(self) -> bool:
        """Whether every number is; a rollout far from the data may run away."""
        return all(bool(np.isfinite(x).all()) for x in (self.point, self.draws))


@in_float64
def ensemble(
    belief: AbstractBelief,
    windows: Steps,
    start_sd: Float[np.ndarray, " d"],
    *,
    draws: int,
    key: Key,
) -> Ensemble:
    """Roll the belief's point and ``draws`` of its functions through all windows.

    Every draw has its own function, held for the whole window, its own start (of sd
    ``start_sd`` about the given one) and the belief's noise at every step.
    """
    found = _ensemble(
        belief,
        jnp.asarray(windows.start, jnp.float32),
        jnp.asarray(windows.action, jnp.float32),
        jnp.asarray(start_sd, jnp.float32),
        jax.random.split(key, draws),
        windows.steps,
        windows.outputs,
    )
    return Ensemble(*(np.asarray(x, np.float64) for x in found))


@eqx.filter_jit
def _ensemble(
    belief: AbstractBelief,
    start: Float[Array, "W n"],
    action: Float[Array, "W K m"],
    start_sd: Float[Array, " d"],
    keys: KeyArray[Array, " D"],
    steps: tuple[int, ...],
    outputs: tuple[int, ...],
) -> tuple[Array, Array]:
    noise = belief.noise.astype(jnp.float32)[None, None]
    (W, K, _), d, at = action.shape, noise.size, np.asarray(steps) - 1

    def rolled(f: Dynamics, s: State, actions: Array, noises: Array) -> Array:
        def step(s: State, row: tuple[Action, Array]) -> tuple[State, State]:
            a, e = row
            s = f(s, a)
            s = s.at[:d].add(e)
            return s, s

        states = jax.lax.scan(step, s, (actions, noises))[1]
        return states[at][:, np.asarray(outputs)]

    def every(f: Dynamics, starts: Array, noises: Array) -> Array:
        return jax.vmap(lambda s, a, e: rolled(f, s, a, e))(starts, action, noises)

    def one(each: tuple[Key, Key]) -> Array:
        which, own = each
        begin, process = jax.random.split(own)
        starts = start_sd[None] * jax.random.normal(begin, (W, d), jnp.float32)
        noises = noise * jax.random.normal(process, (W, K, d), jnp.float32)
        return every(belief.sample(which), start.at[:, :d].add(starts), noises)

    point = every(belief.point(), start, jnp.zeros((W, K, d), jnp.float32))
    return point, jax.lax.map(one, tuple(jax.vmap(jax.random.split, out_axes=1)(keys)))
