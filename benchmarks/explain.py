"""Does `sim2gp explain` find the missing physics that was planted?

    python benchmarks/explain.py [--truths N] [--strength X] [--machines M...]
        [--workers N] [--out DIR] [--refresh | --keep-old]

Two machines; on each, every effect of `planted_effects` on N hidden
machines, nothing on 2 N, and three effects that no library holds on N each. Prints what
was answered to what was planted and the shares of right answers, and writes
``summary.json`` into DIR. Finished cells are kept next to DIR and not computed again.
"""

import argparse
from collections import Counter
from pathlib import Path
from typing import Any

import planted_effects as study
from sim2gp.planning.tasks import MACHINES
from sim2gp.runs import Progress
from sim2gp.runs.cells import add_options
from sim2gp.runs.executors import cores
from sim2gp.runs.plain import to_json
from sim2gp.studies.study import run_cells

ROOT = Path(__file__).resolve().parents[1]


def main() -> None:
    """Compute the missing cells; print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--truths", type=int, default=10)
    parser.add_argument("--strength", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--machines", nargs="+", default=list(MACHINES))
    parser.add_argument("--workers", type=int, default=cores())
    parser.add_argument("--out", type=Path, default=ROOT / "runs" / "explain-study")
    add_options(parser)
    options = parser.parse_args()
    rows = {
        machine: [*study.cells(machine, options.truths, options.seed, options.strength)]
        for machine in options.machines
    }
    values, about = run_cells(
        rows,
        options.out,
        workers=options.workers,
        progress=Progress(),
        old=options.old,
    )
    report([values[cell] for row in rows.values() for cell in row], about, options)


def report(
    found: list[dict[str, Any]], source: dict[str, Any], options: argparse.Namespace
) -> None:
    """Print the confusion table and the claims; write the summary."""
    confusion: dict[str, dict[str, int]] = {}
    for cell in found:
        row = f"{cell['machine']} {cell['planted']}"
        answer = study.verdict(cell["machine"], cell)
        confusion.setdefault(row, Counter())[answer] += 1
    for row, answers in confusion.items():
        counts = ", ".join(f"{n} {a}" for a, n in Counter(answers).most_common())
        print(f"{row:24s} {counts}")
    claims = study.claims(found)
    for name, claim in claims.items():
        word = "holds" if claim["holds"] else "FAILS"
        share = f"{100 * claim['share']:.1f} % of {claim['of']}"
        print(f"{word} {name}: {share} (at least {100 * claim['bar']:.0f} %)")
    options.out.mkdir(parents=True, exist_ok=True)
    about = {"truths": options.truths, "seed": options.seed}
    summary = {
        "command_line": f"python benchmarks/explain.py --truths {options.truths} "
        f"--strength {options.strength:g} --seed {options.seed}",
        **about,
        "strength": options.strength,
        **source,
        "claims": claims,
        "confusion": {row: dict(answers) for row, answers in confusion.items()},
        "cells": found,
    }
    (options.out / "summary.json").write_text(to_json(summary))


if __name__ == "__main__":
    main()
