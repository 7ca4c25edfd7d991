"""Designed experiments, and what one would run otherwise, on arms with friction.

    python benchmarks/design.py [--truths N] [--recordings N] [--seconds S]
        [--workers N] [--out DIR] [--refresh | --keep-old]

Hidden two-link arms are drawn from CAD priors. Each is excited for S seconds within the
same limits of torque, torque rate, position and velocity and with the same energy: by
random input, by a multisine that was optimised for the prior's middle alone (the
field's standard), by `sim2gp design` (multisine and free). The log, with sensor noise,
is fitted by the likelihood of `sim2gp identify`. Compared are the realised errors of
the constants, those of a held-out motion, the posterior's volume, and the predicted sd.
"""

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sim2gp.data.logs import Log
from sim2gp.data.split_log import cut
from sim2gp.experiment_design import (
    AbstractCommandSignal,
    DOptimal,
    Experiment,
    FreeCommands,
    LimitBox,
    MultisineCommands,
    information,
    optimise_commands,
    posterior_scale,
    search,
    trajectory,
)
from sim2gp.experiment_design.limits import excess
from sim2gp.identification.fit import fit_windows
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.parameters import prior_from_moments
from sim2gp.runs.cells import Cells, Old, add_options
from sim2gp.runs.executors import Processes, cores
from sim2gp.studies.claims import bootstrap_median
from sim2gp.systems import TwoLink
from sim2gp.types import in_float64

PERIOD, WINDOW = 0.01, 0.2
NOISE = 2e-4  # rad, of both encoders: 14 bits a turn, and a little more
LIMITS = {
    "torque1": (-4.0, 4.0),
    "torque2": (-3.0, 3.0),
    "q1": (-1.6, 1.6),
    "q2": (-1.8, 1.8),
    "q1.velocity": (-8.0, 8.0),
    "q2.velocity": (-16.0, 16.0),
}
RATES = {"torque1": 40.0, "torque2": 40.0}
#: CAD: relative sd of masses and lengths, and of friction, which no drawing knows.
GEOMETRY, FRICTION = 0.15, 0.5
METHODS = ("random", "multisine", "design", "design free")
#: The project's goals: error over random input's and the multisine's; calibration.
OF_RANDOM, OF_MULTISINE, CALIBRATED = 0.5, 0.9, (0.8, 1.25)


#: Mean square of the commands, each in its own limit, of every experiment.
ENERGY = 0.007
TRIES = 30  # random inputs, for one that keeps the limits
STARTS = 4  # random motions that a search improves, the multisine's too
DESIGNS = 4  # of each kind, by searches of their own; arms take them in turn
HELD, AHEAD = 500, 100  # periods of the held-out motion, and of a prediction in it


class Job(NamedTuple):
    method: str
    seed: int
    seconds: float
    recordings: int
    out: Path
    old: Old


def arm() -> TwoLink:
    """Nine constants as a drawing knows them; link 2 was put on a scale."""
    table = TwoLink().parameters
    nominal = table.nominal()
    changes: dict[str, Any] = {"m2": nominal["m2"]}
    for p in table.free:
        if p.name != "m2":
            share = FRICTION if p.name in ("b1", "b2", "cf1", "cf2") else GEOMETRY
            mean = nominal[p.name]
            changes[p.name] = prior_from_moments(p, mean, share * mean)
    return TwoLink(table.replace(**changes), gravity=9.81)


def setting(seconds: float) -> tuple[Experiment, LimitBox]:
    """What is planned with: the prior, the sensors, the limits."""
    system, steps = arm(), round(seconds / PERIOD)
    names = [channel.name for channel in system.physical_states]
    experiment = Experiment(
        system,
        system.parameters.prior(),
        jnp.full(2, NOISE),
        jnp.zeros(4),
        jnp.asarray([0.1, 0.1, 1.0, 1.0]),
        (names.index("q1"), names.index("q2")),
        PERIOD,
        steps,
        round(WINDOW / PERIOD),
    )
    return experiment, LimitBox.of(system, LIMITS, RATES, start=np.zeros(4))


