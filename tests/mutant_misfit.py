"""Mutants of the misfit tests: wrong models that pass, right ones that do not."""

from mutant_list import Mutant

CORE, FITS = "identification/misfit/tests.py", "identification/misfit/residuals.py"

MISFIT = (
    Mutant(
        "Ljung-Box: products across episodes",
        CORE,
        "pair = (run[k:] == run[:-k]) & valid[k:] & valid[:-k]",
        "pair = (run[k:] >= run[:-k]) & valid[k:] & valid[:-k]",
        ("test_misfit.py", "keeps_to_episodes"),
    ),
    Mutant(
        "Ljung-Box: correlation by projection left in",
        CORE,
        "bias = -noise * float(",
        "bias = -0.0 * float(",
        ("test_misfit.py", "slow_regressors"),
    ),
    Mutant(
        "misfit: start states cost no freedom",
        CORE,
        "self.count - self.own_rank - self.basis.shape[1]",
        "self.count - self.basis.shape[1]",
        ("test_misfit.py", "start_states"),
    ),
    Mutant(
        "misfit: features keep fitted directions",
        CORE,
        "flat = self.without(columns).reshape(",
        "flat = columns.reshape(",
        ("test_misfit.py", "exact_in_a_linear"),
    ),
    Mutant(
        "misfit: several chances count once",
        CORE,
        "min(1.0, len(tested) * p)",
        "min(1.0, 1.0 * p)",
        ("test_misfit.py", "many_constants"),
    ),
    Mutant(
        "misfit: estimated noise put to the test",
        CORE,
        "if not known or data.freedom < 1:",
        "if data.freedom < 1:",
        ("test_misfit.py", "estimated_noise"),
    ),
    Mutant(
        "misfit: rounding is taken for structure",
        CORE,
        "unit = np.maximum(scale, QUIET)",
        "unit = np.maximum(scale, 1e-9)",
        ("test_misfit.py", "far_below"),
    ),
    Mutant(
        "misfit: what is not a number passes",
        CORE,
        "bad = int(np.sum(~np.isfinite(A)))",
        "bad = int(np.sum(A == 1e300))",
        ("test_misfit.py", "never_passes"),
    ),
    Mutant(
        "misfit: Jacobian not in units of the noise",
        FITS,
        "jacobian=J / sd[:, None],",
        "jacobian=J,",
        ("test_residuals.py", "its_own_rows"),
    ),
    Mutant(
        "misfit: past inputs of another episode",
        FITS,
        "first = np.searchsorted(episode, episode)",
        "first = np.zeros(N, int)",
        ("test_residuals.py", "inputs_of_the_tests"),
    ),
)
