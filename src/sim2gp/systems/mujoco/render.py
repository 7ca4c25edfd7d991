"""The child process that renders a motion with MuJoCo: run as a script, in isolation.

    python -I render.py FOLDER

FOLDER holds ``model.mjb`` and ``motion.npz``: joint positions ``recorded`` and
``forecast``, ``lookat``, and ``view`` (azimuth and elevation in degrees, distance,
field of view in degrees, width, height, bytes). The frames become ``0.webp`` and so on.
A graphics driver that crashes ends this process and no other. This file imports nothing
of sim2gp.
"""

import io
import os
import sys
from typing import Any

import numpy as np
from PIL import Image

QUALITIES = (60, 30)  # of the pictures; the second if the first are too heavy
FORECAST = (0.84, 0.37, 0.0, 0.5)  # the colour of the forecast's machine
LARGER = 1.03  # than the recorded one: the same surface twice would flicker


def camera_of(x: Any) -> Any:
    """MuJoCo's camera, that looks where the stick figure's does."""
    import mujoco

    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.lookat[:] = x["lookat"]
    camera.azimuth, camera.elevation, camera.distance = x["view"][:3]
    return camera


def prepare_view(model: Any, view: Any) -> None:
    """Field of view, size of the picture, and a clipping plane behind the machine."""
    model.vis.global_.fovy = view[3]
    model.vis.global_.offwidth, model.vis.global_.offheight = int(view[4]), int(view[5])
    model.vis.map.zfar = max(model.vis.map.zfar, 3.0 * view[2] / model.stat.extent)
    model.vis.map.znear = 0.05 * view[2] / model.stat.extent
    light = model.vis.headlight
    light.ambient[:] = np.maximum(light.ambient, 0.4)
    light.diffuse[:] = np.maximum(light.diffuse, 0.6)


def render_picture(renderer: Any, sky: bool) -> Any:
    """The picture, transparent where there is nothing (without a sky that is black)."""
    colours = renderer.render()
    if sky:
        return Image.fromarray(colours)
    renderer.enable_segmentation_rendering()
    some = renderer.render()[..., 0] >= 0
    renderer.disable_segmentation_rendering()
    solid = (255 * some).astype(np.uint8)
    return Image.fromarray(np.concatenate([colours, solid[..., None]], axis=-1))


def render_frames(folder: str) -> int:
    """Render every frame; returns the exit code."""
    import mujoco

    mujoco.set_mju_user_warning(lambda _: None)
    model = mujoco.MjModel.from_binary_path(os.path.join(folder, "model.mjb"))
    with np.load(os.path.join(folder, "motion.npz")) as stored:
        x = {name: stored[name] for name in stored.files}
    sky = bool(np.any(model.tex_type == int(mujoco.mjtTexture.mjTEXTURE_SKYBOX)))
    view, options, pert = x["view"], mujoco.MjvOption(), mujoco.MjvPerturb()
    prepare_view(model, view)
    first, second = mujoco.MjData(model), mujoco.MjData(model)
    images, camera = [], camera_of(x)
    with mujoco.Renderer(model, int(view[5]), int(view[4])) as renderer:
        for recorded, forecast in zip(x["recorded"], x["forecast"], strict=True):
            first.qpos[:], second.qpos[:] = recorded, forecast
            mujoco.mj_forward(model, first)
            mujoco.mj_forward(model, second)
            renderer.update_scene(first, camera, options)
            scene = renderer.scene
            count, moving = scene.ngeom, mujoco.mjtCatBit.mjCAT_DYNAMIC
            mujoco.mjv_addGeoms(model, second, options, pert, moving, scene)
            for geom in scene.geoms[count : scene.ngeom]:
                geom.rgba[:], geom.matid = FORECAST, -1
                geom.size[:] *= LARGER
            images.append(render_picture(renderer, sky))
    for quality in QUALITIES:
        files = []
        for image in images:
            file = io.BytesIO()
            image.save(file, format="WEBP", quality=quality)
            files.append(file.getvalue())
        if sum(map(len, files)) <= view[6]:
            break
    for i, content in enumerate(files):
        with open(os.path.join(folder, f"{i}.webp"), "wb") as out:
            out.write(content)
    return 0


if __name__ == "__main__":
    raise SystemExit(render_frames(*sys.argv[1:]))
