"""This library and others, timed in turns on one core: a table of ratios.

    pip install 'sim2gp[bench]' torch pytorch_mppi gpytorch flax evosax interpax
    taskset -c 0 python benchmarks/side_by_side.py [--out FILE]

`sim2gp bench`, and jobs that need a peer: a plan of pytorch_mppi (the same cart-pole,
period and reward), one of hydrax (its own cart-pole, in MJX), SBX's updates of SAC (the
same networks and batches), GPyTorch's predictions (an exact Gaussian process of as many
transitions), and mujoco.sysid on a two-link arm (ten seconds in one window: time, and
the error of the motion it predicts) and on the six-axis arm of `arm_and_sysid.py`
(whole commands). A job whose peer is not installed says so. On the package index hydrax
is another project: put the sources of the planner on PYTHONPATH.
"""

import argparse
import contextlib
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from commands import MAIN, timed
from interval_arms import (
    CONDITIONS,
    NAMES,
    NOISE,
    SECONDS,
    Recordings,
    motion_of,
    multisine,
    physical,
)
from sim2gp.commands import bench
from sim2gp.commands.bench import Job
from sim2gp.commands.bench_jobs import HORIZON, ROWS, SAMPLES, Pair, plan, random_rows
from sim2gp.commands.window_length import fit_chosen_windows
from sim2gp.data.split_log import cut
from sim2gp.data.transitions import Transitions
from sim2gp.data.windows import Windows
from sim2gp.identification.fit import fit_windows
from sim2gp.models import Sim2GP
from sim2gp.planning import SAC
from sim2gp.planning.episode import oracle_world
from sim2gp.planning.tasks import Task, cartpole_swingup, furuta_swingup
from sim2gp.project.in_memory import project_of_machine
from sim2gp.systems import CartPole, Furuta, UniformRodArm
from sim2gp.types import in_float64

ROOT = Path(__file__).resolve().parents[1]
UPDATES = 1280
POINTS = 1000
ARMS = 20
REST = 1e-9  # rad, rad/s: sd of a start that is known


def mppi() -> Pair:
    """A plan of one round here, and one of pytorch_mppi."""
    import torch
    from pytorch_mppi import MPPI

    torch.set_num_threads(1)
    task = cartpole_swingup()
    step = torch_cart_pole(task)

    def cost(s: Any, a: Any) -> Any:
        x, theta, speed = s[:, 0], s[:, 1], s[:, 3]
        rail = 0.1 * x**2 + 10.0 * torch.clamp(x.abs() - 0.3, min=0.0)
        rest = 1e-4 * speed**2 + 1e-3 * (a[:, 0] / 3.0) ** 2
        return rail + rest - 0.5 * (1.0 - torch.cos(theta))

    high = torch.tensor(np.asarray(task.actions.high))
    theirs = MPPI(
        step,
        cost,
        4,
        torch.eye(1) * (0.5 * high) ** 2,
        num_samples=SAMPLES,
        horizon=HORIZON,
        u_min=-high,
        u_max=high,
    )
    start = torch.tensor(np.asarray(task.reset(jax.random.key(0))))
    return Pair(plan(oracle_world(task), task), lambda: theirs.command(start))