class Powered(AbstractCommandSignal):
    """Another signal's commands, made smaller where they would take too much energy."""

    inner: AbstractCommandSignal
    limit: float = eqx.field(static=True)

    @property
    def coefficients(self) -> int:
        return self.inner.coefficients

    def commands(self, C: Any, limits: LimitBox) -> Any:
        U = self.inner.commands(C, limits)
        return U * jnp.minimum(1.0, jnp.sqrt(self.limit / energy(U, limits)))

    def random(self, key: Any, inputs: int) -> Any:
        return self.inner.random(key, inputs)


def energy(U: Any, limits: LimitBox) -> Any:
    """Mean square of the commands, each in its own limit."""
    return jnp.mean((U / limits.high[None]) ** 2)


@in_float64
def commands(method: str, seed: int, seconds: float) -> np.ndarray:
    """A design of that seed; of random input, what an arm of that seed is given."""
    experiment, limits = setting(seconds)
    steps, key = experiment.steps, jax.random.key(seed)
    sine = Powered(PERIOD, steps, MultisineCommands(PERIOD, steps), ENERGY)
    free = Powered(PERIOD, steps, FreeCommands(PERIOD, steps), ENERGY)
    if method == "random":
        return random_input(experiment, limits, free, key)
    if method == "multisine":
        # Optimised at the prior's middle alone.
        found = optimise_commands(
            experiment, DOptimal(), limits, sine, key=key, draws=1, starts=STARTS
        )
    else:
        family = free if method == "design free" else sine
        found = optimise_commands(
            experiment, DOptimal(), limits, family, key=key, starts=STARTS
        )
    return np.asarray(found.commands)


def random_input(
    experiment: Experiment, limits: LimitBox, signal: Powered, key: Any
) -> np.ndarray:
    """The first of many that keeps the limits on 100 drawn arms with all its energy.

    Where none does, the one that keeps them with the most.
    """
    p = experiment.belief.mean.size
    draws = jax.random.normal(jax.random.fold_in(key, 1), (100, p))

    @eqx.filter_jit
    def beyond(U: Any) -> Any:
        machines = jax.vmap(experiment.belief.at)(draws)
        states = jax.vmap(lambda tt: trajectory(experiment, tt, U))(machines)
        return jnp.mean(jax.vmap(lambda S: excess(limits, S) > 0.0)(states))

    best, most = None, 0.0
    for i in range(TRIES):
        white = jax.random.normal(
            jax.random.fold_in(key, 2 + i), (signal.coefficients, 2)
        )
        for share in (0.2, 0.1, 0.05):
            U = signal.commands(share * white, limits)
            power = float(energy(U, limits))
            if power > most and float(beyond(U)) <= search.ALLOWED:
                best, most = np.asarray(U), power
                break
        if most >= 0.99 * ENERGY:
            break
    assert best is not None, "no random input keeps the limits"
    return best


def truth(seed: int) -> Any:
    """The seed's arm, in sd of the prior."""
    p = arm().parameters.prior().mean.size
    return jax.random.normal(jax.random.key(1000 + seed), (p,))


def recorded(seed: int, run: int, U: np.ndarray) -> tuple[Log, np.ndarray]:
    """The log of the commands on the seed's arm, and the states behind it."""
    experiment, _ = setting(len(U) * PERIOD)
    machine = experiment.belief.at(truth(seed))
    states = np.asarray(trajectory_of(experiment, machine, jnp.asarray(U)))[:-1]
    rng = np.random.default_rng([seed, run])
    y = states[:, :2] + NOISE * rng.standard_normal((len(U), 2))
    log = Log(
        name=f"arm{seed}-{run}",
        source=f"arm{seed}-{run}.csv",
        time=PERIOD * np.arange(len(U)),
        channels={"q1": y[:, 0], "q2": y[:, 1]},
        inputs={"torque1": U[:, 0], "torque2": U[:, 1]},
        mask={n: np.ones(len(U), bool) for n in ("q1", "q2")},
        notes=(),
    )
    return log, states


