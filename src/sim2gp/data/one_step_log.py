"""Logs for models of one step: an even period, smoothed states, mean inputs.

A model of one step, ``s' = f(s, a)``, cannot read a log directly: its rows come at the
log's own stamps, velocities are not measured, inputs change within a step. Here a state
is found every ``period`` seconds from the 50 ms of samples around it, and the input of
a step is the mean of the held one. A delay stays in the machine: the state then carries
the inputs of past steps (`carrying_inputs`). The windows to be judged by are those of
`sim2gp.data.grid`, and start as those do, from the past alone.

The parabola through 50 ms of a fast swing is off by its third derivative, which a model
of one step would learn as physics. So the parabola is taken of what a simulation of the
same 50 ms leaves, started where the parabolas say; thrice, as the start improves.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sim2gp.data.cuts import inputs_since, knots_of
from sim2gp.data.grid import (
    PERIOD,
    SAMPLES,
    Grid,
    even_spans,
    on_grid,
    parabola_weights,
    states_from,
)
from sim2gp.data.logs import Log
from sim2gp.data.split_log import measured_states
from sim2gp.data.transitions import Transitions
from sim2gp.data.windows import Windows
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.simulate import simulate
from sim2gp.types import in_float64

PASSES = 3  # simulations behind a smoothed state


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


class Samples(eqx.Module):
    """The samples around every state that is wanted, and the steps between states.

    windows: 50 ms about each state, rows as in a forecast; the start is a parabola's.
    rough: the state by parabolas alone. log: of each state.
    first: of each step, the index of its state; the next state is one index on.
    held: of each step, the mean inputs of the past ones and its own, oldest first.
    """

    windows: Windows
    rough: Float[np.ndarray, "N n"]
    log: Int[np.ndarray, " N"]
    first: Int[np.ndarray, " M"]
    held: Float[np.ndarray, "M past1 m"]

    def step_log(self) -> Int[np.ndarray, " M"]:
        """The log of each step."""
        return self.log[self.first]


def samples_of(logs: Sequence[Log], stepper: AbstractSystem, period: float) -> Samples:
    """All states and steps of the logs for which no sample of their 50 ms is masked.

    ``stepper`` is what `carrying_inputs` returns.
    """
    names = [channel.name for channel in stepper.physical_states]
    actions = [channel.name for channel in stepper.actions]
    measured = measured_states(logs, stepper)
    stride, half = stride_of(period), SAMPLES // 2
    parts: list[tuple[np.ndarray, ...]] = []
    spans: list[tuple[int, float, float]] = []
    for k, log in enumerate(logs):
        y, valid = on_grid(log, measured)
        at = np.arange(-(-half // stride) * stride, len(y) - half, stride)
        around = at[:, None] + np.arange(-half, half + 1)[None]
        whole = valid[around].all(axis=(1, 2))
        at, around = at[whole], around[whole]
        follows = np.flatnonzero(np.diff(at) == stride)
        since = log.time[0] + PERIOD * at
        inputs = since[follows], period, stepper.history, 1
        held = mean_inputs(log, actions, *inputs)
        parts.append((y[around], np.full(len(at), k), len(spans) + follows, held))
        spans += [(k, float(s) - PERIOD * half, 2 * PERIOD * half) for s in since]
    y, which, first, held = (np.concatenate(x) for x in zip(*parts, strict=True))
    knots, area = inputs_since(logs, actions, spans, stepper.longest_delay)
    local = _parabolas(y)
    start = _parabola_state(local, -PERIOD * half, names, measured)
    windows = Windows(
        even_spans(*y.shape[:2]),
        knots,
        area,
        y,
        np.ones(y.shape, bool),
        start,
        np.zeros_like(start),
        np.zeros(len(measured)),
        np.asarray([logs[k].group for k, _, _ in spans], np.int32),
        tuple(names.index(name) for name in measured),
    )
    return Samples(
        windows,
        _parabola_state(local, 0.0, names, measured),
        which,
        first,
        held,
    )


@in_float64
def smoothed_states(
    system: AbstractSystem, tt: Float[Array, " p"], samples: Samples
) -> Float[np.ndarray, "N n"]:
    """The states in the middle of their samples, by simulation and parabola.

    ``system`` and its virtual parameters ``tt`` are those of the windows' fit.
    """
    names = [channel.name for channel in system.physical_states]
    w = samples.windows
    measured = [names[i] for i in w.outputs]
    start, y, half = w.start, np.asarray(w.y), SAMPLES // 2
    exact = jax.tree.map(jnp.asarray, w)
    for _ in range(PASSES):
        path = np.asarray(_simulate_windows(system, tt, exact, jnp.asarray(start)))
        left = _parabolas(y - path[..., list(w.outputs)])
        start = start + _parabola_state(left, -PERIOD * half, names, measured)
        states = path[:, half] + _parabola_state(left, 0.0, names, measured)
    return np.asarray(states)


@eqx.filter_jit
def _simulate_windows(
    system: AbstractSystem, tt: Array, windows: Windows, start: Float[Array, "N n"]
) -> Float[Array, "N L n"]:
    params = system.record(system.parameters.values(tt))
    found: Array = windows.each(
        lambda window, x0: simulate(system, params, window, x0), start
    )
    return found


def transitions(samples: Samples, states: Float[np.ndarray, "N n"]) -> Transitions:
    """One-step data between the given states, past inputs carried newest first."""
    now, then = states[samples.first], states[samples.first + 1]
    held, count = samples.held, len(samples.first)
    before = held[:, :-1][:, ::-1].reshape(count, -1)
    after = held[:, 1:][:, ::-1].reshape(count, -1)
    return Transitions.of(
        np.concatenate([now, before], axis=1),
        held[:, -1],
        np.concatenate([then, after], axis=1),
    )


def _parabolas(y: Float[np.ndarray, "N L c"]) -> Float[np.ndarray, "N 3 c"]:
    """Coefficients of the parabola through each window, time from its middle."""
    half = SAMPLES // 2
    age = PERIOD * np.arange(-half, half + 1)
    return np.asarray(np.einsum("kl,nlc->nkc", parabola_weights(age), y))


def _parabola_state(
    local: Float[np.ndarray, "N 3 c"],
    t: float,
    names: Sequence[str],
    measured: Sequence[str],
) -> Float[np.ndarray, "N n"]:
    """The state at ``t`` by parabolas: values, and slopes for unmeasured velocities."""
    value = local[:, 0] + t * (local[:, 1] + t * local[:, 2])
    slope = local[:, 1] + 2.0 * t * local[:, 2]
    return states_from(value, slope, names, measured)


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