def torch_cart_pole(task: Task) -> Callable[[Any, Any], Any]:
    """The cart-pole of `sim2gp.systems.CartPole` for a batch, by torch."""
    import torch

    c = CartPole()
    p = c.parameters.nominal()
    ratio = c.gear_ratio / c.pinion_radius
    gain = c.gear_efficiency * c.motor_efficiency * ratio
    gain *= p["motor_constant"] / c.motor_resistance
    first = p["pole_mass"] * p["pole_half_length"]
    m11 = p["pole_mass"] + p["cart_mass"]
    m11 += c.gear_efficiency * c.motor_inertia * ratio**2
    m22 = 4.0 / 3.0 * first * p["pole_half_length"]

    def rate(s: Any, u: Any) -> Any:
        theta, v, w = s[:, 1], s[:, 2], s[:, 3]
        sin, m12 = torch.sin(theta), first * torch.cos(theta)
        motor = gain * (c.motor_efficiency * u - ratio * p["motor_constant"] * v)
        f1 = motor - p["cart_damping"] * v + first * sin * w**2
        f2 = -p["pole_damping"] * w - first * c.gravity * sin
        det = m11 * m22 - m12**2
        a1, a2 = (m22 * f1 - m12 * f2) / det, (m11 * f2 - m12 * f1) / det
        return torch.stack([v, w, a1, a2], dim=1)

    count = round(task.dt / c.max_substep)
    h = task.dt / count

    def step(s: Any, a: Any) -> Any:
        u = a[:, 0]
        for _ in range(count):
            k1 = rate(s, u)
            k2 = rate(s + 0.5 * h * k1, u)
            k3 = rate(s + 0.5 * h * k2, u)
            k4 = rate(s + h * k3, u)
            s = s + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        return s

    return step


def hydrax() -> Pair:
    """A plan of 128 sequences of 100 steps, here and of hydrax in MJX."""
    from mujoco import mjx

    cache = jax.config.jax_compilation_cache_dir
    from hydrax.algs import MPPI
    from hydrax.tasks.cart_pole import CartPole as OfHydrax

    jax.config.update("jax_compilation_cache_dir", cache)  # hydrax sets its own
    samples, steps = 128, 100
    mine, of_hydrax = cartpole_swingup(), OfHydrax()
    horizon = {"plan_horizon": steps * of_hydrax.dt, "num_knots": steps}
    theirs = MPPI(of_hydrax, samples, noise_level=0.3, temperature=0.1, **horizon)
    start, params = mjx.make_data(of_hydrax.model), theirs.init_params()
    improve = jax.jit(theirs.optimize)
    ours = plan(oracle_world(mine), mine, samples=samples, horizon=steps)
    return Pair(ours, lambda: jax.block_until_ready(improve(start, params)[0].mean))


def sac(envs: int) -> Callable[[], Pair]:
    """1,280 steps with as many updates, here and in SBX."""

    def make() -> Pair:
        from sbx import SAC as Theirs
        from stable_baselines3.common.vec_env import DummyVecEnv

        from off_policy import wrapped

        task, key = furuta_swingup(), jax.random.key(0)
        world, steps = oracle_world(task), UPDATES // envs
        ours = SAC(num_envs=envs, updates=envs, steps=steps)
        nothing = Transitions.empty(1, task.size, task.actions.low.size)
        learner = ours.prepare(ours.init(world, key=key), world, nothing, key=key)
        theirs = Theirs(
            "MlpPolicy",
            DummyVecEnv([lambda i=i: wrapped(world, i) for i in range(envs)]),
            gradient_steps=envs,
            policy_kwargs={"net_arch": list(ours.hidden)},
            learning_starts=1,
        )
        theirs.learn(512)
        return Pair(
            lambda: ours.prepare(learner, world, nothing, key=key).updates,
            lambda: theirs.learn(UPDATES, reset_num_timesteps=False),
        )

    return make


