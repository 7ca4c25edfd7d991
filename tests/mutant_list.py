"""The mutants; the text that one replaces must occur exactly once in its file."""

import ast
from dataclasses import dataclass
from pathlib import Path

#: A file of tests, and which of them (-k).
Hunt = tuple[str, str]
ORACLE = ("test_linear_posterior.py", "degenerate or no_rows or order_and_splitting")
MODEL = (
    "test_sim2gp.py",
    "regression or expectation or predictive or function_space or rows",
)
UPDATE = ("test_sim2gp.py", "update")
DRAWS = ("test_sim2gp.py", "draws")
CURVED = ("test_sim2gp.py", "gauss or quadrature")
BOUNDS = ("test_parameters.py", "inside or formulas or slopes")
DENSITY = ("test_gaussian.py", "")


@dataclass(frozen=True)
class Mutant:
    """``old`` becomes ``new`` in ``file``; the ``hunt`` must then fail."""

    name: str
    file: str
    old: str
    new: str
    hunt: Hunt

    def apply(self, package: Path) -> None:
        """Patch a copy of the package; it must still be Python."""
        path = package / self.file
        source = path.read_text()
        if source.count(self.old) != 1:
            raise LookupError(f"{self.name}: found {source.count(self.old)} times")
        changed = source.replace(self.old, self.new)
        ast.parse(changed)
        path.write_text(changed)


JACOBIAN = "inference/linearized.py"
LS, SIM, LIN, STEP = (
    "inference/least_squares.py",
    "models/sim2gp.py",
    "models/draws.py",
    "data/one_step.py",
)
TABLE, GAUSS, MAPS = (
    "inference/parameters.py",
    "inference/gaussian.py",
    "inference/bijections.py",
)

#: Where each quantity is formed.
ROWS = "return xp.concatenate([xp.eye(z.size"
WHITEN = "solve_triangular(noise_scale, block, lower=True)"
EVIDENCE = "return -0.5 * full[:, -1] @ full[:, -1] - log_det"
RESIDUAL = "jnp.where(valid, value - s2[:d], 0.0)"
POSTERIOR = "        found.posterior,\n"
BOX = "low + (high - low) * sigmoid(t), low, high"
HESSIAN = """        Gaussian(
            found.posterior.mean,
            model.prior.scale
            @ jnp.linalg.cholesky(
                jnp.linalg.inv(
                    jax.hessian(
                        lambda z: 0.5
                        * jnp.sum(
                            (
                                OneStepLikelihood(model.system, data, model.dt).rows(
                                    model.prior.at(z), model.prior.scale
                                )[0]
                                / found.noise.sd[None]
                            )
                            ** 2
                        )
                        + 0.5 * z @ z
                    )(found.z())
                )
            ),
        ),
"""

