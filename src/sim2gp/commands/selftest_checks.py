"""What the selftest measures; every function returns one number, and less is better.

References use nothing of the library: rational arithmetic from the standard library,
differences, singular values, conservation laws.
"""

import math
from collections.abc import Callable, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.stats
from jaxtyping import Array, Float

from sim2gp.cleanup import temporary_folder
from sim2gp.errors import InputError, NotConverged
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.least_squares import linear_posterior
from sim2gp.models import Sim2GP
from sim2gp.runs import load_run, new_run
from sim2gp.studies.two_link import DT, LEVELS, coverage, record
from sim2gp.systems import CartPole, Furuta, TwoLink, UniformRodArm
from sim2gp.systems.mechanism import AbstractMechanism
from sim2gp.types import in_float64

ARMS = 20
#: A batch of ``(J, y, noise factor, prior mean, prior factor)``.
Problems = tuple[np.ndarray, ...]
Rng = np.random.Generator
Solved = tuple[Array, Array, Array]


@jax.jit
def _solve_batch(*problems: Array) -> Solved:
    """Posterior mean, its scale, and log evidence of a batch."""

    def one(J: Array, y: Array, L: Array, mean: Array, S: Array) -> Solved:
        posterior, evidence = linear_posterior(J, y, L, Gaussian(mean, S))
        return posterior.mean, posterior.scale, evidence

    return jax.vmap(one)(*problems)


def _lower(rng: Rng, count: int, n: int) -> np.ndarray:
    """Random lower factors with correlations of order one."""
    strict = np.tril(0.5 * rng.standard_normal((count, n, n)), -1)
    return strict + rng.uniform(0.5, 2.0, (count, n, 1)) * np.eye(n)


def _random_problems(
    rng: Rng, count: int, N: int, d: int, p: int, cond: float
) -> Problems:
    """Linear problems with truths from the prior; condition numbers up to ``cond``."""
    U = np.linalg.qr(rng.standard_normal((count, N * d, p)))[0]
    V = np.linalg.qr(rng.standard_normal((count, p, p)))[0]
    fall = -np.log10(cond) * rng.uniform(0.0, 1.0, (count, 1))
    singular = 10.0 ** (fall * np.linspace(0.0, 1.0, p)[None])
    J = 2.0 * ((U * singular[:, None, :]) @ V).reshape(count, N, d, p)
    L, S = _lower(rng, count, d), _lower(rng, count, p)
    mean = rng.standard_normal((count, p))
    tt = mean + np.einsum("cij,cj->ci", S, rng.standard_normal((count, p)))
    noise = np.einsum("cij,cnj->cni", L, rng.standard_normal((count, N, d)))
    return J, np.einsum("cndp,cp->cnd", J, tt) + noise, L, mean, S


@in_float64
def exactness(rng: Rng) -> float:
    """Largest error against rational arithmetic; that of the evidence over ten."""
    problems = _random_problems(rng, 8, 12, 2, 4, 1e8)
    mean, scale, evidence = (np.asarray(x) for x in _solve_batch(*problems))
    worst = 0.0
    for i, problem in enumerate(zip(*problems, strict=True)):
        exact_mean, exact_cov, exact_evidence = _rational(*problem)
        sd = np.sqrt(np.diag(exact_cov).astype(float))
        off = (_fractions(mean[i]) - exact_mean).astype(float)
        cov = scale[i] @ scale[i].T - exact_cov.astype(float)
        evidence_off = abs(evidence[i] - exact_evidence) / max(1.0, abs(exact_evidence))
        errors = (np.abs(off) / sd).max(), (np.abs(cov) / np.outer(sd, sd)).max()
        worst = max(worst, *errors, evidence_off / 10.0)
    return float(worst)


_fractions = np.vectorize(Fraction, otypes=[object])