def predictions() -> Pair:
    """Mean and covariance of 1,000 next states, from as many transitions."""
    import gpytorch
    import torch

    torch.set_num_threads(1)
    key, rows = jax.random.key(0), random_rows(furuta_swingup())
    model = Sim2GP(Furuta())
    belief = model.fit(model.init(key), rows, key=key)
    S, A, S2 = (
        np.asarray(x, np.float32) for x in (rows.state, rows.action, rows.next_state)
    )
    X = np.concatenate([S, A], axis=1)
    at = np.random.default_rng(0).integers(0, ROWS, POINTS)
    ours = jax.jit(jax.vmap(belief.predict))

    class Process(gpytorch.models.ExactGP):
        """One for each state, of squared exponentials in states and input."""

        def __init__(self, x: Any, y: Any, likelihood: Any) -> None:
            super().__init__(x, y, likelihood)
            batch = torch.Size([y.shape[0]])
            kernel = gpytorch.kernels.RBFKernel(
                ard_num_dims=x.shape[-1], batch_shape=batch
            )
            self.mean_module = gpytorch.means.ZeroMean(batch_shape=batch)
            self.covar_module = gpytorch.kernels.ScaleKernel(kernel, batch_shape=batch)

        def forward(self, x: Any) -> Any:
            return gpytorch.distributions.MultivariateNormal(
                self.mean_module(x), self.covar_module(x)
            )

    n = S.shape[1]
    x = torch.tensor(X).expand(n, *X.shape)
    likelihood = gpytorch.likelihoods.GaussianLikelihood(batch_shape=torch.Size([n]))
    theirs = Process(x, torch.tensor((S2 - S).T), likelihood).eval()
    likelihood.eval()
    new = x[:, at]

    def predict() -> object:
        with torch.no_grad(), gpytorch.settings.fast_pred_var():
            found = likelihood(theirs(new))
            return found.mean, found.variance

    evaluate = in_float64(lambda: ours(S[at], A[at]))
    return Pair(evaluate, predict)


def two_link() -> Pair:
    """A fit of a two-link arm to ten seconds, one window, here and by mujoco.sysid."""
    from interval_sysid import intervals

    system, (data, _) = UniformRodArm(), arm_recordings(0)
    windows = arm_windows(data, at_rest=True)

    def theirs() -> object:
        with contextlib.redirect_stdout(None):
            return intervals(data, 0, system.parameters)

    return Pair(
        lambda: fit_windows(system, windows, key=jax.random.key(0)).posterior.mean,
        theirs,
    )


def arm_recordings(seed: int) -> tuple[Recordings, np.ndarray]:
    """Ten seconds of an arm, and its angles without noise."""
    rng = np.random.default_rng(seed)
    virtual = rng.standard_normal((1, len(NAMES)))
    torque = multisine(rng, SECONDS, 1)
    angles = motion_of(physical(virtual), torque, CONDITIONS["white"])[..., :2]
    noise = NOISE * rng.standard_normal(angles.shape)
    return Recordings(virtual, torque, angles + noise), angles


def arm_windows(data: Recordings, *, at_rest: bool) -> Windows:
    """All ten seconds as one window; mujoco.sysid is given that it begins at rest."""
    system = UniformRodArm()
    known = {channel.name: REST for channel in system.states} if at_rest else None
    windows, _ = cut([data.log(0)], system, window=SECONDS, start_sd=known)
    if at_rest:
        start = np.zeros_like(windows.start)
        windows = eqx.tree_at(lambda w: w.start, windows, start)
    return windows


@in_float64
def arm_errors() -> dict[str, float]:
    """Root mean square error of the motion that each fit predicts; median of arms, rad.

    ``start_unknown`` is this library where it is not given that the arm begins at rest,
    ``default`` the same in the windows that `identify` chooses.
    """
    from interval_sysid import intervals

    system, sd = UniformRodArm(), np.asarray(UniformRodArm().parameters.prior().sd())
    errors: dict[str, list[float]] = {}
    for seed in range(ARMS):
        data, truth = arm_recordings(seed)
        project, key = project_of_machine(system), jax.random.key(0)
        fits = {
            "default": fit_chosen_windows(project, [data.log(0)], key=key).fit.fitted
        }
        for name in ("ours", "start_unknown"):
            windows = arm_windows(data, at_rest=name == "ours")
            fits[name] = fit_windows(system, windows, key=key)
        found = {name: np.asarray(x.posterior.mean) for name, x in fits.items()}
        with contextlib.redirect_stdout(None):
            found["theirs"] = intervals(data, 0, system.parameters)[0] * sd
        for name, virtual in found.items():
            values = physical(virtual[None])
            motion = motion_of(values, data.torque, CONDITIONS["white"])[..., :2]
            error = float(np.sqrt(np.mean((motion - truth) ** 2)))
            errors.setdefault(f"error_{name}", []).append(error)
    return {name: float(np.median(each)) for name, each in errors.items()}


