"""Derivatives of whole windows against differences of whole windows, and against MJX.

The windows are asked for as a fit asks for them: `AbstractSimulator.rolled`, then
`AbstractSimulator.linearised` along all constants, starts and inputs.
"""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import servo_arm
from sim2gp.data.split_log import cut
from sim2gp.data.window_slopes import HostRun, SlopeInputs, about
from sim2gp.project import load_project
from sim2gp.systems import Coulomb, Drag, MuJoCo, Spring, Viscous
from sim2gp.systems.assemble import free_parts
from sim2gp.systems.host import simulator_of
from sim2gp.systems.mujoco.engine import Engine
from sim2gp.systems.plants.external import AbstractSimulator, Arguments
from sim2gp.systems.simulate import simulate
from sim2gp.types import in_float64
from tests.systems.test_slopes import CONTACT, tree

mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is not installed")

ROOT = Path(__file__).resolve().parents[2]
EULER, IMPLICIT_FAST = 0, 3
#: Relative, of the largest slope of each direction.
SAME = 1e-6
#: Of states of size one, after some sixty steps.
ROUNDING = 50.0 * np.finfo(float).eps
#: Of differences: a long one for what acts weakly, a short one where dry friction lets
#: go within the others.
STEPS = 2e-5, 2e-4, 1e-6

CARTPOLE = """<mujoco><option timestep=".005" iterations="100" ls_iterations="50"
tolerance="1e-12"/><worldbody><body name="cart"><joint name="x" type="slide"
axis="1 0 0" damping=".5" armature=".1" frictionloss=".3"/><geom type="box"
size=".1 .05 .02" mass="1" contype="0" conaffinity="0"/><body name="pole"
pos="0 .06 0"><joint name="q" axis="0 1 0" damping=".02"/><geom type="capsule"
fromto="0 0 0 0 0 -.6" size=".02" mass=".2" contype="0" conaffinity="0"/></body></body>
</worldbody><actuator><motor name="push" joint="x" gear="3"/></actuator></mujoco>"""
ACROBOT = """<mujoco><option timestep=".005"/><worldbody><body name="upper">
<joint name="shoulder" axis="0 1 0" damping=".05"/><geom type="capsule"
fromto="0 0 0 0 0 1" size=".05" mass="1" contype="0" conaffinity="0"/>
<body name="lower" pos="0 0 1"><joint name="elbow" axis="0 1 0" damping=".05"
armature=".01"/><geom type="capsule" fromto="0 0 0 0 0 1" size=".05" mass="1.5"
contype="0" conaffinity="0"/></body></body></worldbody><actuator>
<motor name="torque" joint="elbow" gear="2"/></actuator></mujoco>"""


def _benchmark() -> ModuleType:
    script = ROOT / "benchmarks" / "mujoco_slopes.py"
    spec = importlib.util.spec_from_file_location("mujoco_slopes", script)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    before = list(sys.path)
    spec.loader.exec_module(module)
    sys.path[:] = before
    return module


BENCHMARK = _benchmark()


def windows(engine: Engine) -> tuple[Arguments, Arguments]:
    """Two windows with inputs that wander, and every direction of their arguments.

    A row is two or more steps of the model; the second window is shorter.
    """
    model, rng = engine.model, np.random.default_rng(1)
    W, n, m = 2, model.nv, model.nu
    length = 30 if n < 20 else 12
    theta = np.asarray([group[0].get(model) for group in engine.constants])
    x0 = np.zeros((W, 2 * n))
    x0[:, :n] = BENCHMARK.inside(model) + 0.02 * rng.normal(size=(W, n))
    u = 0.02 * np.cumsum(rng.normal(size=(W, length, m)), axis=1)
    if m == n:  # servos
        u += x0[:, None, :n]
    span = np.full((W, length), 0.01)
    span[:, 0] = span[1, -4:] = 0.0
    p = theta.size
    each = np.eye(p + 2 * n + m)
    each[:p] *= engine.differences.scale[:, None]
    along = [np.tile(part, (W, 1, 1)) for part in np.split(each, [p, p + 2 * n])]
    of_u = np.tile(along[2][:, None], (1, length, 1, 1))
    at = Arguments(np.tile(theta, (W, 1)), x0, u, span)
    return at, Arguments(along[0], along[1], of_u, span)


