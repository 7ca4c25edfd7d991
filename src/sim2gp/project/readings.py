"""Signs, zeros and units that no name gives: the reading that the machine explains.

The machine predicts short windows of the logs, at the file's own parameters, under each
reading of a channel. A window's score is the mean over measured channels of

    1/2 log( error^2 / motion^2 )

and one reading beats another where its score is lower in most windows (a sign test).
Readings that none beats are tried again on twice as many windows (a race; Maron and
Moore 1994). All readings are tried where they are few. Otherwise each joint is tried
with the inputs that act on it, twice around, while the other channels keep the best
reading so far: first by its own prediction, then by those of all. The plainest reading
stays unless another beats it; what the time did not suffice for, and what no window
decides, is reported.
"""

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sim2gp.data.logs import Column, Log
from sim2gp.data.logs.units import unit_factor
from sim2gp.data.split_log import cut
from sim2gp.data.windows import Windows, channel_motion
from sim2gp.systems import MuJoCo
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.simulate import inputs_of
from sim2gp.types import in_float64

SURE = 3.0  # (windows won - windows lost) / sqrt(windows): the sign test's z
WINDOW = 0.2  # s
WINDOWS, STAGES = 40, 4  # tried first; how often their number may double, and once
SECONDS = 120.0  # of the logs, from which those windows are taken
EXHAUSTIVE = 256  # readings at most; beyond, one joint after the other
ROWS = 4096  # windows that are simulated together
_FLOOR, _CAP = 1e-3, 10.0  # of error / motion
_SAME = 1e-6  # of two scores

Scores = Float[np.ndarray, "K W"]


@dataclass(frozen=True)
class Reading:
    """How a joint (with its velocity) or an input is read: sign, zero, other unit."""

    sign: int = 1
    offset: float = 0.0
    unit: str | None = None

    def of(self, column: Column, rate: bool = False) -> Column:
        """The column read so; a velocity has no zero."""
        unit = self.unit and (f"{self.unit}/s" if rate else self.unit)
        return replace(
            column,
            sign=self.sign * column.sign,
            offset=0.0 if rate else self.offset,
            unit=column.unit or unit,
        )


PLAIN = Reading()
Readings = dict[str, Reading]  # of joints and inputs, by channel


@dataclass(frozen=True)
class Question:
    """The logs of a machine, and how each of its channels may be read.

    ``logs`` are read in the `finer` unit of each channel's options. ``options`` lists
    the readings of joints and inputs by name, the plainest first; ``together`` names
    the channels that are tried in one go.
    """

    logs: Sequence[Log]
    options: Mapping[str, Sequence[Reading]]
    together: Sequence[Sequence[str]]


def finer(options: Sequence[Reading]) -> str | None:
    """The unit in which no number of a channel is too large; None is its own."""
    return next((reading.unit for reading in options if reading.unit), None)


@dataclass
class BestReadings:
    """The best reading of each channel, and how sure that is.

    ``surer[name]``: the sign test's z against the best reading in which the channel
    differs, infinite where it has no other; a channel that was not tried has no entry.
    ``rivals[name]``: that other reading, of all channels that were tried with it.
    ``images`` readings, this one among them, fit the machine equally well: a pendulum
    and its mirror image.
    """

    readings: Readings
    surer: dict[str, float] = field(default_factory=dict)
    rivals: dict[str, Readings] = field(default_factory=dict)
    images: int = 1


@in_float64
def find_readings(
    system: AbstractSystem, asked: Question, *, until: float
) -> BestReadings:
    """The reading of joints and inputs that explains the logs best.

    ``until`` (of `time.monotonic`, s): what was not tried by then keeps its first
    option. Raises `InputError` E116 where no window can be cut.
    """
    found = BestReadings({name: options[0] for name, options in asked.options.items()})
    groups = _channel_groups(asked)
    try:
        trial = _Trial(system, asked, until)
        for turn in range(1 if len(groups) == 1 else 2):
            found.images = 1
            for names in groups:
                _settle_readings(
                    trial, asked, names, found, alone=turn == 0 < len(groups) - 1
                )
    except TimeoutError:
        pass
    return found


