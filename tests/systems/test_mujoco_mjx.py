"""MJX as the engine: values and Jacobians of C MuJoCo, in both modes; refusals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2gp import systems as sy
from sim2gp.inference.parameters import Parameter
from sim2gp.types import in_float64

mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is not installed")
pytest.importorskip("mujoco.mjx", reason="the extra `mujoco` is not installed")

#: A cart with dry friction, a pole, and a puck that slides on the floor.
MODEL = """
<mujoco>
  <option timestep="0.005" iterations="100" ls_iterations="50" tolerance="1e-12"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1" friction=".4"/>
    <body name="cart" pos="0 0 .5" simple="false">
      <joint name="x" type="slide" axis="1 0 0" damping="1" armature=".1"
             frictionloss=".05"/>
      <geom type="box" size=".1 .1 .02" mass=".5" contype="0" conaffinity="0"/>
      <body name="pole" pos="0 .03 .02">
        <joint name="q" axis="0 1 0" damping=".02"/>
        <geom type="capsule" fromto="0 0 0 0 0 .3" size=".02" mass=".1" contype="0"
              conaffinity="0"/>
        <body name="tip" pos=".1 0 .3"><geom size=".03" mass=".1" contype="0"
          conaffinity="0"/></body>
      </body>
    </body>
    <body name="puck" pos="1 0 .05">
      <joint name="px" type="slide" axis="1 0 0"/>
      <joint name="pz" type="slide" axis="0 0 1"/>
      <geom name="puck" type="sphere" size=".05" mass=".3" friction=".4"/>
    </body>
  </worldbody>
  <actuator><general name="u" joint="x" gear="2" gainprm="1.5"/></actuator>
</mujoco>
"""
FRICTION = ["geom/puck/friction", "geom/floor/friction"]  # the larger one counts
CONSTANTS = [
    *("joint/x/damping", "joint/x/armature", "joint/x/frictionloss"),
    *("body/cart/mass", "body/pole/mass", "body/tip/length", "body/pole/com_z"),
    *("actuator/u/gain", "actuator/u/gear", FRICTION, "option/gravity"),
]
PLACE = {"body/pole/com_z": Parameter("", "m", "place", "identity", mean=0.15, sd=0.05)}
STATE = np.array([0.0, 0.3, 0.0, 0.0, 0.4, -1.0, 0.8, 0.0])
ACTION, STEPS, DT = np.array([0.5]), 25, 0.005


#: The cart alone: it compiles in a few seconds.
CART = """<mujoco>{option}<worldbody><body name="c">
  <joint name="x" type="slide" axis="1 0 0" damping="1" frictionloss=".1"/>{joint}
  <geom name="g" size=".1" mass="1"/></body></worldbody>{more}
  <actuator><motor name="u" joint="x" gear="2"/></actuator></mujoco>"""
EMPTY = {"option": "", "joint": "", "more": ""}
OF_CART = ["joint/x/damping", "joint/x/frictionloss", "body/c/mass", "actuator/u/gear"]


def systems(text: str, constants: list) -> list[sy.MuJoCo]:
    """The same model in C and in MJX."""
    priors = {k: v for k, v in PLACE.items() if k in constants}
    model = mujoco.MjModel.from_xml_string(text)
    return [sy.MuJoCo(model, constants, priors, engine=e) for e in ("c", "mjx")]


def rollout(c: sy.MuJoCo, theta: np.ndarray, start: np.ndarray) -> np.ndarray:
    """States of C MuJoCo, one call for each step as MJX has it."""
    s = start[None]
    for _ in range(STEPS):
        s = c.engine.flow(theta[None], s, ACTION[None], np.array([DT]))
    return s[0]


def differences(c: sy.MuJoCo, theta: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Central differences of rollouts in every constant."""
    columns = []
    for k in range(len(theta)):
        step = np.zeros_like(theta)
        step[k] = 1e-6 * theta[k]
        up, down = (rollout(c, theta + x * step, start) for x in (1.0, -1.0))
        apart = up - down
        columns.append(apart / (2.0 * step[k]))
    return np.stack(columns, axis=1)


