"""What a calibration curve and its simultaneous band say: which levels fail, and how.

Bands fail where the share inside leaves the simultaneous band about its level. There,
the factor is what the half-width would have to be multiplied with to hold its share.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from sim2gp.identification.words import digits, join_names

NARROW, WIDE, BOTH = "too narrow", "too wide", "wrong shape"
PASSED, UNKNOWN = "not contradicted", "too few to say"


def calibration_verdict(
    levels: Float[np.ndarray, " L"],
    share: Float[np.ndarray, " L"],
    half: Float[np.ndarray, " L"],
    factor: Float[np.ndarray, " L"],
    blocks: int,
) -> dict[str, Any]:
    """Verdict on one channel, and the levels that fail with their ranges.

    ``half`` are the half-widths of the simultaneous band, infinite where too few
    blocks allow no verdict.
    """
    off = (share - levels) / half
    failed = np.abs(off) > 1.0
    few, many = bool(np.any(failed & (off < 0.0))), bool(np.any(failed & (off > 0.0)))
    said = {
        (False, False): PASSED,
        (True, False): NARROW,
        (False, True): WIDE,
        (True, True): BOTH,
    }
    return {
        "verdict": said[few, many] if np.all(np.isfinite(half)) else UNKNOWN,
        "blocks": blocks,
        "failed_levels": levels[failed].tolist(),
        "shares": share[failed].tolist(),
        "factors": factor[failed].tolist(),
        "ranges": [
            _failed_range(levels, share, factor, off, part)
            for part in _failed_runs(failed, off)
        ],
    }


def _failed_runs(failed: np.ndarray, off: Float[np.ndarray, " L"]) -> list[np.ndarray]:
    """Neighbouring levels that fail in one direction."""
    sign = np.where(failed, np.sign(off), 0.0)
    cuts = np.flatnonzero(np.diff(sign)) + 1
    return [p for p in np.split(np.arange(len(sign)), cuts) if sign[p[0]] != 0.0]


def _failed_range(
    levels: np.ndarray,
    share: np.ndarray,
    factor: np.ndarray,
    off: np.ndarray,
    part: np.ndarray,
) -> dict[str, Any]:
    """One run of levels; the level named is the farthest off, in its band's width."""
    worst = part[np.argmax(np.abs(off[part]))]
    return {
        "low": float(levels[part[0]]),
        "high": float(levels[part[-1]]),
        "direction": "few" if off[worst] < 0.0 else "many",
        "factor_low": float(factor[part[0]]),
        "factor_high": float(factor[part[-1]]),
        "level": float(levels[worst]),
        "share": float(share[worst]),
    }


def describe_calibration(
    channels: Mapping[str, Mapping[str, Any]],
    levels: Float[np.ndarray, " L"],
    half: Float[np.ndarray, "c L"],
    blocks: str,
    fewest: int,
    widened: float,
) -> str:
    """All channels in words; ``half`` as in `calibration_verdict`, by row.

    ``widened``: how many times the bands' width is that of the errors of the logs that
    they were learned from.
    """
    by: dict[str, list[int]] = {}
    for c, entry in enumerate(channels.values()):
        kind = entry["verdict"]
        by.setdefault(kind if kind in (PASSED, UNKNOWN) else "failed", []).append(c)
    names = list(channels)
    texts = []
    for c in by.get("failed", ()):
        ranges = "; ".join(map(_failing, channels[names[c]]["ranges"]))
        texts.append(f"{names[c]}: {ranges}.")
    if PASSED in by:
        middle = int(np.argmin(np.abs(levels - 0.5)))
        which, wide = by[PASSED], max(half[c, middle] for c in by[PASSED])
        low, high = max(0.5 - wide, 0.0), min(0.5 + wide, 1.0)
        texts.append(
            f"{join_names([names[c] for c in which])}: {blocks} contradict no band "
            f"from {_percent(levels[0])} to {_percent(levels[-1])} %; with so "
            f"few, a 50 % band that holds {_percent(low)} or {_percent(high)} % would "
            "pass, too."
        )
    elif "failed" in by:
        texts.append(f"Judged by {blocks}.")
    if any(entry["verdict"] == WIDE for entry in channels.values()):
        texts.append(
            f"All bands are {digits(widened, 2)} times as wide as the errors of the "
            "logs that were fitted: a new log may differ from them, by more than few "
            "logs can tell."
        )
    if UNKNOWN in by:
        counts = [channels[names[c]]["blocks"] for c in by[UNKNOWN]]
        texts.append(
            f"{join_names([names[c] for c in by[UNKNOWN]])}: too few to say whether "
            f"the bands are right: {min(counts)} independent blocks of windows "
            f"({blocks}), {fewest} are needed."
        )
    return " ".join(texts)


def _failing(found: Mapping[str, Any]) -> str:
    """One range of levels, in which direction it fails, and the width it needs."""
    low, high = found["low"], found["high"]
    example = f"the {_percent(found['level'])} % band {_percent(found['share'])} %"
    modal = "should" if found["direction"] == "few" else "could"
    first, last = (f"{found[f'factor_{end}']:.2g}" for end in ("low", "high"))
    if low == high:
        return (
            f"the {_percent(low)} % band holds too {found['direction']} measurements "
            f"({_percent(found['share'])} %) and {modal} be about {first} times as wide"
        )
    factor = first if first == last else f"{first} to {last}"
    return (
        f"the {_percent(low)} to {_percent(high)} % bands hold too "
        f"{found['direction']} measurements ({example}) and {modal} be about {factor} "
        "times as wide"
    )


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f}"
