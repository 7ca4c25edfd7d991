"""What a machine looks like: bodies in space for each state, and one camera.

A scene is a list of shapes over points (x, y, z) in metres, z up. Some points stay,
the others move with the state. The page's player, its still picture and the GIF all
draw the same scene through the same perspective projection,

    depth = D - p . forward
    u = c_x + f (p . right) / depth,   v = c_y - f (p . up) / depth.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from sim2gp.errors import error, nearest

Points = Float[np.ndarray, "k 3"]
Moving = Float[np.ndarray, "T j 3"]


@dataclass(frozen=True)
class Shape:
    """One body: a "rod" or "trail" (a line), a "ball" or a "face" (a polygon).

    `points` counts the fixed points first, then the moving ones; `size` is a width or
    radius in metres; a face with `cull` is seen from its front only. Shapes of a
    higher `layer` cover those below; within one, the one whose `anchor` point is
    farther away is covered.
    """

    kind: str
    points: tuple[int, ...]
    colour: str
    size: float = 0.0
    layer: int = 1
    anchor: int = 0
    cull: bool = False


@dataclass(frozen=True)
class Camera:
    """A camera that looks at a point from an azimuth and an elevation (radians)."""

    target: tuple[float, float, float]
    azimuth: float
    elevation: float
    distance: float
    focal: float
    turns: bool


@dataclass(frozen=True)
class Scene:
    """Shapes, their fixed points and their moving points at each time."""

    shapes: tuple[Shape, ...]
    fixed: Points
    moving: Moving
    camera: Camera
    width: int = 640
    height: int = 420
    #: (row of the state, name, unit, factor) of the strip charts below the machine
    strips: tuple[tuple[int, str, str, float], ...] = ()
    inputs: tuple[tuple[str, str], ...] = ()

    def points(self, frame: int) -> Points:
        """All points at one time, the fixed ones first."""
        return np.concatenate([self.fixed, self.moving[frame]])


def project(scene: Scene, points: Points) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (k, 2) of points in space and their depths (k,) in metres."""
    camera = scene.camera
    sin_a, cos_a = math.sin(camera.azimuth), math.cos(camera.azimuth)
    sin_e, cos_e = math.sin(camera.elevation), math.cos(camera.elevation)
    right = np.array([-sin_a, cos_a, 0.0])
    forward = np.array([cos_e * cos_a, cos_e * sin_a, sin_e])  # towards the camera
    up = np.array([-sin_e * cos_a, -sin_e * sin_a, cos_e])
    local = points - np.asarray(camera.target)
    depth = camera.distance - local @ forward
    scale = camera.focal / depth
    u = scene.width / 2 + scale * (local @ right)
    v = scene.height / 2 - scale * (local @ up)
    return np.stack([u, v], axis=1), depth


def _circle(radius: float, z: float, count: int = 48) -> Points:
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    return np.stack(
        [radius * np.cos(angle), radius * np.sin(angle), np.full(count, z)], axis=1
    )


def _box_corners(low: Sequence[float], high: Sequence[float]) -> Points:
    (x0, y0, z0), (x1, y1, z1) = low, high
    return np.array(
        [
            [x, y, z]
            for z in (z0, z1)
            for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))
        ]
    )


#: The faces of `_box_corners`, each anticlockwise as seen from outside, with its shade.
_FACES = (
    ((4, 5, 6, 7), "steel-top"),
    ((0, 1, 5, 4), "steel"),
    ((1, 2, 6, 5), "steel-side"),
    ((2, 3, 7, 6), "steel"),
    ((3, 0, 4, 7), "steel-side"),
)


