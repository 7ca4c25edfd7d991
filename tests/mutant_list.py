"""The mutants; the text that one replaces must occur exactly once in its file."""

import ast
from dataclasses import dataclass
from pathlib import Path

#: A file of tests, and which of them (-k).
Hunt = tuple[str, str]
ORACLE = ("test_linear_posterior.py", "degenerate or no_rows or order_and_splitting")
DESCENT = (
    "test_laplace.py",
    "finite or last_turn or noise or too_long or gains or stationary",
)
ARROW = ("test_laplace.py", "nuisances or expected or weights")
MODEL = (
    "test_sim2gp.py",
    "regression or expectation or predictive or function_space or rows",
)
UPDATE = ("test_sim2gp.py", "update")
GAIN = ("test_sim2gp.py", "information_gain")
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


LS, SIM, LIN = "least_squares.py", "models/sim2gp.py", "models/linearized.py"
LAPLACE, ARROWS = "laplace.py", "arrowhead.py"
TABLE, GAUSS = "parameters.py", "gaussian.py"

#: Where each quantity is formed.
ROWS = "prior = jnp.concatenate(["
WHITEN = "solve_triangular(noise_scale, block, lower=True)"
CHANNELS = "/ self.sd[None, :, None, None]"
EVIDENCE = "return -0.5 * full[:, -1] @ full[:, -1] - log_det"
NORMALISER = "N * (jnp.log(noise.sd) + 0.5 * LOG_2PI)"
RESIDUAL = "jnp.where(valid, value - s2[:d], 0.0)"
POSTERIOR = "        fit.posterior(model.prior),\n"
EXPECTED = "noise.weights @ (squares + spread)"
BOX = "low + (high - low) * jax.nn.sigmoid(t), low, high"
GAIN_SUM = "jnp.maximum(jnp.sum(jnp.log(jnp.abs(jnp.diag(R)))), 0.0)"
HESSIAN = """        Gaussian(
            fit.posterior(model.prior).mean,
            model.prior.scale
            @ jnp.linalg.cholesky(
                jnp.linalg.inv(
                    jax.hessian(
                        lambda z: 0.5
                        * jnp.sum(
                            (_OneStep(model, data).rows(z)[0] / noise.sd[None]) ** 2
                        )
                        + 0.5 * z @ z
                    )(fit.z)
                )
            ),
        ),
"""

