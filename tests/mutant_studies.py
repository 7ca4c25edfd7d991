"""Mutants of the studies' verdicts: claims that hold too easily."""

from mutant_list import Mutant

CLAIMS, MAP = "experiments/claims.py", "experiments/mismatch.py"

STUDIES = (
    Mutant(
        "claims: many places count once",
        CLAIMS,
        "level = 1.0 - (1.0 - LEVEL) / len(pairs)",
        "level = LEVEL",
        ("test_claims.py", "many_places"),
    ),
    Mutant(
        "claims: the best is asked of one other",
        CLAIMS,
        "if high < worst:",
        "if worst == np.inf:",
        ("test_claims.py", "of_all_others"),
    ),
    Mutant(
        "map: regrets resampled apart",
        MAP,
        "weights @ each[best]",
        "weights[::-1] @ each[best]",
        ("test_mismatch.py", "knows_its_seeds"),
    ),
    Mutant(
        "map: an episode not flown costs nothing",
        MAP,
        "each = 1.0 - np.minimum(np.where(np.isfinite(score), score, 0.0), 1.0)",
        "each = 1.0 - np.minimum(np.where(np.isfinite(score), score, 1.0), 1.0)",
        ("test_mismatch.py", "regret_by_hand"),
    ),
)
