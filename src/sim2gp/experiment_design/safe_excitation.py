"""The first experiment on a machine without a log: a safe excitation, not a design.

Every input is a sum of sines within its limits, at rest at both ends. All amplitudes
are made smaller together until the simulated machine keeps the limits of its joints, at
the nominal parameters and at draws of the prior, and until MuJoCo's model touches
nothing new and stays below the force limits of its actuators.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sim2gp.experiment_design import LimitBox, MultisineCommands
from sim2gp.experiment_design.limits import input_ranges, servo_rates
from sim2gp.systems import MuJoCo
from sim2gp.systems.base import AbstractSystem
from sim2gp.types import Key, in_float64

SECONDS, PERIOD = 30.0, 0.01  # of the experiment, and of its commands, in s
TONES, HIGHEST = 8, 1.0  # sines of each input; the fastest in Hz
DRAWS = 8  # of the prior, next to the nominal parameters
SHARES = (0.4, 0.25, 0.15, 0.1, 0.05)  # of the way to the limits of each input
MARGIN = 0.05  # of a joint's range, kept free at each end
LOOK = 50  # steps, after which a simulation is looked at
FORCE = 0.9  # of an actuator's largest force

Commands = Float[np.ndarray, "T m"]


@dataclass(frozen=True)
class Excitation:
    """Commands each `PERIOD`, the positions expected, and in words what they are.

    ``commands`` is None where none was found; ``words`` then says why.
    """

    words: str
    commands: Commands | None = None
    states: Float[np.ndarray, "T n"] | None = None


@in_float64
def safe_excitation(system: AbstractSystem, *, key: Key, until: float) -> Excitation:
    """The largest of a few sums of sines that keeps all limits in simulation.

    No other one is tried after ``until`` (of `time.monotonic`, s).
    """
    low, high = input_ranges(system)
    open_ = [
        c.name
        for c, a, b in zip(system.actions, low, high, strict=True)
        if not np.isfinite(b - a)
    ]
    if open_:
        names = ", ".join(open_)
        return Excitation(f"no experiment: the model names no limits of {names}")
    home = np.where((low < 0.0) & (high > 0.0), 0.0, 0.5 * (low + high))
    start = _rest_state(system, home)
    n = len(system.physical_states)
    none = np.full(n, np.inf)
    slow = servo_rates(system)
    rate = np.asarray([slow.get(c.name, np.inf) for c in system.actions])
    box = LimitBox(low - home, high - home, rate, -none, none)
    signal = MultisineCommands(
        PERIOD, round(SECONDS / PERIOD), tones=TONES, highest=HIGHEST
    )
    U = np.asarray(signal.commands(signal.random(key, len(low)), box))
    step, why = _drawn_step(system, key), ""
    for share in SHARES:
        if time.monotonic() > until:
            return Excitation("no experiment: the time was over")
        commands = home + share * U
        states, why = _simulate_commands(system, step, start, commands)
        why = why or _strain(system, start, commands)
        if not why:
            words = f"a sum of sines, at most {share:.0%} of the way to each limit"
            return Excitation(words, commands, states[0])
    return Excitation(f"no experiment: with the smallest commands tried, {why}")


def _rest_state(
    system: AbstractSystem, home: Float[np.ndarray, " m"]
) -> Float[np.ndarray, " n"]:
    """At rest where the servos hold it; other joints at zero, or in their middle."""
    states = system.physical_states
    names = [c.name for c in states]
    x = np.asarray(
        [0.0 if c.low < 0.0 < c.high else 0.5 * (c.low + c.high) for c in states]
    )
    if isinstance(system, MuJoCo):
        for channel, target in zip(system.actions, home.tolist(), strict=True):
            joint = system.drives.get(channel.name)
            if channel.name in system.servos and joint in names and channel.unit != "1":
                x[names.index(joint)] = target
    return np.asarray(x)


def _simulate_commands(
    system: AbstractSystem,
    step: Callable[..., Any],
    start: Float[np.ndarray, " n"],
    commands: Commands,
) -> tuple[Float[np.ndarray, "K L n"], str]:
    """States at each command's end, nominal parameters first, and what goes wrong.

    It ends soon after a joint has left its range.
    """
    x = np.tile(start, (1 + DRAWS, 1))
    found: list[np.ndarray] = []
    why = ""
    for k, u in enumerate(commands):
        x = step(x, np.tile(u, (len(x), 1)))
        found.append(x)
        if k % LOOK == LOOK - 1 or k == len(commands) - 1:
            why = _joint_that_leaves(system, np.stack(found[-LOOK:], axis=1))
            if why:
                break
    return np.stack(found, axis=1), why


def _drawn_step(system: AbstractSystem, key: Key) -> Callable[..., Any]:
    """One period of all machines."""
    table, prior = system.parameters, system.parameters.prior()
    z = jax.random.normal(key, (DRAWS, prior.mean.size))
    values = jax.vmap(table.values)(prior.mean[None] + z @ prior.scale.T)
    nominal = table.nominal()
    rows = {
        k: jnp.concatenate([jnp.asarray([nominal[k]]), v]) for k, v in values.items()
    }
    if isinstance(system, MuJoCo):
        theta = np.stack([np.asarray(rows[name]) for name in system.names], axis=1)
        h = np.full(len(theta), PERIOD)
        return lambda x, u: system.engine.flow(theta, x, u, h)
    params = jax.vmap(system.record)(rows)
    flow = jax.jit(jax.vmap(lambda p, x, u: system.flow(p, x, u, PERIOD)))
    return lambda x, u: np.asarray(flow(params, x, u))


def _joint_that_leaves(
    system: AbstractSystem, states: Float[np.ndarray, "K T n"]
) -> str:
    """The joint that comes too near to an end of its range; empty where none does."""
    if not np.isfinite(states).all():
        return "the simulation diverges"
    for i, channel in enumerate(system.physical_states):
        span = channel.high - channel.low
        if not np.isfinite(span):
            continue
        low, high = channel.low + MARGIN * span, channel.high - MARGIN * span
        if states[..., i].min() < low or states[..., i].max() > high:
            return f"{channel.name} comes to an end of its range"
    return ""


def _strain(
    system: AbstractSystem, start: Float[np.ndarray, " n"], commands: Commands
) -> str:
    """What touches, or which actuator is at its force limit, at nominal parameters."""
    if not isinstance(system, MuJoCo):
        return ""
    import mujoco

    nominal = system.parameters.nominal()
    theta = np.asarray([nominal[name] for name in system.names])
    model = system.engine.with_values(theta)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = (
        start[: model.nq],
        start[model.nq : model.nq + model.nv],
    )
    mujoco.mj_forward(model, data)
    touching = data.ncon
    count = max(1, round(PERIOD / model.opt.timestep))
    most = FORCE * np.abs(model.actuator_forcerange).max(axis=1)
    limited = model.actuator_forcelimited.astype(bool)
    for u in commands:
        data.ctrl[:] = u
        mujoco.mj_step(model, data, nstep=count)
        if data.ncon > touching:
            return "parts of the model touch"
        over = limited & (np.abs(data.actuator_force) > most)
        if over.any():
            name = system.actions[int(np.argmax(over))].name
            return f"{name} comes to the limit of its force"
    return ""