MUTANTS = (
    Mutant("prior counted twice", LS, ROWS, f"{ROWS[:8]}2.0**0.5 * {ROWS[8:]}", ORACLE),
    Mutant(
        "prior twice in the model",
        LS,
        ROWS,
        f"{ROWS[:8]}1.41421356 * {ROWS[8:]}",
        MODEL,
    ),
    Mutant("prior omitted", LS, ROWS, f"{ROWS[:8]}1e-9 * {ROWS[8:]}", ORACLE),
    Mutant(
        "prior mean omitted",
        LS,
        "z[:, None]], axis=1)\n    return stack(data, prior)",
        "0.0 * z[:, None]], axis=1)\n    return stack(data, prior)",
        ORACLE,
    ),
    Mutant(
        "sigmoid range of the paper",
        TABLE,
        BOX,
        BOX.replace("(high - low)", "high").replace(", low, high", ", low, low + high"),
        BOUNDS,
    ),
    Mutant("box not clamped", TABLE, f"jnp.clip({BOX})", BOX.split(",")[0], BOUNDS),
    Mutant(
        "log box without its exponential",
        TABLE,
        "jnp.exp(np.log(low) + span",
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
        LIN,
        "    return value, J\n",
        "    return value, J.T\n",
        MODEL,
    ),
    Mutant(
        "prior factor transposed",
        SIM,
        "model.prior.mean + model.prior.scale @ z",
        "model.prior.mean + model.prior.scale.T @ z",
        MODEL,
    ),
    Mutant(
        "posterior factor transposed",
        LIN,
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
        "evidence without the noise's scale",
        LAPLACE,
        NORMALISER,
        NORMALISER.replace("jnp.log(noise.sd) + ", "0.0 * noise.sd + "),
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
        SIM,
        RESIDUAL,
        RESIDUAL.replace("value - s2[:d]", "s2[:d] - value"),
        MODEL,
    ),
    Mutant(
        "rows that do not exist",
        SIM,
        RESIDUAL,
        RESIDUAL.replace("valid", "valid | True"),
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
        "/ (2.0 + jnp.sum(count, axis=0))",
        "/ jnp.sum(count, axis=0)",
        MODEL,
    ),
    Mutant("EM never runs", SIM, "rounds=NOISE_ROUNDS", "rounds=1", MODEL),
    Mutant(
        "noise of the first channel for all",
        LAPLACE,
        EXPECTED,
        EXPECTED.replace("(squares + spread)", "(squares + spread)[:, :1]"),
        MODEL,
    ),
    Mutant(
        "step in the wrong direction",
        LS,
        "return -solve_triangular(full",
        "return solve_triangular(full",
        ORACLE,
    ),
    Mutant(
        "last turn no better than the others",
        LAPLACE,
        "jnp.where(exact, small & (count >= 2), settled | small)",
        "settled | small",
        DESCENT,
    ),
    Mutant(
        "the last start wins, finite or not",
        LAPLACE,
        "found.cost < best.cost, True)",
        "True, True)",
        DESCENT,
    ),
    Mutant(
        "nothing found counts as converged",
        LAPLACE,
        "jnp.full(blank.shape, jnp.nan, blank.dtype)",
        "jnp.full(blank.shape, 0.0, blank.dtype)",
        DESCENT,
    ),
    Mutant(
        "worst start wins",
        LAPLACE,
        "found.cost < best.cost",
        "~(found.cost < best.cost)",
        ("test_laplace.py", "best"),
    ),
    Mutant(
        "first start not descended",
        LAPLACE,
        "jnp.where(first, damping, jnp.where(keep, lowered, raised))",
        "jnp.where(keep, lowered, raised)",
        ("test_laplace.py", "every"),
    ),
    Mutant(
        "steps too long are taken",
        LAPLACE,
        "keep = (gained > slack) | lost_in_rounding",
        "keep = jnp.isfinite(gained) | (here.cost == jnp.inf)",
        DESCENT,
    ),
    Mutant(
        "the maps' curvature forgotten",
        TABLE,
        "bend = jnp.where(first > 0.0, second / first, 0.0)",
        "bend = jnp.where(first > 0.0, 0.0 * second / first, 0.0)",
        CURVED,
    ),
    Mutant(
        "nuisances without their prior",
        ARROWS,
        "prior = identity.at[:, -1].set(e)",
        "prior = 1e-9 * identity.at[:, -1].set(e)",
        ARROW,
    ),
    Mutant(
        "nuisances do not follow",
        LAPLACE,
        "de = -(arrow.slope[..., -1] + arrow.slope[..., :-1] @ dz)",
        "de = -(arrow.slope[..., -1] + 0.0 * arrow.slope[..., :-1] @ dz)",
        ARROW,
    ),
    Mutant(
        "evidence without the nuisances' determinant",
        LAPLACE,
        "log_joint(self.full) - jnp.sum(jnp.log(pivots))",
        "log_joint(self.full) - 0.0 * jnp.sum(jnp.log(pivots))",
        ARROW,
    ),
    Mutant(
        "a window's weight squared",
        ARROWS,
        "jnp.sqrt(self.weights)[:",
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
    Mutant("gain doubled", LIN, GAIN_SUM, f"2.0 * {GAIN_SUM}", GAIN),
    Mutant(
        "gain without the noise",
        SIM,
        "scale[:d] / belief.noise[:, None]\n\n",
        "scale[:d]\n\n",
        GAIN,
    ),
    Mutant(
        "draws without their slope", LIN, "return mean + slope", "return mean", DRAWS
    ),
    Mutant(
        "draws with twice the spread",
        LIN,
        "delta = (tt - posterior.mean)",
        "delta = 2.0 * (tt - posterior.mean)",
        DRAWS,
    ),
)
