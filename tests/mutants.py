"""Faults that the tests must see: each is put into a copy of the package and hunted.

    python tests/mutants.py            all of them, a table, exit code 1 if one survives
    python tests/mutants.py prior      those whose name contains "prior"

A mutant is a name, a file, the text it replaces, what it puts there, and the tests that
must fail. The text must occur exactly once: code that has moved is an error, not a
mutant that quietly no longer exists.
"""

import ast
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "sim2gp"

#: A file of tests, and which of them (-k).
Hunt = tuple[str, str]
ORACLE = ("test_linear_posterior.py", "degenerate or no_rows or order_and_splitting")
DESCENT = ("test_least_squares.py", "finite or polish or noise or laplace")
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
TABLE, GAUSS = "parameters.py", "gaussian.py"

#: Where each quantity is formed.
ROWS = "prior = jnp.concatenate(["
WHITEN = "solve_triangular(noise_scale, block, lower=True)"
CHANNELS = "stack(*(channels / noise[:, None, None]))"
COST = "return 0.5 * full[:, -1] @ full[:, -1]"
EVIDENCE = "return -self.cost - jnp.sum(jnp.log(jnp.diag(self.R)))"
NORMALISER = "N * jnp.sum(jnp.log(noise) + 0.5 * LOG_2PI)"
RESIDUAL = "jnp.where(valid, value - s2[:d], 0.0)"
POSTERIOR = "        fit.posterior(model.prior),\n"
EXPECTED = " + jnp.sum((J @ fit.scale()) ** 2, axis=(1, 2))"
BOX = "low + (high - low) * jax.nn.sigmoid(t), low, high"
GAIN_SUM = "jnp.maximum(jnp.sum(jnp.log(jnp.abs(jnp.diag(R)))), 0.0)"
HESSIAN = """        Gaussian(
            fit.posterior(model.prior).mean,
            model.prior.scale
            @ jnp.linalg.cholesky(
                jnp.linalg.inv(
                    jax.hessian(
                        lambda z: 0.5
                        * jnp.sum((likelihood.rows(z)[0] / noise[None]) ** 2)
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
        SIM,
        CHANNELS,
        CHANNELS.replace("noise[", "noise[").replace("])", "] ** 2)"),
        MODEL,
    ),
    Mutant(
        "root of the sd in the model",
        SIM,
        CHANNELS,
        CHANNELS.replace("])", "] ** 0.5)"),
        MODEL,
    ),
    Mutant(
        "one half missing in the cost", LS, COST, COST.replace("0.5 * ", ""), ORACLE
    ),
    Mutant(
        "one half missing in the determinant",
        LS,
        EVIDENCE,
        EVIDENCE.replace("- jnp", "- 2.0 * jnp"),
        ORACLE,
    ),
    Mutant("evidence without determinant", LS, EVIDENCE, "return -self.cost", ORACLE),
    Mutant(
        "evidence without the noise's scale",
        SIM,
        NORMALISER,
        NORMALISER.replace("jnp.log(noise) + ", "0.0 * noise + "),
        MODEL,
    ),
    Mutant(
        "evidence without two pi",
        SIM,
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
    Mutant("EM without the posterior's spread", SIM, EXPECTED, "", MODEL),
    Mutant("EM without its prior", SIM, "/ (2.0 + N))", "/ N)", MODEL),
    Mutant("EM never runs", SIM, "rounds=NOISE_ROUNDS", "rounds=1", MODEL),
    Mutant(
        "noise of the first channel for all",
        SIM,
        "jnp.sum(r**2, axis=1)",
        "jnp.sum(r[0] ** 2)",
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
        "polish skipped",
        LS,
        "return (count <= 2) | (",
        "return (count <= 0) & (",
        DESCENT,
    ),
    Mutant(
        "a start that is not finite wins",
        LS,
        "fit.cost < best.cost",
        "~(fit.cost >= best.cost)",
        DESCENT,
    ),
    Mutant(
        "nothing found counts as converged",
        LS,
        "jnp.full_like(best.status, NOT_FINITE)",
        "jnp.full_like(best.status, CONVERGED)",
        DESCENT,
    ),
    Mutant(
        "worst start wins",
        LS,
        "fit.cost < best.cost",
        "~(fit.cost < best.cost)",
        ("test_least_squares.py", "best"),
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


def hunt(package: Path, hunt: Hunt) -> tuple[bool, str]:
    """Whether the tests fail on this copy of the package, and the first that does."""
    name, only = hunt
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
    command += [f"tests/{name}", "--durations=0", "--durations-min=1000", "--tb=no"]
    command += ["-k", only] if only else []
    path = os.pathsep.join([str(package.parent), os.environ.get("PYTHONPATH", "")])
    env = os.environ | {"PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        command, cwd=ROOT, env=env, capture_output=True, text=True, timeout=900
    )
    if done.returncode not in (0, 1):  # nothing collected, or pytest itself failed
        raise RuntimeError(
            f"{name}: pytest ended with {done.returncode}\n{done.stdout}"
        )
    failed = [line for line in done.stdout.splitlines() if line.startswith("FAILED")]
    failed += [line for line in done.stdout.splitlines() if line.startswith("ERROR")]
    what = failed[0].split("::")[1].split(" - ")[0] if failed else ""
    return done.returncode == 1, what


def copy_of_the_package(folder: str) -> Path:
    skip = shutil.ignore_patterns("__pycache__")
    return Path(shutil.copytree(PACKAGE, Path(folder) / "sim2gp", ignore=skip))


def survivors(mutants: Iterable[Mutant]) -> list[str]:
    """Hunt each mutant, print a line for each, and name those that live."""
    mutants, alive = list(mutants), []
    with tempfile.TemporaryDirectory() as folder:
        package = copy_of_the_package(folder)
        for healthy in sorted({m.hunt for m in mutants}):
            if hunt(package, healthy)[0]:
                raise RuntimeError(f"{healthy} fails without any mutant")
    print(f"{'mutant':38} {'verdict':9} {'s':>4}  by")
    for mutant in mutants:
        start = time.monotonic()
        with tempfile.TemporaryDirectory() as folder:
            package = copy_of_the_package(folder)
            mutant.apply(package)
            killed, by = hunt(package, mutant.hunt)
        seconds = time.monotonic() - start
        verdict = "killed" if killed else "SURVIVED"
        print(f"{mutant.name:38} {verdict:9} {seconds:4.0f}  {by}", flush=True)
        alive += [] if killed else [mutant.name]
    print(f"{len(mutants) - len(alive)} of {len(mutants)} killed")
    return alive


def main(words: list[str]) -> int:
    """Exit code 1 if a mutant survives."""
    chosen = [m for m in MUTANTS if not words or any(w in m.name for w in words)]
    return 1 if survivors(chosen) else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
