"""Recordings of hidden arms for `intervals.py`: plain numpy, all sets at once.

The horizontal two-link arm of `sim2gp.systems.UniformRodArm` under multisine torques,
both encoders at 100 Hz for ten seconds. Written without the library's simulator, which
is what fits them.
"""

from typing import NamedTuple

import numpy as np

from interval_mujoco import knowing_arm, moved, mujoco_arm
from planted_effects import Cogging
from sim2gp.data.logs import Log
from sim2gp.systems import (
    AbstractEffect,
    AbstractSystem,
    Coulomb,
    UniformRodArm,
    free_parts,
)

PERIOD, SECONDS = 0.01, 10.0
SUBSTEPS = 10  # of RK4 in a period: dry friction is stiff
NOISE = 2e-3  # rad, of both encoders, whatever its colour
TORQUE = np.array([0.25, 0.10])  # N m, root mean square
FREQUENCIES = np.arange(0.2, 2.2, 0.2)  # Hz
LENGTHS, WIDTH = (0.5, 0.4), 0.05
TURNS = 6.0  # of cogging, in one of the joint
NAMES = ("m1", "b1", "m2", "b2")


class Condition(NamedTuple):
    """What is wrong with the assumption of white noise on a right model."""

    title: str
    rho: float = 0.0  # of first-order autoregressive noise, from sample to sample
    friction: float = 0.0  # N m of dry friction in both joints
    width: float = WIDTH  # rad/s, of its tanh; the library's effect has that of WIDTH
    cogging: float = 0.0  # N m in both joints: no library has it
    noise: float = NOISE  # rad
    mujoco: bool = False  # whether the arm is a MuJoCo model (`interval_mujoco.py`)

    def system(self) -> AbstractSystem:
        """The simulator that is fitted."""
        return mujoco_arm() if self.mujoco else UniformRodArm()


CONDITIONS = {
    "white": Condition("white noise"),
    "noisy": Condition("white noise of 20 mrad", noise=0.02),
    "ar80": Condition("AR(1) noise, .8", rho=0.8),
    "ar95": Condition("AR(1) noise, .95", rho=0.95),
    "friction1": Condition("dry friction, 1 mN m", friction=0.001),
    "friction5": Condition("dry friction, 5 mN m", friction=0.005),
    "friction20": Condition("dry friction, 20 mN m", friction=0.02),
    "sharp20": Condition(
        "dry friction, 20 mN m, five times as sharp", friction=0.02, width=WIDTH / 5.0
    ),
    "cogging10": Condition("cogging, 10 mN m", cogging=0.01),
    "mujoco": Condition("a MuJoCo arm, white noise", mujoco=True),
    "mujoco_friction20": Condition(
        "a MuJoCo arm, dry friction, 20 mN m", friction=0.02, mujoco=True
    ),
    "mujoco_cogging10": Condition(
        "a MuJoCo arm, cogging, 10 mN m", cogging=0.01, mujoco=True
    ),
}


class Recordings(NamedTuple):
    """True virtual constants (S, 4), torques and measurements (T, S, 2)."""

    truth: np.ndarray
    torque: np.ndarray
    measured: np.ndarray

    def log(self, s: int) -> Log:
        """Set ``s`` as the library reads it."""
        count = len(self.torque)
        joints, inputs = ("q1", "q2"), ("torque1", "torque2")
        return Log(
            name=f"set{s}",
            source=f"set{s}.csv",
            time=PERIOD * np.arange(count),
            channels={n: self.measured[:, s, i] for i, n in enumerate(joints)},
            inputs={n: self.torque[:, s, i] for i, n in enumerate(inputs)},
            mask={n: np.ones(count, bool) for n in joints},
        )


def recordings(condition: Condition, sets: int, chunk: int) -> Recordings:
    """``sets`` hidden arms, each with its own torques and noise.

    Truths are drawn from N(0, 1) in virtual units, where the prior's sd is 1.5. All
    conditions share truths, torques and the noise's innovations.
    """
    rng = np.random.default_rng([20, chunk])
    truth = rng.standard_normal((sets, 4))
    values, torque = physical(truth), multisine(rng, SECONDS, sets)
    if condition.mujoco:
        states = moved(values, torque, condition, PERIOD)
    else:
        states = motion_of(values, torque, condition)
    white = rng.standard_normal((len(torque), sets, 2))
    noise = coloured(white, condition.rho)
    return Recordings(truth, torque, states[..., :2] + condition.noise * noise)


