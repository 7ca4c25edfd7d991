"""The numbers of a compiled model that its equation of motion is made of.

Each parameter changes some of them. Differences of the compiled model say how, without
a simulation.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

Table = Float[np.ndarray, "..."]
NO_GRAVITY = 1 << 7


class Numbers(NamedTuple):
    """Numbers of bodies, joints (one degree of freedom each) and actuators.

    ``inertia``: of each body about its frame's origin, rotation before translation,
    kg m^2, kg m, kg. ``place``: of its frame in its parent's, m. ``drag`` and ``rate``
    are those of MuJoCo's model of dry friction: the force is
    ``-drag (acceleration + rate velocity)`` within ``+- frictionloss``. ``gain`` and
    ``bias`` are the coefficients of 1, length and velocity.
    """

    inertia: Float[np.ndarray, "b 6 6"]
    place: Float[np.ndarray, "b 3"]
    gravity: Float[np.ndarray, " 3"]
    armature: Float[np.ndarray, " n"]
    damping: Float[np.ndarray, " n"]
    stiffness: Float[np.ndarray, " n"]
    frictionloss: Float[np.ndarray, " n"]
    drag: Float[np.ndarray, " n"]
    rate: Float[np.ndarray, " n"]
    gear: Float[np.ndarray, " m"]
    gain: Float[np.ndarray, "m 3"]
    bias: Float[np.ndarray, "m 3"]


class Tree(NamedTuple):
    """What no parameter changes: who carries whom, which joint each actuator drives.

    ``above[i, j]``: whether joint ``i`` moves joint ``j`` (not itself).
    """

    parent: tuple[int, ...]  # of each body
    turn: Float[np.ndarray, "b 3 3"]  # of each body's frame in its parent's
    joints: tuple[tuple[int, ...], ...]  # of each body, in order
    body: tuple[int, ...]  # of each joint
    hinge: np.ndarray
    axis: Float[np.ndarray, "n 3"]
    anchor: Float[np.ndarray, "n 3"]
    zero: Float[np.ndarray, " n"]  # position of the joint in the model's reference
    spring: Float[np.ndarray, " n"]
    above: np.ndarray
    driven: tuple[int, ...]


def tree_of(model: Any) -> Tree | None:
    """The tree of a model of hinges and slides whose actuators act on joints.

    None where an actuator acts on something else, or has a state.
    """
    stateful = model.na or np.any(model.actuator_dyntype)
    if stateful or np.any(model.actuator_trntype > 1):
        return None
    body, n = model.jnt_bodyid.copy(), model.njnt
    parent = model.body_parentid.copy()
    over = np.zeros((model.nbody, model.nbody), bool)  # proper ancestors of bodies
    for b in range(1, model.nbody):
        over[:, b] = over[:, parent[b]]
        over[parent[b], b] = True
    above = over[body][:, body]
    same = body[:, None] == body[None]
    above |= same & (np.arange(n)[:, None] < np.arange(n)[None])
    return Tree(
        tuple(parent.tolist()),
        _rotation(model.body_quat),
        tuple(tuple(np.flatnonzero(body == b).tolist()) for b in range(model.nbody)),
        tuple(body.tolist()),
        model.jnt_type == 3,
        model.jnt_axis.copy(),
        model.jnt_pos.copy(),
        model.qpos0.copy(),
        model.qpos_spring.copy(),
        above,
        tuple(model.actuator_trnid[:, 0].tolist()),
    )


def numbers_of(model: Any) -> Numbers:
    """The numbers of a model whose derived numbers are up to date."""
    drag, rate = _dry_friction(model)
    weightless = model.opt.disableflags & NO_GRAVITY
    affine = np.asarray([[1.0, 0.0, 0.0], [1.0, 1.0, 1.0]])  # gains: fixed, affine
    return Numbers(
        _inertia(
            model.body_mass, model.body_ipos, model.body_iquat, model.body_inertia
        ),
        model.body_pos.copy(),
        np.zeros(3) if weightless else model.opt.gravity.copy(),
        model.dof_armature.copy(),
        model.dof_damping.reshape(model.nv, -1)[:, 0].copy(),
        model.jnt_stiffness.reshape(model.njnt, -1)[:, 0].copy(),
        model.dof_frictionloss.copy(),
        drag,
        rate,
        model.actuator_gear[:, 0].copy(),
        model.actuator_gainprm[:, :3] * affine[model.actuator_gaintype.clip(0, 1)],
        model.actuator_biasprm[:, :3] * (model.actuator_biastype == 1)[:, None],
    )


def moved_by(
    at: Callable[[Float[np.ndarray, " p"]], Any],
    theta: Float[np.ndarray, " p"],
    step: Float[np.ndarray, " p"],
    low: Float[np.ndarray, " p"],
    high: Float[np.ndarray, " p"],
) -> list[Numbers]:
    """Derivatives of the numbers in each parameter; ``at`` is the model of values."""
    found = []
    for i in range(theta.size):
        up, down = theta.copy(), theta.copy()
        up[i] = min(theta[i] + step[i], max(high[i], theta[i]))
        down[i] = max(theta[i] - step[i], min(low[i], theta[i]))
        ends = numbers_of(at(up)), numbers_of(at(down))
        apart = up[i] - down[i]
        found.append(Numbers(*((a - b) / apart for a, b in zip(*ends, strict=True))))
    return found


def _dry_friction(model: Any) -> tuple[Table, Table]:
    """MuJoCo's regularised dry friction (its documentation, "Constraint model")."""
    least, most = model.dof_solimp[:, 0], model.dof_solimp[:, 1]
    impedance = np.clip(least, 1e-4, 0.9999)
    most = np.clip(most, 1e-4, 0.9999)
    softness = (1.0 - impedance) / impedance * model.dof_invweight0
    time, ratio = model.dof_solref.T
    time = np.maximum(time, 2.0 * model.opt.timestep)
    direct = model.dof_solref[:, 0] <= 0.0  # its negative numbers are the rates
    rate = np.where(direct, -ratio / most, 2.0 / (most * time))
    return 1.0 / np.maximum(softness, 1e-15), rate


def _inertia(mass: Table, centre: Table, quat: Table, diagonal: Table) -> Table:
    """Of each body, about its frame's origin."""
    R, h = _rotation(quat), skew(mass[:, None] * centre)
    out = np.zeros((len(mass), 6, 6))
    about = (R * diagonal[:, None]) @ R.swapaxes(-1, -2) - h @ skew(centre)
    out[:, :3, :3], out[:, :3, 3:], out[:, 3:, :3] = about, h, h.swapaxes(-1, -2)
    out[:, 3:, 3:] = mass[:, None, None] * np.eye(3)
    return out


def skew(x: Table) -> Table:
    """The matrices of a cross product, ``skew(x) y = x cross y``."""
    K = np.zeros((*x.shape, 3))
    K[..., 0, 1], K[..., 0, 2], K[..., 1, 2] = -x[..., 2], x[..., 1], -x[..., 0]
    K[..., 1, 0], K[..., 2, 0], K[..., 2, 1] = x[..., 2], -x[..., 1], x[..., 0]
    return K


def _rotation(quat: Table) -> Table:
    """The matrices of quaternions of any length."""
    K = skew(quat[..., 1:])
    bend = quat[..., :1, None] * K + K @ K
    return np.eye(3) + 2.0 * bend / np.sum(quat**2, axis=-1)[..., None, None]
