"""Derivatives of MuJoCo's steps against differences of steps, and against MuJoCo's."""

import mujoco
import numpy as np
import pytest

from sim2gp import Parameter
from sim2gp.systems import MuJoCo
from sim2gp.systems.mujoco.engine import Engine
from sim2gp.systems.plants.external import AbstractSimulator

FRICTION = "joint/*/frictionloss"
OPEN = ["joint/*/damping", "joint/*/armature", "joint/*/stiffness", "body/*/mass",
        "body/*/length", "actuator/*/kp", "actuator/*/kv", "actuator/*/gear",
        "body/*/com_x", "option/gravity"]  # fmt: skip
LINKS = 4


SIDE = """<body name="side" pos=".1 .2 0"><inertial pos="0 .1 .05" mass=".7"
diaginertia=".01 .02 .015"/><joint name="side" axis="1 1 0" damping=".1" armature=".01"
stiffness=".5" frictionloss=".01"/><joint name="side2" axis="0 1 0" damping=".1"
armature=".02" stiffness=".3" frictionloss=".02"/></body>"""


def tree(integrator: str, friction: bool = True, more: str = "") -> str:
    """Links at odd angles, a slide and a branch among them; servos that saturate."""
    rng = np.random.default_rng(3)

    def row(*x: float) -> str:
        return " ".join(f"{v:.4f}" for v in x)

    def link(k: int) -> str:
        if k == LINKS:
            return ""
        kind = "slide" if k == 1 else "hinge"
        dry = f'frictionloss="{0.3 * rng.uniform():.3f}"' if friction else ""
        side = SIDE if k == 1 else ""  # a branch
        return (
            f'<body name="link{k}" pos="{row(*rng.normal(0, 0.2, 3))}" '
            f'quat="{row(*rng.normal(size=4))}">'
            f'<inertial pos="{row(*rng.normal(0, 0.1, 3))}" '
            f'quat="{row(*rng.normal(size=4))}" mass="{1 + rng.uniform():.3f}" '
            f'diaginertia=".02 .03 .025"/>'
            f'<joint name="j{k}" type="{kind}" axis="{row(*rng.normal(size=3))}" '
            f'pos="{row(*rng.normal(0, 0.1, 3))}" damping="{0.5 * rng.uniform():.3f}" '
            f'armature=".05" stiffness="1" springref=".2" {dry}/>{link(k + 1)}{side}'
            "</body>"
        )

    servos = "".join(
        f'<position joint="j{k}" kp="20" kv="3" gear="{1 + 0.3 * k}" '
        'forcerange="-8 8"/>'
        for k in range(LINKS)
    )
    return (
        f'<mujoco><option integrator="{integrator}" timestep=".004" {more}/>'
        f"<worldbody>{link(0)}</worldbody><actuator>{servos}</actuator></mujoco>"
    )


def opened(text: str, constants: list[str]) -> tuple[Engine, np.ndarray]:
    """A model's engine, and the values of its open constants."""
    model = mujoco.MjModel.from_xml_string(text)
    centred = Parameter("", "", "", "identity", mean=0.0, sd=0.1)
    bodies = [model.body(b).name for b in range(1, model.nbody)]
    named = "body/*/com_x" in constants
    priors = {f"body/{name}/com_x": centred for name in bodies if named}
    engine = MuJoCo(model, constants, priors).engine
    return engine, np.asarray([g[0].get(model) for g in engine.constants])