def _channel_groups(asked: Question) -> Sequence[Sequence[str]]:
    """All channels at once where their readings are few; those with one are known."""
    open_ = [name for name, options in asked.options.items() if len(options) > 1]
    if np.prod([len(asked.options[name]) for name in open_]) <= EXHAUSTIVE:
        return [open_] if open_ else []
    groups = [[n for n in names if n in open_] for names in asked.together]
    return [names for names in groups if names]


def _settle_readings(
    trial: "_Trial",
    asked: Question,
    names: Sequence[str],
    found: BestReadings,
    *,
    alone: bool,
) -> None:
    """Try all readings of some channels; the others keep theirs.

    Those that none beats are tried on twice as many windows, until none but images are
    left. ``alone``: by the predictions of these channels, while others may be misread.
    """
    choices = itertools.product(*(asked.options[name] for name in names))
    tried = [dict(zip(names, choice, strict=True)) for choice in choices]
    plain = {name: asked.options[name][0] for name in names}
    judged = names if alone else ()
    others, images = dict(found.readings), found.images
    left, scores = np.arange(len(tried)), np.zeros((len(tried), 0))
    surer = np.full(len(tried), np.inf)
    for stage in range(trial.stages):
        more = trial.scores([others | tried[k] for k in left], judged, stage)
        scores = np.concatenate([scores, more], axis=1)
        mean = scores.mean(axis=1).round(6)
        behind = _surer(scores, int(np.argmin(mean)))
        good = np.flatnonzero(behind <= SURE).tolist()
        plainest = min(good, key=lambda i: (_departs(tried[left[i]], plain), mean[i]))
        same = np.abs(scores - scores[plainest]).max(axis=1) <= _SAME
        surer[left] = np.where(behind > SURE, behind, _surer(scores, plainest))
        surer[left[same]] = np.inf
        chosen = tried[left[plainest]]
        found.images = images * int(same.sum())
        for name in names:
            differ = [k for k, each in enumerate(tried) if each[name] != chosen[name]]
            k = min(differ, key=lambda k: surer[k])
            found.surer[name], found.rivals[name] = float(surer[k]), tried[k]
        found.readings |= chosen
        if same[good].all():
            return
        left, scores = left[good], scores[good]


def _departs(readings: Readings, plain: Readings) -> tuple[int, int]:
    """How many channels get another sign or zero than in the file; another unit."""
    pairs = [(reading, plain[name]) for name, reading in readings.items()]
    moved = sum((r.sign, r.offset) != (p.sign, p.offset) for r, p in pairs)
    return moved, sum(r.unit != p.unit for r, p in pairs)


def _surer(scores: Scores, k: int) -> Float[np.ndarray, " K"]:
    """The sign test's z of one reading against each: windows won less windows lost."""
    away = scores - scores[k]
    won, lost = (away > _SAME).sum(axis=1), (away < -_SAME).sum(axis=1)
    z: Float[np.ndarray, " K"] = (won - lost) / np.sqrt(scores.shape[1])
    return z


