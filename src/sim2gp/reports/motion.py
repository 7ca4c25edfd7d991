"""A film of forecasts over what was recorded, for the report.

Windows follow each other: the recorded motion goes on, the forecast starts again from
the measured state every half second.
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from sim2gp.data.grid import Grid
from sim2gp.data.logs import Log
from sim2gp.identification.forecasts.prediction import Picture
from sim2gp.inference.gaussian import Gaussian
from sim2gp.systems import CartPole, Furuta, MuJoCo, TwoLink, UniformRodArm
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.machine import plant_of
from sim2gp.types import in_float64

if TYPE_CHECKING:
    from sim2gp.reports.scenes import Scene

MOST = 20  # windows: ten seconds
FRAME = 0.08  # s of the film between pictures of MuJoCo's own
_STRIPS = 4
_BUNDLED: tuple[tuple[type, str], ...] = (
    (Furuta, "furuta"),
    (CartPole, "cartpole"),
    (TwoLink, "two_link"),
    (UniformRodArm, "two_link"),
)


def film(
    system: AbstractSystem,
    posterior: Gaussian,
    picture: Picture,
    grid: Grid,
    logs: Sequence[Log],
    title: str,
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Summary entry "animation" and its arrays; both empty for an unknown machine.

    ``picture`` is what `forecast_traces` made of ``grid``. Of a machine in
    several configurations the film keeps to that of its first window.
    """
    machine = plant_of(system)
    (which,) = picture["which"]
    if not len(which):
        return {}, {}
    configuration = np.asarray(grid.windows.configuration)[which]
    shown = np.flatnonzero(configuration == configuration[0])[:MOST]
    which = which[shown]
    time, y, mean, _ = (x[shown, :-1] for x in picture["trace"])
    names = [c.name for c in system.physical_states]
    joints = [n for n in names if not n.endswith((".velocity", ".activation"))]
    columns = {names[i]: c for c, i in enumerate(grid.windows.outputs)}
    motion = [_motion(x, y, columns, joints) for x in (mean, y)]
    constants = _posterior_constants(system, posterior, int(configuration[0]))
    dt = float(time[0, 1] - time[0, 0])
    about, arrays = _drawing(machine, constants, motion, dt)
    if not about:
        return {}, {}
    several = system.variants
    if several:
        title = f"{title}; the machine {several[configuration[0]].name}"
    unseen = [n for n in joints if n not in columns]
    if unseen:
        title = f"{title}; {', '.join(unseen)} was not measured and is drawn at zero"
    actions = [c.name for c in system.actions][:2]
    each = list(zip(grid.log[which], time, strict=True))
    held = np.concatenate([_held_inputs(logs[k], t, system)[:, :2] for k, t in each])
    marks = [
        {"time": n * dt * len(t), "text": f"{logs[k].name}, from {t[0]:.1f} s"}
        for n, (k, t) in enumerate(each)
    ]
    units = {c.name: c.unit for c in (*system.physical_states, *system.actions)}
    about |= {
        "dt": dt,
        "title": title,
        "marks": marks,
        "strips": _strips(joints, motion[1], units),
        "inputs": [[n, units[n] if units[n] != "1" else ""] for n in actions],
    }
    return about, arrays | {
        "animation/state": motion[0].astype(np.float32),
        "animation/recorded": motion[1].astype(np.float32),
        "animation/action": held.astype(np.float32),
    }


def _held_inputs(
    log: Log, time: Float[np.ndarray, " T"], system: AbstractSystem
) -> Float[np.ndarray, "T m"]:
    """The inputs of a log at some times."""
    given = log.commanded([c.name for c in system.actions])
    rows = np.searchsorted(log.time, time + 1e-9, side="right") - 1
    held: np.ndarray = given[rows]
    return held


@in_float64
def _posterior_constants(
    system: AbstractSystem, posterior: Gaussian, configuration: int
) -> dict[str, float]:
    values = system.values(np.asarray(posterior.mean, float), configuration)
    return {name: float(value) for name, value in values.items()}


def _motion(
    x: Float[np.ndarray, "W R c"],
    y: Float[np.ndarray, "W R c"],
    columns: dict[str, int],
    joints: Sequence[str],
) -> Float[np.ndarray, "T q"]:
    """Joint positions of all windows in a row; what was not measured is bridged."""
    flat = np.zeros((x.shape[0] * x.shape[1], len(joints)))
    for j, name in enumerate(joints):
        if name in columns:
            values = x[..., columns[name]].ravel()
            good = np.isfinite(values)
            if good.any():
                at = np.arange(len(values))
                flat[:, j] = np.interp(at, at[good], values[good])
    return flat


def _drawing(
    machine: Any, values: dict[str, float], motion: list[np.ndarray], dt: float
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """How the machine looks: a scene of the report's own, or a stick figure."""
    for kind, name in _BUNDLED:
        if isinstance(machine, kind):
            params = {n: v for n, v in values.items() if "." not in n}
            for field in ("gravity", "length1"):
                if hasattr(machine, field):
                    params.setdefault(field, float(getattr(machine, field)))
            params.setdefault("length1", params.get("l1", 0.5))
            params.setdefault("length2", params.get("l2", 0.8 * params["length1"]))
            return {"system": name, "params": params}, {}
    if not isinstance(machine, MuJoCo):
        return {}, {}
    from sim2gp.reports.skeleton import figure_entry, skeleton
    from sim2gp.systems.mujoco.figure import figure_of

    theta = np.asarray([values[name] for name in machine.names])
    model = machine.engine.with_values(theta)
    figure = figure_of(model, np.concatenate(motion))
    points = figure.moving.astype(np.float32)
    half = len(motion[0])
    entry = figure_entry(figure)
    frames = _rendered_frames(model, motion, skeleton(entry, points), round(FRAME / dt))
    return {"system": "figure", "figure": entry} | frames[0], {
        "animation/points": points[:half],
        "animation/recorded_points": points[half:],
        **frames[1],
    }


def _rendered_frames(
    model: Any, motion: list[np.ndarray], scene: "Scene", least: int
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """MuJoCo's own pictures, seen as the stick figure is; empty where it has none.

    One each ``least`` rows, or fewer if they would be too many.
    """
    from sim2gp.systems.mujoco.film import MOST, render_motion

    every = max(1, least, -(-len(motion[0]) // MOST))
    width, height = scene.width * 3 // 4, scene.height * 3 // 4
    camera = scene.camera
    found = render_motion(
        model,
        motion[1][::every],
        motion[0][::every],
        lookat=np.asarray(camera.target),
        view=(
            math.degrees(camera.azimuth) + 180.0,
            -math.degrees(camera.elevation),
            camera.distance,
            2.0 * math.degrees(math.atan(0.5 * scene.height / camera.focal)),
        ),
        size=(width, height),
    )
    if not found:
        return {}, {}
    return {"frames": {"every": every, "width": width, "height": height}}, {
        "animation/frames": np.frombuffer(b"".join(found), np.uint8),
        "animation/frame_ends": np.cumsum([len(frame) for frame in found]),
    }


def _strips(
    joints: Sequence[str], motion: np.ndarray, units: dict[str, str]
) -> list[list[Any]]:
    """The joints that move most, in their order: row, name, unit, factor."""
    far = np.argsort(-np.ptp(motion, axis=0))[:_STRIPS]
    found = []
    for j in sorted(far.tolist()):
        turns = units[joints[j]] == "rad"
        unit, factor = ("deg", 180.0 / np.pi) if turns else (units[joints[j]], 1.0)
        found.append([j, joints[j], unit, float(factor)])
    return found
