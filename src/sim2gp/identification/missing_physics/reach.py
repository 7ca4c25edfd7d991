"""Where a machine has been in its recordings: what forces of a variable are about."""

import math

import numpy as np
from jaxtyping import Bool, Float

from sim2gp.data.cuts import Cuts
from sim2gp.data.windows import AT_A_TIME, Windows
from sim2gp.systems.base import AbstractSystem
from sim2gp.types import AnyArray

SPAN = 0.05  # s over which a velocity is a difference of positions
Range = tuple[float, float]


def box_of(system: AbstractSystem, windows: Windows | Cuts) -> dict[str, Range]:
    """The range of each channel; of one that no recording tells, its limits, or one.

    Ends are rounded outwards: recordings that are alike share a program that has them
    in it (`FixedSines`).
    """
    channels = (*system.physical_states, *system.actions)
    limits = {c.name: (c.low, c.high) for c in channels}
    unlimited = (-1.0, 1.0)
    found = {k: x if np.isfinite(x).all() else unlimited for k, x in limits.items()}
    seen: dict[str, list[float]] = {}
    for _, some in windows.in_parts(max(1, AT_A_TIME // windows.length)):
        for name, values in _visited(system, some).items():
            if values.size:
                ends = [float(np.min(values)), float(np.max(values))]
                seen[name] = [*seen.get(name, []), *ends]
    return found | {name: _rounded(np.asarray(ends)) for name, ends in seen.items()}


def _visited(
    system: AbstractSystem, windows: Windows
) -> dict[str, Float[np.ndarray, "*k"]]:
    """Values of each channel that windows tell of, and of inputs without limits."""
    names, found = [c.name for c in system.physical_states], {}
    y, known = np.asarray(windows.y), np.asarray(windows.mask)
    time = np.cumsum(np.asarray(windows.span), axis=1)
    for k, i in enumerate(windows.outputs):
        found[names[i]] = y[..., k][known[..., k]]
        rate = f"{names[i]}.velocity"
        if rate in names and names.index(rate) not in windows.outputs:
            found[rate] = _speeds(y[..., k], known[..., k], time)
    for j, channel in enumerate(system.actions):
        if not math.isfinite(channel.low + channel.high):
            found[channel.name] = _inputs(windows)[..., j]
    return found


def box_of_rows(
    system: AbstractSystem,
    states: Float[AnyArray, "N n"],
    inputs: Float[AnyArray, "T m"],
) -> dict[str, Range]:
    """The range of each channel in rows of states and inputs, as it is."""
    channels = (*system.physical_states, *system.actions)
    columns = *states.T[: len(system.physical_states)], *inputs.T
    pairs = zip(channels, columns, strict=True)
    return {c.name: (float(np.min(x)), float(np.max(x))) for c, x in pairs}


def _inputs(windows: Windows) -> Float[np.ndarray, "W H m"]:
    """The held inputs, from the area under them."""
    area, knots = np.asarray(windows.area), np.asarray(windows.knots)
    width = np.diff(knots, axis=1)[..., None]
    return np.diff(area, axis=1) / np.where(width > 0.0, width, np.inf)


def _speeds(
    y: Float[AnyArray, "W L"],
    known: Bool[AnyArray, "W L"],
    time: Float[AnyArray, "W L"],
) -> Float[np.ndarray, " k"]:
    """Mean velocities over `SPAN`, or over a whole window that is shorter."""
    found = []
    for values, mask, at in zip(y, known, time, strict=True):
        values, at = values[mask], at[mask]
        later = np.searchsorted(at, at + SPAN)
        later = np.minimum(later, len(at) - 1)
        apart = at[later] - at if len(at) else at
        far = apart > 0.5 * min(SPAN, at[-1] - at[0]) if len(at) else apart > 0.0
        found.append((values[later] - values)[far] / apart[far])
    return np.concatenate(found) if found else np.zeros(0)


def _rounded(values: Float[AnyArray, "*k"]) -> Range:
    """Their range: half-widths are powers of the root of two, centres half of those."""
    low, high = float(np.min(values)), float(np.max(values))
    half = max(0.5 * (high - low), 1e-3 * max(abs(low), abs(high)), 1e-9)
    half = 2.0 ** (0.5 * math.ceil(2.0 * math.log2(half)))
    grid = 0.5 * half
    middle = grid * round(0.5 * (high + low) / grid)
    return middle - 1.25 * half, middle + 1.25 * half
