"""Is this installation right? Exactness and calibration in a minute, on this machine.

Each check measures one number that must not exceed its limit (the measurements are in
`selftest_checks`). A check that raises fails with the error's words, and the others
still run.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from sim2gp.commands import selftest_checks as checks
from sim2gp.commands.result import AbstractResult
from sim2gp.runs import Progress
from sim2gp.runs.provenance import provenance


@dataclass(frozen=True)
class Check:
    """``measure(rng)`` must be finite and at most ``limit``."""

    what: str
    measure: Callable[[np.random.Generator], float]
    limit: float


#: Limits are those of the test suite; -log10 p = 4 is one false alarm in 10,000.
CHECKS = {
    "exactness": Check(
        "posterior and evidence of linear problems against rational arithmetic "
        "(mean and covariance in sd, evidence / 10, relative)",
        checks.exactness,
        1e-10,
    ),
    "units": Check(
        "change of the posterior when all units change by powers of two, in sd",
        checks.unit_invariance,
        0.0,
    ),
    "degenerate": Check(
        "no data, one row, zero sensitivity, equal rows, rank one, condition 1e16, "
        "more parameters than rows: departure from the prior where nothing is known",
        checks.degenerate,
        1e-10,
    ),
    "bounds": Check(
        "parameters outside their bounds at virtual values up to infinity; round trip",
        checks.bounds_round_trip,
        1e-12,
    ),
    "jacobians": Check(
        "derivatives of every machine's step against 5-point differences, relative",
        checks.jacobians,
        1e-6,
    ),
    "energy": Check(
        "relative change of the energy of every machine without friction over 1 s",
        checks.energy,
        1e-6,
    ),
    "calibration": Check(
        "1,000 linear problems with truths from the prior: -log10 p of squared errors",
        checks.posterior_calibration,
        4.0,
    ),
    "arm": Check(
        "20 two-link arms drawn from the prior and learned: -log10 p of the counts "
        "inside 50, 90 and 95 % intervals",
        checks.arm,
        4.0,
    ),
    "store": Check(
        "runs lost or damage missed, with a failed and a torn write",
        checks.store,
        0.0,
    ),
}


@dataclass(frozen=True, repr=False)
class SelfTest(AbstractResult):
    """The checks of an installation, each with its figure and its limit."""

    @property
    def passed(self) -> bool:
        """Whether all hold."""
        return bool(self.summary["passed"])


def selftest(*, seed: int = 0, progress: Progress | None = None) -> SelfTest:
    """Run every check; ``passed`` says whether all hold."""
    progress = progress or Progress()
    started = time.perf_counter()
    device = jax.devices()[0]
    found = {}
    for number, (name, check) in enumerate(CHECKS.items()):
        # Its own stream: a check's figure does not hang on the others.
        found[name] = measure(check, np.random.default_rng([seed, number]))
        progress.say(_check_line(name, found[name]))
    failed = [name for name, entry in found.items() if entry["result"] != "PASS"]
    summary = {
        "command": "selftest",
        "passed": not failed,
        "seed": seed,
        "checks": found,
        **provenance(started),
        "device": f"{device.platform} ({device.device_kind})",
    }
    names = ("sim2gp", "jax", "python")
    made_of = ", ".join(f"{name} {summary['versions'][name]}" for name in names)
    verdict = f"FAIL: {', '.join(failed)}" if failed else "PASS"
    summary["headline"] = (
        f"{verdict}; {len(found) - len(failed)} of {len(found)} checks in "
        f"{summary['wall_seconds']:.0f} s; {made_of}, {summary['device']}"
    )
    progress.say(summary["headline"])
    return SelfTest(summary)


def measure(check: Check, rng: np.random.Generator) -> dict[str, Any]:
    """One row of the table: the verdict, the figure, its limit, and the time."""
    started = time.perf_counter()
    try:
        figure, error = float(check.measure(rng)), ""
    except Exception as fault:  # any error here is a result of the test
        figure, error = np.nan, f"{type(fault).__name__}: {fault}".split("\n")[0]
    row = {
        "result": "PASS" if figure <= check.limit else "FAIL",
        "figure": figure if np.isfinite(figure) else None,
        "limit": check.limit,
        "seconds": round(time.perf_counter() - started, 1),
        "what": check.what,
    }
    return row | ({"error": error[:200]} if error else {})


def _check_line(name: str, row: dict[str, Any]) -> str:
    figure = "no figure" if row["figure"] is None else f"{row['figure']:.2g}"
    text = f"{row['result']} {name:<12} {figure} (at most {row['limit']:.2g})"
    text += f", {row['seconds']:.1f} s"
    return f"{text}: {row['error']}" if "error" in row else text
