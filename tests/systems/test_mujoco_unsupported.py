"""What a MuJoCo model may have: it steps as C MuJoCo does, or is refused by name."""

import jax.numpy as jnp
import numpy as np
import pytest

from sim2gp import systems as sy
from sim2gp.types import in_float64

mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is not installed")

Q = '<joint name="q" damping=".1"/><geom size=".1" pos=".3 0 0" mass="1"/>'
P = '<joint name="p" axis="0 1 0" damping=".2"/><geom size=".1" pos=".4 0 0" mass="2"/>'
MODEL = """<mujoco model="pair">{option}
<worldbody>
  <body name="one">{one}<site name="s1" pos=".2 0 0"/></body>
  <body name="two" pos="0 0 .5">{two}<site name="s2" pos=".3 0 0"/></body>{body}
</worldbody>{more}</mujoco>"""


def model(
    one: str = Q, two: str = P, body: str = "", more: str = "", option: str = ""
) -> object:
    """Two pendulums, and what else; skipped where this MuJoCo does not know it."""
    text = MODEL.format(one=one, two=two, body=body, more=more, option=option)
    try:
        return mujoco.MjModel.from_xml_string(text)
    except ValueError as error:
        pytest.skip(f"not in MuJoCo {mujoco.__version__}: {error}")


def actuator(text: str) -> dict[str, str]:
    return {"more": f"<actuator>{text}</actuator>"}


TENDON = (
    '<tendon><spatial name="t"><site site="s1"/><site site="s2"/></spatial></tendon>'
)
SUPPORTED = {
    "motor": actuator('<motor joint="q" gear="3" ctrlrange="-1 1"/>'),
    "position": actuator('<position joint="q" kp="8" kv=".3" forcerange="-1 1"/>'),
    "dampratio": actuator('<position joint="q" kp="8" dampratio=".7"/>'),
    "filtered servo": actuator('<position joint="q" kp="8" timeconst=".05"/>'),
    "velocity": actuator('<velocity joint="q" kv="2" ctrlrange="-2 2"/>'),
    "damper": actuator('<damper joint="q" kv="2" ctrlrange="0 1"/>'),
    "intvelocity": actuator('<intvelocity joint="q" kp="5" actrange="-1 1"/>'),
    "cylinder": actuator(
        '<cylinder joint="q" timeconst=".1" area="2" bias="1 -2 -1"/>'
    ),
    "muscle": actuator('<muscle joint="q" lengthrange="-1 1" force="3"/>'),
    "affine": actuator(
        '<general joint="q" gainprm="3" biastype="affine" biasprm=".2 -2 -.1"/>'
    ),
    "tendon": {
        "more": TENDON + '<actuator><motor tendon="t" gear="2"/></actuator>',
    },
    "mimic joint": {
        "more": '<equality><joint joint1="p" joint2="q" polycoef="0 -2 0 0 0"/>'
        "</equality>"
    },
    "connected": {"more": '<equality><connect site1="s1" site2="s2"/></equality>'},
}


@pytest.mark.parametrize("name", SUPPORTED)
@in_float64
def test_what_is_supported_steps_as_c_mujoco(name: str) -> None:
    """The state, activations with it, after ten steps from anywhere."""
    found = model(**SUPPORTED[name])
    plant = sy.MuJoCo(found)
    rng = np.random.default_rng(3)
    data = mujoco.MjData(found)
    data.qpos[:], data.qvel[:] = rng.normal(size=2), rng.normal(size=2)
    data.act[:], data.ctrl[:] = rng.uniform(size=found.na), rng.uniform(size=found.nu)
    s = np.concatenate([data.qpos, data.qvel, data.act])
    a = data.ctrl.copy()
    assert len(plant.states) == len(s)
    for _ in range(10):
        mujoco.mj_step(found, data)
    nominal = plant.parameters.nominal()
    params = plant.record({k: jnp.asarray(v) for k, v in nominal.items()})
    h = 10 * found.opt.timestep
    out = plant.flow(params, jnp.asarray(s), jnp.asarray(a), h)
    expected = np.concatenate([data.qpos, data.qvel, data.act])
    np.testing.assert_allclose(out, expected, rtol=1e-10, atol=1e-10)
    assert np.abs(expected - s).max() > 1e-3
