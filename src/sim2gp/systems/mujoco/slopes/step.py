"""The derivative of one step of MuJoCo in parameters, state and input, in closed form.

A step of length ``h`` ends at ``v' = v + h a``, ``q' = q + h v'``, where ``a`` solves

    F = ID(q, v, a) - passive - actuators - dry friction - applied = 0

(`rigid_body`, `actuation`), so that ``F_a da = -(F_q dq + F_v dv + F_u du + F_c dc)``
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
    """A compiled model with its numbers, and what each parameter changes of them."""

    model: Any
    tree: Tree
    has: Numbers
    by: list[Numbers]


def in_closed_form(model: Any) -> bool:
    """Whether steps of the model can be of the kind that is differentiated here."""
    integrators = actuation.EULER, actuation.IMPLICIT_FAST
    return bool(model.opt.integrator in integrators and model.nv == model.nq)


class Slopes(NamedTuple):
    """``da`` by parameters, position, velocity and input; where they hold."""

    by: Float[np.ndarray, "B n k"]
    hold: Bool[np.ndarray, " B"]


class Equation(NamedTuple):
    """``F`` and its derivatives; ``size`` is what its terms sum without their signs.

    ``mass`` is ``M`` with the armatures, ``late`` the diagonal of ``K``.
    """

    F: Float[np.ndarray, "n B"]
    size: Float[np.ndarray, "n B"]
    by_a: Float[np.ndarray, "n n B"]
    by_q: Float[np.ndarray, "n n B"]
    by_v: Float[np.ndarray, "n n B"]
    by_u: Float[np.ndarray, "n m B"]
    by_c: Float[np.ndarray, "n p B"]
    mass: Float[np.ndarray, "n n B"]
    late: Float[np.ndarray, "n B"]
    late_by_c: Float[np.ndarray, "n p B"]


def acceleration_slopes(
    of: Model, q: Batch, v: Batch, u: Batch, after: Batch, h: float
) -> Slopes:
    """Slopes of the acceleration of steps that end at velocities ``after``.

    ``u`` may have applied forces behind the inputs of the actuators.
    """
    a = (after - v) / h
    found = _smooth(of, q, v, u, after, a, h)
    left = found.F
    if (of.has.frictionloss > 0.0).any():
        left = left - _dry_friction(of, found, q, v, a, h)
    rhs = np.concatenate([found.by_c, found.by_q, found.by_v, found.by_u], axis=1)
    by = -_solve(found.by_a, rhs)
    small = (np.abs(left) <= LEFT_OVER * found.size).all(0)
    by = np.moveaxis(by, -1, 0)
    return Slopes(by, small & np.isfinite(by).all((1, 2)))


def _smooth(
    of: Model, q: Batch, v: Batch, u: Batch, after: Batch, a: Batch, h: float
) -> Equation:
    """The equation without dry friction."""
    model, tree, has, by = of
    at = rigid_body.motion(tree, has, q, v, a)
    bodies = rigid_body.forces(tree, has.inertia, at)
    links = rigid_body.inverse_dynamics(tree, at, bodies, a)
    u, applied = u[: model.nu], u[model.nu :]
    acts, drives = actuation.torques(model, tree, has, q, v, after, u)
    rotor = has.armature[:, None] * a
    size = links.size + acts.size + np.abs(rotor) + has.frictionloss[:, None]
    late = -acts.by_v_after
    mass = links.mass + _diagonal(np.broadcast_to(has.armature[:, None], q.shape))
    damped = after if actuation.damps_late(model) else v
    by_c, late_by_c = np.empty((2, len(q), len(by), q.shape[1]))
    for i, change in enumerate(by):
        about = model, tree, has, change
        late_by_c[:, i] = actuation.late_by_numbers(*about, drives)
        by_c[:, i] = change.armature[:, None] * a
        by_c[:, i] -= actuation.by_numbers(*about, q, damped, drives)
        by_c[:, i] += rigid_body.by_numbers(tree, at, bodies, change)
    F, by_u = links.tau + rotor - acts.tau, -acts.by_u
    if len(applied):
        F, size = F - applied, size + np.abs(applied)
        by_force = _diagonal(np.full_like(applied, -1.0))
        by_u = np.concatenate([by_u, by_force], axis=1)
    return Equation(
        F,
        size + 1e-12,
        mass + _diagonal(h * late),
        links.by_q - _diagonal(acts.by_q),
        links.by_v - _diagonal(acts.by_v + acts.by_v_after),
        by_u,
        by_c,
        mass,
        late,
        late_by_c,
    )


def _dry_friction(
    of: Model, to: Equation, q: Batch, v: Batch, a: Batch, h: float
) -> Batch:
    """The force of dry friction; its derivatives are added to the equation's."""
    has, most = of.has, of.has.frictionloss[:, None]
    first = a + _solve(to.mass, h * to.late * a)  # before the integration
    slip = first + has.rate[:, None] * v
    drag = has.drag[:, None] * slip
    slides = np.where(np.abs(drag) < most, 0.0, np.sign(drag))
    for i, change in enumerate(of.by):
        to.by_c[:, i] += slides * change.frictionloss[:, None]
    stick = (np.abs(drag) < most) & (most > 0.0)
    some = np.flatnonzero(stick.any(0))
    if some.size:
        here = Equation(*(x[..., some] for x in to))
        point = (x[..., some] for x in (q, v, a, first - a, stick))
        added = _sticking(of, here, tuple(point), h)
        wholes = to.by_a, to.by_q, to.by_v, to.by_c
        for whole, part in zip(wholes, added, strict=True):
            whole[..., some] += part
    return -np.clip(drag, -most, most)


