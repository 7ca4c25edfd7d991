"""What is asked of an experiment, and whether it is worth the robot's time."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from sim2gp.errors import error
from sim2gp.identification.words import digits, join_names

NARROWER = 0.05  # an experiment must narrow what is asked by this share


class Limits:
    """What an experiment must keep: ``Limits(torque=2.0, q1=(-1.0, 1.0))``.

    A number is a half-width about zero, a pair low and high; channels, inputs and
    velocities by the machine's names, in its units. ``rates`` are the largest changes
    of inputs per s. Names that are none of Python's are given in a mapping.
    """

    def __init__(
        self,
        channels: Mapping[str, float | tuple[float, float]] | None = None,
        /,
        *,
        rates: Mapping[str, float] | None = None,
        **more: float | tuple[float, float],
    ) -> None:
        given = {**(channels or {}), **more}
        self.boxes = {name: _limit_pair(name, x) for name, x in given.items()}
        self.rates = {name: float(x) for name, x in (rates or {}).items()}


def _limit_pair(name: str, limit: float | tuple[float, float]) -> tuple[float, float]:
    """Low and high (E141 where low is not below high)."""
    low, high = (-limit, limit) if isinstance(limit, int | float) else limit
    if low < high:
        return float(low), float(high)
    raise error("limits_out_of_order", got=f"{low:g} to {high:g}", name=name)


@dataclass(frozen=True)
class DesignOptions:
    """What is asked of an experiment: the options of `sim2gp.design`."""

    seconds: float = 10.0
    kind: str = "free"
    about: tuple[str, ...] = ()
    predict: float | None = None
    within: float = 2.0
    limits: Limits = field(default_factory=Limits)
    start: Mapping[str, float] = field(default_factory=dict)
    period: float | None = None
    starts: int = 1
    configuration: str | None = None


def experiment_verdict(
    asked: DesignOptions, expected: Mapping[str, Mapping[str, Any]], nats: float
) -> tuple[bool, str]:
    """Whether it is worth the robot's time, and why.

    What such an experiment cannot narrow is no reason to run it, and that is so of
    what the model's errors add to the plain sd. But what is said to be known is the
    corrected sd.
    """
    names = asked.about or tuple(expected)
    narrowed = [n for n in names if expected[n]["of_before"] <= 1.0 - NARROWER]
    if not narrowed:
        return False, (
            "Not worth running: within these limits nothing narrows "
            f"{join_names(names)} by more than {100.0 * NARROWER:.0f} %."
        )
    share, wide = (
        {n: 100.0 * expected[n][sd] / abs(expected[n]["mean"]) for n in narrowed}
        for sd in ("sd", "corrected_sd")
    )
    poor = [n for n in narrowed if share[n] > asked.within]
    others = [n for n in names if n not in narrowed]
    rest = f" It says next to nothing about {join_names(others)}." if others else ""
    wider = [n for n in narrowed if wide[n] > max(asked.within, share[n])]
    if not poor and wider:
        worst = max(wider, key=lambda n: wide[n])
        return False, (
            f"Not worth running: the logs alone determine {join_names(narrowed)} "
            f"within {asked.within:g} % already; the model's errors keep {worst} at "
            f"{digits(wide[worst], 2)} %, which more data do not reduce.{rest}"
        )
    if not poor:
        return False, (
            f"Not worth running: {join_names(narrowed)} known within "
            f"{asked.within:g} % already.{rest}"
        )
    worst = max(poor, key=lambda n: share[n])
    now, after = (
        digits(share[worst] * x, 2) for x in (1, expected[worst]["of_before"])
    )
    text = (
        f"Worth running: {nats:.1f} nats. The sd of {worst} should fall from {now} to "
        f"{after} % of its value"
    )
    if wide[worst] > share[worst]:
        text += f"; with the model's errors it is {digits(wide[worst], 2)} % now"
    return True, f"{text}.{rest}"


def prediction_verdict(
    asked: DesignOptions, ahead: Mapping[str, float], nats: float
) -> tuple[bool, str]:
    """The same of a prediction, its sd in those of the sensors' noise.

    Nobody can see that it is better than the sensors.
    """
    before, after, wide = (ahead[k] for k in ("before", "after", "corrected"))
    what = f"what is predicted {asked.predict:g} s ahead"
    now = f"{digits(before, 2)} sd of the sensors' noise"
    if wide > before:
        now += f" ({digits(wide, 2)} with the model's errors)"
    if before <= 1.0:
        return False, f"Not worth running: {what} is known within {now} already."
    if after > (1.0 - NARROWER) * before:
        return False, (
            f"Not worth running: within these limits nothing narrows {what} by more "
            f"than {100.0 * NARROWER:.0f} %; it is known within {now}."
        )
    return True, (
        f"Worth running: {nats:.1f} nats; {what}, known within {now} now, should be "
        f"within {digits(after, 2)} after."
    )


def expected_table(expected: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    rows = [
        [
            name,
            f"{e['mean']:.4g} {e['unit']}",
            f"{e['corrected_sd']:.2g}",
            f"{e['sd']:.2g}",
            f"{e['expected_sd']:.2g}",
            f"{digits(100.0 * e['of_before'], 2)} %",
        ]
        for name, e in expected.items()
    ]
    return {
        "title": "What the experiment should tell",
        "columns": ["parameter", "MAP", "corrected sd", "sd now", "sd after", "left"],
        "rows": rows,
        "note": "The corrected sd has the model's errors in it, and the limits of the "
        "states hold for machines as different as that. The others are plain: expected "
        "where the machine is as believed and its noise independent.",
    }
