"""What `bench` times: pairs of calls, ours and what it is compared with.

Calls return when their work is done, and nothing of it is kept. Sizes are those of real
runs: a swing-up's plan, an episode's transitions, a preparation of SAC.
"""

import subprocess
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sim2gp.data.one_step import OneStepLikelihood, compiled_rows
from sim2gp.data.transitions import Transitions
from sim2gp.models import MissingForces, Sim2GP
from sim2gp.planning import MPC, MPPI, SAC, MarkovObjective, World
from sim2gp.planning.episode import oracle_world, world_of
from sim2gp.planning.sac import updated
from sim2gp.planning.tasks import Task, cartpole_swingup, furuta_swingup
from sim2gp.systems import CartPole, Furuta, MuJoCo
from sim2gp.types import Key, in_float64

SAMPLES, HORIZON = 1024, 50
ROWS = 250  # an episode of five seconds
TURNS = 50  # of SAC: of 64 episodes, and as many times its updates
WINDOWS, STEPS = 100, 200  # of the MuJoCo machine
CART_POLE = """
<mujoco><option timestep="0.005"/><worldbody>
  <body name="cart"><joint name="x" type="slide" axis="1 0 0" damping="1"/>
    <geom type="box" size=".1 .1 .02" mass=".5"/>
    <body name="pole"><joint name="q" axis="0 1 0" damping=".02"/>
      <geom type="capsule" fromto="0 0 0 0 0 .3" size=".02" mass=".1"/></body></body>
</worldbody><actuator><motor name="u" joint="x" gear="2"/></actuator></mujoco>
"""


class Pair(NamedTuple):
    """Calls that are timed in turns; or ours, and so many seconds."""

    ours: Callable[[], object]
    theirs: Callable[[], object] | float


def _done(f: Callable[..., Any], *args: Any) -> Callable[[], object]:
    return lambda: jax.block_until_ready(jax.tree.leaves(f(*args)))


def plan_in_simulator() -> Pair:
    """A plan of MPPI in the simulator, and a bare rollout of its size."""
    task = cartpole_swingup()
    return Pair(plan(oracle_world(task), task), bare_rollout(task))


def plan_in_draw() -> Pair:
    """A plan in a linearised draw, and a bare rollout of the simulator."""
    task, key = cartpole_swingup(), jax.random.key(0)
    dynamics = Sim2GP(CartPole()).init(key).sample(key)
    world = world_of(task, dynamics, MarkovObjective(task.reward))
    return Pair(plan(world, task), bare_rollout(task))


def plan(
    world: World, task: Task, samples: int = SAMPLES, horizon: int = HORIZON
) -> Callable[[], object]:
    """One round of MPPI."""
    planner = MPC(update=MPPI(samples=samples, iterations=1), horizon=horizon)
    key = jax.random.key(1)
    state, s = planner.init(world, key=key), task.reset(key)
    act = eqx.filter_jit(lambda *x: planner.act(*x, key=key))
    return _done(act, state, world, s)


def bare_rollout(task: Task) -> Callable[[], object]:
    """As many simulated steps as a plan has, and nothing else."""
    key = jax.random.key(1)
    s, span = task.reset(key), (SAMPLES, HORIZON, task.actions.low.size)
    actions = jax.random.uniform(key, span, s.dtype, -1.0)

    @eqx.filter_jit
    def states(task: Task, s: Array, A: Array) -> Float[Array, "N H n"]:
        def step(s: Array, a: Array) -> tuple[Array, Array]:
            s2 = task.dynamics(s, a)
            return s2, s2

        return jax.vmap(lambda a: jax.lax.scan(step, s, a)[1])(A)

    return _done(states, task, s, actions)


def fit_and_jacobians() -> Pair:
    """A fit of an episode's transitions, and one evaluation of their Jacobians."""
    model, data = Sim2GP(Furuta()), random_rows(furuta_swingup())

    with jax.enable_x64(True):
        rows = jax.tree.map(jnp.asarray, data)
        likelihood = OneStepLikelihood(model.system, rows, model.dt)
    args = likelihood, model.prior.mean, model.prior.scale
    return Pair(_fit(model, data), in_float64(_done(compiled_rows, *args)))