MUTANTS = (
    Mutant("prior counted twice", LS, ROWS, f"{ROWS[:7]}2.0**0.5 * {ROWS[7:]}", ORACLE),
    Mutant(
        "prior twice in the model",
        LS,
        ROWS,
        f"{ROWS[:7]}1.41421356 * {ROWS[7:]}",
        MODEL,
    ),
    Mutant("prior omitted", LS, ROWS, f"{ROWS[:7]}1e-9 * {ROWS[7:]}", ORACLE),
    Mutant(
        "prior mean omitted",
        LS,
        "dtype=z.dtype), z[:, None]], axis=1)",
        "dtype=z.dtype), 0.0 * z[:, None]], axis=1)",
        ORACLE,
    ),
    Mutant(
        "sigmoid range of the paper",
        MAPS,
        BOX,
        BOX.replace("(high - low)", "high").replace(", low, high", ", low, low + high"),
        BOUNDS,
    ),
    Mutant("box not clamped", MAPS, f"xp.clip({BOX})", BOX.split(",")[0], BOUNDS),
    Mutant(
        "log box without its exponential",
        MAPS,
        "xp.exp(np.log(low) + span",
        "(np.log(low) + span",
        BOUNDS,
    ),
    Mutant(
        "Jacobian of the oracle transposed",
        LS,
        "J @ prior.scale, (J",
        "J @ prior.scale.T, (J",
        ORACLE,
    ),
    Mutant(
        "Jacobian transposed",
        JACOBIAN,
        "    return value, J\n",
        "    return value, J.T\n",
        MODEL,
    ),
    Mutant(
        "prior factor transposed",
        "inference/levenberg_marquardt.py",
        "likelihood.blocks(about.at(z), e, about.scale)",
        "likelihood.blocks(about.mean + about.scale.T @ z, e, about.scale.T)",
        MODEL,
    ),
    Mutant(
        "posterior factor transposed",
        JACOBIAN,
        "J @ posterior.scale)",
        "J @ posterior.scale.T)",
        MODEL,
    ),
    Mutant(
        "noise squared in the whitening",
        LS,
        WHITEN,
        WHITEN.replace("noise_scale", "noise_scale @ noise_scale"),
        ORACLE,
    ),
    Mutant(
        "noise factor transposed",
        LS,
        WHITEN,
        WHITEN.replace("noise_scale", "noise_scale.T").replace("True", "False"),
        ("test_linear_posterior.py", "powers_of or vague or conjugate"),
    ),
    Mutant(
        "one half missing in the cost",
        LS,
        EVIDENCE,
        EVIDENCE.replace("-0.5 * ", "-"),
        ORACLE,
    ),
    Mutant(
        "one half missing in the determinant",
        LS,
        EVIDENCE,
        EVIDENCE.replace("- log_det", "- 2.0 * log_det"),
        ORACLE,
    ),
    Mutant(
        "evidence without determinant",
        LS,
        EVIDENCE,
        EVIDENCE.replace(" - log_det", ""),
        ORACLE,
    ),
    Mutant(
        "negated covariance",
        GAUSS,
        "cov = self.scale @ self.scale.T",
        "cov = -self.scale @ self.scale.T",
        DENSITY,
    ),
    Mutant("full Hessian for Gauss-Newton", SIM, POSTERIOR, HESSIAN, CURVED),
    Mutant(
        "noise omitted from the predictive",
        SIM,
        "_latent(belief, s, a).plus(noise)",
        "_latent(belief, s, a).plus(0.0 * noise)",
        MODEL,
    ),
    Mutant(
        "sign of the residual",
        STEP,
        RESIDUAL,
        RESIDUAL.replace("value - s2[:d]", "s2[:d] - value"),
        MODEL,
    ),
    Mutant(
        "rows that do not exist",
        STEP,
        RESIDUAL,
        RESIDUAL.replace("valid", "valid | True"),
        MODEL,
    ),
    Mutant("EM never runs", SIM, "rounds=NOISE_ROUNDS", "rounds=1", MODEL),
    Mutant(
        "step in the wrong direction",
        LS,
        "return -solve_triangular(full",
        "return solve_triangular(full",
        ORACLE,
    ),
    Mutant(
        "the maps' curvature forgotten",
        TABLE,
        "bend = xp.where(first > 0.0, over, 0.0)",
        "bend = xp.where(first > 0.0, 0.0 * over, 0.0)",
        CURVED,
    ),
    Mutant(
        "a map's bend is that of its sigmoid alone",
        "inference/bijections.py",
        "steep + down - up",
        "down - up",
        ("test_parameters.py", "slopes_of_the_maps"),
    ),
    Mutant(
        "update forgets the evidence",
        SIM,
        "belief.log_evidence + predictive",
        "predictive",
        UPDATE,
    ),
    Mutant(
        "update with the opposite residual",
        SIM,
        "r = (latent.mean - s2)[:d]",
        "r = (s2 - latent.mean)[:d]",
        UPDATE,
    ),
    Mutant(
        "update keeps the covariance",
        SIM,
        "        Gaussian(mean, scale),\n",
        "        Gaussian(mean, belief.posterior.scale),\n",
        UPDATE,
    ),
    Mutant(
        "update mixes two whitenings",
        SIM,
        "@ belief.prior.scale\n",
        "@ belief.posterior.scale\n",
        UPDATE,
    ),
    Mutant(
        "draws without their slope", LIN, "return mean + slope", "return mean", DRAWS
    ),
    Mutant(
        "draws with twice the spread",
        LIN,
        "mean + slope\n",
        "mean + 2.0 * slope\n",
        DRAWS,
    ),
)
