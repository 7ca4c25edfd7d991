"""The report of a run: its sections in the order in which a reader asks for them."""

import base64
import shlex
from collections.abc import Mapping
from typing import Any

from markupsafe import Markup

from sim2gp.identification.words import bound_warnings
from sim2gp.reports import data, parameters
from sim2gp.reports.animation import player
from sim2gp.reports.experiment import experiment
from sim2gp.reports.forces import missing_forces
from sim2gp.reports.glance import glance, unique
from sim2gp.reports.numbers import format_duration, format_number, is_number
from sim2gp.reports.parameters import Arrays, Section, Summary
from sim2gp.reports.returns import returns_section
from sim2gp.reports.template import asset, render
from sim2gp.reports.traces import traces

#: Plain numbers of the summary that belong at the top, where present.
_FACTS = {
    "n_transitions": "transitions",
    "n_rows": "rows",
    "n_logs": "logs",
    "log_evidence": "log evidence",
    "best_return": "best return",
    "deadline_misses": "deadline misses",
    "information_nats": "information, nats",
}


def _warning_text(item: object) -> str:
    """One warning as text, whether it came as a string or as {code, text}."""
    if isinstance(item, Mapping):
        code, text = item.get("code", ""), item.get("text") or item.get("message", "")
        return f"{code} {text}".strip()
    return str(item)


def _names_with_verdict(summary: Summary, verdict: str) -> str:
    entries: Mapping[str, Any] = summary.get("parameters") or {}
    return ", ".join(n for n, e in entries.items() if e.get("verdict") == verdict)


def _report_problems(summary: Summary) -> list[tuple[str, str]]:
    """What a reader must know before any number: pairs of weight and words."""
    found: list[tuple[str, str]] = []
    status = summary.get("status")
    if summary.get("converged") is False:
        found.append(("bad", "The fit did not converge; its numbers are not a result."))
    elif status and str(status) not in ("ok", "done", "converged", "complete"):
        found.append(("bad", f"Status: {status}."))
    at_ends = bound_warnings(summary.get("parameters") or {})
    found += [("bad", words) for words in at_ends.values()]
    idle = _names_with_verdict(summary, "dead")
    if idle:
        found.append(("bad", f"The data do not depend on: {idle}."))
    misfit = summary.get("misfit")
    if summary.get("none_of_these"):
        text = "No effect of the library explains what the simulator lacks."
        found.append(("warn", text))
    explains = summary.get("command") == "explain"  # its headline says it
    if isinstance(misfit, Mapping) and misfit.get("alarm") and not explains:
        verdict = misfit.get("verdict") or "The residuals contradict the model."
        found.append(("warn", str(verdict)))
    for item in summary.get("prior_conflicts") or ():
        found.append(("warn", f"Data against prior: {_warning_text(item)}"))
    flat = [d for d in summary.get("directions") or () if d.get("flat")]
    if flat:
        noun = "combination is" if len(flat) == 1 else "combinations are"
        text = f"{len(flat)} {noun} left open by the data (see Combinations)"
        found.append(("warn", f"{text}."))
    found += [("warn", _warning_text(item)) for item in summary.get("warnings") or ()]
    return unique(found)


def _status_box(summary: Summary) -> dict[str, Any]:
    """The box at the top: what went wrong, or that nothing did."""
    found = _report_problems(summary)
    return {
        "problems": [words for _, words in found],
        "tone": "bad" if any(weight == "bad" for weight, _ in found) else "warn",
        "converged": bool(summary.get("converged")),
    }


def _report_headline(summary: Summary) -> str:
    """What came out, in a sentence; of a study how many claims hold."""
    return str(summary.get("headline") or "") or data.claims_in_a_sentence(summary)


def _provenance_section(summary: Summary) -> Section:
    """Command line, size, time and versions."""
    rows: list[tuple[str, object]] = []
    line = summary.get("command_line")
    if line and not isinstance(line, str):
        line = shlex.join(map(str, line))
    for key, words in _FACTS.items():
        if is_number(summary.get(key)):
            rows.append((words, format_number(summary[key], 4)))
    latency = summary.get("latency_ms")
    if isinstance(latency, Mapping):
        parts = [f"{name} {format_number(value)} ms" for name, value in latency.items()]
        rows.append(("latency", ", ".join(parts)))
    if is_number(summary.get("interaction_seconds")):
        rows.append(
            ("real interaction", format_duration(summary["interaction_seconds"]))
        )
    if is_number(summary.get("wall_seconds")):
        rows.append(("wall time", format_duration(summary["wall_seconds"])))
    if summary.get("seed") is not None:
        rows.append(("seed", summary["seed"]))
    if summary.get("device"):
        rows.append(("device", summary["device"]))
    versions = summary.get("versions") or {}
    if versions:
        rows.append(("versions", ", ".join(f"{n} {v}" for n, v in versions.items())))
    return {"command": line, "rows": rows} if line or rows else None


