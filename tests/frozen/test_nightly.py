"""Frozen figures that take minutes: real recordings, and episodes of ten seeds."""

import json
from pathlib import Path

import numpy as np
import pytest
import scipy.stats

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
    """Ten seeds before and ten now could be of one distribution (Mann and Whitney).

    Rounding alone changes the episodes of a learner that is chaotic: both samples are
    random. At 5 % for all learners together.
    """
    before, moved = json.loads(episodes.RECORD.read_text()), []
    for name, found in episodes.rows(lambda name: name in before):
        was, now = ([row[-1] for row in x] for x in (before[name], found))
        p = scipy.stats.mannwhitneyu(was, now).pvalue
        if p < 0.05 / len(before):
            moved.append(
                f"{name}: {np.median(was):g} then, {np.median(now):g}, p {p:g}"
            )
    assert not moved, "\n".join(moved)
