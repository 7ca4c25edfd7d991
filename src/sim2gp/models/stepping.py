"""Logs for models of one step: an even period, smoothed states, mean inputs.

A model of one step, ``s' = f(s, a)``, cannot read a log directly: its rows come at the
log's own stamps, velocities are not measured, inputs change within a step. Here the
states are the values and slopes of parabolas through 50 ms of samples, centred on the
sample (a Savitzky-Golay filter), taken every ``period`` seconds, and the input of a
step is the mean of the held one. A delay stays in the machine: the state then carries
the inputs of past steps (`Actuated`). The windows to be judged by are those of
`sim2gp.models.grid`, and start as those do, from the past alone.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from jaxtyping import Key as KeyArray

from sim2gp.logs import Log
from sim2gp.models.base import AbstractBelief
from sim2gp.models.cutting import knots_of, measured_states
from sim2gp.models.grid import PERIOD, Grid, on_grid, smoothed
from sim2gp.systems.actuator import Actuated
from sim2gp.systems.base import AbstractSystem
from sim2gp.transitions import Transitions
from sim2gp.types import Action, Dynamics, Key, State, in_float64


def stepping(system: AbstractSystem, period: float) -> AbstractSystem:
    """The machine as its one-step map needs it: delayed inputs are carried along.

    Its constants are the same, in the same order.
    """
    if not (isinstance(system, Actuated) and system.longest_delay > 0.0):
        return system
    return Actuated(
        system.system,
        parameters=system.parameters,
        delay_max=system.longest_delay,
        period=period,
    )


class Steps(eqx.Module):
    """Windows at an even period: a start with its past inputs, and what is applied.

    ``y`` are the measured outputs at the chosen steps, ``valid`` which of them count.
    """

    start: Float[np.ndarray, "W n"]
    action: Float[np.ndarray, "W K m"]
    y: Float[np.ndarray, "W R c"]
    valid: Bool[np.ndarray, "W R c"]
    log: Int[np.ndarray, " W"]
    steps: tuple[int, ...] = eqx.field(static=True)  # of each row R, from 1
    outputs: tuple[int, ...] = eqx.field(static=True)


def stride_of(period: float) -> int:
    """The number of grid samples in a period, at least one."""
    return max(1, round(period / PERIOD))


def transitions(
    logs: Sequence[Log], system: AbstractSystem, period: float
) -> tuple[Transitions, Int[np.ndarray, " N"]]:
    """All smoothed transitions of the logs, and the log of each.

    ``system`` is what `stepping` returns. A transition counts where no sample under
    its two parabolas is masked.
    """
    names = [channel.name for channel in system.physical_states]
    actions = [channel.name for channel in system.actions]
    measured = measured_states(logs, system)
    stride, past = stride_of(period), system.history
    parts, which = [], []
    for k, log in enumerate(logs):
        y, valid = on_grid(log, measured)
        states = smoothed(np.where(valid, y, np.nan), names, measured)
        rows = np.arange(0, len(y) - stride, stride)
        whole = np.isfinite(states).all(axis=1)
        rows = rows[whole[rows] & whole[rows + stride]]
        held = mean_inputs(log, actions, log.time[0] + PERIOD * rows, period, past, 1)
        before = held[:, :past][:, ::-1].reshape(len(rows), -1)
        after = held[:, 1:][:, ::-1].reshape(len(rows), -1)
        now, then = states[rows], states[rows + stride]
        parts.append(
            (
                np.concatenate([now, before], axis=1),
                held[:, past],
                np.concatenate([then, after], axis=1),
            )
        )
        which.append(np.full(len(rows), k))
    state, action, then = (np.concatenate(x) for x in zip(*parts, strict=True))
    return Transitions.of(state, action, then), np.concatenate(which)


def steps_of_grid(
    grid: Grid,
    logs: Sequence[Log],
    system: AbstractSystem,
    period: float,
    judged: Sequence[int],
) -> Steps:
    """The evaluation windows at an even period, judged after so many steps each."""
    actions = [channel.name for channel in system.actions]
    stride, past, W = stride_of(period), system.history, grid.windows
    steps = tuple(judged)
    K, m = max(steps), len(actions)
    held = np.zeros((len(W), past + K, m))
    for k, log in enumerate(logs):
        inside = grid.log == k
        since = grid.since[inside]
        held[inside] = mean_inputs(log, actions, since, stride * PERIOD, past, K)
    before = held[:, :past][:, ::-1].reshape(len(W), -1)
    rows = stride * np.asarray(steps)
    return Steps(
        np.concatenate([np.asarray(W.start), before], axis=1),
        held[:, past:],
        np.asarray(W.y)[:, rows],
        np.asarray(W.mask)[:, rows],
        grid.log,
        steps,
        tuple(W.outputs),
    )


def mean_inputs(
    log: Log,
    actions: Sequence[str],
    since: Float[np.ndarray, " W"],
    period: float,
    past: int,
    count: int,
) -> Float[np.ndarray, "W steps m"]:
    """Mean held input of ``past`` periods before each time and ``count`` after it.

    Oldest first; before its first row a log's first input was held, after its last
    one the last.
    """
    time, area = knots_of(log, actions, past * period)
    edges = since[:, None] + period * np.arange(-past, count + 1)[None]
    flat = np.clip(edges.ravel(), time[0], time[-1])
    whole = [np.interp(flat, time, column).reshape(edges.shape) for column in area.T]
    return np.diff(np.stack(whole, axis=-1), axis=1) / period


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
    noise = belief.noise.astype(jnp.float32)  # type: ignore[attr-defined]
    d, at = noise.size, np.asarray(steps) - 1

    def rolled(f: Dynamics, s: State, actions: Array, noises: Array) -> Array:
        def step(s: State, row: tuple[Action, Array]) -> tuple[State, State]:
            a, e = row
            s = f(s, a)
            s = s.at[:d].add(e)
            return s, s

        states = jax.lax.scan(step, s, (actions, noises))[1]
        return states[at][:, np.asarray(outputs)]

    every = jax.vmap(rolled, in_axes=(None, 0, 0, 0))
    shape = (*action.shape[:2], d)

    def one(key: Key) -> Array:
        function, begin, process = jax.random.split(key, 3)
        e = jax.random.normal(begin, (len(start), d), jnp.float32) * start_sd[None]
        steps = jax.random.normal(process, shape, jnp.float32) * noise[None, None]
        return every(belief.sample(function), start.at[:, :d].add(e), action, steps)

    point = every(belief.point(), start, action, jnp.zeros(shape, jnp.float32))
    return point, jax.lax.map(one, keys)
