"""Inverse dynamics of a tree of hinges and slides, and its derivatives.

Spatial vectors are (rotation, translation) about the world's origin, in the world's
axes, of ``B`` points at once in the last axis. Joint ``j`` moves along ``S_j``:

    v_j = v_before + S_j q'_j,        a_j = a_before + S_j q''_j + v_before x S_j q'_j
    f_b = I_b a_b + v_b x* I_b v_b,   tau_j = S_j . F_j,  F_j = sum of f_b above joint j

with gravity as an acceleration of the world. The derivatives are those of Singh,
Russell and Wensing 2022 (IEEE RA-L 7, "Efficient analytical derivatives of rigid-body
dynamics using spatial vector algebra"): with ``P_j = v_before x S_j`` and ``A_j =
a_before x S_j + v_before x P_j``, and ``I``, ``B`` of all bodies above the higher of
the two joints ``i`` and ``j``,

    d tau_i / d q'_j = S_i . (2 B S_j + 2 I P_j)
    d tau_i / d q_j  = S_i . (2 B P_j + I A_j [+ S_j x* F_j where i is not above j])
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sim2gp.systems.mujoco.slopes.numbers import Numbers, Tree

Batch = Float[np.ndarray, "... B"]
Vector = Float[np.ndarray, " 3"]


class Motion(NamedTuple):
    """Frames and joints of the tree at ``B`` points, and how they move."""

    turn: Float[np.ndarray, "b 3 3 B"]
    origin: Float[np.ndarray, "b 3 B"]
    S: Float[np.ndarray, "n 6 B"]
    v: Float[np.ndarray, "b 6 B"]
    a: Float[np.ndarray, "b 6 B"]
    v_before: Float[np.ndarray, "n 6 B"]
    a_before: Float[np.ndarray, "n 6 B"]


class Forces(NamedTuple):
    """What the bodies above each joint ask for together."""

    I: Float[np.ndarray, "b 6 6 B"]
    B2: Float[np.ndarray, "b 6 6 B"]  # twice B
    F: Float[np.ndarray, "b 6 B"]


class InverseDynamics(NamedTuple):
    """Torques ``tau(q, v, a)`` and their derivatives.

    ``size`` is what they sum without signs: of a body in free fall weight and inertia
    cancel, and the torques themselves are rounding.
    """

    tau: Float[np.ndarray, "n B"]
    size: Float[np.ndarray, "n B"]
    by_q: Float[np.ndarray, "n n B"]
    by_v: Float[np.ndarray, "n n B"]
    mass: Float[np.ndarray, "n n B"]


def cross(a: Batch, b: Batch) -> Batch:
    """``a x b`` of 3-vectors in the first axis."""
    return np.stack(
        [
            a[1] * b[2] - a[2] * b[1],
            a[2] * b[0] - a[0] * b[2],
            a[0] * b[1] - a[1] * b[0],
        ]
    )


def cross_motion(v: Batch, s: Batch) -> Batch:
    """``v x s`` of two motions."""
    w = v[:3]
    return np.concatenate([cross(w, s[:3]), cross(v[3:], s[:3]) + cross(w, s[3:])])


def cross_force(v: Batch, f: Batch) -> Batch:
    """``v x* f`` of a motion and a force."""
    w = v[:3]
    return np.concatenate([cross(w, f[:3]) + cross(v[3:], f[3:]), cross(w, f[3:])])


def apply(A: Batch, x: Batch) -> Batch:
    """Matrices times vectors."""
    return np.einsum("ij...,j...->i...", A, x)


def dot(x: Batch, y: Batch) -> Batch:
    return np.einsum("...iB,iB->...B", x, y)


def motion(tree: Tree, numbers: Numbers, q: Batch, v: Batch, a: Batch) -> Motion:
    """Kinematics of the tree at joint positions, velocities and accelerations."""
    n, B = q.shape
    bodies = len(tree.parent)
    turn, origin = np.zeros((bodies, 3, 3, B)), np.zeros((bodies, 3, B))
    turn[0] = np.eye(3)[..., None]
    vel, acc = np.zeros((bodies, 6, B)), np.zeros((bodies, 6, B))
    acc[0, 3:] = -numbers.gravity[:, None]
    S, v_before, a_before = (np.zeros((n, 6, B)) for _ in range(3))
    for b in range(1, bodies):
        k = tree.parent[b]
        place = origin[k] + np.einsum("ijB,j->iB", turn[k], numbers.place[b])
        R = np.einsum("ijB,jk->ikB", turn[k], tree.turn[b])
        now_v, now_a = vel[k], acc[k]
        for j in tree.joints[b]:
            axis = np.einsum("ijB,j->iB", R, tree.axis[j])
            by = q[j] - tree.zero[j]
            if tree.hinge[j]:
                anchor = place + np.einsum("ijB,j->iB", R, tree.anchor[j])
                R = _turned(R, tree.axis[j], by)
                place = anchor - np.einsum("ijB,j->iB", R, tree.anchor[j])
                S[j, :3], S[j, 3:] = axis, cross(anchor, axis)
            else:
                place = place + axis * by
                S[j, 3:] = axis
            v_before[j], a_before[j] = now_v, now_a
            now_a = now_a + S[j] * a[j] + cross_motion(now_v, S[j]) * v[j]
            now_v = now_v + S[j] * v[j]
        turn[b], origin[b], vel[b], acc[b] = R, place, now_v, now_a
    return Motion(turn, origin, S, vel, acc, v_before, a_before)


def forces(tree: Tree, inertia: Float[np.ndarray, "b 6 6"], at: Motion) -> Forces:
    """Inertias and forces of each body, summed from the leaves on."""
    bodies, _, B = at.v.shape
    I, B2 = np.zeros((2, bodies, 6, 6, B))
    F = np.zeros((bodies, 6, B))
    for b in range(bodies - 1, 0, -1):
        if inertia[b].any():
            own = _in_world(inertia[b], at.turn[b], at.origin[b])
            momentum = apply(own, at.v[b])
            F[b] += apply(own, at.a[b]) + cross_force(at.v[b], momentum)
            T = np.einsum("ijB,jkB->ikB", own, _crossing(at.v[b]))
            B2[b] += _bar(momentum) - T - T.swapaxes(0, 1)
            I[b] += own
        if (k := tree.parent[b]) > 0:
            I[k] += I[b]
            B2[k] += B2[b]
            F[k] += F[b]
    return Forces(I, B2, F)


def inverse_dynamics(tree: Tree, at: Motion, of: Forces, a: Batch) -> InverseDynamics:
    """The torques of the links and their derivatives (armatures are not among them)."""
    n, _, B = at.S.shape
    tau, size = np.zeros((2, n, B))
    by_q, by_v, mass = np.zeros((3, n, n, B))
    rows = [row(at, of, j, tree.body[j]) for j in range(n)]
    for j in range(n):
        b, S = tree.body[j], at.S[j]
        tau[j] = dot(S, of.F[b])
        size[j] = np.einsum("iB,iB->B", np.abs(S), np.abs(of.F[b]))
        P = cross_motion(at.v_before[j], S)
        A = cross_motion(at.a_before[j], S) + cross_motion(at.v_before[j], P)
        below = np.flatnonzero(tree.above[:, j])
        up = [*below, j]
        weight = apply(of.I[b], S)
        mass[up, j] = dot(at.S[up], weight)
        mass[j, below] = mass[below, j]
        by_v[up, j] = dot(at.S[up], apply(of.B2[b], S) + 2.0 * apply(of.I[b], P))
        force = apply(of.B2[b], P) + apply(of.I[b], A) + cross_force(S, of.F[b])
        by_q[up, j] = dot(at.S[up], force)
        for k in np.flatnonzero(tree.above[j]):
            inert, gyro = rows[k]
            by_v[k, j] = dot(gyro, S) + 2.0 * dot(inert, P)
            by_q[k, j] = dot(inert, A) + dot(gyro, P)
    size += np.einsum("ijB,jB->iB", np.abs(mass), np.abs(a))
    return InverseDynamics(tau, size, by_q, by_v, mass)


def row(at: Motion, of: Forces, j: int, b: int) -> tuple[Batch, Batch]:
    """``S_j I`` and ``S_j 2 B`` of the bodies above joint ``j``."""
    return apply(of.I[b], at.S[j]), np.einsum("ijB,iB->jB", of.B2[b], at.S[j])


def by_numbers(tree: Tree, at: Motion, of: Forces, change: Numbers) -> Batch:
    """Derivative of the torques along a change of the links' numbers."""
    out = np.zeros((len(at.S), at.S.shape[-1]))
    for b in np.flatnonzero(change.inertia.any((1, 2))).tolist():
        out += _by_inertia(tree, at, b, change.inertia[b])
    for b in np.flatnonzero(change.place.any(1)).tolist():
        out += _by_place(tree, at, of, b, change.place[b])
    if change.gravity.any():
        out += _by_gravity(tree, at, of, change.gravity)
    return out


