"""A MuJoCo model as a stick figure: bones between its joints, posed by MuJoCo.

A body's point is the anchor of its last hinge, else its frame's origin. A bone joins it
to its parent's, and a body without children has one more to the end of its geometry. Of
the bodies that never move, those that carry others are drawn, and the rail of a slide.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

_LONG = 1.5  # a geometry this much longer than it is thick has an end
_REACH = 2.0  # a rail is drawn no longer than so many spans of what moves on it
_SLIDE, _HINGE = 2, 3


@dataclass(frozen=True)
class Figure:
    """Bones and joints over points, the fixed ones counted first; lengths in m.

    ``rods`` are (point, point, part) and ``balls`` (point, part), a part one of "base",
    "rail", "link" and "tip".
    """

    fixed: Float[np.ndarray, "f 3"]
    moving: Float[np.ndarray, "T j 3"]
    rods: tuple[tuple[int, int, str], ...]
    balls: tuple[tuple[int, str], ...]


def figure_of(model: Any, qpos: Float[np.ndarray, "T nq"]) -> Figure:
    """The stick figure of a model at a sequence of joint positions."""
    import mujoco

    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    moves = [b for b in range(1, model.nbody) if model.body_weldid[b] != 0]
    bases = sorted({a for b in moves for a in _carriers(model, b)})
    ends = {b: _far_end(model, data, b) for b in moves if not _children(model, b)}
    tips = {b: end for b, end in ends.items() if end is not None}
    place = {b: k for k, b in enumerate(bases)}
    fixed = [data.xpos[b].copy() for b in bases]
    rods, balls = [], [(k, "base") for k in place.values()]
    for b in bases:
        if int(model.body_parentid[b]) in place:
            rods.append((place[int(model.body_parentid[b])], place[b], "base"))
    moving = np.empty((len(qpos), len(moves) + len(tips), 3))
    for row, q in enumerate(qpos):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        far = [_fixed_to(data, b, end) for b, end in tips.items()]
        moving[row] = [*(_joint_point(model, data, b) for b in moves), *far]
    for k, b in enumerate(moves):
        parent = int(model.body_parentid[b])
        if model.body_weldid[parent] == 0:
            rail = _rail(model, b, moving[:, k], qpos)
            rods += [(len(fixed), len(fixed) + 1, "rail")] if len(rail) else []
            fixed += rail or [moving[0, k]]
            balls += [] if rail else [(len(fixed) - 1, "base")]
    count = len(fixed)
    place |= {b: count + k for k, b in enumerate(moves)}
    for b in moves:
        if int(model.body_parentid[b]) in place:
            part = "tip" if not _children(model, b) and b not in tips else "link"
            rods.append((place[int(model.body_parentid[b])], place[b], part))
        balls.append((place[b], "link"))
    for k, b in enumerate(tips):
        rods.append((place[b], count + len(moves) + k, "tip"))
        balls.append((count + len(moves) + k, "tip"))
    return Figure(np.reshape(fixed, (-1, 3)), moving, tuple(rods), tuple(balls))


def _children(model: Any, b: int) -> list[int]:
    return [c for c in range(1, model.nbody) if model.body_parentid[c] == b]


def _carriers(model: Any, b: int) -> list[int]:
    """The bodies at rest between the world and a body that moves."""
    found, a = [], int(model.body_parentid[b])
    while a:
        if model.body_weldid[a] == 0:
            found.append(a)
        a = int(model.body_parentid[a])
    return found


def _joints_of_body(model: Any, b: int) -> range:
    first = int(model.body_jntadr[b])
    return range(first, first + int(model.body_jntnum[b])) if first >= 0 else range(0)


def _joint_point(model: Any, data: Any, b: int) -> Float[np.ndarray, "3"]:
    hinges = [j for j in _joints_of_body(model, b) if model.jnt_type[j] == _HINGE]
    return np.array(data.xanchor[hinges[-1]] if hinges else data.xpos[b])


def _fixed_to(data: Any, b: int, local: np.ndarray) -> Float[np.ndarray, "3"]:
    return np.asarray(data.xpos[b] + data.xmat[b].reshape(3, 3) @ local)


def _far_end(model: Any, data: Any, b: int) -> Float[np.ndarray, "3"] | None:
    """The far end of a body's geometry, in its own frame; None where there is none."""
    point, ends = _joint_point(model, data, b), [data.xipos[b]]
    for g in range(model.ngeom):
        if model.geom_bodyid[g] != b:
            continue
        half = model.geom_aabb[g, 3:]
        turn = data.geom_xmat[g].reshape(3, 3)
        centre = data.geom_xpos[g] + turn @ model.geom_aabb[g, :3]
        k = int(np.argmax(half))
        long = half[k] > _LONG * np.sort(half)[1]
        ends += [centre + s * half[k] * turn[:, k] for s in (-1, 1)] if long else []
        ends.append(centre)
    away = [float(np.linalg.norm(end - point)) for end in ends]
    if max(away) < 1e-6:
        return None
    turn = data.xmat[b].reshape(3, 3)
    return np.asarray(turn.T @ (ends[int(np.argmax(away))] - data.xpos[b]))


def _rail(
    model: Any, b: int, points: np.ndarray, qpos: np.ndarray
) -> list[Float[np.ndarray, "3"]]:
    """Both ends of the line that a body on a slide moves on; empty without a slide."""
    joints = _joints_of_body(model, b)
    if not len(joints) or model.jnt_type[joints[0]] != _SLIDE:
        return []
    import mujoco

    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    j = joints[0]
    q = qpos[:, model.jnt_qposadr[j]]
    low, high = float(q.min()), float(q.max())
    span = max(high - low, 1e-3)
    ends = low - 0.1 * span, high + 0.1 * span
    if model.jnt_limited[j]:
        a, z = model.jnt_range[j]
        ends = max(a, low - _REACH * span), min(z, high + _REACH * span)
    return [points[0] + data.xaxis[j] * (end - q[0]) for end in ends]
