"""A recorded run of a machine as a moving picture: on the page and as a GIF.

On the page the first frame is an SVG that needs no script; with scripts its shapes
move (player.js). The GIF is drawn by Pillow from the same scene.
"""

import io
import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from markupsafe import Markup, escape

from sim2gp.reports import frames, svg
from sim2gp.reports.parameters import Arrays, Section
from sim2gp.reports.scenes import Scene, Shape, keep_frames, project, scene_of
from sim2gp.reports.skeleton import overlay_motion, skeleton

_MOST_FRAMES = 1500
_MOST_POINTS = 40_000  # of all frames: some 700 kB
_SLOWEST = 0.02  # s between frames; the player interpolates
_GRAIN = 1e-4  # m; the resolution of the positions on the page
_TRAIL_SECONDS = 0.6
#: The light palette of page.css, for pictures that have no style sheet.
_INK = {
    "floor": "#eceff2", "shadow": "#c9ced5", "steel": "#6b7683", "hub": "#343b43",
    "steel-top": "#98a2ae", "steel-side": "#58626e", "red": "#d55e00",
    "blue": "#0072b2", "quiet": "#8b949e", "ghost": "#c3c9d0",
}  # fmt: skip

States = Float[np.ndarray, "T n"]


def _front(corners: np.ndarray) -> bool:
    (ax, ay), (bx, by), (cx, cy) = corners[:3]
    return bool((bx - ax) * (cy - ay) - (by - ay) * (cx - ax) < 0)


def _ordered(scene: Scene, depth: np.ndarray) -> list[tuple[int, Shape]]:
    """The shapes from the back to the front, with their numbers."""
    return sorted(
        enumerate(scene.shapes),
        key=lambda item: (item[1].layer, -depth[item[1].anchor], item[0]),
    )


def _body(index: int, shape: Shape, seen: np.ndarray, scale: np.ndarray) -> str:
    """One shape of the still picture."""
    corners = " ".join(f"{u:.1f},{v:.1f}" for u, v in seen)
    tag = f'data-i="{index}"'
    if shape.kind == "ball":
        return (
            f'<circle {tag} class="f-{shape.colour}" cx="{seen[0, 0]:.1f}" '
            f'cy="{seen[0, 1]:.1f}" r="{shape.size * scale[0]:.1f}"/>'
        )
    if shape.kind == "rod":
        width = shape.size * float(scale.mean())
        return (
            f'<polyline {tag} class="rod s-{shape.colour}" '
            f'stroke-width="{width:.1f}" points="{corners}"/>'
        )
    if shape.kind == "trail":
        return f'<polyline {tag} class="trail" points="{corners}"/>'
    hidden = shape.cull and not _front(seen)
    style = ' style="display:none"' if hidden else ""
    return f'<polygon {tag} class="f-{shape.colour}"{style} points="{corners}"/>'


def _still(scene: Scene, title: str, words: str) -> Markup:
    """The first frame as SVG."""
    pixels, depth = project(scene, scene.points(0))
    bodies = "".join(
        _body(
            index,
            shape,
            pixels[list(shape.points)],
            scene.camera.focal / depth[list(shape.points)],
        )
        for index, shape in _ordered(scene, depth)
    )
    label = f"{title}: {words}" if words else f"{title}: a drawing of the machine"
    return Markup(
        f'<svg class="stage" viewBox="0 0 {scene.width} {scene.height}" role="img" '
        f'aria-label="{escape(label)}"><g class="bodies">{bodies}</g>'
        f'<text class="said" x="16" y="28">{escape(words)}</text></svg>'
    )


def _film(
    scene: Scene, dt: float, marks: Sequence[tuple[float, str]], starts: list[int]
) -> str:
    """What the player needs to know, as JSON that is safe inside a script element."""
    count = len(scene.moving)
    camera = scene.camera
    film = {
        "dt": dt,
        "grain": _GRAIN,
        "width": scene.width,
        "height": scene.height,
        "trail": round(_TRAIL_SECONDS / dt),
        "camera": {
            "target": camera.target,
            "azimuth": round(camera.azimuth, 6),
            "elevation": round(camera.elevation, 6),
            "distance": round(camera.distance, 6),
            "focal": round(camera.focal, 6),
            "turns": camera.turns,
        },
        "shapes": [
            {
                "kind": shape.kind,
                "points": shape.points,
                "size": round(shape.size, 6),
                "layer": shape.layer,
                "anchor": shape.anchor,
                "cull": shape.cull,
            }
            for shape in scene.shapes
        ],
        "fixed": np.round(scene.fixed, 5).tolist(),
        "moving": np.rint(scene.moving / _GRAIN)
        .astype(int)
        .reshape(count, -1)
        .tolist(),
        "marks": [list(mark) for mark in marks],
        "starts": starts,
    }
    return json.dumps(film, separators=(",", ":")).replace("<", "\\u003c")


