"""The clock of a log and the steps of a simulator that has its own.

Between two rows a simulator takes a whole number of equal steps, none longer than its
own. Its parameters are those of that step: semi-implicit Euler with ``h`` makes a servo
of gain ``kp`` act as if its damping were ``kp h / 2`` smaller. So jitter of the stamps
must not become jitter of the steps: stamps of an even clock are taken as even.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sim2gp.data.logs import Log
from sim2gp.systems.base import AbstractSystem, steps_in

EVEN = 0.1  # periods that a stamp of an even clock may be off
PARTS = 10  # of a period, that stamps of another clock are rounded to
FAR = 1e5  # s; beyond, sums of periods are no longer equally far apart
SAID = 1e-3  # periods: a smaller jitter is not worth a word
SAME = 1e-3  # of two steps, relative


def step_between(gap: float, longest: float) -> float:
    """The length of the equal steps in a gap between two rows, all in s."""
    return gap / int(steps_in(gap, longest))


def on_even_clock(log: Log, system: AbstractSystem) -> Log:
    """The log on an even clock, if the simulator has a step of its own.

    Stamps within a tenth of a period of an even clock are moved there, rows may be
    missing. Others are rounded to a tenth of the period, so that few different steps
    occur. Stamps far from zero count from the first row.
    """
    if system.own_step is None or len(log) < 3:
        return log
    period, at, away = _even(log)
    zero = float(log.time[0]) if abs(log.time[0]) < FAR else 0.0
    if away > EVEN:
        part = period / PARTS
        at = np.round((log.time - log.time[0]) / part)
        at = np.maximum.accumulate(at + 1e-3 * np.arange(len(at)))
        at = np.round(at - 1e-3 * np.arange(len(at)))
        if np.any(np.diff(at) <= 0):
            return log
        return replace(log, time=zero + part * at)
    return replace(log, time=zero + period * at)


def _even(log: Log) -> tuple[float, np.ndarray, float]:
    """The period in s, each row's number, and how many periods a stamp is off."""
    time = log.time - log.time[0]
    count = np.maximum(1, np.round(np.diff(time) / log.period))
    at = np.concatenate([[0.0], np.cumsum(count)])
    period = float(round(np.polyfit(at, time, 1)[0], 9))
    away = time - period * at
    return period, at, float(0.5 * np.ptp(away)) / period


def clock_lines(logs: Sequence[Log], system: AbstractSystem) -> list[str]:
    """How rows of the logs and the simulator's own steps go together, in words."""
    return [line for line, _ in _clock_lines_of_logs(logs, system)]


def clock_warnings(logs: Sequence[Log], system: AbstractSystem) -> list[str]:
    """Those of `clock_lines` where the steps or the stamps are not as given (W155)."""
    return [
        f"W155 {line}" for line, other in _clock_lines_of_logs(logs, system) if other
    ]


def _clock_lines_of_logs(
    logs: Sequence[Log], system: AbstractSystem
) -> list[tuple[str, bool]]:
    own = system.own_step
    if own is None:
        return []
    return list(dict.fromkeys(_clock_line(log, own) for log in logs if len(log) > 2))


def _clock_line(log: Log, own: float) -> tuple[str, bool]:
    """The words, and whether something is not as the files have it."""
    period, _, away = _even(log)
    step = step_between(period, own)
    count, other = round(period / step), abs(step / own - 1.0) > SAME
    text = f"a row every {_ms(period)}: "
    text += "one step" if count == 1 else f"{count} steps"
    text += f" of the model, {_ms(step)}"
    text += " each, " if count > 1 else ", "
    if other:
        text += f"not {_ms(own)} as in its file: parameters are those of this step, "
        text += f'set timestep="{step:.6g}" where you use them'
    else:
        text += "as in its file"
    if away > EVEN:
        text += "; stamps are uneven and rounded to a tenth of the period, "
        text += f"resample = {{period = {period:.4g}}} evens them out"
    elif away > SAID:
        text += f"; stamps jitter by {_ms(away * period)}, they are taken as even"
    return text, other or away > SAID


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.4g} ms"
