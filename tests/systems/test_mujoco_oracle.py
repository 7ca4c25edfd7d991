"""Accelerations against C MuJoCo, which was written by others: 1e-9 relative.

Relative to the larger of a state's two accelerations, the worst of 1,000 random states
with ten random sets of constants.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import machines
import mjcf
from sim2gp import systems as sy
from sim2gp.systems.machine import as_machine

mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is not installed")

STATES = 1000
CONSTANTS = 10  # sets of constants, with a tenth of the states each


pytestmark = pytest.mark.usefixtures("float64")


def mujoco_acceleration(model, data, s, a, applied=0.0):
    data.qpos[:2], data.qvel[:2] = s[:2], s[2:]
    data.ctrl[:] = a
    data.qfrc_applied[:2] = applied
    mujoco.mj_forward(model, data)
    return data.qacc.copy()


def physical(values):
    """A two-link arm whose links have positive inertia about their own centres."""
    values = dict(values)
    values["I1"] += values["m1r1"] * 0.1
    values["I2"] += values["m2r2"] ** 2 / values["m2"]
    return values


def compare(system, xml, *, applied=lambda p, v: 0.0, change=dict, solve=None):
    """Largest relative difference between the system and its MJCF twin."""
    machine = as_machine(system)
    ode = jax.jit(lambda p, s, a: machines.ode(machine, p, s, a))
    tables = machines.batch(system, CONSTANTS, 5)[0]
    worst = 0.0
    for k, tt in enumerate(tables):
        values = {n: float(x) for n, x in system.parameters.values(tt).items()}
        values = change(values)
        p = machine.record({n: jnp.asarray(x) for n, x in values.items()})
        model = mujoco.MjModel.from_xml_string(xml(values))
        data = mujoco.MjData(model)
        _, S, A = machines.batch(system, STATES // CONSTANTS, 100 + k)
        for s, a in zip(np.asarray(S), np.asarray(A), strict=True):
            force = applied(values, s[2:])
            if solve is None:
                expected = mujoco_acceleration(model, data, s, a, force)
            else:
                expected = solve(model, data, values, s, a, force)
            got = np.asarray(ode(p, s, a))[2:]
            worst = max(
                worst, np.max(np.abs(got - expected)) / np.max(np.abs(expected))
            )
    print(f"largest relative difference: {worst:.1e}")
    return worst


@pytest.mark.parametrize("full_rod", [False, True])
def test_furuta(full_rod):
    """As published; and with the rod's own inertia, which the published model omits."""
    furuta = sy.Furuta()
    if full_rod:
        furuta = sy.Machine(furuta, [sy.RodInertia()])
    assert compare(furuta, lambda p: mjcf.furuta(p, full_rod=full_rod)) < 1e-9


@pytest.mark.parametrize(("tilt", "extra"), [(0.0, 0.0), (0.03, 0.0), (0.0, 0.0095)])
def test_cartpole(tilt, extra):
    """As published; on a tilted rail; with the pole's centre off its middle."""
    cartpole = sy.CartPole()
    if tilt:
        cartpole = sy.Machine(cartpole, [sy.RailTilt(magnitude=tilt)])
    if extra:
        cartpole = sy.Machine(cartpole, [sy.PoleGeometry(magnitude=extra)])
    xml = lambda p: mjcf.cartpole(p, tilt=tilt, extra=extra)  # noqa: E731
    assert compare(cartpole, xml) < 1e-9


def dry_friction(p, v):
    """MuJoCo's own dry friction is a soft constraint: ours comes in as a force."""
    return -np.array([p["cf1"], p["cf2"]]) * np.tanh(v / 0.05)


@pytest.mark.parametrize("gravity", [0.0, 9.81])
def test_two_link_with_rotors(gravity):
    """The second rotor as the armature of the tendon ``q1 - gr q2``."""
    arm = sy.TwoLink(gravity=gravity)
    xml = lambda p: mjcf.two_link(p, length1=0.2, gear=6.0, gravity=gravity)  # noqa: E731
    assert compare(arm, xml, applied=dry_friction, change=physical) < 1e-9


def test_two_link_without_rotors():
    arm = sy.TwoLink(gravity=9.81)
    xml = lambda p: mjcf.two_link(p, length1=0.2, gear=6.0, gravity=9.81)  # noqa: E731
    change = lambda values: physical(values) | {"Ir": 0.0}  # noqa: E731
    assert compare(arm, xml, applied=dry_friction, change=change) < 1e-9


def test_two_link_with_explicit_rotor_bodies():
    """Joint 3 tied by ``phi = -gr q2``: ``J^T M J qdd = J^T (f - c)``."""
    arm = sy.TwoLink(gravity=9.81)
    J = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, -6.0]])

    def xml(p):
        return mjcf.two_link(p, length1=0.2, gear=6.0, gravity=9.81, rotors="bodies")

    def solve(model, data, values, s, a, force):
        assert [model.joint(i).name for i in range(3)] == ["q1", "q2", "rotor"]
        data.qpos[:], data.qvel[:] = J @ s[:2], J @ s[2:]
        data.ctrl[:], data.qfrc_applied[:] = a, [*force, 0.0]
        mujoco.mj_forward(model, data)
        M = np.array(
            [column(model, data, unit) for unit in np.eye(3)]
        )  # symmetric: rows are columns
        f = data.qfrc_actuator + data.qfrc_passive + data.qfrc_applied
        return np.linalg.solve(J.T @ M @ J, J.T @ (f - data.qfrc_bias))

    def column(model, data, unit):
        out = np.zeros(3)
        mujoco.mj_mulM(model, data, out, unit)
        return out

    difference = compare(arm, xml, applied=dry_friction, change=physical, solve=solve)
    assert difference < 1e-9


def test_joint_armature_alone_misses_the_coupling():
    """Why the tests above need the tendon: M12 lacks ``-gr Ir`` otherwise."""
    arm = sy.TwoLink(gravity=9.81)

    def xml(p):
        text = mjcf.two_link(p, length1=0.2, gear=6.0, gravity=9.81, rotors="none")
        armature = f' armature="{36.0 * p["Ir"]!r}"'
        return text.replace('name="q2"', 'name="q2"' + armature)

    assert compare(arm, xml, applied=dry_friction, change=physical) > 1e-4


def test_uniform_rods():
    """The paper's arm: two true rods."""
    rods = sy.UniformRodArm(sy.base.parameters_of(sy.UniformRodParams))

    def xml(p):
        values = {
            "m1r1": p["m1"] * p["l1"] / 2,
            "I1": p["m1"] * p["l1"] ** 2 / 3,
            "m2": p["m2"],
            "m2r2": p["m2"] * p["l2"] / 2,
            "I2": p["m2"] * p["l2"] ** 2 / 3,
            "b1": p["b1"],
            "b2": p["b2"],
            "Ir": 0.0,
        }
        return mjcf.two_link(values, length1=p["l1"], gear=1.0, gravity=0.0)

    assert compare(rods, xml) < 1e-9