PEERS = (
    Job("MPPI plan 1,024 x 50, cart-pole", "pytorch_mppi", 0.1, mppi),
    Job("MPPI plan 128 x 100, cart-pole", "hydrax in MJX", 1.0 / 14.0, hydrax),
    Job("SAC, 1 episode: 1,280 updates", "SBX", 0.25, sac(1)),
    Job("SAC, 64 episodes: 1,280 updates", "SBX", 1.0, sac(64)),
    Job("1,000 predictions from 250 transitions", "GPyTorch", 1.0 / 80.0, predictions),
    Job("two-link arm, 10 s in one window", "mujoco.sysid", 0.2, two_link),
)


def arm_rows() -> list[dict[str, Any]]:
    """Whole commands on the six-axis arm: a new process, and with compiled programs."""
    from arm_and_sysid import cell

    rows = []
    for cold, words in ((True, "nothing compiled"), (False, "compiled before")):
        found = cell(5.0, 0, 0.01, cold=cold)
        ours, theirs = found["ours"], found["sysid"]
        job = f"identify, six-axis arm, 5 s of log, {words}"
        seconds = ours["wall"], theirs["wall"]
        row = bench.row_of(job, "mujoco.sysid", 1.0, *seconds)
        row |= {"error_ours": ours["median_error"]}
        rows.append(row | {"error_theirs": theirs["median_error"]})
    return rows


def command_rows(data: Path) -> list[dict[str, Any]]:
    """`demo`, and `identify` of six recordings, in seconds of new processes."""
    rows, project = [], str(ROOT / "examples" / "double_pendulum.toml")
    commands = {"demo": (["demo"], 40.0, 25.0)}
    if data.is_dir():
        commands["identify, six recordings"] = (["identify", project], 40.0, 15.0)
    for name, (words, *most) in commands.items():
        with (
            tempfile.TemporaryDirectory() as folder,
            tempfile.TemporaryDirectory() as c,
        ):
            for turn, cache in enumerate((None, c, c)):  # the second fills the cache
                args = [*MAIN, *words, "--quiet", "--out", f"run{turn}"]
                found = timed(Path(folder), args, cache=cache, one_core=True)
                if turn == 1:
                    continue
                how, target = (
                    ("compiled before", most[1]) if turn else ("cold", most[0])
                )
                limit = f"{target:g} s", 1.0
                row = bench.row_of(f"{name}, {how}", *limit, found["wall"], target)
                rows.append(row | {"memory_mib": found["memory"]})
    return rows


def table(summary: dict[str, Any]) -> str:
    """The rows as Markdown."""
    lines = [
        "| job | against | ours | theirs | ratio | at most |",
        "|---|---|---|---|---|---|",
    ]
    for row in summary["rows"]:
        if row["ratio"] is None:
            continue
        ours, theirs = (_time(row[name]) for name in ("ours", "theirs"))
        ratio = f"{row['ratio']:.2g}" if row["ratio"] < 1.0 else f"{row['ratio']:.3g}"
        mark = "" if row["meets_target"] else " (missed)"
        lines.append(
            f"| {row['job']} | {row['against']} | {ours} | {theirs} "
            f"| {ratio}{mark} | {row['target']:.3g} |"
        )
    return "\n".join(lines)


def _time(seconds: float) -> str:
    if seconds < 1.0:
        return f"{1e3 * seconds:.3g} ms"
    return f"{seconds:.3g} s"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("results/bench.json"))
    out = parser.parse_args().out
    started, rows = time.perf_counter(), []
    for job in (*bench.JOBS, *PEERS):
        row = bench.timed_row(job)
        if job.make is two_link and row["ratio"] is not None:
            row |= arm_errors()
        rows.append(row)
        print(bench.line(row), flush=True)
    for row in (*arm_rows(), *command_rows(ROOT / "../shared/data/double_pendulum")):
        rows.append(row)
        print(bench.line(row), flush=True)
    summary = bench.summary_of(rows, started)
    del summary["tables"]
    out.write_text(json.dumps(summary, indent=1) + "\n")
    print(table(summary))


if __name__ == "__main__":
    main()