def points(engine: Engine, theta: np.ndarray, count: int) -> tuple[np.ndarray, ...]:
    rng, n, m = np.random.default_rng(0), engine.model.nv, engine.model.nu
    q = rng.normal(size=(count, n))
    # Half of them creep: dry friction holds there.
    v = rng.normal(size=(count, n)) * np.where(np.arange(count) % 2, 1.0, 0.01)[:, None]
    u = rng.normal(size=(count, m))
    h = np.full(count, engine.model.opt.timestep)
    return np.tile(theta, (count, 1)), np.concatenate([q, v], axis=1), u, h


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
@pytest.mark.parametrize("friction", [True, False])
def test_a_step_is_differentiated_as_its_differences_are(integrator, friction):
    constants = OPEN + [FRICTION] * friction
    engine, theta = opened(tree(integrator, friction), constants)
    x = points(engine, theta, 40)
    out, expected = AbstractSimulator.slopes(engine, *x)
    # Nothing is left to differences.
    engine.flow = None
    J = engine.jacobian(*x, out)
    size = np.abs(expected).max(axis=(0, 1))
    assert np.sum(size > 0.0) >= size.size - 1  # where the tree stands moves nothing
    assert np.all(np.abs(J - expected).max(axis=(0, 1)) <= 1e-6 * size + 1e-10)


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
@pytest.mark.parametrize("friction", [True, False])
def test_a_step_under_forces_is_mujocos_own_and_so_are_its_slopes(integrator, friction):
    """`mj_step` with `qfrc_applied`, and central differences of it in every force."""
    engine, theta = opened(tree(integrator, friction), OPEN + [FRICTION] * friction)
    theta, s, u, h = points(engine, theta, 20)
    f = 2.0 * np.random.default_rng(5).normal(size=(len(s), engine.model.nv))
    model, data = engine.model, mujoco.MjData(engine.model)

    def stepped(k: int, f: np.ndarray) -> np.ndarray:
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = np.split(s[k], 2)
        data.ctrl[:], data.qfrc_applied[:] = u[k], f
        mujoco.mj_step(model, data)
        return np.concatenate([data.qpos, data.qvel])

    out = engine.flow(theta, s, np.concatenate([u, f], axis=1), h)
    mine = np.stack([stepped(k, f[k]) for k in range(len(s))])
    assert np.allclose(out, mine, rtol=0.0, atol=1e-12)
    assert not np.allclose(out, engine.flow(theta, s, u, h), rtol=0.0, atol=1e-4)
    x = theta, s, np.concatenate([u, f], axis=1), h
    _, others = AbstractSimulator.slopes(engine, *x)
    engine.flow = None  # nothing is left to differences
    J = engine.jacobian(*x, out)
    size = np.abs(others).max(axis=(0, 1))
    assert np.all(np.abs(J - others).max(axis=(0, 1)) <= 1e-6 * size + 1e-10)
    steps = 1e-4 * np.eye(model.nv)
    for k in range(len(s)):
        each = [stepped(k, f[k] + d) - stepped(k, f[k] - d) for d in steps]
        expected = np.stack(each, axis=1) / 2e-4
        assert np.allclose(J[k, :, -model.nv :], expected, rtol=1e-5, atol=1e-8)


LEG = """<mujoco><option timestep=".004"/><worldbody><body name="trunk" pos="0 0 1">
<joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
<joint name="pitch" axis="0 1 0"/><geom name="trunk" size=".1" mass="3"/>
<body name="leg" pos="0 0 -.1"><joint name="hip" axis="0 1 0" damping=".2"/>
<geom name="leg" type="capsule" fromto="0 0 0 0 0 -.4" size=".03" mass="1"/></body>
</body></worldbody><actuator><motor joint="hip"/></actuator></mujoco>"""


