"""The report of a run: its sections in the order in which a reader asks for them."""

import base64
import shlex
from collections.abc import Mapping
from typing import Any

from sim2gp.reports import data, parameters
from sim2gp.reports.animation import player
from sim2gp.reports.experiment import experiment
from sim2gp.reports.glance import glance, has_glance, unique
from sim2gp.reports.markup import (
    Raw,
    asset,
    duration,
    esc,
    is_number,
    number,
    page,
    paragraph,
    section,
)
from sim2gp.reports.parameters import Arrays, Summary
from sim2gp.reports.returns import returns
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


def _said(item: object) -> str:
    """One warning as text, whether it came as a string or as {code, text}."""
    if isinstance(item, Mapping):
        code, text = item.get("code", ""), item.get("text") or item.get("message", "")
        return f"{code} {text}".strip()
    return str(item)


def _named(summary: Summary, verdict: str) -> str:
    entries: Mapping[str, Any] = summary.get("parameters") or {}
    return ", ".join(n for n, e in entries.items() if e.get("verdict") == verdict)


def _problems(summary: Summary) -> list[tuple[str, str]]:
    """What a reader must know before any number: pairs of weight and words."""
    found: list[tuple[str, str]] = []
    status = summary.get("status")
    if summary.get("converged") is False:
        found.append(("bad", "The fit did not converge; its numbers are not a result."))
    elif status and str(status) not in ("ok", "done", "converged", "complete"):
        found.append(("bad", f"Status: {status}."))
    pressed = _named(summary, "at_bound")
    if pressed:
        text = "The data press these against the edge of their range"
        found.append(("bad", f"{text}: {pressed}."))
    idle = _named(summary, "dead")
    if idle:
        found.append(("bad", f"The data do not depend on: {idle}."))
    misfit = summary.get("misfit")
    if isinstance(misfit, Mapping) and misfit.get("alarm"):
        found.append(("warn", str(misfit.get("verdict"))))
    for item in summary.get("prior_conflicts") or ():
        found.append(("warn", f"Data against prior: {_said(item)}"))
    flat = [d for d in summary.get("directions") or () if d.get("flat")]
    if flat:
        noun = "combination is" if len(flat) == 1 else "combinations are"
        text = f"{len(flat)} {noun} left open by the data (see Combinations)"
        found.append(("warn", f"{text}."))
    found += [("warn", _said(item)) for item in summary.get("warnings") or ()]
    return unique(found)


def _status(summary: Summary) -> Raw:
    """The box at the top: what went wrong, or that nothing did."""
    problems = _problems(summary)
    if not problems:
        good = "Converged. " if summary.get("converged") else ""
        text = f"{good}No warnings."
        return Raw(f'<div class="status"><p><strong>{text}</strong></p></div>\n')
    tone = "bad" if any(weight == "bad" for weight, _ in problems) else "warn"
    items = "".join(f"<li>{esc(words)}</li>" for _, words in problems)
    title = "Read this first" if tone == "bad" else "Keep in mind"
    return Raw(
        f'<div class="status {tone}"><p><strong>{title}</strong></p>'
        f"<ul>{items}</ul></div>\n"
    )


def _learned(summary: Summary) -> str:
    """What was learned, whether to believe it, and how far it predicts."""
    said = [str(summary["headline"])] if summary.get("headline") else []
    misfit, unseen = summary.get("misfit"), summary.get("held_out")
    if (
        isinstance(misfit, Mapping)
        and misfit.get("verdict")
        and not misfit.get("alarm")
    ):
        said.append(str(misfit["verdict"]))
    if isinstance(unseen, Mapping) and unseen.get("headline"):
        said.append(str(unseen["headline"]))
    return " ".join(filter(None, said))


