"""Forces of actuators, springs and dampers on the joints, and their derivatives.

    force = gain . (1, l, l') u + bias . (1, l, l')
    l = gear q,        torque = gear force

A force at its limit stays there, and so does a joint's torque. `implicitfast` takes
the velocities of dampers and actuators at the end of the step, `Euler` those of the
dampers: MuJoCo's documentation, "Numerical integration".
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from sim2gp.systems.mujoco.slopes.numbers import Numbers, Tree

Batch = Float[np.ndarray, "... B"]
EULER, IMPLICIT_FAST = 0, 3
NO_EULER_DAMPING = 1 << 16


class Torques(NamedTuple):
    """Torques on the joints; derivatives by position, velocities before and after the
    step, inputs and, in `by_numbers`, the model's numbers. All act on their own joint.
    """

    tau: Float[np.ndarray, "n B"]
    size: Float[np.ndarray, "n B"]
    by_q: Float[np.ndarray, "n B"]
    by_v: Float[np.ndarray, "n B"]
    by_v_after: Float[np.ndarray, "n B"]
    by_u: Float[np.ndarray, "n m B"]


class Drives(NamedTuple):
    """What of the actuators `by_numbers` asks for."""

    free: Float[np.ndarray, "m B"]  # 1 where neither force nor torque is at a limit
    u: Float[np.ndarray, "m B"]
    length: Float[np.ndarray, "m B"]
    rate: Float[np.ndarray, "m B"]
    force: Float[np.ndarray, "m B"]
    slope: Float[np.ndarray, "m B"]  # of the force in length
    damping: Float[np.ndarray, "m B"]  # of the force in velocity


def damps_late(model: Any) -> bool:
    """Whether dampers see the velocity at the step's end."""
    late: bool = model.opt.integrator == IMPLICIT_FAST
    return late or not model.opt.disableflags & NO_EULER_DAMPING


def torques(
    model: Any, tree: Tree, has: Numbers, q: Batch, v: Batch, after: Batch, u: Batch
) -> tuple[Torques, Drives]:
    """All of them at positions and velocities, under inputs."""
    implicit, damped = model.opt.integrator == IMPLICIT_FAST, damps_late(model)
    away = q - tree.spring[:, None]
    drag = -has.damping[:, None] * (after if damped else v)
    tau = drag - has.stiffness[:, None] * away
    size = np.abs(drag) + np.abs(has.stiffness[:, None] * away)
    by_q = np.repeat(-has.stiffness[:, None], q.shape[1], 1)
    by_v, by_after = np.zeros_like(q), np.zeros_like(q)
    (by_after if damped else by_v)[:] -= has.damping[:, None]
    drives, pull = _drives(model, tree, has, q, v, after if implicit else v, u)
    by_u = np.zeros((len(q), *u.shape))
    gear = has.gear[:, None]
    for i, j in enumerate(tree.driven):
        tau[j] += pull[i]
        size[j] += np.abs(pull[i])
        by_q[j] += gear[i] ** 2 * drives.free[i] * drives.slope[i]
        speed = gear[i] ** 2 * drives.free[i] * drives.damping[i]
        (by_after if implicit else by_v)[j] += speed
        gain = has.gain[i, 0] + has.gain[i, 1] * drives.length[i]
        gain = gain + has.gain[i, 2] * drives.rate[i]
        moves = gear[i] * drives.free[i] * gain
        if model.actuator_ctrllimited[i]:
            moves = moves * _inside(u[i], model.actuator_ctrlrange[i])
        by_u[j, i] += moves
    return Torques(tau, size, by_q, by_v, by_after, by_u), drives


