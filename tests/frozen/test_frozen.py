"""Nothing that is frozen has moved (`cases.py`; `record.py` records it again)."""

import numpy as np
import pytest

from frozen.cases import VALUES, Arrays, every, stored

pytestmark = pytest.mark.skipif(
    not VALUES.is_dir(), reason="the frozen values are in the repository alone"
)

CASES = every()
#: Minutes of compilation: what is left shows any fault of the mathematics by day.
BY_DAY = (
    "transition/two_link/actuated",
    "transition/zeroed",
    "density/arm",
)
#: Relative to the largest number of an array: of what is computed in one sweep, of
#: what a descent finds, of what float32 training finds.
EXACT, DESCENT, TRAINED = 1e-9, 1e-7, 1e-3
WIDTH = 0.01  # of a corrected interval's, which effects of a library widen


def tolerance(case: str, name: str) -> float:
    """How far a number of a case may move."""
    group = case.split("/")[0]
    if group == "learner":
        return TRAINED
    if name in ("draw", "point", "draws"):
        return 1e-6  # float32
    if name.startswith("corrected"):
        return WIDTH
    swept = ("factors", "residual", "jacobian")
    return EXACT if group in ("transition", "density") or name in swept else DESCENT


def moved(case: str, found: Arrays) -> list[str]:
    """What is another number than it was, and by how much."""
    before = stored(case)
    assert sorted(found) == sorted(before)
    out = []
    for name, was in before.items():
        now, size = found[name], max(float(np.max(np.abs(was), initial=0.0)), 1e-300)
        assert now.shape == was.shape, name
        if name == "corrected_mean":  # in its own sd
            size = float(np.sqrt(np.min(np.diag(before["corrected_covariance"]))))
        gap = float(np.max(np.abs(now - was), initial=0.0)) / size
        if not gap <= tolerance(case, name):
            out.append(f"{name}: {gap:.1e} of its largest number")
    return out


@pytest.mark.parametrize(
    "case",
    [
        name if name in BY_DAY else pytest.param(name, marks=pytest.mark.nightly)
        for name in CASES
        if not name.startswith("data/")
    ],
)
def test_a_frozen_figure_has_not_moved(case: str) -> None:
    assert not moved(case, CASES[case]())


def test_a_small_change_is_seen() -> None:
    case = "density/arm"
    before = stored(case)
    assert not moved(case, before)
    for name in before:
        assert moved(case, before | {name: before[name] * (1.0 + 2e-9)})
