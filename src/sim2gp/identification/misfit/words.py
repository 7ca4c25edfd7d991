"""The findings of the misfit tests, in a control engineer's words."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from sim2gp.identification.words import digits

#: Noise of the states themselves enters successive one-step residuals with opposite
#: signs: -1/2 between neighbours.
NOISY = -0.25
NOISY_STATES = (
    "it looks like sensor noise on the states, which one-step regression takes for "
    "exact; set likelihood.window to some tenths of a second"
)
FEW = 1000  # rows below which small dry friction was measured not to show


@dataclass(frozen=True)
class Finding:
    """One test: its statistic and p value (NaN where it does not apply), and words.

    ``freedom`` are the statistic's degrees of freedom, those of the numerator of an F;
    ``cause`` is the likely cause of an alarm, where the test can name one.
    """

    statistic: float
    freedom: int
    p: float
    alarm: bool
    text: str
    cause: str = ""

    def as_dict(self) -> dict[str, object]:
        """JSON has no NaN: a number that does not exist is None."""
        numbers = {"statistic": self.statistic, "p": self.p}
        exist = {k: v if math.isfinite(v) else None for k, v in numbers.items()}
        about = {"freedom": self.freedom, "alarm": self.alarm, "text": self.text}
        return exist | about


def make_finding(
    test: str,
    statistic: float,
    freedom: int,
    p: float,
    about: Mapping[str, object],
    level: float,
) -> Finding:
    """The finding of one test; without a p value there is no alarm, and it says so."""
    alarm = bool(p < level)
    if math.isnan(p):
        return Finding(math.nan, 0, math.nan, False, _not_tested(test, about))
    words = {
        "chi2": _chi2_sentence,
        "ljung_box": _ljung_box_sentence,
        "f_test": _f_test_sentence,
    }
    text = words.get(test, _split)(statistic, alarm, about)
    differenced = test == "ljung_box" and alarm and float(str(about["first"])) < NOISY
    cause = NOISY_STATES if differenced else ""
    return Finding(statistic, freedom, p, alarm, f"{text} ({p_value_text(p)}).", cause)


def p_value_text(p: float) -> str:
    """``p = 2e-7``."""
    return f"p = {digits(p, 1 if p < 0.01 else 2)}" if p > 1e-99 else "p < 1e-99"


def _not_tested(test: str, about: Mapping[str, object]) -> str:
    if test == "chi2" and not about.get("known"):
        return (
            "Not tested: the noise was estimated from these same residuals, so that "
            "their size says nothing about the model."
        )
    if test == "ljung_box":
        return "Not tested: too few rows follow each other."
    return "Not tested: too few rows."


def _chi2_sentence(ratio: float, alarm: bool, about: Mapping[str, object]) -> str:
    del about
    size = f"{digits(math.sqrt(ratio), 3)} times the stated noise"
    if alarm:
        return f"The residuals are {size}: too large for noise alone"
    return f"The residuals are {size}: no larger than it allows"


def _ljung_box_sentence(Q: float, alarm: bool, about: Mapping[str, object]) -> str:
    del Q
    if alarm:
        alike = float(str(about["first"])) > 0.0
        return (
            f"The residuals of {about['channel']} are correlated from row to row "
            f"({about['first']:.2f} between neighbours): each row says less than it is "
            f"counted for, and plain intervals are {'too narrow' if alike else 'wrong'}"
        )
    return f"The residuals are not correlated over {about['lags']} rows"


def _f_test_sentence(ratio: float, alarm: bool, about: Mapping[str, object]) -> str:
    del ratio
    if alarm:
        return (
            f"The residuals of {about['channel']} follow the state and the input: "
            "something is missing from the model"
        )
    return "The residuals follow neither the state nor the input"


_HALVES = {
    "late": ("The first and the second half of the data", "the machine has changed"),
    "vigorous": ("Gentle and vigorous motion", "the model errs with its size"),
}


def _split(distance: float, alarm: bool, about: Mapping[str, object]) -> str:
    del distance
    halves, why = _HALVES[str(about["split"])]
    if alarm:
        return (
            f"{halves} give parameters that differ {about['times']:.1f} times as much "
            f"as their intervals allow: {why}, or the intervals are too narrow"
        )
    return "Early and late, gentle and vigorous rows agree on the parameters"


_SHORT = {
    "f_test": "The residuals follow the state and the input (F test, {p})",
    "split_half": "Two halves of the data disagree on the parameters (split-half, {p})",
    "ljung_box": "The residuals are correlated from row to row (Ljung-Box, {p})",
    "chi2": "The residuals are larger than the stated noise (chi-squared, {p})",
}


def misfit_verdict(tests: Mapping[str, Finding], count: int, rows: str) -> str:
    """The verdict in a sentence or two; of the alarms, the most important one."""
    if all(math.isnan(finding.p) for finding in tests.values()):
        return f"{count} {rows} are too few to test the model on."
    raised = [name for name in _SHORT if tests[name].alarm]
    if raised:
        first = _SHORT[raised[0]].format(p=p_value_text(tests[raised[0]].p))
        split = tests["split_half"]
        if raised == ["ljung_box"] and tests["ljung_box"].cause:
            return f"{first}: {tests['ljung_box'].cause}."
        times = digits(math.sqrt(split.statistic / max(split.freedom, 1)), 2)
        halves = f", about {times} times going by two halves" if split.alarm else ""
        return (
            f"{first}: something is missing from the model, and plain intervals are "
            f"too narrow{halves}; try `sim2gp explain`."
        )
    few = count < FEW
    return f"Nothing in {count} {rows} contradicts the model. " + (
        "Small dry friction would not show in so few."
        if few
        else "Effects far below the noise would still not show."
    )