def fitted(logs: list[Log], seed: int) -> Gaussian:
    """What `sim2gp identify` believes after the logs."""
    system = arm()
    windows, _ = cut(logs, system, window=WINDOW)
    return fit_windows(system, windows, key=jax.random.key(seed)).posterior


def motion_error(belief: Gaussian, seed: int) -> float:
    """Of angles (rad) in five seconds that were held out, at the belief's mean.

    Each second is predicted from where the arm is when it begins. From a single start
    the later seconds would hang on its last digits, for any estimate.
    """
    experiment, limits = setting(HELD * PERIOD)
    signal = MultisineCommands(PERIOD, HELD)
    U = signal.commands(0.06 * signal.random(jax.random.key(77), 2), limits)
    states = np.asarray(trajectory_of(experiment, experiment.belief.at(truth(seed)), U))
    second, _ = setting(AHEAD * PERIOD)
    errors = []
    for k in range(0, HELD, AHEAD):
        now = eqx.tree_at(lambda e: e.start, second, jnp.asarray(states[k]))
        found = np.asarray(trajectory_of(now, belief.mean, U[k : k + AHEAD]))
        errors.append((found - states[k : k + AHEAD + 1])[1:, :2])
    return float(np.sqrt(np.mean(np.square(errors))))


@in_float64
def learned(seed: int, U: np.ndarray, recordings: int) -> dict[str, Any]:
    """Fly on the seed's arm, fit each recording of it, and compare with the truth.

    An arm's error is the root mean square over its recordings: that of a single one is
    mostly the luck of whichever constant is known least.
    """
    experiment, limits = setting(len(U) * PERIOD)
    prior, z = experiment.belief, truth(seed)
    predicted = np.asarray(_expected(experiment, z, jnp.asarray(U)))
    away, sd, motion, volume = [], [], [], []
    for run in range(recordings):
        log, states = recorded(seed, run, U)
        belief = fitted([log], seed)
        away.append(np.asarray(belief.mean - prior.mean - prior.scale @ z))
        sd.append(np.asarray(belief.sd()))
        motion.append(motion_error(belief, seed))
        volume.append(np.linalg.slogdet(np.asarray(belief.scale))[1])
    errors = np.asarray(away)
    each = np.sqrt(np.mean((errors / np.asarray(prior.sd())) ** 2, axis=1))
    return {
        "constants": float(np.sqrt(np.mean(each**2))),
        "motion": float(np.sqrt(np.mean(np.square(motion)))),
        "constants_of_each": each.tolist(),
        "motion_of_each": motion,
        "log_volume": float(np.mean(volume)),
        "z": (errors / np.asarray(sd)).tolist(),
        "z_expected": (errors / predicted).tolist(),
        "energy": float(energy(U, limits)),
        "beyond": float(excess(limits, jnp.asarray(states))),
    }


trajectory_of = eqx.filter_jit(trajectory)


@eqx.filter_jit
def _expected(experiment: Experiment, z: Any, U: Any) -> Any:
    states = trajectory(experiment, experiment.belief.at(z), U)
    A = information(experiment, z, U, states)
    return jnp.sqrt(jnp.sum(posterior_scale(experiment.belief, A) ** 2, axis=1))


def work(job: Job) -> dict[str, Any]:
    """One method on its arms."""
    if job.method == "random":
        U = commands(job.method, job.seed, job.seconds)
        return learned(job.seed, U, job.recordings)
    which = job.seed % DESIGNS
    cells, name = Cells(job.out, __file__, job.old), designed(job)
    U = stored(cells, name, lambda: commands(job.method, which, job.seconds))
    return learned(job.seed, U, job.recordings)