@pytest.mark.parametrize(
    ("text", "constants", "start"),
    [
        (CART.format(**EMPTY), OF_CART, np.array([0.0, 0.4])),
        pytest.param(MODEL, CONSTANTS, STATE, marks=pytest.mark.nightly),
    ],
)
@in_float64
@pytest.mark.nightly
def test_rollouts_and_their_jacobians_are_c_mujocos(text, constants, start) -> None:
    """With other values than the file's: what MuJoCo derives of them goes along."""
    c, x = systems(text, constants)
    own = np.array([g[0].get(c.engine.model) for g in c.engine.constants])
    theta = 1.1 * own
    cuts = [len(own), len(own) + len(start)]

    @jax.jit
    def both(z, tangent):
        def f(z):
            theta, s, a = jnp.split(z, cuts)
            return x.step(theta, s, a, DT)

        value, push = jax.linearize(f, z)
        (J,) = jax.vmap(jax.linear_transpose(push, z))(jnp.eye(len(value)))
        return value, J, push(tangent)

    s, J = start, np.zeros((len(start), len(own)))
    tangent = np.random.default_rng(0).standard_normal(len(own))
    along = np.zeros(len(start))
    for _ in range(STEPS):
        z = jnp.concatenate([theta, s, ACTION])
        given = jnp.concatenate([tangent, along, np.zeros(1)])
        s, each, along = (np.asarray(v) for v in both(z, given))
        J = each[:, : cuts[0]] + each[:, cuts[0] : cuts[1]] @ J
    np.testing.assert_allclose(s, rollout(c, theta, start), atol=1e-11)
    expected = differences(c, theta, start)
    for k, name in enumerate(c.names):
        size = np.abs(expected[:, k]).max()
        assert size > 1e-3, name
        assert np.abs(J[:, k] - expected[:, k]).max() < 1e-6 * size, name
    np.testing.assert_allclose(along, J @ tangent, rtol=1e-9, atol=1e-12)


@in_float64
def test_constants_and_what_follows_from_them_are_c_mujocos() -> None:
    """As `mujoco.mj_setConst` derives it, of bodies that turn, slide, or are welded."""
    c, x = systems(MODEL, CONSTANTS)
    theta = np.asarray([g[0].get(c.engine.model) for g in c.engine.constants]) * 1.3
    names = ["dof_M0", "dof_invweight0", "body_invweight0", "dof_damping", "body_mass"]
    names += [
        "dof_frictionloss",
        "dof_armature",
        "body_inertia",
        "body_pos",
        "body_ipos",
    ]
    names += ["actuator_gear", "actuator_gainprm", "geom_friction"]
    expected = c.engine.with_values(theta)

    @jax.jit
    def fields(theta):
        model = x.mjx.with_values(theta)
        return [getattr(model, name) for name in names], model.opt.gravity

    found, gravity = fields(jnp.asarray(theta))
    np.testing.assert_allclose(gravity, expected.opt.gravity, rtol=1e-14)
    for name, value in zip(names, found, strict=True):
        wanted = getattr(expected, name)
        np.testing.assert_allclose(
            np.asarray(value).reshape(wanted.shape), wanted, rtol=1e-9, atol=1e-12
        )


@pytest.mark.nightly
@pytest.mark.parametrize(
    "option",
    ['integrator="implicitfast"', 'integrator="RK4"', 'cone="elliptic"', 'solver="CG"'],
)
@in_float64
def test_every_integrator_and_solver_agrees(option) -> None:
    """In steps of uneven length, and of none."""
    text = MODEL.replace("<option ", f"<option {option} ")
    c, x = systems(text, ["body/cart/mass", FRICTION])
    theta, s, a = (jnp.asarray(v) for v in ([0.6, 0.5], STATE, ACTION))
    step = jax.jit(lambda h: x.flow(theta, s, a, h))
    for h in (0.012, 0.0):
        expected = c.flow(theta, s, a, h)
        np.testing.assert_allclose(step(jnp.asarray(h)), expected, atol=1e-8)
