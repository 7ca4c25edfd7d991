"""The hidden arms of `interval_arms.py` as a MuJoCo model, moved by MuJoCo itself.

The same two uniform rods in the horizontal plane. What is missing in the model acts as
`qfrc_applied`, at each step of MuJoCo.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sim2gp.systems import AbstractSystem, MuJoCo, UniformRodArm
from sim2gp.systems.assemble import with_parts
from sim2gp.systems.effects.bases import Harmonics, Sign
from sim2gp.systems.effects.forces import MissingForce

if TYPE_CHECKING:
    from interval_arms import Condition

STEP = 0.002  # s, of MuJoCo
#: In the order of the constants of `interval_arms.py`.
PATHS = {"m1": "body/rod1/mass", "b1": "joint/q1/damping"}
PATHS |= {"m2": "body/rod2/mass", "b2": "joint/q2/damping"}
LENGTHS = 0.5, 0.4


def _rod(k: int, at: float, inside: str = "") -> str:
    """A rod of 1 kg about a vertical axis."""
    length = LENGTHS[k - 1]
    across = length**2 / 12.0
    return (
        f'<body name="rod{k}" pos="{at} 0 0"><joint name="q{k}" axis="0 0 1" '
        f'damping="0.1"/><inertial pos="{0.5 * length} 0 0" mass="1" '
        f'diaginertia="1e-5 {across} {across}"/>{inside}</body>'
    )


def _model() -> object:
    import mujoco

    motors = "".join(
        f'<motor name="torque{k}" joint="q{k}" ctrlrange="-1 1"/>' for k in (1, 2)
    )
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{STEP}"/><worldbody>'
        f"{_rod(1, 0.0, _rod(2, LENGTHS[0]))}</worldbody>"
        f"<actuator>{motors}</actuator></mujoco>"
    )


def mujoco_arm() -> MuJoCo:
    """The model, with the priors of the bundled arm."""
    table = UniformRodArm().parameters
    priors = {path: replace(table[k], name=path) for k, path in PATHS.items()}
    return MuJoCo(_model(), list(PATHS.values()), priors)


def moved(
    values: np.ndarray, torque: np.ndarray, condition: "Condition", period: float
) -> np.ndarray:
    """States (T, S, 4) from rest under held torques."""
    out = [_one(arm, torque[:, s], condition, period) for s, arm in enumerate(values)]
    return np.stack(out, axis=1)


def _one(
    values: np.ndarray, torque: np.ndarray, condition: "Condition", period: float
) -> np.ndarray:
    import mujoco

    from interval_arms import TURNS

    model, out = mujoco_arm().engine.with_values(values), []
    data, steps = mujoco.MjData(model), round(period / STEP)
    for u in torque:
        out.append(np.concatenate([data.qpos, data.qvel]))
        data.ctrl[:] = u
        for _ in range(steps):
            dry = condition.friction * np.tanh(data.qvel / condition.width)
            data.qfrc_applied[:] = -dry - condition.cogging * np.sin(TURNS * data.qpos)
            mujoco.mj_step(model, data)
    return np.stack(out)


def knowing_arm(condition: "Condition") -> AbstractSystem:
    """The simulator of an oracle who knows what is missing, not how much of it."""
    from interval_arms import TURNS

    forces = [
        MissingForce(q, 0.05, Harmonics((1.0,), frequency=TURNS), what="cogging")
        if condition.cogging
        else MissingForce(
            q, 0.05, Sign((condition.width,)), of_velocity=True, what="dry_friction"
        )
        for q in ("q1", "q2")
    ]
    arm = mujoco_arm()
    # It knows that they are there: no scale of their priors is learned.
    priors = [replace(p, group="") for f in forces for p in f.priors(arm)]
    return with_parts(arm, forces, {p.name: p for p in priors})