def furuta(state: np.ndarray, params: Mapping[str, float]) -> Scene:
    """A rotary pendulum: arm angle theta, pendulum angle alpha (0 hanging, pi up)."""
    arm = params.get("arm_length", 0.085)
    rod = params.get("pendulum_length", 0.129)
    theta, alpha = state[:, 0], state[:, 1]
    zero, one = np.zeros_like(theta), np.ones_like(theta)
    along = np.stack([np.cos(theta), np.sin(theta), zero], axis=1)
    across = np.stack([-np.sin(theta), np.cos(theta), zero], axis=1)
    joint = arm * along
    # The model's M12 = +B cos(alpha) says so: near hanging, a positive rate of alpha
    # moves the tip the way a positive rate of theta moves the joint.
    tip = joint + rod * (
        np.sin(alpha)[:, None] * across
        - np.cos(alpha)[:, None] * np.stack([zero, zero, one], axis=1)
    )
    floor = -1.12 * rod
    half = 0.42 * arm
    cube = _box_corners((-half, -half, floor), (half, half, -0.16 * rod))
    disc = _circle(1.45 * arm, floor)
    hub = np.array([[0, 0, -0.16 * rod], [0, 0, 0], [0, 0, 0.03 * rod]])
    fixed = np.concatenate([disc, cube, hub])
    n, c = len(fixed), len(disc)
    flat = np.array([1.0, 1.0, 0.0])
    ground = np.array([0.0, 0.0, floor])
    outer = 1.12 * joint
    moving = np.stack(
        [joint, tip, outer, joint * flat + ground, tip * flat + ground], axis=1
    )
    axis = c + 9
    width = 0.12 * arm
    shapes = (
        Shape("face", tuple(range(c)), "floor", layer=0),
        Shape("rod", (c + 8, n + 3, n + 4), "shadow", width, layer=0),
        Shape("trail", (n + 1,), "red", layer=1, anchor=n),
        *(
            Shape("face", tuple(c + i for i in face), shade, 0.0, 1, axis, True)
            for face, shade in _FACES
        ),
        Shape("rod", (c + 8, axis), "hub", 0.20 * arm, 1, axis),
        Shape("rod", (axis, n + 2), "blue", width, 1, axis),
        Shape("ball", (axis,), "hub", 0.11 * arm, 1, axis),
        Shape("rod", (n, n + 1), "red", 0.75 * width, 1, n),
        Shape("ball", (n,), "hub", 0.05 * arm, 1, n),
        Shape("ball", (n + 1,), "red", 0.085 * arm, 1, n),
    )
    reach = max(1.75 * arm, rod)
    camera = Camera(
        (0.0, 0.0, -0.23 * rod), math.radians(-62), math.radians(24), 7.5 * reach,
        1190.0, True,
    )  # fmt: skip
    return Scene(
        shapes, fixed, moving, camera,
        strips=((1, "pendulum angle alpha", "deg", 180 / math.pi),
                (0, "arm angle theta", "deg", 180 / math.pi)),
        inputs=(("voltage", "V"),),
    )  # fmt: skip


def cartpole(state: np.ndarray, params: Mapping[str, float]) -> Scene:
    """A cart on a rail: position x, pole angle theta (0 hanging, pi up)."""
    pole = 2.0 * params.get("pole_half_length", 0.16825)
    rail = params.get("rail_length", 0.814)
    x, theta = state[:, 0], state[:, 1]
    zero = np.zeros_like(x)
    pivot = np.stack([x, zero, zero], axis=1)
    tip = pivot + pole * np.stack([np.sin(theta), zero, -np.cos(theta)], axis=1)
    half, depth, height = 0.16 * pole, 0.09 * pole, 0.075 * pole
    corners = _box_corners((-half, -depth, -height), (half, depth, height))
    body = pivot[:, None, :] + corners
    end = rail / 2 + half
    fixed = np.array(
        [[-end, 0, 0], [end, 0, 0], [-end, 0, -0.16 * pole], [-end, 0, 0.16 * pole],
         [end, 0, -0.16 * pole], [end, 0, 0.16 * pole]]
    )  # fmt: skip
    front = np.array([0.0, -1.6 * depth, 0.0])
    moving = np.concatenate(
        [(pivot + front)[:, None], (tip + front)[:, None], body], axis=1
    )
    n = len(fixed)
    width = 0.05 * pole
    shapes = (
        Shape("rod", (0, 1), "quiet", 0.6 * width, 0),
        Shape("rod", (2, 3), "steel-side", width, 0),
        Shape("rod", (4, 5), "steel-side", width, 0),
        Shape("trail", (n + 1,), "red", layer=1),
        *(
            Shape("face", tuple(n + 2 + i for i in face), shade, 0.0, 2, n, True)
            for face, shade in _FACES
        ),
        Shape("rod", (n, n + 1), "red", 1.1 * width, 3),
        Shape("ball", (n,), "hub", 0.8 * width, 3),
        Shape("ball", (n + 1,), "red", 1.3 * width, 3),
    )
    distance = 8.0 * pole + 2 * rail
    # The pole may point outwards at either end of the rail.
    reach = (end + 1.06 * pole) / 320
    camera = Camera(
        (0.0, 0.0, 0.0), math.radians(-90), math.radians(6), distance,
        distance / reach, True,
    )  # fmt: skip
    return Scene(
        shapes, fixed, moving, camera, height=340,
        strips=((1, "pole angle theta", "deg", 180 / math.pi),
                (0, "cart position x", "m", 1.0)),
        inputs=(("voltage", "V"),),
    )  # fmt: skip