def designed(job: Job) -> str:
    """The cell of its commands, which several arms share."""
    which = job.seed % DESIGNS
    return f"{job.method.replace(' ', '_')}_{job.seconds:g}_{which}"


def stored(cells: Cells, name: str, make: Callable[[], np.ndarray]) -> np.ndarray:
    """Commands from the disk, computed where they are not there yet."""
    found = cells.load(name, {})
    if found is None:
        found = cells.save(name, {}, {"commands": make()})
    return np.asarray(found["commands"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--truths", type=int, default=20)
    parser.add_argument("--recordings", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--workers", type=int, default=cores())
    parser.add_argument("--out", type=Path, default=Path("results/design"))
    add_options(parser)
    options = parser.parse_args()
    seeds = range(options.truths)
    rest = options.seconds, options.recordings, options.out, options.old
    groups = [[Job(m, s, *rest) for s in seeds] for m in METHODS]
    cells = Cells(options.out, __file__, options.old)
    cells.check((designed(job), {}) for group in groups for job in group)
    found: dict[str, list[Any]] = {m: [None] * len(seeds) for m in METHODS}
    for job, result in Processes(options.workers).spread(work, groups):
        found[job.method][job.seed] = result
        print(f"{job.method}, arm {job.seed}", file=sys.stderr)
    text = "\n".join(lines(found))
    print(text)
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "table.txt").write_text(text + "\n")
    (options.out / "arms.json").write_text(json.dumps(found, indent=1) + "\n")


def lines(found: dict[str, list[Any]]) -> list[str]:
    """Medians, ratios per arm with bootstrap intervals, and the goals."""

    def each(method: str, what: str) -> np.ndarray:
        return np.asarray([row[what] for row in found[method]])

    out = [
        f"{'':12s}{'constants':>12s}{'motion, rad':>14s}{'log volume':>12s}"
        f"{'rms z':>8s}{'expected':>10s}{'energy':>8s}{'beyond':>8s}"
    ]
    for m in METHODS:
        rms = [np.sqrt(np.mean(each(m, k) ** 2)) for k in ("z", "z_expected")]
        out.append(
            f"{m:12s}{np.median(each(m, 'constants')):12.4f}"
            f"{np.median(each(m, 'motion')):14.2e}"
            f"{np.median(each(m, 'log_volume')):12.2f}{rms[0]:8.2f}{rms[1]:10.2f}"
            f"{np.median(each(m, 'energy')):8.3f}{np.max(each(m, 'beyond')):8.3f}"
        )
    for ours in METHODS[2:]:
        for other, goal in (("random", OF_RANDOM), ("multisine", OF_MULTISINE)):
            for what in ("constants", "motion"):
                rng = np.random.default_rng(0)
                ratio, low, high = bootstrap_median(
                    each(ours, what) / each(other, what), rng
                )
                verdict = "holds" if ratio <= goal else "does not hold"
                out.append(
                    f"{ours}: error of the {what} at most {goal:g} of {other}'s: "
                    f"{verdict} ({ratio:.2f} [{low:.2f}, {high:.2f}], median over arms)"
                )
        lower = int(np.sum(each(ours, "log_volume") < each("random", "log_volume")))
        out.append(f"{ours}: volume below random's in {lower} of {len(found[ours])}")
        for name, words in (("z", "the fit's sd"), ("z_expected", "the expected sd")):
            of_sd = float(np.sqrt(np.mean(each(ours, name) ** 2)))
            low, high = CALIBRATED
            held = "holds" if low <= of_sd <= high else "does not hold"
            out.append(
                f"{ours}: errors in {words}, root mean square within {low:g} to "
                f"{high:g}: {held} ({of_sd:.2f})"
            )
    return out


if __name__ == "__main__":
    main()
