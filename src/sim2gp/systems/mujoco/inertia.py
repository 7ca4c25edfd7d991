"""The ten numbers of a rigid body's inertia, any ten real numbers being a body.

The pseudo-inertia of a body, of points ``x`` in its frame and density ``rho``,

    P = integral of [x; 1] [x; 1]^T rho dx = [Sigma, m c; m c^T, m],

is positive definite exactly where masses and principal moments can be those of matter.
Deformed by an affine map it stays so: with the model's own ``P0`` and upper triangular

    U = e^alpha [e^d1 s12  s13  t1]
                [0    e^d2 s23  t2]
                [0    0    e^d3 t3]
                [0    0    0    1 ]

every ``U P0 U^T`` is a body, each body is one of them, and zero is the model's own
(Rucker and Wensing, Smooth Parameterization of Rigid-Body Inertia, 2022). ``alpha`` is
half the logarithm of the density, ``d`` and ``s`` stretch and shear the body about the
origin of its frame, ``t`` moves it (m).
"""

from collections.abc import Mapping
from itertools import product
from typing import Any

import numpy as np
from jaxtyping import Float

Four = Float[np.ndarray, "4 4"]
NAMES = ("alpha", "d1", "d2", "d3", "s12", "s23", "s13", "t1", "t2", "t3")
ALIKE = 1e-3  # as far as files round the two sides of a robot
_PLACES = (
    (3, 3),
    (0, 0),
    (1, 1),
    (2, 2),
    (0, 1),
    (1, 2),
    (0, 2),
    (0, 3),
    (1, 3),
    (2, 3),
)


def deformation(values: Float[np.ndarray, "10"]) -> Four:
    """``U`` of the ten numbers."""
    U = np.eye(4)
    for (i, j), value in zip(_PLACES[1:], values[1:], strict=True):
        U[i, j] = np.exp(value) if i == j else value
    return np.asarray(np.exp(values[0]) * U)


def numbers(U: Four) -> Float[np.ndarray, "10"]:
    """The inverse of `deformation`."""
    V = U / U[3, 3]
    rest = [np.log(V[i, j]) if i == j else V[i, j] for i, j in _PLACES[1:]]
    return np.asarray([np.log(U[3, 3]), *rest])


def pseudo_inertia(
    mass: float, com: Float[np.ndarray, "3"], about_com: Float[np.ndarray, "3 3"]
) -> Four:
    """``P`` of a mass, its centre, and its rotational inertia about that."""
    P = np.empty((4, 4))
    P[:3, :3] = 0.5 * np.trace(about_com) * np.eye(3) - about_com
    P[:3, :3] += mass * np.outer(com, com)
    P[:3, 3] = P[3, :3] = mass * com
    P[3, 3] = mass
    return P


def rigid_body(
    P: Four,
) -> tuple[float, Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Mass, centre, and inertia about it: the inverse of `pseudo_inertia`."""
    mass, com = float(P[3, 3]), P[:3, 3] / P[3, 3]
    spread = P[:3, :3] - mass * np.outer(com, com)
    return mass, com, np.trace(spread) * np.eye(3) - spread


def upper_factor(P: Four) -> Four:
    """Upper triangular ``V`` with a positive diagonal and ``V V^T = P``."""
    turned = np.linalg.cholesky(P[::-1, ::-1])
    return np.asarray(turned[::-1, ::-1])


def mirror_sign(one: Four, other: Four, name: str) -> float:
    """Sign of a number of ``other``, the mirror image of a body, relative to ``one``'s.

    With ``M`` a diagonal of signs and ``other = M one M``, the deformation that keeps
    them images of each other is ``M U M``. The fewest mirrors that do are taken; bodies
    that are no images have equal numbers.
    """
    size = np.sqrt(np.outer(np.diag(one), np.diag(one)))
    i, j = _PLACES[NAMES.index(name)]
    for signs in sorted(product((1.0, -1.0), repeat=3), key=sum, reverse=True):
        M = np.asarray([*signs, 1.0])
        if np.all(np.abs(np.outer(M, M) * one - other) <= ALIKE * size):
            return float(M[i] * M[j])
    return 1.0


class BodyInertia:
    """One body of a compiled model: reading and setting of its ten numbers."""

    def __init__(self, model: Any, body: int) -> None:
        self.body = body
        self.own = of_body(model, body)

    @property
    def radius(self) -> float:
        """Of gyration about the centre of mass, in m."""
        mass, _, about = rigid_body(self.own)
        return float(np.sqrt(0.5 * np.trace(about) / mass))

    def get(self, model: Any) -> Float[np.ndarray, "10"]:
        """How the body differs from the model's own."""
        now, own = upper_factor(of_body(model, self.body)), upper_factor(self.own)
        return numbers(np.linalg.solve(own.T, now.T).T)  # of U, where U V0 = V

    def put(self, model: Any, values: Mapping[str, float]) -> None:
        """Give the body these numbers; those that are not named are zero."""
        U = deformation(np.asarray([values.get(name, 0.0) for name in NAMES]))
        set_body(model, self.body, U @ self.own @ U.T)


def of_body(model: Any, b: int) -> Four:
    """The pseudo-inertia of a body of a compiled model, in the body's frame."""
    about = inertia_matrix(model, b)
    return pseudo_inertia(float(model.body_mass[b]), model.body_ipos[b].copy(), about)


def set_body(model: Any, b: int, P: Four) -> None:
    """Mass, centre, principal moments and axes of a pseudo-inertia."""
    import mujoco

    mass, com, about = rigid_body(P)
    moments, axes, quat = np.empty(3), np.empty(9), np.empty(4)
    mujoco.mju_eig3(moments, axes, quat, np.ascontiguousarray(about).reshape(-1))
    model.body_mass[b], model.body_ipos[b] = mass, com
    model.body_inertia[b], model.body_iquat[b] = moments, quat
    unframe(model, b)


def inertia_matrix(model: Any, b: int) -> Float[np.ndarray, "3 3"]:
    """About the centre of mass, in the body's axes."""
    import mujoco

    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, model.body_iquat[b])
    R = turn.reshape(3, 3)
    return np.asarray((R * model.body_inertia[b]) @ R.T)


def unframe(model: Any, b: int) -> None:
    """Forget which frames of a body were the same before its centre moved."""
    model.body_sameframe[b] = 0
    model.geom_sameframe[model.geom_bodyid == b] = 0
    model.site_sameframe[model.site_bodyid == b] = 0