class _Trial:
    """What readings are worth on the windows with the most motion."""

    def __init__(self, system: AbstractSystem, asked: Question, until: float) -> None:
        windows, _ = cut(_beginning(asked.logs), system, window=WINDOW)
        most = np.argsort(-channel_motion(windows).mean(axis=1), kind="stable")
        ends = WINDOWS * 2 ** np.arange(STAGES)
        each = (x for x in np.split(most[: ends[-1]], ends[:-1]) if x.size)
        self.windows = [windows.some(np.sort(x)) for x in each]
        now = np.zeros(windows.area.shape[-1])
        self.inputs = [
            np.stack([inputs_of(x, now) for x in w.held()]) for w in self.windows
        ]
        self.states = [c.name for c in system.physical_states]
        self.actions = [c.name for c in system.actions]
        self.units = {
            c.name: c.unit for c in (*system.physical_states, *system.actions)
        }
        self.base = {name: finer(options) for name, options in asked.options.items()}
        self.step, self.until = _nominal_step(system), until

    @property
    def stages(self) -> int:
        """How often windows can be asked for."""
        return len(self.windows)

    def scores(
        self, readings: Sequence[Readings], names: Sequence[str], stage: int
    ) -> Scores:
        """Of each reading and window, by some channels or, where none is measured, all.

        Raises `TimeoutError` where time is over.
        """
        w, inputs = self.windows[stage], self.inputs[stage]
        many = max(1, ROWS // len(w))
        parts = (readings[i : i + many] for i in range(0, len(readings), many))
        each = np.concatenate([self._shares(some, w, inputs) for some in parts])
        seen = [self.states[i].removesuffix(".velocity") for i in w.outputs]
        own = [i for i, name in enumerate(seen) if name in names]
        found: Scores = each[..., own or range(len(seen))].mean(axis=2)
        return found

    def _shares(
        self,
        readings: Sequence[Readings],
        w: Windows,
        inputs: Float[np.ndarray, "W L m"],
    ) -> Float[np.ndarray, "K W c"]:
        """Log of error over motion, of each reading, window and channel."""
        K, seen = len(readings), list(w.outputs)
        scale, zero = self._read(readings, self.states)
        y = w.y * scale[:, None, None, seen] + zero[:, None, None, seen]
        start = w.start * scale[:, None] + zero[:, None]
        gain, offset = self._read(readings, self.actions)
        u = inputs * gain[:, None, None] + offset[:, None, None]
        W, L = w.span.shape
        s = start.reshape(K * W, -1)
        u = u.reshape(K * W, L, -1)
        span = np.tile(w.span, (K, 1))
        error = np.zeros((K, W, len(seen)))
        for row in range(1, L):
            if time.monotonic() > self.until:
                raise TimeoutError
            s = self.step(s, u[:, row], span[:, row])
            away = s[:, seen].reshape(K, W, -1) - y[:, :, row]
            error += np.where(w.mask[:, row], away**2, 0.0)
        error /= np.maximum(w.mask[:, 1:].sum(axis=1), 1)
        moved = channel_motion(w).mean(axis=0) * scale[:, None, seen] ** 2
        share = np.sqrt(error / np.maximum(moved, 1e-30))
        share = np.where(np.isfinite(share), np.clip(share, _FLOOR, _CAP), _CAP)
        return np.asarray(np.log(share))

    def _read(
        self, readings: Sequence[Readings], names: Sequence[str]
    ) -> tuple[Float[np.ndarray, "K n"], Float[np.ndarray, "K n"]]:
        """Scale and zero of channels, from the unit that the logs were read in."""
        scale, zero = np.ones((2, len(readings), len(names)))
        for k, each in enumerate(readings):
            for i, name in enumerate(names):
                whole = name.removesuffix(".velocity")
                reading = each.get(whole, PLAIN)
                unit = self.units.get(whole, "")
                own, read = self.base.get(whole), reading.unit
                ratio = unit_factor(read, unit, name) / unit_factor(own, unit, name)
                scale[k, i] = reading.sign * ratio
                zero[k, i] = reading.offset if name == whole else 0.0
        return scale, zero


def _beginning(logs: Sequence[Log]) -> list[Log]:
    """The first minutes of the logs: the windows are cut from these."""
    some, left = [], SECONDS
    for log in logs:
        rows = slice(0, int(np.searchsorted(log.time - log.time[0], left)))
        if rows.stop < 2:
            break
        left -= float(log.time[rows][-1] - log.time[0])
        some.append(
            replace(
                log,
                time=log.time[rows],
                channels={name: x[rows] for name, x in log.channels.items()},
                inputs={name: x[rows] for name, x in log.inputs.items()},
                mask={name: x[rows] for name, x in log.mask.items()},
            )
        )
    return some


def _nominal_step(system: AbstractSystem) -> Callable[..., Float[np.ndarray, "B n"]]:
    """One step of many rows at the parameters' nominal values.

    MuJoCo's own engine where it is one: nothing is compiled then.
    """
    values = system.parameters.nominal()
    if isinstance(system, MuJoCo):
        engine = system.engine
        theta = np.asarray([values[name] for name in system.names], float)

        def on_the_host(s: np.ndarray, u: np.ndarray, h: np.ndarray) -> np.ndarray:
            rows = np.broadcast_to(theta, (len(s), theta.size))
            found: np.ndarray = engine.flow(rows, s, u, h)
            return found

        return on_the_host
    params = system.record({name: jnp.asarray(x) for name, x in values.items()})
    step = jax.jit(jax.vmap(lambda s, u, h: system.flow(params, s, u, h)))
    return lambda s, u, h: np.asarray(step(s, u, h))