def fit_with_missing_forces() -> Pair:
    """A fit that may find missing forces, and the plain fit."""
    model, data = Sim2GP(Furuta()), random_rows(furuta_swingup())
    return Pair(_fit(MissingForces(model), data), _fit(model, data))


def _fit(model: Any, data: Transitions) -> Callable[[], object]:
    key = jax.random.key(0)
    return _done(lambda: model.fit(model.init(key), data, key=key))


def random_rows(task: Task) -> Transitions:
    """An episode under inputs that are held for five steps."""
    key, m = jax.random.key(2), task.actions.low.size
    A = jnp.repeat(jax.random.uniform(key, (ROWS // 5, m), minval=-1.0), 5, axis=0)
    A = jax.vmap(lambda a: task.limit(0.5 * task.actions.high * a))(A)
    rows = [np.asarray(x, float) for x in driven(task, key, A)]
    return Transitions.empty(ROWS, task.size, m).extend(*rows)


@eqx.filter_jit
def driven(
    task: Task, key: Key, A: Float[Array, "T m"]
) -> tuple[Float[Array, "T n"], Float[Array, "T m"], Float[Array, "T n"]]:
    """States, inputs and next states of a task's machine under given inputs."""

    def step(s: Array, row: tuple[Array, Array]) -> tuple[Array, Any]:
        a, key = row
        s2 = task.step(s, a, key=key)
        return s2, (s, a, s2)

    keys = jax.random.split(key, len(A))
    rows: tuple[Array, Array, Array] = jax.lax.scan(step, task.reset(key), (A, keys))[1]
    return rows


def sac_and_updates() -> Pair:
    """SAC with 64 episodes in parallel, and the same updates without any step."""
    task, key = furuta_swingup(), jax.random.key(0)
    world, sac = oracle_world(task), SAC(num_envs=64, updates=64, steps=TURNS)
    nothing = Transitions.empty(1, task.size, task.actions.low.size)
    learner = sac.prepare(sac.init(world, key=key), world, nothing, key=key)

    @eqx.filter_jit
    def updates(learner: Any) -> Any:
        keys = jax.random.split(key, sac.updates * TURNS)
        return jax.lax.scan(
            lambda x, k: (updated(sac, x, world, k), None), learner, keys
        )

    return Pair(
        _done(lambda: sac.prepare(learner, world, nothing, key=key)),
        _done(updates, learner),
    )


def mujoco_steps() -> Pair:
    """Windows of a MuJoCo machine, and bare calls of `mj_step`."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(CART_POLE)
    engine = MuJoCo(model, ["joint/x/damping"], engine="c").engine
    rng, step = np.random.default_rng(0), model.opt.timestep
    u = rng.uniform(-1.0, 1.0, (WINDOWS, STEPS, 1))
    x0, span = 0.3 * rng.standard_normal((WINDOWS, 4)), np.full((WINDOWS, STEPS), step)
    theta, data = np.ones((WINDOWS, 1)), mujoco.MjData(model)

    def bare() -> None:
        for w in range(WINDOWS):
            mujoco.mj_resetData(model, data)
            data.qpos[:], data.qvel[:] = x0[w, :2], x0[w, 2:]
            data.ctrl[:] = u[w, 0]
            mujoco.mj_step(model, data, STEPS)  # no time is spent in Python

    return Pair(lambda: engine.rollout(theta, x0, u, span), bare)


def imports() -> Pair:
    """A new process that imports this package, and one that imports JAX."""
    return Pair(_python("import sim2gp"), _python("import jax"))


def command_line_help() -> Pair:
    """``sim2gp --help``, and half a second."""
    entry = "from sim2gp.cli import entry; entry()"
    return Pair(_python(entry, "--help"), 0.5)


def _python(*words: str) -> Callable[[], object]:
    command = [sys.executable, "-c", *words]
    return lambda: subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