def two_link_points(
    state: np.ndarray, lengths: tuple[float, float], *, vertical: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Elbow and tip (T, 2) of an arm; angles from +x, or from straight down."""
    start = -math.pi / 2 if vertical else 0.0
    first = state[:, 0] + start
    second = first + state[:, 1]
    elbow = lengths[0] * np.stack([np.cos(first), np.sin(first)], axis=1)
    tip = elbow + lengths[1] * np.stack([np.cos(second), np.sin(second)], axis=1)
    return elbow, tip


def two_link(state: np.ndarray, params: Mapping[str, float]) -> Scene:
    """A two-link arm; q2 relative; seen from above, or from the side under gravity."""
    l1, l2 = params.get("length1", 0.5), params.get("length2", 0.4)
    vertical = abs(params.get("gravity", 0.0)) > 0.0
    elbow, tip = two_link_points(state, (l1, l2), vertical=vertical)
    zero = np.zeros((len(elbow), 1))

    def upright(plane: np.ndarray) -> np.ndarray:
        """The plane of the arm as the plane x-z, which faces the camera."""
        return np.concatenate([plane[:, :1], zero, plane[:, 1:]], axis=1)

    reach = l1 + l2
    rim = _circle(reach, 0.0)[:, [0, 2, 1]]
    fixed = np.concatenate([rim, np.zeros((1, 3))])
    moving = np.stack([upright(elbow), upright(tip)], axis=1)
    c, n = len(rim), len(fixed)
    width = 0.055 * reach
    shapes = (
        Shape("face", tuple(range(c)), "floor", layer=0),
        Shape("trail", (n + 1,), "red", layer=1),
        Shape("rod", (c, n), "blue", width, 2),
        Shape("rod", (n, n + 1), "red", 0.8 * width, 3),
        Shape("ball", (c,), "hub", 0.75 * width, 4),
        Shape("ball", (n,), "hub", 0.5 * width, 4),
        Shape("ball", (n + 1,), "red", 0.55 * width, 4),
    )
    camera = Camera(
        (0.0, 0.0, 0.0), math.radians(-90), 0.0, 20 * reach, 20 * 190.0, False
    )
    return Scene(
        shapes, fixed, moving, camera,
        strips=((0, "joint q1", "deg", 180 / math.pi),
                (1, "joint q2", "deg", 180 / math.pi)),
        inputs=(("torque 1", "N m"), ("torque 2", "N m")),
    )  # fmt: skip


SCENES: dict[str, Callable[[np.ndarray, Mapping[str, float]], Scene]] = {
    "furuta": furuta,
    "cartpole": cartpole,
    "two_link": two_link,
}


def scene_of(about: Mapping[str, Any], state: np.ndarray) -> Scene:
    """The scene of a run's machine; `about` is the summary's entry "animation"."""
    system = str(about.get("system"))
    if system not in SCENES:
        where, known = "summary.json, animation.system", ", ".join(SCENES)
        close = nearest(system, SCENES) or "furuta"
        raise error("no_drawing", where=where, got=system, known=known, close=close)
    params = {k: float(v) for k, v in dict(about.get("params") or {}).items()}
    return SCENES[system](np.asarray(state, dtype=float), params)


def keep_frames(scene: Scene, index: np.ndarray) -> Scene:
    """The same scene at some of its times only."""
    return replace(scene, moving=scene.moving[index])
