"""Signs, zeros and units that no name tells: the reading that the machine explains.

Every reading of the columns is tried on the machine itself, twice. Forecasts of 0.2 s
at constants drawn from the prior leave the few that are near the best, by

    mean over channels of  1/2 log( error^2 / motion^2 ),

of the better quarter of the draws; of those the one with the highest evidence is taken: the likelihood of `identify`, its
constants fitted, on the windows with the most motion. The plain reading is kept unless
another one is better by `SURE` nats, and what no reading decides is said to be open.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sim2gp.errors import NotConverged, NotFinite
from sim2gp.logs import Column, Log
from sim2gp.logs.units import factor
from sim2gp.models.cutting import cut
from sim2gp.models.grid import evaluation_windows
from sim2gp.models.windows import Windows, fit_windows, simulate
from sim2gp.systems.base import AbstractSystem, Channel
from sim2gp.types import Key, in_float64

SURE = 5.0  # nats of evidence that a reading is better than another by
HORIZON = 0.2  # s
DRAWS, BEST = 16, 4
WINDOWS = 40  # that are tried, those with the most motion
EXHAUSTIVE = 128  # readings at most; beyond, one channel after the other
FINAL = 6  # readings that are fitted
NEAR = 1.5  # of the first score, from the best one
LARGE = 3.2  # of a travel that may be degrees or millimetres
_FLOOR, _CAP = 1e-3, 10.0  # of error / motion


@dataclass(frozen=True)
class Reading:
    """How one joint (with its velocity) or input is read: sign, unit, zero."""

    sign: int = 1
    unit: str | None = None
    offset: float = 0.0

    def of(self, column: Column, rate: bool = False) -> Column:
        """The column read so; a velocity has neither a zero nor the joint's unit."""
        unit = None if self.unit is None else self.unit + "/s" * rate
        return replace(
            column,
            sign=self.sign * column.sign,
            unit=column.unit or unit,
            offset=0.0 if rate else self.offset,
        )


PLAIN = Reading()
Readings = dict[str, Reading]  # of joints and inputs, by channel


@dataclass(frozen=True)
class Found:
    """The best reading of each channel, and by how many nats each beats the next.

    ``surer[name]`` compares with the best reading in which this channel has another
    sign, zero or unit, among those that were fitted (infinite where there is none).
    ``images`` readings, this one among them, the machine cannot tell apart: a pendulum
    and its mirror image.
    """

    readings: Readings
    surer: dict[str, float]
    images: int


@in_float64
def find_readings(
    system: AbstractSystem,
    logs: Sequence[Log],
    stated: Mapping[str, Column],
    *,
    key: Key,
) -> Found:
    """The reading of every measured joint and every input that explains the logs best.

    ``stated`` are the columns that the logs were read by; a unit that one states stays.
    """
    joints = {c.name: c for c in system.physical_states}
    options: dict[str, list[Reading]] = {}
    for name, column in stated.items():
        if name in joints and not name.endswith(".velocity"):
            options[name] = _of_joint(joints[name], column, logs)
        elif name not in joints:
            options[name] = [PLAIN, Reading(-1)]
    trial = _Trial(system, logs, key)
    tried = _tried(trial, options)
    first = list(dict(reversed([(score, r) for r, score in tried])).items())
    near = [r for score, r in sorted(first)[:FINAL] if score < tried[0][1] + NEAR]
    evidence = [trial.evidence(reading) for reading in near]
    top = max(evidence)
    good = [r for r, e in zip(near, evidence, strict=True) if e >= top - SURE]
    chosen = min(good, key=_departs)
    surer = {
        name: top
        - max(
            (e for r, e in zip(near, evidence, strict=True) if r[name] != chosen[name]),
            default=-np.inf,
        )
        for name in options
    }
    score = dict((tuple(r.items()), s) for r, s in tried)[tuple(chosen.items())]
    return Found(chosen, surer, sum(s == score for _, s in tried))


def _of_joint(channel: Channel, column: Column, logs: Sequence[Log]) -> list[Reading]:
    """The plain reading first; half a turn's zero where the joint turns freely."""
    units: list[str | None] = [None]
    travel = max(np.ptp(log.channels[channel.name]) for log in logs)
    if column.unit is None and travel > LARGE:
        units += {"rad": ["deg"], "m": ["mm", "cm"]}.get(channel.unit, [])
    zeros = (0.0, np.pi) if channel.angle else (0.0,)
    return [
        Reading(sign, unit, zero)
        for unit in units
        for zero in zeros
        for sign in (1, -1)
    ]


def _departs(reading: Readings) -> int:
    return sum(r != PLAIN for r in reading.values())


def _tried(
    trial: "_Trial", options: Mapping[str, list[Reading]]
) -> list[tuple[Readings, float]]:
    """Readings with their scores, best first; of equal ones the plainer first.

    All of them where they are few, else channel by channel, twice around.
    """
    if np.prod([len(choices) for choices in options.values()]) <= EXHAUSTIVE:
        every = [
            dict(zip(options, chosen, strict=True))
            for chosen in itertools.product(*options.values())
        ]
    else:
        best, every = dict.fromkeys(options, PLAIN), []
        for name in [*options, *options]:
            here = [{**best, name: reading} for reading in options[name]]
            best = min(here, key=lambda r: (trial.score(r), _departs(r)))
            every += [r for r in here if r not in every]
    scored = [(reading, round(trial.score(reading), 6)) for reading in every]
    return sorted(scored, key=lambda x: (x[1], _departs(x[0])))