@pytest.mark.parametrize("flag", ["", '<flag gravity="disable"/>'])
def test_a_body_in_free_fall_is_differentiated_in_closed_form(flag, monkeypatch):
    """Weight and inertia cancel there; the torques that are left are rounding."""
    text = LEG.replace('timestep=".004"/>', f'timestep=".004">{flag}</option>')
    engine, theta = opened(text, ["joint/hip/damping", "body/*/mass"])
    x = points(engine, theta, 10)
    out, expected = AbstractSimulator.slopes(engine, *x)
    monkeypatch.setattr(AbstractSimulator, "slopes", None)
    size = np.abs(expected).max(axis=(0, 1))
    error = np.abs(engine.jacobian(*x, out) - expected).max(axis=(0, 1))
    assert np.all(error <= 1e-6 * size + 1e-10)


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
def test_a_step_is_differentiated_as_mujoco_does(integrator):
    engine, theta = opened(tree(integrator), ["body/*/mass"])
    theta_, s, u, h = points(engine, theta, 6)
    out = engine.flow(theta_, s, u, h)
    J = engine.jacobian(theta_, s, u, h, out)
    data = mujoco.MjData(engine.model)
    n, m, p = s.shape[1], u.shape[1], theta.size
    for k in range(len(s)):
        data.qpos[:], data.qvel[:] = np.split(s[k], 2)
        data.ctrl[:] = u[k]
        A, B = np.zeros((n, n)), np.zeros((n, m))
        mujoco.mjd_transitionFD(engine.model, data, 1e-6, True, A, B, None, None)
        assert np.allclose(J[k, :, p : p + n], A, atol=1e-5 * np.abs(A).max())
        assert np.allclose(J[k, :, p + n :], B, atol=1e-5 * np.abs(B).max())


@pytest.mark.parametrize(
    "more", ['density="900" viscosity=".5"', 'integrator="RK4"', 'wind="9 0 0"']
)
def test_what_the_closed_form_does_not_know_is_seen_in_the_step(more):
    """A fluid's drag: no attribute is asked for, the step itself tells."""
    text = tree("Euler", more='density="900"' if "wind" in more else "")
    if "RK4" in more:
        text = tree("RK4")
    elif "wind" in more or "density" in more:
        text = tree("Euler", more=more + (' density="900"' if "wind" in more else ""))
    engine, theta = opened(text, ["joint/*/damping"])
    x = points(engine, theta, 6)
    out, expected = AbstractSimulator.slopes(engine, *x)
    assert np.allclose(engine.jacobian(*x, out), expected, rtol=1e-9, atol=1e-12)


CONTACT = """<mujoco><option timestep=".002"/><worldbody>
<geom type="plane" size="1 1 .1"/><body pos="0 0 .31"><joint name="lift" type="slide"
axis="0 0 1" damping="1"/><joint name="turn" axis="0 1 0" damping=".1"/>
<geom name="foot" type="sphere" size=".1" pos=".1 0 -.2" mass="1"/></body></worldbody>
<actuator><motor joint="turn"/></actuator></mujoco>"""


def test_contacts_and_limits_are_left_to_differences():
    engine, theta = opened(CONTACT, ["joint/*/damping"])
    s = np.asarray([[-0.012, 0.0, -0.1, 0.2], [0.5, 0.0, -0.1, 0.2]])
    x = np.tile(theta, (2, 1)), s, np.asarray([[0.3], [0.3]]), np.full(2, 0.002)
    out, expected = AbstractSimulator.slopes(engine, *x)
    free = np.abs(s[0, 2] - 9.81 * 0.002 - out[0, 2])
    assert free > 1e-3  # it touches
    J = engine.jacobian(*x, out)
    assert np.allclose(J, expected, rtol=1e-6, atol=1e-8)
    data = mujoco.MjData(engine.model)
    data.qpos[:], data.qvel[:] = np.split(s[0], 2)
    data.ctrl[:] = 0.3
    A, B = np.zeros((4, 4)), np.zeros((4, 1))
    mujoco.mjd_transitionFD(engine.model, data, 1e-6, True, A, B, None, None)
    assert np.allclose(J[0, :, 2:6], A, atol=1e-4)


def test_a_state_that_runs_away_is_no_number():
    engine, theta = opened(tree("Euler"), ["joint/*/damping"])
    x0, u = np.zeros((1, 2 * engine.model.nv)), np.zeros((1, 5, LINKS))
    x0[0, engine.model.nv] = 1e12
    out = engine.rollout(theta[None], x0, u, np.full((1, 5), 0.004))
    assert np.isnan(out[0, -1]).all()
