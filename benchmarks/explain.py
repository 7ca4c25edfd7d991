"""Does `sim2gp explain` find the missing physics that was planted?

    python benchmarks/explain.py [--truths N] [--strength X] [--seconds S] [--out DIR]
        [--refresh | --keep-old]

Two machines; on each, every effect of `planted_effects` on N hidden
machines, nothing on 2 N, and three effects that no library holds on N each. Prints what
was answered to what was planted and the shares of right answers, and writes
``summary.json`` into DIR. Finished cells are kept beside DIR: after S seconds it stops,
and goes on where it was when it is called again.
"""

import argparse
import time
from collections import Counter
from pathlib import Path
from typing import Any

import planted_effects as study
from sim2gp.planning.tasks import MACHINES
from sim2gp.runs import Progress
from sim2gp.runs.cells import Cells, add_options
from sim2gp.runs.plain import to_json

ROOT = Path(__file__).resolve().parents[1]


def main() -> None:
    """Compute the missing cells; print and write the table once all are there."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--truths", type=int, default=10)
    parser.add_argument("--strength", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=float("inf"))
    parser.add_argument("--machines", nargs="+", default=list(MACHINES))
    parser.add_argument("--out", type=Path, default=ROOT / "runs" / "explain-study")
    add_options(parser)
    options = parser.parse_args()
    started = time.perf_counter()
    store = Cells(options.out, study.__file__, options.old)
    found: list[dict[str, Any]] = []
    todo = [
        (machine, name, k)
        for machine in options.machines
        for name, k in study.cells(machine, options.truths)
    ]
    about = {"seed": options.seed, "strength": options.strength}
    named = [("-".join(map(str, job)), about) for job in todo]
    store.check(named)
    with Progress().task("cells", len(todo)) as task:
        for machine, name, k in todo:
            label = f"{machine}-{name}-{k}"
            cell = store.load(label, about)
            if cell is None:
                if time.perf_counter() - started > options.seconds:
                    print(f"{len(found)} of {len(todo)} cells; call again")
                    return
                cell = study.cell(machine, name, k, **about)
                store.save(label, about, cell)
            found.append(cell)
            task.advance(f"{label}: {study.verdict(machine, cell)}")
    report(found, store.summary(named), options)


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
        told = ", ".join(f"{n} {a}" for a, n in Counter(answers).most_common())
        print(f"{row:24s} {told}")
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