def _by_place(tree: Tree, at: Motion, of: Forces, b: int, along: Vector) -> Batch:
    """Derivative of the torques where body ``b`` sits further ``along`` (m, parent's).

    It is that of a slide between the body and its parent.
    """
    k = tree.parent[b]
    slide = np.zeros_like(at.S[0])
    slide[3:] = np.einsum("ijB,j->iB", at.turn[k], along)
    P = cross_motion(at.v[k], slide)
    A = cross_motion(at.a[k], slide) + cross_motion(at.v[k], P)
    force = apply(of.B2[b], P) + apply(of.I[b], A) + cross_force(slide, of.F[b])
    out = np.zeros((len(at.S), slide.shape[1]))
    carried = {b}
    for c in range(b + 1, len(tree.parent)):
        if tree.parent[c] in carried:
            carried.add(c)
    carriers = set()
    while k > 0:
        carriers.add(k)
        k = tree.parent[k]
    for j, body in enumerate(tree.body):
        if body in carried:
            inert, gyro = row(at, of, j, body)
            out[j] = dot(inert, A) + dot(gyro, P)
        elif body in carriers:
            out[j] = dot(at.S[j], force)
    return out


def _by_inertia(
    tree: Tree, at: Motion, b: int, change: Float[np.ndarray, "6 6"]
) -> Batch:
    """Derivative of the torques in an inertia of body ``b``, which they are linear in.

    ``change`` is in the body's own frame, so that it is one matrix for all points.
    """
    R, p = at.turn[b], at.origin[b]
    v, a = (_in_body(x, R, p) for x in (at.v[b], at.a[b]))
    f = change @ a + cross_force(v, change @ v)
    moment, push = np.einsum("ijB,jB->iB", R, f[:3]), np.einsum("ijB,jB->iB", R, f[3:])
    world = np.concatenate([moment + cross(p, push), push])
    out = np.zeros((len(at.S), world.shape[1]))
    k = b
    while k > 0:
        for j in tree.joints[k]:
            out[j] = dot(at.S[j], world)
        k = tree.parent[k]
    return out