def _strip(
    time: np.ndarray,
    values: np.ndarray,
    name: str,
    unit: str,
    starts: list[int],
    recorded: np.ndarray | None = None,
) -> Markup:
    """One signal against time with the cursor that follows the player."""
    lines = np.array(values, dtype=float)
    lines[[s for s in starts if 0 < s < len(lines)]] = np.nan
    low, high = svg.span(values, *([] if recorded is None else [recorded]))
    axes = svg.Axes(
        (0.0, max(float(time[-1]), 1e-9)), (low, high), 400.0, 112.0, x_label="s"
    )
    marks = []
    if unit == "deg" and name.startswith("p"):
        # Upright is the same pose at every odd number of half turns.
        turns = range(math.ceil(low / 180), math.floor(high / 180) + 1)
        for turn in turns if len(turns) < 8 else ():  # a spinning pole passes many
            if turn % 2:
                marks.append(svg.level(axes, 180.0 * turn, "quiet", "upright"))
    if recorded is not None:
        marks.append(svg.line(axes, time, recorded, "quiet"))
    marks.append(svg.line(axes, time, lines, "c0" if recorded is None else "c1"))
    css = "c1" if recorded is None else "truth"
    marks.append(
        f'<line class="rule {css} cursor" x1="0" x2="0" y1="0" y2="{axes.size[1]:.1f}" '
        f'data-width="{axes.size[0]:.1f}"/>'
    )
    said = f"{svg.extent(values)}, time {svg.extent(time, 's')}"
    return svg.chart(axes, marks, title=name, said=said, unit=unit)