class _Trial:
    """What readings are worth; each of the two programs is compiled once."""

    def __init__(self, system: AbstractSystem, logs: Sequence[Log], key: Key) -> None:
        self.system, self.logs, self.key = system, logs, key
        self.known: dict[Any, float] = {}
        prior = system.parameters.prior()
        draws = jax.random.normal(key, (DRAWS - 1, prior.mean.size))
        z = jnp.concatenate([jnp.zeros((1, prior.mean.size)), draws])
        self.tt = prior.mean + z @ prior.scale.T
        grid = evaluation_windows(logs, system, longest=HORIZON)
        known = np.isfinite(grid.lag).all(axis=1)
        self.ahead = _moving(grid.windows, known)
        windows, _ = cut(logs, system, window=HORIZON)
        self.fitted = _moving(windows, np.ones(len(windows), bool))

    def score(self, readings: Readings) -> float:
        """Of forecasts at draws of the prior, from centred starts."""
        name = tuple(readings.items())
        if name not in self.known:
            logs = [_read(log, readings, self.system) for log in self.logs]
            grid = evaluation_windows(logs, self.system, longest=HORIZON)
            start = grid.windows.start - np.nan_to_num(grid.lag)
            some = _some(replace(grid.windows, start=start), self.ahead)
            motion = np.maximum(_motion(some).mean(axis=0), 1e-30)
            share = np.sqrt(np.asarray(_errors(self.system, some, self.tt)) / motion)
            share = np.where(np.isfinite(share), np.clip(share, _FLOOR, _CAP), _CAP)
            each = np.sort(np.log(share).mean(axis=1))
            self.known[name] = float(each[:BEST].mean())
        return self.known[name]

    def evidence(self, readings: Readings) -> float:
        """Log evidence of what the files say, in nats, after a fit of the constants."""
        logs = [_read(log, readings, self.system) for log in self.logs]
        windows, _ = cut(logs, self.system, window=HORIZON)
        some = _some(windows, self.fitted)
        try:
            belief = fit_windows(self.system, some, key=self.key, starts=1)
        except (NotConverged, NotFinite):
            return -np.inf
        states = [c.name for c in self.system.physical_states]
        scales = [_scale(states[i], readings, self.system) for i in some.outputs]
        samples = np.asarray(some.mask).sum(axis=(0, 1))
        density = float(samples @ np.log(np.abs(scales)))  # of the file's own numbers
        return float(belief.log_evidence) + density


def _moving(windows: Windows, known: Bool[np.ndarray, " W"]) -> Int[np.ndarray, " K"]:
    """The windows with the most motion, of whole ones."""
    whole = known & np.asarray(windows.mask).any(axis=(1, 2))
    motion = np.where(whole, _motion(windows).mean(axis=1), -1.0)
    most = np.argsort(-motion, kind="stable")[:WINDOWS]
    return np.sort(most[motion[most] >= 0.0])


def _some(windows: Windows, which: Int[np.ndarray, " K"]) -> Windows:
    floor = windows.floor
    rest = eqx.tree_at(lambda w: w.floor, windows, None)
    some = jax.tree.map(lambda x: np.asarray(x)[which], rest)
    return eqx.tree_at(lambda w: w.floor, some, floor, is_leaf=lambda x: x is None)


def _motion(windows: Windows) -> Float[np.ndarray, "W c"]:
    """Mean square of how far each channel went within a window."""
    y, mask = np.asarray(windows.y), np.asarray(windows.mask)
    away = np.where(mask, (y - y[:, :1]) ** 2, 0.0)
    return np.asarray(away.sum(axis=1) / np.maximum(mask.sum(axis=1), 1))


@eqx.filter_jit
def _errors(
    system: AbstractSystem, windows: Windows, tt: Float[Array, "K p"]
) -> Float[Array, "K c"]:
    """Mean square of forecasts' errors at each vector of constants."""

    def at(tt: Array) -> Array:
        params = system.record(system.parameters.values(tt))

        def one(window: Windows) -> Array:
            states = simulate(system, params, window, window.start)
            away = states[:, np.asarray(window.outputs)] - window.y
            count = jnp.maximum(window.mask.sum(axis=0), 1)
            return jnp.where(window.mask, away**2, 0.0).sum(axis=0) / count

        found: Array = windows.each(one)
        return found.mean(axis=0)

    return jax.vmap(at)(tt)


def _scale(channel: str, readings: Readings, system: AbstractSystem) -> float:
    """What a reading multiplies a channel by."""
    joint = channel.removesuffix(".velocity")
    base = next(c.unit for c in system.physical_states if c.name == joint)
    reading = readings.get(joint, PLAIN)
    return reading.sign * factor(reading.unit, base, joint)


def _read(log: Log, readings: Readings, system: AbstractSystem) -> Log:
    """The log in another reading than the plain one that it was read in."""
    channels = {
        name: _scale(name, readings, system) * x
        + (readings[name].offset if name in readings else 0.0)
        for name, x in log.channels.items()
    }
    inputs = {
        name: readings.get(name, PLAIN).sign * u for name, u in log.inputs.items()
    }
    return replace(log, channels=channels, inputs=inputs)
