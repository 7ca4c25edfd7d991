"""Frozen figures that take minutes: real recordings, and episodes of ten seeds."""

import json
from pathlib import Path

import numpy as np
import pytest

import sim2gp as sg
from frozen import episodes
from frozen.cases import VALUES
from frozen.recordings import EXAMPLES, check_same, figures
from sim2gp.cli import main

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.nightly


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_recording_is_identified_as_before(
    name: str, shared_data: Path, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    main(["identify", str(ROOT / "examples" / f"{name}.toml"), "--out", str(out)])
    now = figures(sg.load_run(out))
    with np.load(VALUES / f"recording_{name}.npz") as file:
        was = dict(file)
    check_same(was, now)


def test_learners_act_as_before() -> None:
    """The median of ten seeds lies in the recorded one's bootstrap interval."""
    before = json.loads(episodes.RECORD.read_text())
    rng, moved = np.random.default_rng(0), []
    for name, found in episodes.rows(lambda name: name in before):
        was, now = (np.asarray([row[-1] for row in x]) for x in (before[name], found))
        draws = np.median(rng.choice(was, (2000, len(was))), axis=1)
        low, high = np.quantile(draws, (0.025, 0.975))
        if not low <= np.median(now) <= high:
            moved.append(f"{name}: {np.median(now):g} beyond {low:g} to {high:g}")
    assert not moved, "\n".join(moved)