def _frame_rows(count: int, dt: float, points: int) -> np.ndarray:
    """Which rows are shown: no finer than needed, never too many."""
    most = min(_MOST_FRAMES, max(_MOST_POINTS // max(points, 1), 2))
    stride = max(1, math.floor(_SLOWEST / dt + 1e-9), math.ceil(count / most))
    return np.arange(0, count, stride)


def _marks(about: Mapping[str, Any]) -> list[tuple[float, str]]:
    """The captions of the film: pairs of the time they start (s) and their words."""
    return [
        (float(mark["time"]), str(mark["text"])) for mark in about.get("marks") or ()
    ]


def _scene(about: Mapping[str, Any], arrays: Arrays) -> tuple[Scene, Scene | None]:
    """The machine, and the machine as it was recorded where that is known."""

    def scene(kind: str) -> Scene:
        if "figure" in about:
            points = "points" if kind == "state" else f"{kind}_points"
            return skeleton(about["figure"], arrays[f"animation/{points}"])
        return scene_of(about, arrays[f"animation/{kind}"])

    both = "animation/recorded" in arrays
    return scene("state"), scene("recorded") if both else None


def _signals(
    about: Mapping[str, Any], scene: Scene, arrays: Arrays, starts: list[int]
) -> list[Markup]:
    """Positions, over what was recorded, then inputs."""
    state = np.asarray(arrays["animation/state"], dtype=float)
    recorded, action = arrays.get("animation/recorded"), arrays.get("animation/action")
    time = float(about["dt"]) * np.arange(len(state))
    stated = [
        (int(r), str(n), str(u), float(f)) for r, n, u, f in about.get("strips") or ()
    ]
    strips = [
        _strip(
            time, factor * state[:, row], name, unit, starts,
            None if recorded is None else factor * recorded[:, row],
        )
        for row, name, unit, factor in stated or scene.strips
    ]  # fmt: skip
    inputs = [(str(n), str(u)) for n, u in about.get("inputs") or scene.inputs]
    for column, (name, unit) in enumerate(inputs):
        if action is not None and action.ndim == 2 and column < action.shape[1]:
            held = np.asarray(action[: len(state), column], dtype=float)
            strips.append(_strip(time[: len(held)], held, name, unit, starts))
    return strips


def player(about: Mapping[str, Any], arrays: Arrays) -> Section:
    """The machine on the page: a picture that plays, and its signals below.

    `about` is the summary's entry "animation": dt (s), title, optional marks (a list of
    {time, text}) where a new episode starts, and either system and params or a stick
    figure. `arrays` are the run's: ``animation/state``, and of a forecast the
    ``recorded`` motion.
    """
    dt = float(about["dt"])
    scene, other = _scene(about, arrays)
    count = len(scene.moving)
    if other is not None:
        scene = overlay_motion(scene, other.moving)
    index = _frame_rows(count, dt, scene.moving.shape[1])
    stride = int(index[1] - index[0]) if len(index) > 1 else 1
    marks = _marks(about)
    rows = sorted({round(time / dt) for time, _ in marks} - {0})
    strips = _signals(about, scene, arrays, rows)
    title = str(about.get("title") or "The machine")
    scene = keep_frames(scene, index)
    film = _film(scene, dt * stride, marks, [math.ceil(r / stride) for r in rows])
    film = film[:-1] + frames.pictures(about, arrays) + "}"
    words = marks[0][1] if marks and marks[0][0] <= 0 else ""
    size = about.get("frames")
    return {
        "title": title,
        "still": _still(scene, title, words),
        "film": Markup(film),
        "canvas": {k: int(size[k]) for k in ("width", "height")} if size else None,
        "turns": scene.camera.turns,
        "recorded": other is not None,
        "strips": strips,
    }


def _paint(scene: Scene, frame: int, trail: range, words: str, grain: int) -> Any:
    """One frame as a Pillow image, drawn `grain` times too large and shrunk."""
    from PIL import Image, ImageDraw, ImageFont

    size = (scene.width * grain, scene.height * grain)
    image = Image.new("RGB", size, "#ffffff")
    pen = ImageDraw.Draw(image)
    pixels, depth = project(scene, scene.points(frame))

    def disc(at: np.ndarray, radius: float, fill: str) -> None:
        u, v = at * grain
        r = radius * grain
        pen.ellipse((u - r, v - r, u + r, v + r), fill=fill)

    for _, shape in _ordered(scene, depth):
        index = list(shape.points)
        seen, scale = pixels[index], scene.camera.focal / depth[index]
        fill = _INK[shape.colour]
        if shape.kind == "ball":
            disc(seen[0], shape.size * float(scale[0]), fill)
        elif shape.kind == "face":
            if not shape.cull or _front(seen):
                pen.polygon([tuple(p) for p in seen * grain], fill=fill)
        elif shape.kind == "rod":
            width = shape.size * float(scale.mean())
            path = [tuple(p) for p in seen * grain]
            pen.line(path, fill=fill, width=max(1, round(width * grain)))
            for end in seen:
                disc(end, width / 2, fill)
        else:
            _paint_trail(pen, scene, shape, trail, grain)
    image = image.resize((scene.width, scene.height), Image.Resampling.LANCZOS)
    if words:
        font = ImageFont.load_default(max(12, scene.width // 32))
        ImageDraw.Draw(image).text((14, 10), words, fill="#1b1f24", font=font)
    return image


def _paint_trail(
    pen: Any, scene: Scene, shape: Shape, trail: range, grain: int
) -> None:
    """The path of the tip, fading into the past."""
    row = shape.points[0] - len(scene.fixed)
    if len(trail) < 2:
        return
    path = project(scene, scene.moving[list(trail), row])[0] * grain
    for age in range(1, len(path)):
        mix = age / len(path)
        tone = [round(255 + (c - 255) * 0.6 * mix) for c in (0xD5, 0x5E, 0x00)]
        pen.line(
            [tuple(path[age - 1]), tuple(path[age])], fill=tuple(tone), width=2 * grain
        )


def _shrink_scene(scene: Scene, width: int) -> Scene:
    """The same picture, `width` pixels wide."""
    from dataclasses import replace

    ratio = width / scene.width
    camera = replace(scene.camera, focal=scene.camera.focal * ratio)
    return replace(
        scene, camera=camera, width=width, height=round(scene.height * ratio)
    )


def _palette(image: Any) -> Any:
    """The colours of one image, with paper that is exactly white."""
    palette = image.quantize(64, dither=0)
    colours = np.asarray(palette.getpalette()).reshape(-1, 3)
    colours[np.argmax(colours.sum(axis=1))] = 255
    palette.putpalette(colours.ravel().tolist())
    return palette


def _rows_of_gif(count: int, dt: float, fps: float) -> np.ndarray:
    stride = max(1, round(1.0 / (fps * dt)))
    return np.arange(0, count, stride)


def animation_gif(
    about: Mapping[str, Any], state: States, *, width: int = 480, fps: float = 25.0
) -> bytes:
    """The film as a GIF that loops; `about` as in `player`, `fps` frames a second."""
    state = np.asarray(state, dtype=float)
    dt = float(about["dt"])
    scene = _shrink_scene(scene_of(about, state), width)
    marks = _marks(about)
    rows = _rows_of_gif(len(state), dt, fps)
    step = int(rows[1] - rows[0]) if len(rows) > 1 else 1
    images = []
    for row in rows:
        past = [m for m in marks if m[0] <= row * dt + 1e-9]
        start = round(past[-1][0] / dt) if past else 0
        first = max(start, int(row) - round(_TRAIL_SECONDS / dt))
        words = past[-1][1] if past else str(about.get("title") or "")
        images.append(_paint(scene, int(row), range(first, int(row) + 1), words, 2))
    # One palette for all frames, or the colours flicker.
    palette = _palette(images[len(images) // 2])
    frames = [image.quantize(palette=palette, dither=0) for image in images]
    file = io.BytesIO()
    frames[0].save(
        file,
        format="GIF",
        save_all=True,
        append_images=frames[1:],
        duration=[round(1000 * step * dt)] * (len(frames) - 1) + [1200],
        loop=0,
        optimize=False,
        disposal=1,
    )
    return file.getvalue()


def animation_png(
    about: Mapping[str, Any], state: States, *, row: int = 0, width: int = 640
) -> bytes:
    """One moment of the film as a PNG, with the path of the tip before it."""
    state = np.asarray(state, dtype=float)
    row = row % len(state)
    scene = _shrink_scene(scene_of(about, state), width)
    first = max(0, row - round(_TRAIL_SECONDS / float(about["dt"])))
    file = io.BytesIO()
    _paint(scene, row, range(first, row + 1), "", 3).save(file, format="PNG")
    return file.getvalue()
