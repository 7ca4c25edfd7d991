"""A recorded motion and its forecast as MuJoCo shows them, where it can draw.

A child process draws, so that a driver that crashes, hangs or complains is nobody's
trouble: then there are no pictures. ``MUJOCO_GL`` names the back end, as it does for
MuJoCo itself; ``MUJOCO_GL=disable`` draws nothing.
"""

import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from sim2gp.cleanup import temporary_folder
from sim2gp.systems.mujoco.load import in_child

MOST = 125  # frames
BYTES = 500_000  # of all of them
SECONDS = 60
_OFF = ("disable", "disabled", "off", "false", "0")
_CHILD = os.path.join(os.path.dirname(__file__), "render.py")


def backends(environment: Mapping[str, str], platform: str) -> list[str]:
    """What to try, in this order; "" is MuJoCo's own choice."""
    asked = environment.get("MUJOCO_GL", "").lower().strip()
    if asked in _OFF:
        return []
    if asked or not platform.startswith("linux"):
        return [asked]
    return ["egl", "osmesa"]


def render_motion(
    model: Any,
    recorded: Float[np.ndarray, "T nq"],
    forecast: Float[np.ndarray, "T nq"],
    *,
    lookat: Float[np.ndarray, "3"],
    view: tuple[float, float, float, float],
    size: tuple[int, int],
) -> list[bytes]:
    """A WebP picture for each row, the forecast in orange; empty where none can be.

    ``view`` is azimuth, elevation (degrees, as MuJoCo has them), distance in m and
    field of view in degrees.
    """
    import mujoco

    for backend in backends(os.environ, sys.platform):
        with temporary_folder() as folder:
            place = Path(folder)
            mujoco.mj_saveModel(model, str(place / "model.mjb"))
            np.savez(
                place / "motion.npz",
                recorded=recorded,
                forecast=forecast,
                lookat=lookat,
                view=np.asarray((*view, *size, BYTES), float),
            )
            environment = dict(os.environ) | ({"MUJOCO_GL": backend} if backend else {})
            done = in_child(_CHILD, [folder], folder, SECONDS, environment)
            files = [place / f"{i}.webp" for i in range(len(recorded))]
            if done is None:  # a machine that is too slow is so with any of them
                return []
            if done.returncode == 0 and files[-1].exists():
                return [file.read_bytes() for file in files]
    return []
