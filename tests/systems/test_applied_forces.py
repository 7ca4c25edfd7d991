"""Missing forces on MuJoCo models: `qfrc_applied` of C MuJoCo, of MJX, and of windows.

The oracle is `mj_step` with the forces of the state before each step, in plain NumPy.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2gp.systems import Coulomb, MuJoCo, free_parts
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.effects.forces import MissingForce
from sim2gp.systems.effects.missing import missing_forces
from sim2gp.systems.effects.scales import drives
from sim2gp.systems.host import simulator_of
from sim2gp.systems.machine import Machine
from sim2gp.systems.plants.external import Arguments
from sim2gp.types import in_float64

mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is not installed")

STEP = 0.002
ARM = f"""<mujoco><option timestep="{STEP}" iterations="100" ls_iterations="50"
tolerance="1e-12"/><worldbody><body><joint name="q1" axis="0 1 0" damping=".05"
armature=".01"/><geom type="capsule" fromto="0 0 0 .5 0 0" size=".03" mass="1"
contype="0" conaffinity="0"/><body pos=".5 0 0"><joint name="q2" axis="0 1 0"
damping=".03"/><geom name="rod" type="capsule" fromto="0 0 0 .4 0 0" size=".03"
mass=".6" contype="0" conaffinity="0"/></body></body></worldbody><actuator>
<motor name="u1" joint="q1" ctrlrange="-4 4"/><motor name="u2" joint="q2"
ctrlrange="-2 2"/></actuator></mujoco>"""
CONSTANTS = ["joint/q1/damping", "joint/q2/damping"]
BOX = {"q1": (-1.0, 1.0), "q2": (-1.0, 1.0), "q1.velocity": (-4.0, 4.0)}
BOX |= {"q2.velocity": (-6.0, 6.0), "u1": (-4.0, 4.0), "u2": (-2.0, 2.0)}


def forces(plant: MuJoCo) -> list[MissingForce]:
    """On both joints one of each kind, with weights."""
    rng = np.random.default_rng(0)
    found = missing_forces(plant, BOX, fine=True)
    out = []
    for f in (f for f in found if isinstance(f, MissingForce)):
        w = 0.4 * f.magnitude * rng.normal(size=len(f.basis.sds))
        out.append(dataclasses.replace(f, weights=tuple(w.tolist())))
    return out


def arm(engine: Any = "c") -> MuJoCo:
    return MuJoCo(mujoco.MjModel.from_xml_string(ARM), CONSTANTS, engine=engine)


def start_and_inputs(count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    return np.asarray([0.3, -0.4, 0.5, -1.0]), rng.normal(size=(count, 2))


def force_at(parts: list[MissingForce], s: np.ndarray) -> np.ndarray:
    """One by one, each by its own basis."""
    f = np.zeros(2)
    for part in parts:
        joint = ("q1", "q2").index(part.where)
        z = jnp.asarray(s[joint + 2 * part.of_velocity])
        f[joint] += part.basis.features(z) @ jnp.asarray(part.weights)
    return f


def stepped(parts: list[MissingForce], s: np.ndarray, u: np.ndarray) -> np.ndarray:
    """States after each row of inputs, one step each."""
    model = mujoco.MjModel.from_xml_string(ARM)
    data, out = mujoco.MjData(model), []
    data.qpos[:], data.qvel[:] = np.split(s, 2)
    for row in u:
        now = np.concatenate([data.qpos, data.qvel])
        data.ctrl[:], data.qfrc_applied[:] = row, force_at(parts, now)
        mujoco.mj_step(model, data)
        out.append(np.concatenate([data.qpos, data.qvel]))
    return np.stack(out)


@in_float64
def test_windows_move_as_mujoco_does_under_the_forces() -> None:
    plant = arm()
    parts = forces(plant)
    system, (s, u) = Machine(plant, parts), start_and_inputs(40)
    simulator = simulator_of(system)
    own = {name: w for part in parts for name, w in part.values.items()}
    known = own | dict(zip(CONSTANTS, (0.05, 0.03), strict=True))
    theta = np.asarray([[known[name] for name in simulator.names]])
    span = np.full((1, len(u)), STEP)
    found = simulator.rollout(theta, s[None], u[None], span)[0]
    expected = stepped(parts, s, u)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-10)
    assert np.abs(expected - stepped([], s, u)).max() > 0.1
    # Rows that are longer than a step of MuJoCo: forces follow its steps, not the rows.
    rows = u[::4].repeat(4, axis=0)
    again = simulator.rollout(theta, s[None], u[None, ::4], 4.0 * span[:, ::4])[0]
    np.testing.assert_allclose(again, stepped(parts, s, rows)[3::4], atol=1e-10)


def flow_of(system: AbstractSystem, h: float) -> Any:
    params = system.nominal()
    return lambda s, a: system.flow(params, s, a, h)


@in_float64
def test_a_step_within_jax_is_the_hosts_and_so_are_its_derivatives() -> None:
    """Values and forward and reverse mode, by state, input and all parameters."""
    plant = arm()
    parts = forces(plant)
    system, (s, u) = free_parts(plant, parts), start_and_inputs(1)
    prior = system.parameters.prior()
    tt, (a,) = prior.mean + 0.3 * jnp.diag(prior.scale), jnp.asarray(u)
    x0 = jnp.asarray(s)
    h, n, p = 3.0 * STEP, 4, prior.mean.size

    def f(x: Any) -> Any:
        return system.transition(tt + x[n : n + p], x0 + x[:n], a + x[n + p :], h)

    zero = jnp.zeros(n + p + 2)
    J = np.asarray(jax.jit(jax.jacfwd(f))(zero))
    np.testing.assert_allclose(jax.jit(jax.jacrev(f))(zero), J, atol=1e-12)
    f = jax.jit(f)
    scale = np.concatenate([np.ones(n), np.diag(prior.scale), np.ones(2)])
    for k in range(zero.size):
        step = zero.at[k].set(1e-5 * scale[k])
        slope = (f(step) - f(-step)) / (2e-5 * scale[k])
        size = np.abs(J[:, k]).max()
        np.testing.assert_allclose(J[:, k], slope, atol=1e-6 * size + 1e-9)
    simulator, values = simulator_of(system), system.values(tt)
    theta = np.asarray([[float(values[name]) for name in simulator.names]])
    out = simulator.flow(theta, s[None], u, np.asarray([h]))[0]
    np.testing.assert_allclose(f(zero), out, rtol=0.0, atol=1e-12)


@in_float64
def test_sensitivities_of_windows_are_differences_of_windows() -> None:
    """Weights, states, inputs; with dry friction of a named effect around the steps."""
    plant = arm()
    system = Machine(plant, [Coulomb("q1", 0.5, width=0.5), *forces(plant)])
    simulator, (s, u) = simulator_of(system), start_and_inputs(8)
    values = {name: x for part in system.parts for name, x in part.values.items()}
    given = dict(zip(CONSTANTS, (0.05, 0.03), strict=True)) | values
    theta = np.asarray([given[name] for name in simulator.names])
    x, p = np.concatenate([theta, s]), theta.size
    span = np.full((1, len(u)), 2.0 * STEP)

    def at(x: np.ndarray) -> Arguments:
        return Arguments(x[None, :p], x[None, p:], u[None], span)

    each = np.eye(x.size)
    of_u = np.zeros((1, len(u), 2, x.size))
    along = Arguments(each[None, :p], each[None, p:], of_u, span)
    states, J = simulator.linearised_rollout(at(x), along)
    np.testing.assert_allclose(states, simulator.rolled(at(x)).at_rows, atol=1e-12)
    for k in range(x.size):
        ends = (at(x + step * each[k]) for step in (1e-5, -1e-5))
        up, down = (simulator.rolled(end).at_rows[0] for end in ends)
        expected = (up - down) / 2e-5
        size = np.abs(expected).max()
        np.testing.assert_allclose(J[0, ..., k], expected, atol=2e-6 * size + 1e-9)


@in_float64
@pytest.mark.nightly  # 14 s; by day a step within JAX is the host's
def test_mjx_takes_the_forces_as_c_mujoco_does() -> None:
    pytest.importorskip("mujoco.mjx", reason="MJX is not installed")
    c, mjx = arm(), arm("mjx")
    parts = forces(c)
    s, u = start_and_inputs(1)
    x, a = jnp.asarray(s), jnp.asarray(u[0])
    found = []
    for plant in (c, mjx):
        system = free_parts(plant, parts)
        prior = system.parameters.prior()
        tt, p = prior.mean + 0.3 * jnp.diag(prior.scale), prior.mean.size

        def f(y: Any, system: Any = system, tt: Any = tt, p: int = p) -> Any:
            out = system.transition(tt + y[:p], x + y[p : p + 4], a, 2.0 * STEP)
            return out, out

        found.append(jax.jit(jax.jacfwd(f, has_aux=True))(jnp.zeros(p + 4)))
    (J, state), (J_mjx, state_mjx) = found
    np.testing.assert_allclose(state_mjx, state, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(J_mjx, J, rtol=0.0, atol=1e-6 * np.abs(J).max())


@in_float64
def test_a_force_is_in_newton_metres_of_what_moves_the_joint() -> None:
    """A motor's force at its range, on the joint that it drives alone."""
    text = ARM.replace("<option", '<option gravity="0 0 0"')
    plant = MuJoCo(mujoco.MjModel.from_xml_string(text), CONSTANTS)
    found = drives(plant)
    model = plant.engine.model
    data, M = mujoco.MjData(model), np.zeros((2, 2))
    mujoco.mj_forward(model, data)
    for row, unit in zip(M, np.eye(2), strict=True):
        mujoco.mj_mulM(model, data, row, unit)
    spread = np.linalg.inv(M)
    # The larger of its own motor's and of what the other's motion makes of it.
    one, two = (np.abs(spread[j] * [4.0, 2.0]).max() / spread[j, j] for j in (0, 1))
    assert found["q1"].force == pytest.approx(one, rel=0.03)
    assert found["q2"].force == pytest.approx(two, rel=0.03)
    parts = {f.name: f for f in missing_forces(plant, BOX)}
    assert parts["q1.position_force"].unit(plant) == "N m"
    # Steep, but a step of the largest expected size does not reverse the joint.
    dry = parts["q2.dry_friction"]
    steepest = dry.magnitude * spread[1, 1] * STEP / dry.basis.widths[0]
    assert steepest == pytest.approx(0.5, rel=0.03)
    assert Coulomb("q1", 1.0).unit(plant) == "rad/s^2"
