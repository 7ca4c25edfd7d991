"""Mutants of corrected intervals and of the importance check."""

from mutant_list import Mutant

SCATTER, WEIGHTS = (
    "identification/intervals/scatter.py",
    "identification/exact_posterior/importance.py",
)
PULLS, LACKING = (
    "identification/intervals/pulls.py",
    "identification/intervals/discrepancy.py",
)
HERE, TAILS, LACKS = "test_intervals.py", "test_importance.py", "test_discrepancy.py"
LONGER = "commands/longer.py"

INTERVALS = (
    Mutant(
        "intervals: no small-sample factor",
        SCATTER,
        "/ np.sqrt(np.maximum(left, 1e-12))",
        "/ np.sqrt(np.maximum(left, 1.0))",
        (HERE, "fishers_information"),
    ),
    Mutant(
        "intervals: the jackknife's factor",
        SCATTER,
        "/ np.sqrt(np.maximum(left, 1e-12))",
        "/ np.maximum(left, 1e-12)",
        (HERE, "fishers_information"),
    ),
    Mutant(
        "intervals: recordings joined",
        SCATTER,
        "pair = group[1:] == group[:-1]",
        "pair = group[1:] >= group[:-1]",
        (HERE, "lag_follows"),
    ),
    Mutant(
        "intervals: narrower than plain",
        SCATTER,
        "np.maximum(size, 1.0)",
        "np.maximum(size, 0.1)",
        (HERE, "between_the_plain"),
    ),
    Mutant(
        "intervals: inflation as sd, not variance",
        SCATTER,
        "weight = U / spread[:, None]",
        "weight = U / np.sqrt(spread)[:, None]",
        (HERE, "coloured_noise"),
    ),
    Mutant(
        "intervals: the MAP for the data's estimate",
        SCATTER,
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
        LACKING,
        "if cost_of_rows(found, cut) - before - linear <= slack:",
        "if cost_of_rows(found, cut) < np.inf:",
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
        "intervals: effects believed as large as the library's",
        SCATTER,
        "D = np.where(effects, share, 1.0)",
        "D = np.where(effects, share > 0.0, 1.0)",
        (LACKS, "average_over_shares"),
    ),
    Mutant(
        "intervals: effects cost nothing",
        SCATTER,
        "logs.append(0.5 * float(onto @ onto) - log_det)",
        "logs.append(0.5 * float(onto @ onto))",
        (LACKS, "average_over_shares"),
    ),
    Mutant(
        "intervals: an average without the spread of its parts",
        SCATTER,
        "np.concatenate([C.T, [m - mean]])",
        "np.concatenate([C.T, [0.0 * mean]])",
        (LACKS, "average_over_shares"),
    ),
    Mutant(
        "intervals: scores of another place than the MAP",
        SCATTER,
        "z, pulls = z + step, pulls.at(step)",
        "z = z + step",
        (LACKS, "where_a_linear_machine"),
    ),
    Mutant(
        "discrepancy: constants in disguise are effects",
        LACKING,
        "if sine_to(A[:, own], A[:, j])[0] > DISGUISE]",
        "if j >= 0]",
        (LACKS, "friction_that"),
    ),
    Mutant(
        "discrepancy: one linearisation tells all",
        LACKING,
        "if len(order) == p or np.max(moved) <= SETTLED:",
        "if True:",
        (LACKS, "friction_that"),
    ),
    Mutant(
        "discrepancy: a belief's own prior is dropped",
        LACKING,
        "scale = prior.scale.at[np.ix_(own, own)].set(fitted.prior.scale)",
        "scale = prior.scale",
        (LACKS, "keeps_its_constants"),
    ),
    Mutant(
        "longer: missing physics refuses nothing",
        LONGER,
        "alarm = misfit_of_windows(likelihood, fitted).alarm",
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
