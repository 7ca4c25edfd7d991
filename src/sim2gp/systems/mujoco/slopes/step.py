"""The derivative of one step of MuJoCo in constants, state and input, in closed form.

A step of length ``h`` ends at ``v' = v + h a``, ``q' = q + h v'``, where ``a`` solves

    F = ID(q, v, a) - passive - actuators - dry friction = 0

(`rigid_body`, `actuation`), so that ``da = -F_a^-1 (F_q dq + F_v dv + F_u du + F_c dc)``
by the implicit function theorem. Dry friction is a force ``-D (a0 + rate v)`` within
its bounds, of the acceleration ``a0`` that MuJoCo finds before it integrates:
``M a0 = (M + h K) a``, where ``K`` are the velocity slopes taken at the step's end.

Nothing is assumed of the rest of the model: where ``F`` is not zero at the step that
MuJoCo took, something else acts (a contact, a limit, a fluid), and the step's slopes
are not those here.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from sim2gp.systems.mujoco.slopes import actuation, rigid_body
from sim2gp.systems.mujoco.slopes.numbers import Numbers, Tree

Batch = Float[np.ndarray, "... B"]
#: Of the sum of all torques on a joint: what more is left over is no rounding, nor the
#: tolerance of MuJoCo's solver.
LEFT_OVER = 1e-6


class Model(NamedTuple):
    """A compiled model with its numbers, and what each constant changes of them."""

    model: Any
    tree: Tree
    has: Numbers
    by: list[Numbers]


def in_closed_form(model: Any) -> bool:
    """Whether steps of the model can be of the kind that is differentiated here."""
    integrators = actuation.EULER, actuation.IMPLICIT_FAST
    return bool(model.opt.integrator in integrators and model.nv == model.nq)


class Slopes(NamedTuple):
    """``da`` by constants, position, velocity and input; where they hold."""

    by: Float[np.ndarray, "B n k"]
    hold: Bool[np.ndarray, " B"]


def acceleration_slopes(
    of: Model, q: Batch, v: Batch, u: Batch, after: Batch, h: float
) -> Slopes:
    """Slopes of the acceleration of steps that end at velocities ``after``."""
    model, tree, has, by = of
    a = (after - v) / h
    at = rigid_body.motion(tree, has, q, v, a)
    bodies = rigid_body.forces(tree, has.inertia, at)
    links = rigid_body.inverse_dynamics(tree, at, bodies)
    acts, drives = actuation.torques(model, tree, has, q, v, after, u)
    rotor = has.armature[:, None] * a
    size = links.size + acts.size + np.abs(rotor) + has.frictionloss[:, None] + 1e-12
    left = links.tau + rotor - acts.tau
    diagonal = np.arange(len(q))
    mass = links.mass.copy()
    mass[diagonal, diagonal] += has.armature[:, None]
    K = -acts.by_v_after
    F_a = mass.copy()
    F_a[diagonal, diagonal] += h * K
    F_q, F_v = links.by_q, links.by_v
    F_q[diagonal, diagonal] -= acts.by_q
    F_v[diagonal, diagonal] -= acts.by_v + acts.by_v_after
    F_c = np.empty((len(q), len(by), q.shape[1]))
    held = after if damps_late(model) else v
    for i, change in enumerate(by):
        F_c[:, i] = _by_constant(of, change, (q, held, a), at, bodies, drives)
    friction = has.frictionloss > 0.0
    if friction.any():
        args = mass, K, F_a, F_q, F_v, F_c, a, q, v, h
        left -= _dry_friction(of, left, *args)
    rhs = np.concatenate([F_c, F_q, F_v, -acts.by_u], axis=1)
    found = -np.linalg.solve(np.moveaxis(F_a, -1, 0), np.moveaxis(rhs, -1, 0))
    hold = (np.abs(left) <= LEFT_OVER * size).all(0) & np.isfinite(found).all((1, 2))
    return Slopes(found, hold)


def damps_late(model: Any) -> bool:
    """Whether dampers see the velocity at the step's end."""
    late: bool = model.opt.integrator == actuation.IMPLICIT_FAST
    return late or not model.opt.disableflags & actuation.NO_EULER_DAMPING