def _machine_section(summary: Summary, arrays: Arrays) -> Section:
    about, state = summary.get("animation"), arrays.get("animation/state")
    if not about or state is None or len(state) < 2:
        return None
    return player(about, arrays)


def _figure_section(summary: Summary, arrays: Arrays) -> Section:
    """The paper's figure that this run reproduces."""
    from sim2gp.reports.figure1 import figure1, figure_bytes
    from sim2gp.reports.figure2 import figure2
    from sim2gp.reports.figure3 import LABELS, figure3
    from sim2gp.reports.mismatch_map import mismatch_map

    if summary.get("figure1") and "figure1/prior/mean" in arrays:
        name, drawn = "Figure 1", figure1(arrays, summary)
        words = "the arm over two data sets, and the beliefs before and after each"
        more = (
            "Shades are the central 90 % of draws, dashed black lines the recording; "
            "the ellipses hold one and two standard deviations."
        )
    elif summary.get("figure2"):
        name = f"Figure {summary['figure2'].get('number', '2')}"
        drawn = figure2(arrays, summary)
        words = "best-seen score against episode, for every learner"
        more = (
            "Lines are medians over seeds, shades quartiles; 1 is the oracle's score, "
            "0 that of a pole left hanging, the dotted line 0.95."
        )
    elif summary.get("figure3"):
        shown = summary["figure3"]["shown"]
        name = "Figure 5" if shown == "nll" else "Figure 3"
        drawn = figure3(arrays, summary, shown)
        words = f"{LABELS[shown]} against episode, for every explorer"
        more = (
            "On the swing-up of a planner that knows the truth, which no learner is "
            "shown. Lines are medians over seeds, shades quartiles."
        )
    elif summary.get("mismatch_map"):
        name, drawn = "Mismatch map", mismatch_map(arrays, summary)
        words = "best score of two episodes, for every effect and learner"
        more = (
            "Medians over seeds; 1 is the oracle's score, 0 that of a pole left "
            "hanging."
        )
    else:
        return None
    code = base64.b64encode(figure_bytes(drawn, "png")).decode("ascii")
    return {"title": name, "alt": f"{name}: {words}", "png": code, "more": more}


def _sections(summary: Summary, arrays: Arrays) -> list[dict[str, Any]]:
    """What there is to show, in the order in which a reader asks for it."""
    figure, scored = _figure_section(summary, arrays), returns_section(summary, arrays)
    machine = ("machine", "The machine", _machine_section(summary, arrays))
    title = figure["title"] if figure else ""
    found: list[tuple[str, str, Any]] = [
        ("claims", "Claims", data.claims_section(summary)),
        ("figure", title, figure),
        *([machine] if scored else []),
        ("returns", "Returns", scored),
        ("experiment", "The experiment", experiment(summary, arrays)),
        ("parameters", "Parameters", parameters.parameter_section(summary)),
        ("directions", "Combinations", parameters.directions_section(summary)),
        ("misfit", "Noise and misfit", data.noise_and_misfit(summary)),
        ("forces", "Forces that are missing", missing_forces(summary, arrays)),
        (
            "heldout",
            "Prediction of held-out data",
            data.held_out_section(summary, arrays),
        ),
        ("calibration", "Calibration", data.calibration_section(summary, arrays)),
        *([] if scored else [machine]),
        ("traces", "Measured against simulated", traces(summary, arrays)),
        (
            "densities",
            "Before and after the data",
            parameters.parameter_densities(summary, arrays),
        ),
        (
            "correlation",
            "What moves together",
            parameters.correlations(summary, arrays),
        ),
        ("tables", "More numbers", data.extra_tables(summary)),
        ("made", "How this was made", _provenance_section(summary)),
    ]
    return [
        {
            "kind": kind,
            "anchor": title.lower().replace(" ", "") if kind == "figure" else kind,
            "title": title,
            "about": about,
        }
        for kind, title, about in found
        if about
    ]


def write_report(summary: Summary, arrays: Arrays) -> str:
    """The report as one self-contained HTML document.

    A section is drawn only if its data are there; the same input gives the same bytes.
    """
    sections = _sections(summary, arrays)
    name = f"sim2gp {summary.get('command') or 'run'}"
    answers = glance(summary)
    return render(
        "page.html",
        name=name,
        title=summary.get("title") or name,
        style=Markup(asset("page.css")),
        player=Markup(asset("player.js")),
        tables_script=Markup(asset("tables.js")),
        status=_status_box(summary),
        headline="" if answers else _report_headline(summary),
        glance=answers,
        sections=sections,
    )
