"""Mutants of the descent to the MAP, of what it eliminates, and of its evidence."""

from mutant_list import MODEL, Mutant

DESCENDS, ARROWS, LAPLACE = (
    "inference/levenberg_marquardt.py",
    "inference/arrowhead.py",
    "inference/laplace.py",
)
DESCENT = (
    "test_laplace.py",
    "finite or last_turn or noise or too_long or gains or stationary or small",
)
ARROW = ("test_laplace.py", "nuisances or expected or weights")

#: Where each quantity is formed.
CHANNELS = "/ self.sd[None, :, None, None]"
NORMALISER = "N * (xp.log(noise.sd) + 0.5 * LOG_2PI)"
EXPECTED = "noise.weights @ (squares + spread)"

DESCENTS = (
    Mutant(
        "variance for sd in the model",
        ARROWS,
        CHANNELS,
        f"{CHANNELS}**2",
        MODEL,
    ),
    Mutant(
        "root of the sd in the model",
        ARROWS,
        CHANNELS,
        f"{CHANNELS}**0.5",
        MODEL,
    ),
    Mutant(
        "evidence without the noise's scale",
        LAPLACE,
        NORMALISER,
        NORMALISER.replace("xp.log(noise.sd) + ", "0.0 * noise.sd + "),
        MODEL,
    ),
    Mutant(
        "evidence without two pi",
        LAPLACE,
        NORMALISER,
        NORMALISER.replace(" + 0.5 * LOG_2PI", ""),
        MODEL,
    ),
    Mutant(
        "EM without the posterior's spread",
        LAPLACE,
        EXPECTED,
        EXPECTED.replace("(squares + spread)", "squares"),
        MODEL,
    ),
    Mutant(
        "EM without its prior",
        LAPLACE,
        "/ (2.0 + xp.sum(counts, axis=0))",
        "/ xp.sum(counts, axis=0)",
        MODEL,
    ),
    Mutant(
        "noise of the first channel for all",
        LAPLACE,
        EXPECTED,
        EXPECTED.replace("(squares + spread)", "(squares + spread)[:, :1]"),
        MODEL,
    ),
    Mutant(
        "last turn no better than the others",
        DESCENDS,
        "jnp.where(exact, small & (count >= 2), small)",
        "small",
        DESCENT,
    ),
    Mutant(
        "the last start wins, finite or not",
        DESCENDS,
        "found.cost < best.cost, True)",
        "True, True)",
        DESCENT,
    ),
    Mutant(
        "nothing found counts as converged",
        LAPLACE,
        "xp.isfinite(self.at.cost) & xp.all(xp.isfinite(self.full))",
        "xp.ones((), bool)",
        DESCENT,
    ),
    Mutant(
        "worst start wins",
        DESCENDS,
        "found.cost < best.cost",
        "~(found.cost < best.cost)",
        ("test_laplace.py", "best"),
    ),
    Mutant(
        "large batches for the pool of threads",
        "inference/linalg.py",
        "jax.custom_jvp(sequential_vmap(function))",
        "jax.custom_jvp(function)",
        ("test_linalg.py", "large_batch"),
    ),
    Mutant(
        "arrived by the gradient alone",
        LAPLACE,
        " | (step_sd <= NEAR)",
        "",
        ("test_sim2gp.py", "without_noise"),
    ),
    Mutant(
        "first start not descended",
        DESCENDS,
        "jnp.where(first, damping, next_damping)",
        "next_damping",
        ("test_laplace.py", "every"),
    ),
    Mutant(
        "steps too long are taken",
        DESCENDS,
        "keep = (actual_reduction > slack) | lost_in_rounding",
        "keep = jnp.isfinite(actual_reduction) | (here.cost == jnp.inf)",
        DESCENT,
    ),
    Mutant(
        "nuisances without their prior",
        ARROWS,
        "identity[:, :-1], e[:, None]",
        "1e-9 * identity[:, :-1], 1e-9 * e[:, None]",
        ARROW,
    ),
    Mutant(
        "nuisances do not follow",
        DESCENDS,
        "de = -(arrow.slope[..., -1] + arrow.slope[..., :-1] @ dz)",
        "de = -(arrow.slope[..., -1] + 0.0 * arrow.slope[..., :-1] @ dz)",
        ARROW,
    ),
    Mutant(
        "evidence without the nuisances' determinant",
        LAPLACE,
        "log_joint(self.full) - xp.sum(xp.log(pivots))",
        "log_joint(self.full) - 0.0 * xp.sum(xp.log(pivots))",
        ARROW,
    ),
    Mutant(
        "a window's weight squared",
        ARROWS,
        "library(self.weights).sqrt(self.weights)[:",
        "self.weights[:",
        ARROW,
    ),
    Mutant(
        "spread without the nuisances' own",
        LAPLACE,
        "(own @ root[:, None]) ** 2",
        "0.0 * (own @ root[:, None]) ** 2",
        ARROW,
    ),
    Mutant(
        "robust weights the wrong way round",
        LAPLACE,
        "/ freedom) / (1.0 + misfit / freedom)",
        "/ freedom) * (1.0 + misfit / freedom)",
        ARROW,
    ),
    Mutant(
        "Student's weights take back what the noise gains",
        LAPLACE,
        "xp.where(mean > 0, mean, 1.0)",
        "xp.where(mean > 0, 1.0, 1.0)",
        ("test_em.py", "student"),
    ),
    Mutant(
        "windows without data have a say in the noise",
        LAPLACE,
        "xp.mean(noise.weights, where=with_data)",
        "xp.mean(noise.weights)",
        ("test_em.py", "student"),
    ),
    Mutant(
        "a start that is no number is descended",
        DESCENDS,
        "jnp.isnan(start).any(), ~last",
        "False, ~last",
        ("test_laplace.py", "no_number"),
    ),
    Mutant(
        "rounds that are not needed are taken",
        DESCENDS,
        "~last & (index >= taken)",
        "~last & (index > taken + 9)",
        ("test_laplace.py", "needed"),
    ),
    Mutant(
        "a fit near another keeps its starts",
        "identification/fit.py",
        "warm_start.nuisances, warm_start.noise, WARM_ROUNDS",
        "warm_start.nuisances, warm_start.noise, 0",
        ("test_windows.py", "near_another"),
    ),
    Mutant(
        "steps in vain are tried for ever",
        DESCENDS,
        "vain & (here.gradient <= flat)",
        "vain & (here.gradient <= 0.0)",
        ("test_laplace.py", "rounding_hides"),
    ),
    Mutant(
        "the host keeps every step",
        "inference/host_descent.py",
        "keep = gain > 1e-12 * (1.0 + cost)",
        "keep = bool(np.isfinite(gain))",
        ("test_descent_in_numpy.py", "refused"),
    ),
    Mutant(
        "curvature of the bounds is forgotten in NumPy",
        "inference/parameters.py",
        "by_tt = xp.linalg.solve(",
        "by_tt = (0.0 if xp is np else 1.0) * xp.linalg.solve(",
        ("test_descent_in_numpy.py", "pieces"),
    ),
    Mutant(
        "padded nuisances in the place of parameters",
        "inference/stacked.py",
        "np.concatenate([own, np.arange(n, k)])",
        "np.arange(k - n + own.size)",
        ("test_stacked.py", "linear"),
    ),
    Mutant(
        "every likelihood in the first one's windows",
        "inference/stacked.py",
        "w, i = w + rows, i + columns",
        "w, i = 0, i + columns",
        ("test_stacked.py", "linear"),
    ),
)
