"""Signs, zeros and units that no name tells: the reading that the machine explains.

Every reading of the columns is tried on the machine itself, twice, on the windows with
the most motion. Forecasts at constants drawn from the prior leave the few that are near
the best, by

    mean over channels of  1/2 log( error^2 / motion^2 )

of the better quarter of the draws; of those the one with the highest evidence is taken,
with the likelihood of `identify` and its constants fitted. The plainest reading is kept
unless another one is better by `SURE` nats; what no reading decides is said to be open.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sim2gp.data.logs import Column, Log
from sim2gp.data.logs.units import factor
from sim2gp.data.split_log import cut
from sim2gp.data.windows import Windows
from sim2gp.errors import NotConverged, NotFinite
from sim2gp.identification.fit import fit_windows
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.simulate import simulate
from sim2gp.types import Key, in_float64

SURE = 5.0  # nats of evidence that a reading is better than another by
WINDOW = 0.2  # s
DRAWS, BEST = 16, 4
WINDOWS = 40  # that are tried
EXHAUSTIVE = 128  # readings at most; beyond, one channel after the other
FINAL = 6  # readings that are fitted
NEAR = 1.5  # of the first score, from the best one
_FLOOR, _CAP = 1e-3, 10.0  # of error / motion


@dataclass(frozen=True)
class Reading:
    """How a joint (with its velocity) or an input is read: its sign and its zero."""

    sign: int = 1
    offset: float = 0.0

    def of(self, column: Column, rate: bool = False) -> Column:
        """The column read so; a velocity has no zero."""
        offset = 0.0 if rate else self.offset
        return replace(column, sign=self.sign * column.sign, offset=offset)


PLAIN = Reading()
Readings = dict[str, Reading]  # of joints and inputs, by channel


class Version(NamedTuple):
    """The columns in certain units, and the logs as these read them."""

    columns: Mapping[str, Column]
    logs: Sequence[Log]


@dataclass(frozen=True)
class Found:
    """The best version, and its best reading of each channel.

    ``surer[name]``: by how many nats of evidence this beats the best reading in which
    the channel has another sign or zero, or unit, of those that were fitted (infinite
    where there is none). ``images`` readings, this one among them, the machine cannot
    tell apart: a pendulum and its mirror image.
    """

    version: Version
    readings: Readings
    surer: dict[str, float]
    images: int


@in_float64
def find_readings(
    system: AbstractSystem, versions: Sequence[Version], *, key: Key
) -> Found:
    """The reading of joints and inputs that explains the logs best.

    Raises `NotConverged` where the constants can be fitted in no reading.
    """
    trials = [_Trial(system, version, key) for version in versions]
    tried = sorted(
        ((score, k, r) for k, t in enumerate(trials) for score, r in t.tried()),
        key=lambda x: (x[0], x[1], _departs(x[2])),
    )
    plainest = {score: (k, r) for score, k, r in reversed(tried)}
    near = [x for s, x in sorted(plainest.items()) if s < tried[0][0] + NEAR][:FINAL]
    evidence = [trials[k].evidence(reading) for k, reading in near]
    top = max(evidence)
    if not np.isfinite(top):
        raise NotConverged("E201", "no reading of the columns can be fitted")
    good = [x for x, e in zip(near, evidence, strict=True) if e >= top - SURE]
    k, chosen = min(good, key=lambda x: (x[0], _departs(x[1])))
    surer = {}
    for name in chosen:
        other = [
            e
            for (j, r), e in zip(near, evidence, strict=True)
            if r[name] != chosen[name] or j != k
        ]
        surer[name] = top - max(other, default=-np.inf)
    score = next(s for s, j, r in tried if (j, r) == (k, chosen))
    images = sum((s, j) == (score, k) for s, j, _ in tried)
    return Found(versions[k], chosen, surer, images)


def _departs(reading: Readings) -> int:
    return sum(r != PLAIN for r in reading.values())


class _Trial:
    """What readings of one version are worth."""

    def __init__(self, system: AbstractSystem, version: Version, key: Key) -> None:
        self.system, self.version, self.key = system, version, key
        windows, _ = cut(version.logs, system, window=WINDOW)
        self.windows = _moving(windows)
        prior = system.parameters.prior()
        draws = jax.random.normal(key, (DRAWS - 1, prior.mean.size))
        z = jnp.concatenate([jnp.zeros((1, prior.mean.size)), draws])
        self.tt = prior.mean[None] + z @ prior.scale.T
        self.options = {
            name: _options(name, system)
            for name in version.columns
            if not name.endswith(".velocity")
        }

    def tried(self) -> list[tuple[float, Readings]]:
        """All readings where they are few, else channel by channel, twice around."""
        choices = self.options.values()
        if np.prod([len(readings) for readings in choices]) <= EXHAUSTIVE:
            every = itertools.product(*choices)
            readings = [dict(zip(self.options, r, strict=True)) for r in every]
            return [(self.score(reading), reading) for reading in readings]
        best = dict.fromkeys(self.options, PLAIN)
        known: dict[tuple[tuple[str, Reading], ...], float] = {}
        for name in [*self.options, *self.options]:
            here = [{**best, name: reading} for reading in self.options[name]]
            scored = [(self.score(r), _departs(r), i) for i, r in enumerate(here)]
            known |= {tuple(here[i].items()): s for s, _, i in scored}
            best = here[min(scored)[2]]
        return [(score, dict(reading)) for reading, score in known.items()]

    def score(self, readings: Readings) -> float:
        """Of forecasts at draws of the prior."""
        windows = _read(self.windows, readings, self.system)
        motion = np.maximum(_motion(windows).mean(axis=0), 1e-30)
        share = np.sqrt(np.asarray(_errors(self.system, windows, self.tt)) / motion)
        share = np.where(np.isfinite(share), np.clip(share, _FLOOR, _CAP), _CAP)
        each = np.sort(np.log(share).mean(axis=1))
        return round(float(each[:BEST].mean()), 6)

    def evidence(self, readings: Readings) -> float:
        """Log evidence of the numbers in the files, in nats, constants fitted."""
        windows = _read(self.windows, readings, self.system)
        try:
            belief = fit_windows(self.system, windows, key=self.key, starts=1)
        except (NotConverged, NotFinite):
            return -np.inf
        units = {c.name: c.unit for c in self.system.physical_states}
        names = [list(units)[i] for i in windows.outputs]
        scales = [
            factor(self.version.columns[name].unit, units[name], name) for name in names
        ]
        samples = np.asarray(windows.mask).sum(axis=(0, 1))
        return float(belief.log_evidence) + float(samples @ np.log(scales))


def _options(name: str, system: AbstractSystem) -> list[Reading]:
    """Both signs; half a turn's zero where a joint turns freely."""
    turns = any(c.name == name and c.angle for c in system.physical_states)
    return [Reading(s, z) for z in (0.0, np.pi)[: 1 + turns] for s in (1, -1)]


