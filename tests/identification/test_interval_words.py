"""What is said of corrected intervals."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from sim2gp.identification.intervals import words as intervals
from sim2gp.identification.intervals.averaging import NONE
from sim2gp.identification.intervals.scatter import CorrectedFit
from sim2gp.inference.gaussian import Gaussian
from tests.identification.test_intervals import gaussian


def test_the_words_say_which_intervals_these_are() -> None:
    found = CorrectedFit(gaussian(np.zeros(1), np.eye(1)), 9.0, 2, 30.0, True)
    text = intervals.describe_intervals(found, [1.0, 2.96, 3.31], 40)
    assert text.startswith("Intervals are 1 to 3.3 times as wide")
    assert "40 windows are coloured and pull the parameters 3 times" in text
    assert "are 3 times as wide" in intervals.describe_intervals(found, [3.0, 3.0], 40)
    white = dataclasses.replace(found, inflation=1.0)
    text = intervals.describe_intervals(white, [1.02, 1.1], 40)
    assert "at most 1.1 times those of independent samples" in text
    few = dataclasses.replace(found, enough=False)
    assert "3 windows are too few" in intervals.describe_intervals(few, [1.0], 3)


def test_the_words_say_whether_physics_is_missing() -> None:
    posterior = gaussian(np.zeros(1), np.eye(1))
    found = CorrectedFit(posterior, 1.0, 1, 30.0, True, {NONE: 0.03, "ripple": 0.97})
    text = intervals.describe_intervals(found, [1.0, 4.0], 40)
    assert text.startswith("Intervals are 1 to 4 times as wide as if every sample were")
    assert "coloured" not in text
    assert "lacks physics with a probability of 97 %: intervals allow for" in text
    assert "sim2gp explain" in text
    sound = CorrectedFit(posterior, 9.0, 1, 30.0, True, {NONE: 0.96, "ripple": 0.04})
    text = intervals.describe_intervals(sound, [3.0], 40)
    assert "coloured and pull the parameters 3 times" in text
    assert "missing, which has a probability of 4 %" in text
    unlikely = CorrectedFit(
        posterior, 9.0, 1, 30.0, True, {NONE: 0.9999, "ripple": 1e-4}
    )
    text = intervals.describe_intervals(unlikely, [3.0], 40)
    assert "which has a probability of less than 1 %" in text
    none = CorrectedFit(posterior, 9.0, 1, 30.0, True)
    assert "not physics that the model lacks" in intervals.describe_intervals(
        none, [3.0], 40
    )


def test_a_wide_interval_says_why_in_one_sentence() -> None:
    """Where the two sd differ by more than a factor of 3, and only there."""
    flat = Gaussian(jnp.zeros(1), jnp.ones((1, 1)))
    coloured = CorrectedFit(flat, 81.0, 1, 40.0, True)
    assert intervals.explain_widening(coloured, [0.9, 3.0], 340) is None
    assert (
        intervals.explain_widening(CorrectedFit(flat, 81.0, 1, 2.0, False), [9.0], 3)
        is None
    )
    text = intervals.explain_widening(coloured, [12.0, 41.0], 340)
    assert text is not None
    assert "12 to 41 times" in text
    assert "9 times as far" in text
    assert "physics" not in text
    missing = CorrectedFit(flat, 1.0, 1, 40.0, True, {NONE: 0.07, "ripple": 0.93})
    text = intervals.explain_widening(missing, [1.0, 5.0], 340)
    assert text is not None
    assert "93 %" in text
    assert "white noise" not in text
    assert text.count(". ") == 0