def _by_constant(
    of: Model,
    by: Numbers,
    point: tuple[Batch, Batch, Batch],
    at: rigid_body.Motion,
    bodies: rigid_body.Forces,
    drives: actuation.Drives,
) -> Batch:
    """``F_c`` along one change of the numbers, but for dry friction."""
    model, tree, has, _ = of
    q, v, a = point
    out = by.armature[:, None] * a
    out -= actuation.by_numbers(model, tree, has, by, q, v, drives)
    for b in np.flatnonzero(by.inertia.any((1, 2))):
        out += rigid_body.by_inertia(tree, at, b, by.inertia[b])
    for b in np.flatnonzero(by.place.any(1)):
        out += rigid_body.by_place(tree, at, bodies, b, by.place[b])
    if by.gravity.any():
        out += rigid_body.by_gravity(tree, at, bodies, by.gravity)
    return out


def _dry_friction(
    of: Model,
    asked: Batch,
    mass: Batch,
    K: Batch,
    F_a: Batch,
    F_q: Batch,
    F_v: Batch,
    F_c: Batch,
    a: Batch,
    q: Batch,
    v: Batch,
    h: float,
) -> Batch:
    """The force of dry friction; its derivatives are added to those of ``F``.

    ``asked`` is the force that balances everything else.
    """
    has, by = of.has, of.by
    most = has.frictionloss[:, None]
    M = np.moveaxis(mass, -1, 0)
    lag = np.linalg.solve(M, np.moveaxis(h * K * a, -1, 0)[..., None])[..., 0].T
    first = a + lag  # the acceleration before the integration
    drag = has.drag[:, None] * (first + has.rate[:, None] * v)
    force = -np.clip(drag, -most, most)
    for i, change in enumerate(by):
        F_c[:, i] += np.where(np.abs(drag) < most, 0.0, np.sign(drag)) * (
            change.frictionloss[:, None]
        )
    stick = (np.abs(drag) < most) & (most > 0.0)
    some = np.flatnonzero(stick.any(0))
    if some.size:
        rows = mass, K, F_a, F_q, F_v, F_c, a, lag, first, q, v, stick
        _sticking(of, tuple(x[..., some] for x in rows), (F_a, F_q, F_v, F_c), some, h)
    return force


def _sticking(
    of: Model,
    rows: tuple[Batch, ...],
    F: tuple[Batch, ...],
    some: np.ndarray,
    h: float,
) -> None:
    """Derivatives where friction sticks: ``D (a0 + rate v)`` moves with ``a0``.

    ``M da0 = (M + h K) da + dM (a - a0) + h dK a``.
    """
    has, by = of.has, of.by
    mass, K, F_a, F_q, F_v, F_c, a, lag, first, q, v, stick = rows
    PD = stick * has.drag[:, None]
    n, B = q.shape
    # dM (a - a0), by position and by constants: torques of no motion but of -lag.
    still = has._replace(gravity=np.zeros(3))
    at = rigid_body.motion(of.tree, still, q, np.zeros_like(v), -lag)
    bodies = rigid_body.forces(of.tree, has.inertia, at)
    by_q = rigid_body.inverse_dynamics(of.tree, at, bodies).by_q
    by_c = np.zeros_like(F_c)
    for i, change in enumerate(by):
        by_c[:, i] = -change.armature[:, None] * lag + h * change.damping[:, None] * a
        for b in np.flatnonzero(change.inertia.any((1, 2))):
            by_c[:, i] += rigid_body.by_inertia(of.tree, at, b, change.inertia[b])
        for b in np.flatnonzero(change.place.any(1)):
            by_c[:, i] += rigid_body.by_place(of.tree, at, bodies, b, change.place[b])
    diagonal = np.arange(n)
    late = np.zeros((n, n, B))
    late[diagonal, diagonal] = h * K
    moved = np.concatenate([late, by_q, by_c], axis=1)
    moved = np.linalg.solve(np.moveaxis(mass, -1, 0), np.moveaxis(moved, -1, 0))
    moved = np.moveaxis(moved, 0, -1) * PD[:, None]
    add_a, add_q, add_c = np.split(moved, [n, 2 * n], axis=1)
    add_a[diagonal, diagonal] += PD
    add_v = np.zeros((n, n, B))
    add_v[diagonal, diagonal] = PD * has.rate[:, None]
    slip = first + has.rate[:, None] * v
    for i, change in enumerate(by):
        add_c[:, i] += stick * change.drag[:, None] * slip
    for whole, add in zip(F, (add_a, add_q, add_v, add_c), strict=True):
        whole[..., some] += add