def _moving(windows: Windows) -> Windows:
    """Those with the most motion; the noise of starts is that of all."""
    most = np.argsort(-_motion(windows).mean(axis=1), kind="stable")[:WINDOWS]
    which: Int[np.ndarray, " K"] = np.sort(most)
    some = jax.tree.map(
        lambda x: np.asarray(x)[which], eqx.tree_at(lambda w: w.floor, windows, None)
    )
    kept: Windows = eqx.tree_at(
        lambda w: w.floor, some, windows.floor, is_leaf=lambda x: x is None
    )
    return kept


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
            count = jnp.maximum(window.mask.sum(axis=0, dtype=away.dtype), 1.0)
            return jnp.where(window.mask, away**2, 0.0).sum(axis=0) / count

        found: Array = windows.each(one)
        return found.mean(axis=0)

    return jax.vmap(at)(tt)


def _read(windows: Windows, readings: Readings, system: AbstractSystem) -> Windows:
    """The windows in another reading than the plain one that they were cut in."""
    names = [c.name for c in system.physical_states]
    of = [readings.get(name.removesuffix(".velocity"), PLAIN) for name in names]
    sign = np.asarray([float(r.sign) for r in of])
    zero = np.asarray(
        [
            0.0 if n.endswith(".velocity") else r.offset
            for n, r in zip(names, of, strict=True)
        ]
    )
    seen = np.asarray(windows.outputs)
    inputs = np.asarray(
        [float(readings.get(c.name, PLAIN).sign) for c in system.actions]
    )
    found: Windows = eqx.tree_at(
        lambda w: (w.y, w.start, w.area),
        windows,
        (
            windows.y * sign[seen] + zero[seen],
            windows.start * sign + zero,
            windows.area * inputs,
        ),
    )
    return jax.tree.map(jnp.asarray, found)