def by_numbers(
    model: Any, tree: Tree, has: Numbers, by: Numbers, q: Batch, v: Batch, at: Drives
) -> Batch:
    """Derivative of the torques along a change of the numbers; ``v`` of the dampers."""
    out = -by.damping[:, None] * v
    out -= by.stiffness[:, None] * (q - tree.spring[:, None])
    moved = np.any(by.gain) or np.any(by.bias) or np.any(by.gear)
    for i, j in enumerate(tree.driven if moved else ()):
        basis = np.stack([np.ones_like(at.length[i]), at.length[i], at.rate[i]])
        force = by.gain[i] @ basis * at.u[i] + by.bias[i] @ basis
        lever = at.force[i] + at.slope[i] * at.length[i] + at.damping[i] * at.rate[i]
        out[j] += at.free[i] * (has.gear[i] * force + by.gear[i] * lever)
        # A force at its limit still goes through the gear.
        held = (at.free[i] == 0.0) & _inside(at.force[i], _range(model, i))
        out[j] += held * by.gear[i] * at.force[i]
    return out


def late_by_numbers(
    model: Any, tree: Tree, has: Numbers, by: Numbers, at: Drives
) -> Batch:
    """Change of minus the torques' slope in the velocity after the step."""
    out = np.zeros((len(by.damping), at.u.shape[1]))
    if damps_late(model):
        out += by.damping[:, None]
    if model.opt.integrator == IMPLICIT_FAST:
        for i, j in enumerate(tree.driven):
            change = by.gain[i, 2] * at.u[i] + by.bias[i, 2]
            twice = 2.0 * has.gear[i] * by.gear[i] * at.damping[i]
            out[j] -= at.free[i] * (has.gear[i] ** 2 * change + twice)
    return out


def _drives(
    model: Any, tree: Tree, has: Numbers, q: Batch, v: Batch, at: Batch, u: Batch
) -> tuple[Drives, Batch]:
    """Forces of the actuators at the velocities ``at``, and their torques.

    Whether a limit holds is decided at the velocity ``v`` before the step.
    """
    low, high = model.actuator_ctrlrange.T[:, :, None]
    limited = model.actuator_ctrllimited.astype(bool)[:, None]
    u = np.where(limited, np.clip(u, low, high), u)
    gear = has.gear[:, None]
    driven = list(tree.driven)
    length = gear * q[driven]
    free, value = np.ones_like(u), np.zeros_like(u)
    slope = has.gain[:, 1, None] * u + has.bias[:, 1, None]
    damping = has.gain[:, 2, None] * u + has.bias[:, 2, None]
    rest = has.gain[:, 0, None] * u + has.bias[:, 0, None] + slope * length
    before = rest + damping * gear * v[driven]
    rate = gear * at[driven]
    value = rest + damping * rate
    for i in np.flatnonzero(model.actuator_forcelimited):
        held = ~_inside(before[i], model.actuator_forcerange[i])
        free[i, held] = 0.0
        value[i] = np.where(
            held, np.clip(before[i], *model.actuator_forcerange[i]), value[i]
        )
    pull = gear * value
    for j in np.flatnonzero(model.jnt_actfrclimited):
        mine = np.flatnonzero(np.equal(driven, j))
        total = np.sum(gear[mine] * before[mine], axis=0)
        held = ~_inside(total, model.jnt_actfrcrange[j])
        if mine.size and held.any():
            free[np.ix_(mine, held)] = 0.0
            pull[np.ix_(mine, held)] = 0.0
            pull[mine[0], held] = np.clip(total[held], *model.jnt_actfrcrange[j])
    return Drives(free, u, length, rate, value, slope, damping), pull


def _inside(x: Batch, limits: Float[np.ndarray, " 2"]) -> Bool[np.ndarray, "... B"]:
    return (x > limits[0]) & (x < limits[1])


def _range(model: Any, i: int) -> Float[np.ndarray, " 2"]:
    """Of a force: its own limits, closed, or none."""
    if not model.actuator_forcelimited[i]:
        return np.asarray([-np.inf, np.inf])
    low, high = model.actuator_forcerange[i]
    return np.asarray([np.nextafter(low, -np.inf), np.nextafter(high, np.inf)])