def _rational(
    J: np.ndarray, y: np.ndarray, L: np.ndarray, mean: np.ndarray, S: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Mean, covariance and evidence of ``y_n = J_n tt + e_n`` without rounding."""
    N, d, p = J.shape
    J, y, L, mean, S = (_fractions(x) for x in (J, y, L, mean, S))
    unit = _fractions(np.eye(p))
    white, _ = _eliminate(L, _fractions(np.eye(d)))
    A = np.concatenate([white @ J[n] @ S for n in range(N)])
    r = np.concatenate([white @ (y[n] - J[n] @ mean) for n in range(N)])
    b = A.T @ r
    inverse, determinant = _eliminate(A.T @ A + unit, unit)
    z = inverse @ b
    evidence = -0.5 * float(r @ r - b @ z) - 0.5 * _log(determinant)
    evidence -= N * (sum(map(_log, np.diag(L))) + 0.5 * d * math.log(2.0 * math.pi))
    return mean + S @ z, S @ inverse @ S.T, evidence


def _eliminate(A: np.ndarray, B: np.ndarray) -> tuple[np.ndarray, Fraction]:
    """``A^-1 B`` and ``det A`` by Gauss-Jordan; no pivot of ours is zero."""
    rows, determinant = np.concatenate([A, B], axis=1), Fraction(1)
    for i in range(len(A)):
        determinant *= rows[i, i]
        rows[i] = rows[i] / rows[i, i]
        for j in range(len(A)):
            if j != i:
                rows[j] = rows[j] - rows[j, i] * rows[i]
    return rows[:, len(A) :], determinant


def _log(x: Fraction) -> float:
    """Logarithm of a fraction whose parts no float can hold."""
    return math.log(x.numerator) - math.log(x.denominator)


@in_float64
def unit_invariance(rng: Rng) -> float:
    """Change of the posterior, in sd, when every unit changes by a power of two."""
    J, y, L, mean, S = _random_problems(rng, 8, 12, 2, 4, 1e8)
    rows, columns = 2.0 ** rng.integers(-40, 41, 2), 2.0 ** rng.integers(-40, 41, 4)
    scaled = (
        J * rows[:, None] / columns, y * rows, L * rows[:, None],
        mean * columns, S * columns[:, None],
    )  # fmt: skip
    before = [np.asarray(x) for x in _solve_batch(J, y, L, mean, S)]
    after = [np.asarray(x) for x in _solve_batch(*scaled)]
    sd = np.linalg.norm(before[1], axis=2)
    moved = np.abs(after[0] / columns - before[0]) / sd
    widened = np.abs(after[1] / columns[:, None] - before[1]) / sd[:, :, None]
    return float(max(moved.max(), widened.max()))


@in_float64
def degenerate(rng: Rng) -> float:
    """Departure from the prior in all that the data do not determine; no NaN."""
    J = rng.standard_normal((8, 12, 2, 4))
    J[0] = 0.0  # zero sensitivity
    J[1, 1:] = 0.0  # one row
    J[2] = 1e3 * J[2, :1]  # equal rows
    J[7] = 1e3 * J[7, 0, 0]  # all of them equal
    J[3] = J[3, :, :, :1] * J[3, 0, 0]  # rank one
    J[4, :, :, 2] = 0.0  # one parameter without effect
    J[5, :, :, 3] = J[5, :, :, 2]  # two parameters that act alike
    U, V = (np.linalg.qr(rng.standard_normal((n, 4)))[0] for n in (24, 4))
    J[6] = ((U * np.logspace(0.0, -16.0, 4)) @ V.T).reshape(12, 2, 4)
    y, mean = rng.standard_normal((8, 12, 2)), rng.standard_normal((8, 4))
    S = np.broadcast_to(np.diag([0.5, 1.0, 2.0, 4.0]), (8, 4, 4))
    ones = np.broadcast_to(np.eye(2), (8, 2, 2))
    worst = _departure((J, y, ones, mean, S))
    wide = rng.standard_normal((1, 3, 1, 200)), rng.standard_normal((1, 3, 1))
    many = (*wide, np.ones((1, 1, 1)), np.zeros((1, 200)), np.eye(200)[None])
    prior = Gaussian(jnp.asarray(mean[0]), jnp.asarray(S[0]))
    none = jnp.zeros((0, 1, 4)), jnp.zeros((0, 1)), jnp.ones((1, 1))
    posterior, evidence = linear_posterior(*none, prior)
    same = all(map(np.array_equal, jax.tree.leaves(posterior), jax.tree.leaves(prior)))
    same = same and float(evidence) == 0.0
    return max(worst, _departure(many)) if same else math.inf


def _departure(problems: Problems) -> float:
    """Change of mean and variance along null directions, in prior sd."""
    worst = 0.0
    solved = [np.asarray(x) for x in _solve_batch(*problems)]
    if not all(np.isfinite(x).all() for x in solved):
        return math.inf
    mean, scale, _ = solved
    J, _, _, prior_mean, S = problems
    for i in range(len(J)):
        rows = J[i].reshape(-1, J.shape[-1]) @ S[i]
        null = scipy.linalg.null_space(rows, rcond=1e-14)
        # Whitened by the prior: null directions have mean zero, covariance one.
        z = null.T @ np.linalg.solve(S[i], mean[i] - prior_mean[i])
        root = null.T @ np.linalg.solve(S[i], scale[i])
        cov = root @ root.T - np.eye(len(z))
        worst = max(worst, np.abs(z).max(initial=0.0), np.abs(cov).max(initial=0.0))
    return float(worst)


@in_float64
def bounds_round_trip(rng: Rng) -> float:
    """Error of the round trip through the bounds; infinite if one is left."""
    worst = 0.0
    for system in (Furuta(), CartPole(), TwoLink()):
        table = system.parameters
        low = np.asarray([p.low for p in table.free])
        high = np.asarray([p.high for p in table.free])
        far = np.concatenate([10.0 ** rng.uniform(-300, 6, 500), [0.0, 1e6, np.inf]])
        far = np.concatenate([far, -far])[:, None] * np.ones(len(low))
        theta = np.asarray(jax.jit(jax.vmap(table.constrain))(jnp.asarray(far)))
        if not ((low <= theta) & (theta <= high)).all():
            return math.inf
        inside = jnp.asarray(rng.uniform(low, high, (500, len(low))))
        there = jax.jit(jax.vmap(lambda x, t=table: t.constrain(t.unconstrain(x))))
        error = np.abs(np.asarray(there(inside)) - np.asarray(inside)) / (high - low)
        worst = max(worst, float(error.max()))
    return worst


@in_float64
def jacobians(rng: Rng) -> float:
    """Worst relative error of the derivatives that fits use, over three machines."""
    worst = 0.0
    for system in (Furuta(), CartPole(), TwoLink(gravity=9.81)):
        table = system.parameters
        nominal = [table.nominal()[name] for name in table.names]
        tt = np.asarray(table.unconstrain(jnp.asarray(nominal)))
        p, n, m = len(tt), len(system.states), len(system.actions)
        x = rng.uniform(-1.0, 1.0, (16, p + n + m)) * ([0.2] * p + [1.0] * (n + m))
        x[:, :p] += tt

        def step(x: Array, system: Any = system, p: int = p, n: int = n) -> Any:
            return system.transition(x[:p], x[p : p + n], x[p + n :], DT)

        J = np.asarray(jax.jit(jax.vmap(jax.jacfwd(step)))(jnp.asarray(x)))
        reference = _differences(jax.jit(jax.vmap(step)), x)
        size = np.abs(reference).max(axis=(1, 2), keepdims=True)
        worst = max(worst, float((np.abs(J - reference) / size).max()))
    return worst


def _differences(
    f: Callable[[Array], Array], x: Float[np.ndarray, "b k"], h: float = 3e-4
) -> Float[np.ndarray, "b n k"]:
    """Jacobians of a batched function by the 5-point rule."""
    b, k = x.shape
    weights = np.array([1.0, -8.0, 8.0, -1.0]) / (12.0 * h)
    shifts = h * np.array([-2.0, -1.0, 1.0, 2.0])[:, None, None] * np.eye(k)
    points = (x[:, None, None] + shifts).reshape(-1, k)
    values = np.asarray(f(jnp.asarray(points))).reshape(b, 4, k, -1)
    return np.einsum("w,bwkn->bnk", weights, values)


#: Machines, what is set to zero in them, and their potential energy in J.
_CONSERVATIVE: tuple[tuple[AbstractMechanism, str, Callable[[Any, Array], Array]], ...]
_CONSERVATIVE = (
    (
        Furuta(),
        "arm_damping pendulum_damping motor_constant",
        lambda p, q: -0.5 * 9.81 * p.pendulum_mass * p.pendulum_length * jnp.cos(q[1]),
    ),
    (
        CartPole(),
        "cart_damping pole_damping motor_constant",
        lambda p, q: -9.81 * p.pole_mass * p.pole_half_length * jnp.cos(q[1]),
    ),
    (
        TwoLink(gravity=9.81),
        "b1 b2 cf1 cf2",
        lambda p, q: (
            -9.81
            * ((p.m1r1 + 0.2 * p.m2) * jnp.cos(q[0]) + p.m2r2 * jnp.cos(q[0] + q[1]))
        ),
    ),
)


@in_float64
def energy(rng: Rng) -> float:
    """Worst relative change of the total energy of three machines."""
    worst = 0.0
    for system, zeros, potential in _CONSERVATIVE:
        values: Mapping[str, float] = system.parameters.nominal()
        values = {**values, **dict.fromkeys(zeros.split(), 0.0)}
        params = system.record({k: jnp.asarray(v, float) for k, v in values.items()})
        step = system.bind(params, 1e-3)

        def total(
            s: Array, system: Any = system, p: Any = params, V: Any = potential
        ) -> Any:
            return 0.5 * s[2:] @ system.mass_matrix(p, s[:2]) @ s[2:] + V(p, s[:2])

        def path(s: Array, step: Any = step, total: Any = total) -> Array:
            def move(s: Array, _: None) -> tuple[Array, Array]:
                s = step(s, jnp.zeros(len(step.system.actions)))
                return s, total(s)

            return jax.lax.scan(move, s, length=1000)[1] - total(s)

        s = jnp.asarray(rng.uniform(-2.0, 2.0, (4, 4)))
        size = np.abs(potential(params, jnp.zeros(2)))
        change = jax.jit(jax.vmap(path))(s) / size
        worst = max(worst, float(np.abs(change).max()))
    return worst


@in_float64
def posterior_calibration(rng: Rng) -> float:
    """-log10 p of the squared whitened errors of 1,000 linear problems."""
    count, p = 1000, 3
    J = rng.standard_normal((count, 8, 1, p))
    S, ones = _lower(rng, count, p), np.ones((count, 1, 1))
    mean = rng.standard_normal((count, p))
    tt = mean + np.einsum("cij,cj->ci", S, rng.standard_normal((count, p)))
    y = np.einsum("cndp,cp->cnd", J, tt) + rng.standard_normal((count, 8, 1))
    found, scale, _ = (np.asarray(x) for x in _solve_batch(J, y, ones, mean, S))
    z = np.linalg.solve(scale, (tt - found)[:, :, None])
    return _surprise(float(np.sum(z**2)), count * p)


@in_float64
def arm(rng: Rng) -> float:
    """-log10 p of the worst count of arms whose truth lies in a central interval.

    Counts, not squares: a truth near its bound may lie several sd away (a Laplace
    posterior is symmetric, the exact one there is not), and no count minds how far.
    """
    system = UniformRodArm()
    model, z = Sim2GP(system, dt=DT), []
    for key in jax.random.split(jax.random.key(int(rng.integers(2**31))), ARMS):
        draw, excite, fit = jax.random.split(key, 3)
        truth = model.prior.sample(draw)
        data = record(system, truth, key=excite).transitions()
        try:
            mean, sd = model.fit(model.init(fit), data, key=fit).parameters()
        except NotConverged:
            z.append(np.full(truth.size, np.inf))  # an arm that no interval covers
            continue
        z.append(np.asarray((truth - mean) / sd))
    worst = 1.0
    for level in LEVELS:
        for share in coverage(np.asarray(z), level):
            count = round(float(share) * ARMS)
            worst = min(worst, scipy.stats.binomtest(count, ARMS, level / 100).pvalue)
    return -math.log10(worst)


def _surprise(squares: float, count: int) -> float:
    """-log10 of the two-sided p of a sum of ``count`` squared standard normals."""
    tails = scipy.stats.chi2.cdf(squares, count), scipy.stats.chi2.sf(squares, count)
    return -math.log10(max(2.0 * min(tails), 1e-300))


def store(rng: Rng) -> float:
    """Runs lost by a failed write, and damage that reading did not find."""
    faults = 0
    with temporary_folder() as folder:
        path = Path(folder) / "run"
        with new_run(path, "selftest") as writer:
            writer.write_summary({"kept": 1})
            writer.write_arrays("arrays.npz", {"x": rng.standard_normal(100)})
        try:
            with new_run(path, "selftest") as writer:
                writer.write_summary({"kept": 0})
                raise InterruptedError("a write that fails half-way")
        except Exception as error:
            faults += "half-way" not in str(error.__cause__ or error)
        faults += load_run(path).summary != {"kept": 1}
        whole = (path / "arrays.npz").read_bytes()
        for length in range(0, len(whole), 64):
            (path / "arrays.npz").write_bytes(whole[:length])
            try:
                load_run(path)
                faults += 1
            except InputError as error:
                faults += error.code != "E183"
    return float(faults)
