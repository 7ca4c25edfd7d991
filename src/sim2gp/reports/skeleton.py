"""Stick figures of any machine, and two motions of one machine in one picture.

The camera is chosen by the motion. What moves in a plane is seen at a right angle to
it; what moves in space is seen from the side on which it shows most, from a little
above, and can be turned.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from sim2gp.reports.scenes import Camera, Points, Scene, Shape, project

_FLAT = 1e-3  # of the motion's largest extent; less is not another dimension
_FAR = 20.0  # of the machine's size: as good as from infinity
_NEAR = 6.0
_WIDTH, _LOW, _HIGH, _MARGIN = 640, 260, 480, 34  # pixels
_RISE = math.radians(22.0)  # of the camera above what moves in space
_ASIDE = math.radians(25.0)
_COLOURS = {"base": "hub", "rail": "quiet", "link": "blue", "tip": "red"}
_ROD, _GHOST = 9.0, 1.9  # pixels; how much wider a recorded rod is

Moving = Float[np.ndarray, "T j 3"]


def figure_entry(figure: Any) -> dict[str, Any]:
    """A `sim2gp.systems.mujoco.figure.Figure`, without its motion, for a summary."""
    return {
        "fixed": np.round(figure.fixed, 5).tolist(),
        "rods": [list(rod) for rod in figure.rods],
        "balls": [list(ball) for ball in figure.balls],
    }


def skeleton(about: Mapping[str, Any], moving: Moving) -> Scene:
    """The scene of a stick figure; ``about`` as `figure_entry` says."""
    fixed = np.reshape(np.asarray(about["fixed"], float), (-1, 3))
    moving = np.asarray(moving, float)
    camera, height = camera_for(fixed, moving)
    metre = camera.focal / camera.distance  # pixels
    layer = {"rail": 0, "base": 1}
    rods = [
        Shape(
            "rod", (int(a), int(b)), _COLOURS[part],
            (0.5 if part == "rail" else 1.0) * _ROD / metre, layer.get(part, 2), int(b),
        )
        for a, b, part in about["rods"]
    ]  # fmt: skip
    size = {"base": 0.9, "link": 0.62, "tip": 0.55}
    balls = [
        Shape(
            "ball", (int(a),), "red" if part == "tip" else "hub",
            size[part] * _ROD / metre, layer.get(part, 2), int(a),
        )
        for a, part in about["balls"]
    ]  # fmt: skip
    return Scene((*rods, *balls), fixed, moving, camera, _WIDTH, height)


def overlay_motion(scene: Scene, recorded: Moving) -> Scene:
    """The scene over a second motion of its machine, drawn as a wide pale shadow."""
    first, count = len(scene.fixed), scene.moving.shape[1]

    def moved(index: int) -> int:
        return index + count if index >= first else index

    ghosts = [
        replace(
            shape,
            points=tuple(map(moved, shape.points)),
            anchor=moved(shape.anchor),
            colour="ghost",
            size=_GHOST * shape.size,
            layer=2 * shape.layer,
        )
        for shape in scene.shapes
        if shape.kind in ("rod", "ball")
        and shape.colour != "shadow"
        and any(point >= first for point in shape.points)
    ]
    # A layer's shadows lie just below it, wherever they are in space.
    kept = [
        replace(shape, layer=2 * shape.layer + 1)
        for shape in scene.shapes
        if shape.kind != "trail"
    ]
    moving = np.concatenate([scene.moving, recorded], axis=1)
    return replace(scene, shapes=(*ghosts, *kept), moving=moving)


def camera_for(fixed: Points, moving: Moving) -> tuple[Camera, int]:
    """A camera that shows a motion, and the height of its picture in pixels."""
    normal, flat = _view(fixed, moving)
    azimuth = math.atan2(normal[1], normal[0])
    elevation = math.asin(float(np.clip(normal[2], -1.0, 1.0)))
    if flat and abs(normal[2]) > 1.0 - 1e-6:
        azimuth = -0.5 * math.pi  # from above, x to the right
    points = np.concatenate([fixed, moving.reshape(-1, 3)])
    low, high = points.min(axis=0), points.max(axis=0)
    target = 0.5 * (low + high)
    size = max(float(np.linalg.norm(high - low)), 1e-6)
    distance = (_FAR if flat else _NEAR) * size
    shown = Camera(tuple(target.tolist()), azimuth, elevation, distance, 1.0, not flat)
    frame = Scene((), fixed, moving, shown, 0, 0)
    seen, _ = project(frame, points)
    half = np.maximum(np.abs(seen).max(axis=0), 1e-9)
    if flat:  # nothing turns: the middle of the picture is that of what is seen
        middle = 0.5 * (seen.min(axis=0) + seen.max(axis=0)) * distance
        right, up = _axes(azimuth, elevation)
        target = target + middle[0] * right - middle[1] * up
        half = np.maximum(0.5 * np.ptp(seen, axis=0), 1e-9)
    room = 0.5 * _WIDTH - _MARGIN, 0.5 * _HIGH - _MARGIN
    focal = min(room[0] / half[0], room[1] / half[1])
    height = round(float(np.clip(2 * (focal * half[1] + _MARGIN), _LOW, _HIGH)))
    return replace(shown, target=tuple(target.tolist()), focal=float(focal)), height


def _axes(azimuth: float, elevation: float) -> tuple[np.ndarray, np.ndarray]:
    """Right and up of the picture, in space."""
    sin_a, cos_a = math.sin(azimuth), math.cos(azimuth)
    sin_e, cos_e = math.sin(elevation), math.cos(elevation)
    right = np.array([-sin_a, cos_a, 0.0])
    return right, np.array([-sin_e * cos_a, -sin_e * sin_a, cos_e])


def _view(fixed: Points, moving: Moving) -> tuple[np.ndarray, bool]:
    """The direction towards the camera, and whether the motion is in a plane."""
    motion = (moving - moving.mean(axis=0)).reshape(-1, 3)
    points = np.concatenate([fixed, moving.reshape(-1, 3)])
    layout = points - points.mean(axis=0)
    axes, sizes = _principal(motion)
    if sizes[2] > _FLAT * sizes[0]:
        return _oblique(_principal(layout)[0][2]), False
    if (
        sizes[1] <= _FLAT * sizes[0]
    ):  # along a line, or at rest: the machine's own plane
        along = axes[0] if sizes[0] > 0.0 else _principal(layout)[0][0]
        across, wide = _principal(layout - np.outer(layout @ along, along))
        side = across[0] if wide[0] > _FLAT * np.abs(layout).max(initial=0.0) else None
        normal = np.cross(along, _upright(along) if side is None else side)
        return _facing(normal / np.linalg.norm(normal)), True
    return _facing(axes[2]), True


def _upright(along: Sequence[float] | np.ndarray) -> np.ndarray:
    """Up, or towards y for what is upright itself."""
    up = np.array([0.0, 0.0, 1.0])
    return up if abs(along[2]) < 0.9 else np.array([1.0, 0.0, 0.0])


def _principal(cloud: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Principal axes of points about the origin, and the lengths along them."""
    _, sizes, axes = np.linalg.svd(cloud.T @ cloud)
    return axes, np.sqrt(sizes)


def _facing(normal: np.ndarray) -> np.ndarray:
    """Of a plane's two sides the one from above, or with x (else y) to the right."""
    if abs(normal[2]) > 0.1:
        return normal * np.sign(normal[2])
    right = np.array([-normal[1], normal[0]])
    main = right[0] if abs(right[0]) > 0.1 else right[1]
    return normal * np.sign(main)


def _oblique(normal: np.ndarray) -> np.ndarray:
    """From a little above, turned aside so that depth shows."""
    level = float(np.hypot(normal[0], normal[1]))
    facing = np.array([0.0, -1.0, 0.0])
    if level > 0.3:
        facing = _facing(np.array([normal[0], normal[1], 0.0]) / level)
    angle = math.atan2(facing[1], facing[0]) + _ASIDE
    side = math.cos(_RISE)
    return np.array([side * math.cos(angle), side * math.sin(angle), math.sin(_RISE)])
