"""Mutants of corrected intervals and of the importance check."""

from mutant_list import Mutant

PULLS, WEIGHTS = "diagnose/intervals.py", "diagnose/importance.py"
HERE, TAILS = "test_intervals.py", "test_importance.py"
LONGER = "experiments/longer.py"

INTERVALS = (
    Mutant(
        "intervals: no small-sample factor",
        PULLS,
        "/ np.sqrt(np.maximum(left, 1e-12))",
        "/ np.sqrt(np.maximum(left, 1.0))",
        (HERE, "fishers_information"),
    ),
    Mutant(
        "intervals: the jackknife's factor",
        PULLS,
        "/ np.sqrt(np.maximum(left, 1e-12))",
        "/ np.maximum(left, 1e-12)",
        (HERE, "fishers_information"),
    ),
    Mutant(
        "intervals: recordings joined",
        PULLS,
        "pair = group[1:] == group[:-1]",
        "pair = group[1:] >= group[:-1]",
        (HERE, "lag_follows"),
    ),
    Mutant(
        "intervals: narrower than plain",
        PULLS,
        "np.maximum(size, 1.0)",
        "np.maximum(size, 0.1)",
        (HERE, "between_the_plain"),
    ),
    Mutant(
        "intervals: inflation as sd, not variance",
        PULLS,
        "weight = U / spread[:, None]",
        "weight = U / np.sqrt(spread)[:, None]",
        (HERE, "coloured_noise"),
    ),
    Mutant(
        "intervals: the MAP for the data's estimate",
        PULLS,
        "data = s * (Vt @ z) - (Vt @ pulls.scores.sum(axis=0)) / s",
        "data = s * (Vt @ z)",
        (HERE, "between_the_plain"),
    ),
    Mutant(
        "intervals: starts at their prior mean",
        PULLS,
        "own[..., :n], own[..., -1] = np.eye(n), e",
        "own[..., :n], own[..., -1] = np.eye(n), 0.0 * e",
        (HERE, "dense_marginal"),
    ),
    Mutant(
        "importance: start states at their best, not integrated",
        WEIGHTS,
        "return -cost[best] - log_det[best]",
        "return -cost[best]",
        (TAILS, "nuisances_are"),
    ),
    Mutant(
        "importance: the Gaussian's density left out",
        WEIGHTS,
        "0.5 * np.sum(np.asarray(white) ** 2, axis=1)",
        "0.0 * np.sum(np.asarray(white) ** 2, axis=1)",
        (HERE, "exact_posterior"),
    ),
    Mutant(
        "importance: the shape's sign",
        WEIGHTS,
        "return (n * k + 10.0 * 0.5) / (n + 10.0), -k / best",
        "return (10.0 * 0.5 - n * k) / (n + 10.0), -k / best",
        (TAILS, "shape_of_a_tail"),
    ),
    Mutant(
        "intervals: a centre is believed wherever it lies",
        PULLS,
        "if there - before - told <= TRUSTED * max(found.inflation, 1.0):",
        "if there < np.inf:",
        (HERE, "at_its_bound"),
    ),
    Mutant(
        "intervals: starts do not follow the constants",
        PULLS,
        "np.sum(R[:, n:, n] ** 2)",
        "np.sum(R[..., n] ** 2)",
        (HERE, "where_the_gaussian_says"),
    ),
    Mutant(
        "longer: missing physics refuses nothing",
        LONGER,
        "alarm = misfit_of_windows(belief, windows).alarm",
        "alarm = False",
        ("test_longer.py", "too_slow"),
    ),
    Mutant(
        "longer: windows are as long as before",
        LONGER,
        "cut_logs(project, logs, TIMES)",
        "cut_logs(project, logs)",
        ("test_longer.py", "how_much_more"),
    ),
)