def _made(summary: Summary) -> Raw:
    """Command line, size, time and versions."""
    rows: list[tuple[str, object]] = []
    line = summary.get("command_line")
    if line:
        text = line if isinstance(line, str) else shlex.join(map(str, line))
        rows.append(("command", Raw(f"<code>{esc(text)}</code>")))
    for key, words in _FACTS.items():
        if is_number(summary.get(key)):
            rows.append((words, number(summary[key], 4)))
    latency = summary.get("latency_ms")
    if isinstance(latency, Mapping):
        parts = [f"{name} {number(value)} ms" for name, value in latency.items()]
        rows.append(("latency", ", ".join(parts)))
    if is_number(summary.get("interaction_seconds")):
        rows.append(("real interaction", duration(summary["interaction_seconds"])))
    if is_number(summary.get("wall_seconds")):
        rows.append(("wall time", duration(summary["wall_seconds"])))
    if summary.get("seed") is not None:
        rows.append(("seed", summary["seed"]))
    if summary.get("device"):
        rows.append(("device", summary["device"]))
    versions = summary.get("versions") or {}
    if versions:
        rows.append(("versions", ", ".join(f"{n} {v}" for n, v in versions.items())))
    inner = "".join(f"<dt>{esc(k)}</dt><dd>{esc(v)}</dd>\n" for k, v in rows)
    facts = Raw(f'<dl class="facts">\n{inner}</dl>\n' if inner else "")
    return section("made", "How this was made", facts)


def _machine(summary: Summary, arrays: Arrays) -> Raw:
    about, state = summary.get("animation"), arrays.get("animation/state")
    if not about or state is None or len(state) < 2:
        return Raw("")
    return section("machine", "The machine", player(about, arrays))


def _figure(summary: Summary, arrays: Arrays) -> Raw:
    """The paper's figure that this run reproduces."""
    from sim2gp.reports.figure1 import figure1, figure_bytes
    from sim2gp.reports.figure2 import figure2
    from sim2gp.reports.figure3 import LABELS, figure3

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
    else:
        return Raw("")
    code = base64.b64encode(figure_bytes(drawn, "png")).decode("ascii")
    return section(
        name.lower().replace(" ", ""),
        name,
        Raw(
            f'<div class="picture"><img alt="{name}: {words}" '
            f'src="data:image/png;base64,{code}"></div>\n'
        ),
        paragraph(more, "soft"),
    )


def _contents(sections: list[Raw]) -> Raw:
    """Links to the sections that are there."""
    links = []
    for text in sections:
        if not text:
            continue
        anchor = text.split('id="', 1)[1].split('"', 1)[0]
        title = text.split("<h2>", 1)[1].split("</h2>", 1)[0]
        links.append(f'<a href="#{anchor}">{title}</a>')
    return Raw(f"<nav>{' '.join(links)}</nav>\n" if len(links) > 2 else "")


def write_report(summary: Summary, arrays: Arrays) -> str:
    """The report as one self-contained HTML document.

    A section is drawn only if its data are there; the same input gives the same bytes.
    """
    moved, flown = _machine(summary, arrays), returns(summary, arrays)
    sections = [
        data.claims(summary),
        _figure(summary, arrays),
        *((moved, flown) if flown else ()),
        experiment(summary, arrays),
        parameters.parameter_table(summary),
        parameters.directions(summary),
        data.noise_and_misfit(summary),
        data.held_out(summary, arrays),
        data.calibration(summary, arrays),
        *(() if flown else (moved,)),
        traces(summary, arrays),
        parameters.parameter_densities(summary, arrays),
        parameters.correlations(summary, arrays),
        data.extra_tables(summary),
        _made(summary),
    ]
    name = f"sim2gp {summary.get('command') or 'run'}"
    learned = "" if has_glance(summary) else _learned(summary)
    body = "".join(
        [
            f"<header>\n<h1>{esc(summary.get('title') or name)}</h1>\n",
            _status(summary),
            paragraph(learned, "lead") if learned else "",
            glance(summary) if has_glance(summary) else "",
            _contents(sections),
            "</header>\n",
            *sections,
        ]
    )
    script = asset("player.js") if 'class="player"' in body else ""
    script += asset("tables.js") if "<table" in body else ""
    return page(name, body, script)