def moved(at: Arguments, along: Arguments, i: int, by: float) -> Arguments:
    """The arguments moved along direction ``i``."""
    both = zip(at[:3], along[:3], strict=True)
    return Arguments(*(x + by * d[..., i] for x, d in both), at.span)


def compiled(text: str) -> Any:
    return mujoco.MjModel.from_xml_string(text)


def check(model: Any) -> None:
    """Each direction's slopes are central differences of the whole window's states."""
    engine = BENCHMARK.opened(model)
    at, along = windows(engine)
    run = engine.rolled(at)
    slopes = engine.linearised(run, along)
    step_by_step = AbstractSimulator.rollout(engine, *at)
    assert np.allclose(run.at_rows, step_by_step, atol=1e-8)
    rough = [
        i for i in range(slopes.shape[-1]) if not agree(engine, at, along, i, slopes)
    ]
    # The mass of a base that is fixed; dampings that are almost zero.
    assert len(rough) <= 2, rough


def agree(
    engine: Engine, at: Arguments, along: Arguments, i: int, slopes: np.ndarray
) -> bool:
    """Whether a direction's slopes are its differences; False where those are rough."""
    for step in STEPS:
        up, down = (engine.rollout(*moved(at, along, i, x)) for x in (step, -step))
        expected = (up - down) / (2.0 * step)
        size, error = (np.abs(x).max() for x in (expected, slopes[..., i] - expected))
        rounding = ROUNDING / step
        if error <= SAME * size:
            return True
    assert error <= SAME * size + rounding, (i, error, size)
    return False