def _sticking(
    of: Model, at: Equation, point: tuple[np.ndarray, ...], h: float
) -> tuple[Batch, Batch, Batch, Batch]:
    """Derivatives of ``D (a0 + rate v)`` by ``a``, ``q``, ``v`` and parameters.

    ``M da0 = (M + h K) da + dM (a - a0) + h dK a``, where ``lag = a0 - a``.
    """
    has, by, (q, v, a, lag, stick) = of.has, of.by, point
    # dM (a - a0): the torques of no motion but the acceleration -lag.
    still = has._replace(gravity=np.zeros(3))
    moved = rigid_body.motion(of.tree, still, q, np.zeros_like(v), -lag)
    bodies = rigid_body.forces(of.tree, has.inertia, moved)
    by_q = rigid_body.inverse_dynamics(of.tree, moved, bodies, -lag).by_q
    by_c = np.zeros_like(at.by_c)
    for i, change in enumerate(by):
        by_c[:, i] = -change.armature[:, None] * lag + h * at.late_by_c[:, i] * a
        by_c[:, i] += rigid_body.by_numbers(
            of.tree, moved, bodies, change._replace(gravity=np.zeros(3))
        )
    rhs = np.concatenate([_diagonal(h * at.late), by_q, by_c], axis=1)
    n, weight = len(q), stick * has.drag[:, None]
    shares = _solve(at.mass, rhs) * weight[:, None]
    by_a, by_q, by_c = np.split(shares, [n, 2 * n], axis=1)
    slip = a + lag + has.rate[:, None] * v
    for i, change in enumerate(by):
        by_c[:, i] += stick * change.drag[:, None] * slip
    by_v = _diagonal(weight * has.rate[:, None])
    return by_a + _diagonal(weight), by_q, by_v, by_c


def _solve(A: Batch, b: Batch) -> Batch:
    """``A^-1 b`` of each point."""
    vectors = b.ndim == 2
    rhs = np.moveaxis(b[:, None] if vectors else b, -1, 0)
    found = np.moveaxis(np.linalg.solve(np.moveaxis(A, -1, 0), rhs), 0, -1)
    return found[:, 0] if vectors else found


def _diagonal(x: Batch) -> Batch:
    """The diagonal matrices of vectors."""
    out = np.zeros((len(x), *x.shape))
    out[np.arange(len(x)), np.arange(len(x))] = x
    return out