def _by_gravity(tree: Tree, at: Motion, of: Forces, change: Vector) -> Batch:
    """Derivative of the torques in the vector of gravity."""
    out = np.zeros((len(at.S), at.S.shape[-1]))
    for j, b in enumerate(tree.body):
        out[j] = -np.einsum("ijB,iB,j->B", of.I[b, :, 3:], at.S[j], change)
    return out


def _in_body(x: Batch, R: Batch, p: Batch) -> Batch:
    """A motion about a body's origin, in its axes."""
    w, v = x[:3], x[3:] + cross(x[:3], p)
    return np.concatenate(
        [np.einsum("jiB,jB->iB", R, w), np.einsum("jiB,jB->iB", R, v)]
    )


def _turned(R: Batch, axis: Vector, angle: Batch) -> Batch:
    """``R`` times the rotation about its own axis (Rodrigues)."""
    x, y, z = axis
    K = np.asarray([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    RK = np.einsum("ijB,jk->ikB", R, K)
    RKK = np.einsum("ijB,jk->ikB", RK, K)
    return R + np.sin(angle) * RK + (1.0 - np.cos(angle)) * RKK


def _in_world(inertia: Float[np.ndarray, "6 6"], R: Batch, p: Batch) -> Batch:
    """A body's inertia about the world's origin."""
    mass, first = inertia[5, 5], _vector(inertia[:3, 3:])
    h = np.einsum("ijB,j->iB", R, first)
    J = np.einsum("ijB,jk,lkB->ilB", R, inertia[:3, :3], R, optimize=True)
    H, X = _skew(h), _skew(p)
    XH = np.einsum("ijB,jkB->ikB", X, H)
    XX = np.einsum("ijB,jkB->ikB", X, X)
    out = np.zeros((6, 6, p.shape[1]))
    out[:3, :3] = J - XH - XH.swapaxes(0, 1) - mass * XX
    out[:3, 3:] = H + mass * X
    out[3:, :3] = -out[:3, 3:]
    out[3:, 3:] = mass * np.eye(3)[..., None]
    return out


def _vector(K: Float[np.ndarray, "3 3"]) -> Vector:
    return np.asarray([K[2, 1], K[0, 2], K[1, 0]])


def _skew(x: Batch) -> Batch:
    K = np.zeros((3, 3, x.shape[1]))
    K[0, 1], K[0, 2], K[1, 2] = -x[2], x[1], -x[0]
    K[1, 0], K[2, 0], K[2, 1] = x[2], -x[1], x[0]
    return K


def _crossing(v: Batch) -> Batch:
    """The matrix of ``v x``."""
    out = np.zeros((6, 6, v.shape[1]))
    out[:3, :3] = out[3:, 3:] = _skew(v[:3])
    out[3:, :3] = _skew(v[3:])
    return out


def _bar(f: Batch) -> Batch:
    """The matrix of ``s -> s x* f``."""
    out = np.zeros((6, 6, f.shape[1]))
    out[:3, :3] = -_skew(f[:3])
    out[:3, 3:] = out[3:, :3] = -_skew(f[3:])
    return out