@pytest.fixture
def no_differences(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps that the closed form does not know fail the test."""
    monkeypatch.setattr(AbstractSimulator, "slopes", None)


@pytest.mark.usefixtures("no_differences")
@pytest.mark.parametrize("integrator", [EULER, IMPLICIT_FAST])
@pytest.mark.parametrize(
    "text",
    [CARTPOLE, ACROBOT, servo_arm.model_text(), tree("Euler")],
    ids=["cart-pole", "acrobot", "arm", "tree"],
)
def test_a_window_is_differentiated_as_its_differences_are(text, integrator):
    model = compiled(text)
    model.opt.integrator = integrator
    check(model)


@pytest.mark.usefixtures("no_differences")
@pytest.mark.parametrize(
    "integrator", [pytest.param(EULER, marks=pytest.mark.nightly), IMPLICIT_FAST]
)
@pytest.mark.parametrize("name", BENCHMARK.OF_OTHERS)
def test_so_is_one_of_a_robot_of_others(name, integrator):
    model = of_others(name)
    model.opt.integrator = integrator
    check(model)


@pytest.mark.parametrize("name", ["acrobot", "cart-pole"])
def test_so_is_one_in_steps_of_runge_and_kutta(name):
    """As dm_control has them: a recursion of the steps' own differences."""
    check(of_others(name))


def arm_and_windows(folder: Path) -> tuple[Any, Any]:
    """The six-axis arm with an unknown delay, and half seconds of a log."""
    (folder / "arm.xml").write_text(servo_arm.model_text())
    servo_arm.record(folder / "log.csv", seconds=1.0, delay=0.01)
    constants = ["joint/*/armature", "joint/*/frictionloss", "body/*/mass"]
    text = servo_arm.project_text(["log.csv"], constants=constants)
    (folder / "arm.toml").write_text(text.replace("window = 1.0", "window = 0.5"))
    project = load_project(folder / "arm.toml")
    system = project.build_system()
    return system, cut(project.load_logs(), system, window=0.5)[0]


#: Two on one joint, so that their order matters.
FORCES = (
    Coulomb("joint2", 0.3, width=0.3),
    Spring("joint2", 2.0),
    Viscous("joint4", 1.0),
    Drag("joint5", 0.5),
)


@pytest.mark.parametrize(
    "forces",
    [
        pytest.param((), id="as it is"),
        pytest.param(FORCES, id="forces on joints", marks=pytest.mark.nightly),
    ],
)
@in_float64
def test_the_likelihood_of_logs_has_the_slopes_of_its_own_simulation(tmp_path, forces):
    """In virtual constants and starts, one delay of all drives among the constants."""
    plain, cuts = arm_and_windows(tmp_path)
    system = free_parts(plain, forces)
    prior, e = system.parameters.prior(), np.zeros(cuts.start.shape)
    simulator, n = simulator_of(system), e.shape[1]
    k, names = n + prior.mean.size, system.parameters.names
    z = 0.5 * np.asarray([name in [f.name for f in forces] for name in names])

    def run(x: np.ndarray) -> HostRun:
        tt = prior.mean + prior.scale @ (z + x[n:])
        start = cuts.start + cuts.start_sd * (e + x[:n])
        asked = about(tt, start, prior.scale, cuts.start_sd)
        return HostRun(simulator, system, cuts, asked)

    slopes = run(np.zeros(k)).slopes()
    late = [n + i for i, name in enumerate(names) if name.endswith(".delay")]
    for i in range(k):
        # A delayed input is a difference of integrals: it has more rounding.
        step = STEPS[1] if i in late else STEPS[0]
        up, down = (run(x).states for x in step * np.eye(k)[i] * [[1.0], [-1.0]])
        expected = (up - down) / (2.0 * step)
        size, error = (np.abs(x).max() for x in (expected, slopes[..., i] - expected))
        assert error <= SAME * size + ROUNDING / step, (i, error, size)


@in_float64
def test_forces_on_joints_act_on_the_host_as_in_jax(tmp_path):
    """Windows moved by the simulator and its kicks, and step by step by `flow`."""
    plain, cuts = arm_and_windows(tmp_path)
    system = free_parts(plain, FORCES)
    prior = system.parameters.prior()
    tt = prior.mean + 0.5 * jnp.diag(prior.scale)
    asked = SlopeInputs.at(np.asarray(tt), cuts.start)
    run = HostRun(simulator_of(system), system, cuts, asked)
    params = system.record(system.values(tt))
    expected = cuts.each(lambda one: simulate(system, params, one, one.start))
    assert np.allclose(run.states, expected, rtol=0.0, atol=1e-8)


def test_where_contacts_come_and_go_each_step_is_as_mujoco_has_it():
    """A leg that hops: the recursion is the product of MuJoCo's own matrices."""
    model = compiled(CONTACT)
    engine, (n, L) = BENCHMARK.opened(model), (model.nv, 130)
    theta = np.asarray([[group[0].get(model) for group in engine.constants]])
    u = 6.0 * np.sin(0.1 * np.arange(L))[None, :, None]
    span = np.full((1, L), model.opt.timestep)
    at = Arguments(theta, np.asarray([[0.02, -0.3, -0.5, 0.0]]), u, span)
    run = engine.rolled(at)
    of_theta, of_u = np.zeros((1, theta.size, 2 * n)), np.zeros((1, L, 1, 2 * n))
    along = Arguments(of_theta, np.eye(2 * n)[None], of_u, span)
    slopes = engine.linearised(run, along)[0]
    before = np.concatenate([at.x0, run.states[0, :-1]])
    data, touches, S = mujoco.MjData(model), [], np.eye(2 * n)
    A, B = np.zeros((2 * n, 2 * n)), np.zeros((2 * n, 1))
    for k in range(L):
        data.qpos[:], data.qvel[:] = np.split(before[k], 2)
        data.ctrl[:] = u[0, k]
        mujoco.mj_forward(model, data)
        touches.append(data.ncon > 0)
        mujoco.mjd_transitionFD(model, data, 1e-6, True, A, B, None, None)
        S = A @ S
        assert np.abs(slopes[k] - S).max() <= 1e-5 * np.abs(S).max(), k
    assert np.sum(np.diff(touches)) >= 5


def mjx_slopes(model: Any, fields: tuple[str, ...], at: Arguments) -> np.ndarray:
    """Slopes of one window by MJX's forward mode, in fields of the model and the start.

    Columns: a factor of each field's entries, then the start's.
    """
    from mujoco import mjx

    with jax.numpy_dtype_promotion("standard"):
        device = mjx.put_model(model)
    values = [np.asarray(getattr(model, name)).reshape(-1) for name in fields]
    shapes = [np.shape(getattr(device, name)) for name in fields]
    cuts = np.cumsum([v.size for v in values])

    def states(x: jax.Array) -> jax.Array:
        *parts, start = jnp.split(x, cuts)
        new = zip(fields, parts, values, shapes, strict=True)
        here = device.tree_replace(
            {name: (part * value).reshape(shape) for name, part, value, shape in new}
        )
        data = mjx.make_data(here)
        q, v = jnp.split(start, 2)
        data = data.replace(qpos=q, qvel=v)

        def step(data: Any, u: jax.Array) -> Any:
            data = mjx.step(here, data.replace(ctrl=u))
            return data, jnp.concatenate([data.qpos, data.qvel])

        return jax.lax.scan(step, data, jnp.asarray(at.u[0]))[1]

    x = jnp.concatenate([jnp.ones(cuts[-1]), jnp.asarray(at.x0[0])])
    # MJX is written for JAX's own settings, the tests have stricter ones.
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        return np.asarray(jax.jit(jax.jacfwd(states))(x))


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("text", "fields"),
    [
        (CARTPOLE, ("dof_damping", "dof_frictionloss")),
        (ACROBOT, ("dof_damping", "dof_armature")),
        (servo_arm.model_text(), ("dof_damping", "dof_frictionloss")),
    ],
    ids=["cart-pole", "acrobot", "arm"],
)
@in_float64
def test_a_window_is_differentiated_as_by_mjx(text, fields):
    """Forward mode through its steps; nothing there is of this library.

    Servos stay off their largest forces, where MJX's `implicitfast` is not MuJoCo's.
    """
    pytest.importorskip("mujoco.mjx", reason="MJX is not installed")
    model = compiled(text)
    every = [
        (f"joint/{model.joint(j).name}/{field.removeprefix('dof_')}", value)
        for field in fields
        for j, value in enumerate(getattr(model, field).tolist())
    ]
    some = [k for k, (_, value) in enumerate(every) if value > 0.0]
    engine = MuJoCo(model, [every[k][0] for k in some]).engine
    rng, (n, m, L) = np.random.default_rng(2), (model.nv, model.nu, 20)
    x0 = np.concatenate([0.3 * rng.normal(size=n), np.zeros(n)])[None]
    u = x0[:, None, :m] + 0.005 * np.cumsum(rng.normal(size=(1, L, m)), axis=1)
    span = np.full((1, L), model.opt.timestep)
    theta = np.asarray([[every[k][1] for k in some]])
    at, p = Arguments(theta, x0, u, span), theta.size
    each = np.eye(p + 2 * n)
    each[range(p), range(p)] = theta[0]
    of_u = np.zeros((1, L, m, p + 2 * n))
    along = Arguments(each[None, :p], each[None, p:], of_u, span)
    found = engine.linearised(engine.rolled(at), along)[0]
    columns = [*some, *range(len(every), len(every) + 2 * n)]
    expected = mjx_slopes(model, fields, at)[..., columns]
    size, error = (np.abs(x).max(axis=(0, 1)) for x in (expected, found - expected))
    assert size.min() > 1e-5
    assert (error <= SAME * size).all()


def of_others(name: str) -> Any:
    model = BENCHMARK.model_of_others(name)
    if model is None:
        pytest.skip(f"not installed: {BENCHMARK.OF_OTHERS[name]}")
    return model