def physical(truth: np.ndarray) -> np.ndarray:
    """Masses and dampings (S, 4) of virtual values."""
    table = UniformRodArm().parameters
    low = np.array([table[name].low for name in NAMES])
    high = np.array([table[name].high for name in NAMES])
    return low + (high - low) / (1.0 + np.exp(-truth))


def multisine(rng: np.random.Generator, seconds: float, *sets: int) -> np.ndarray:
    """Torques (T, ..., 2) of `FREQUENCIES` with random phases, of rms `TORQUE`."""
    time = PERIOD * np.arange(round(seconds / PERIOD))
    phase = rng.uniform(0.0, 2.0 * np.pi, (len(FREQUENCIES), *sets, 2))
    turns = 2.0 * np.pi * np.multiply.outer(FREQUENCIES, time)
    turns = turns.reshape(*turns.shape, *(1 for _ in sets), 1)
    torque = np.sin(turns + phase[:, None]).sum(axis=0)
    return torque * (TORQUE / np.sqrt(np.mean(torque**2, axis=0)))


def coloured(white: np.ndarray, rho: float) -> np.ndarray:
    """Stationary AR(1) noise of variance 1 from its innovations (T first)."""
    out = white.copy()
    for k in range(1, len(white)):
        out[k] = rho * out[k - 1] + np.sqrt(1.0 - rho**2) * white[k]
    return out


def motion_of(
    values: np.ndarray, torque: np.ndarray, condition: Condition
) -> np.ndarray:
    """States (T, S, 4) from rest under held torques, by RK4."""
    x, h, out = np.zeros((len(values), 4)), PERIOD / SUBSTEPS, []
    for u in torque:
        out.append(x)
        for _ in range(SUBSTEPS):
            k1 = _rate(values, condition, x, u)
            k2 = _rate(values, condition, x + 0.5 * h * k1, u)
            k3 = _rate(values, condition, x + 0.5 * h * k2, u)
            k4 = _rate(values, condition, x + h * k3, u)
            x = x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return np.stack(out)


def _rate(
    values: np.ndarray, condition: Condition, x: np.ndarray, u: np.ndarray
) -> np.ndarray:
    (m1, b1, m2, b2), (l1, l2) = values.T, LENGTHS
    q1, q2, v1, v2 = x.T
    c, s = 0.5 * m2 * l1 * l2 * np.cos(q2), 0.5 * m2 * l1 * l2 * np.sin(q2)
    M22 = m2 * l2**2 / 3.0
    M12 = M22 + c
    M11 = m1 * l1**2 / 3.0 + m2 * l1**2 + M22 + 2.0 * c
    f1 = u[:, 0] - b1 * v1 + s * (2.0 * v1 * v2 + v2**2)
    f2 = u[:, 1] - b2 * v2 - s * v1**2
    f1 = f1 - condition.friction * np.tanh(v1 / condition.width)
    f2 = f2 - condition.friction * np.tanh(v2 / condition.width)
    f1 = f1 - condition.cogging * np.sin(TURNS * q1)
    f2 = f2 - condition.cogging * np.sin(TURNS * q2)
    det = M11 * M22 - M12**2
    return np.stack(
        [v1, v2, (M22 * f1 - M12 * f2) / det, (M11 * f2 - M12 * f1) / det]
    ).T


def with_what_is_missing(condition: Condition) -> AbstractSystem:
    """The simulator of an oracle who knows what is missing, not how much of it."""
    if condition.mujoco:
        return knowing_arm(condition)
    joints = "q1", "q2"
    effects: list[AbstractEffect] = [
        Cogging(q, 0.05, TURNS)
        if condition.cogging
        else Coulomb(q, 0.05, condition.width)
        for q in joints
    ]
    return free_parts(UniformRodArm(), effects)
