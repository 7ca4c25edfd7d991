"""Stick figures: posed as closed forms say, seen in the plane they move in."""

import base64
import io
import json

import numpy as np
import pytest
from PIL import Image

from report_example import a_film
from sim2gp import reports as report
from sim2gp.reports import scenes
from sim2gp.reports.skeleton import camera_for, figure_entry, overlay_motion, skeleton

ARM = """
<mujoco><worldbody>
  <body name="column" pos="0 0 .5"><geom type="box" size=".02 .02 .2"/>
  <body name="upper">
    <joint name="shoulder" axis="0 -1 0"/>
    <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.4" mass="1"/>
    <body name="lower" pos="0 0 -.4">
      <joint name="elbow" axis="0 -1 0"/>
      <geom type="capsule" size=".01" fromto="0 0 0 0 0 -.3" mass=".5"/>
    </body>
  </body></body>
</worldbody></mujoco>"""
CART = """
<mujoco><worldbody><body name="cart" pos="0 0 .1">
  <joint name="x" type="slide" axis="1 0 0" limited="true" range="-.5 .5"/>
  <geom type="box" size=".1 .06 .04" mass="1"/>
  <body name="pole"><joint name="theta" axis="0 -1 0"/>
    <geom type="box" size=".01 .01 .2" pos="0 0 -.2" mass=".2"/></body>
</body></worldbody></mujoco>"""


SPATIAL = """
<mujoco><worldbody><body name="turret">
  <joint name="yaw" axis="0 0 1"/>
  <geom type="capsule" size=".03" fromto="0 0 0 0 0 .2" mass="1"/>
  <body name="upper" pos="0 0 .2"><joint name="shoulder" axis="0 1 0"/>
    <geom type="capsule" size=".02" fromto="0 0 0 .4 0 0" mass="1"/></body>
</body></worldbody></mujoco>"""


def swing(count: int = 40) -> np.ndarray:
    """Two positions that go their own ways."""
    t = np.linspace(0.0, 6.0, count)
    return np.stack([np.sin(t), 0.8 * np.cos(1.7 * t)], axis=1)


def test_an_arm_is_posed_as_its_closed_form_says() -> None:
    mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is absent")
    from sim2gp.systems.mujoco.figure import figure_of

    q = swing()
    figure = figure_of(mujoco.MjModel.from_xml_string(ARM), q)
    elbow, tip = scenes.two_link_points(q, (0.4, 0.31), vertical=True)
    base = np.array([0.0, 0.5])
    shown = figure.moving[:, :, [0, 2]]  # shoulder, elbow, end of the capsule
    np.testing.assert_allclose(shown[:, 0], np.broadcast_to(base, (40, 2)), atol=1e-9)
    np.testing.assert_allclose(shown[:, 1], elbow + base, atol=1e-9)
    np.testing.assert_allclose(shown[:, 2], tip + base, atol=1e-9)
    np.testing.assert_allclose(figure.moving[:, :, 1], 0.0, atol=1e-9)
    n = len(figure.fixed)
    bones = {(a - n, b - n, part) for a, b, part in figure.rods if a >= n}
    assert bones == {(0, 1, "link"), (1, 2, "tip")}
    assert (0, n, "link") in figure.rods  # from the column to the shoulder


def test_a_cart_slides_on_its_rail() -> None:
    mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is absent")
    from sim2gp.systems.mujoco.figure import figure_of

    q = swing() * [0.4, 1.0]
    figure = figure_of(mujoco.MjModel.from_xml_string(CART), q)
    cart, pivot, tip = np.moveaxis(figure.moving, 1, 0)
    np.testing.assert_allclose(cart[:, 0], q[:, 0], atol=1e-12)
    np.testing.assert_allclose(pivot, cart, atol=1e-12)
    away = 0.4 * np.stack([np.sin(q[:, 1]), 0 * q[:, 1], -np.cos(q[:, 1])], axis=1)
    np.testing.assert_allclose(tip - pivot, away, atol=1e-9)
    rail = next(rod for rod in figure.rods if rod[2] == "rail")
    np.testing.assert_allclose(
        figure.fixed[list(rail[:2])], [[-0.5, 0, 0.1], [0.5, 0, 0.1]], atol=1e-9
    )


def turned(normal: np.ndarray) -> np.ndarray:
    """A circle about the origin in the plane with this normal, (T, 2, 3)."""
    t = np.linspace(0.0, 2 * np.pi, 60)
    one = np.linalg.svd(normal[None])[2][1:]
    around = np.cos(t)[:, None] * one[0] + np.sin(t)[:, None] * one[1]
    return np.stack([0.0 * around, around], axis=1)


@pytest.mark.parametrize(
    "normal", [(0, 1, 0), (1, 0, 0), (0, 0, 1), (1, 2, 0), (1, -1, 0.4), (0, -1, 1e-9)]
)
def test_a_plane_is_seen_at_a_right_angle(normal: tuple[float, ...]) -> None:
    """Oracle: a circle is round only from there."""
    circle = turned(np.asarray(normal, float))
    about = {"fixed": [], "rods": [[0, 1, "tip"]], "balls": []}
    scene = skeleton(about, circle)
    assert not scene.camera.turns
    pixels, _ = scenes.project(scene, circle[:, 1])
    middle, _ = scenes.project(scene, np.zeros((1, 3)))
    radius = np.linalg.norm(pixels - middle, axis=1)
    np.testing.assert_allclose(radius / radius[0], 1.0, atol=2e-3)
    assert pixels.min() > 20
    assert (pixels < [scene.width - 20, scene.height - 20]).all()
    up, _ = scenes.project(scene, np.array([[0.0, 0.0, 1.0]]))
    assert normal[2] > 0.5 or up[0, 1] < middle[0, 1] - 5  # what is up stays up


@pytest.mark.parametrize("normal", [(1, -1, 0.4), (1, 1, 1), (0.2, 1, -0.3)])
def test_half_a_circle_stands_in_the_middle(normal: tuple[float, ...]) -> None:
    half = turned(np.asarray(normal, float))[:24, 1:]
    scene = skeleton({"fixed": [], "rods": [], "balls": [[0, "tip"]]}, half)
    pixels, _ = scenes.project(scene, half[:, 0])
    middle = 0.5 * (pixels.min(axis=0) + pixels.max(axis=0))
    np.testing.assert_allclose(middle, [scene.width / 2, scene.height / 2], atol=6)


def test_what_moves_in_space_is_seen_from_above_and_can_be_turned() -> None:
    t = np.linspace(0.0, 6.0, 50)
    path = np.stack([np.cos(t), 0.7 * np.sin(t), 0.4 * np.cos(2.3 * t)], axis=1)
    moving = np.stack([0 * path, path], axis=1)
    camera, height = camera_for(np.zeros((0, 3)), moving)
    assert camera.turns
    assert 0.2 < camera.elevation < 0.6
    scene = scenes.Scene((), np.zeros((0, 3)), moving, camera, 640, height)
    pixels, depth = scenes.project(scene, moving.reshape(-1, 3))
    assert pixels.min() > 0
    assert (pixels < [640, height]).all()
    assert depth.min() > 0


@pytest.mark.parametrize("axis", [0, 2])
def test_what_moves_along_a_line_is_seen_from_its_side(axis: int) -> None:
    path = np.zeros((20, 1, 3))
    path[:, 0, axis] = np.linspace(0.0, 1.0, 20)
    scene = skeleton({"fixed": [], "rods": [], "balls": [[0, "tip"]]}, path)
    pixels, _ = scenes.project(scene, path[:, 0])
    assert np.ptp(pixels, axis=0)[axis // 2] > 300 - 100 * (axis // 2)
    still = skeleton({"fixed": [], "rods": [], "balls": [[0, "tip"]]}, 0 * path)
    assert np.isfinite(scenes.project(still, path[0])[0]).all()


def test_the_recorded_machine_is_a_pale_shadow_of_its_own_points() -> None:
    summary, arrays = a_film()
    about = summary["animation"]["figure"]
    about = about | {"rods": [*about["rods"], [0, 2, "link"]]}  # from the base
    scene = skeleton(about, arrays["animation/points"])
    both = overlay_motion(scene, arrays["animation/recorded_points"])
    assert both.moving.shape[1] == 6
    ghosts = [shape for shape in both.shapes if shape.colour == "ghost"]
    rods, balls = {(4, 5), (5, 6), (0, 5)}, {(4,), (5,), (6,)}
    assert {shape.points for shape in ghosts} == rods | balls
    lowest = min(shape.layer for shape in both.shapes if shape.colour == "blue")
    assert all(shape.layer < lowest for shape in ghosts)
    np.testing.assert_array_equal(
        both.points(7)[4:], arrays["animation/recorded_points"][7]
    )


@pytest.mark.parametrize("system", ["furuta", "cartpole", "two_link"])
def test_bundled_machines_have_a_shadow_too(system: str) -> None:
    state = np.concatenate([swing(), swing()], axis=1)
    scene = scenes.scene_of({"system": system}, state)
    other = scenes.scene_of({"system": system}, state + 0.1)
    both = overlay_motion(scene, other.moving)
    count = scene.moving.shape[1]
    first = len(scene.fixed) + count
    ghosts = [shape for shape in both.shapes if shape.colour == "ghost"]
    assert ghosts
    assert all(max(shape.points) >= first for shape in ghosts)
    assert not any(shape.kind == "trail" for shape in both.shapes)


def film_of(text: str) -> dict[str, object]:
    """What the page tells its player."""
    inside = text.split('<script type="application/json">')[1].split("</script>")[0]
    found: dict[str, object] = json.loads(inside)
    return found


def test_the_page_plays_the_forecast_over_the_recording() -> None:
    summary, arrays = a_film()
    text = report.write_report(summary, arrays)
    film = film_of(text)
    both = [arrays["animation/points"], arrays["animation/recorded_points"]]
    moving = np.array(film["moving"]).reshape(-1, 6, 3) * 1e-4
    np.testing.assert_allclose(moving, np.concatenate(both, axis=1)[::2], atol=6e-5)
    assert film["starts"] == [25]
    assert ">recorded</span>" in text
    for name in ("shoulder", "elbow", "shoulder_motor"):
        assert f'aria-label="{name}' in text
    frames = [base64.b64decode(code) for code in film["frames"]]
    assert b"".join(frames) == arrays["animation/frames"].tobytes()
    assert all(frame[8:12] == b"WEBP" for frame in frames)
    assert film["apart"] == 0.25
    plain = report.write_report(*a_film(pictures=False))
    assert "frames" not in film_of(plain)
    assert "<canvas" not in plain


def test_a_large_figure_does_not_make_a_heavy_page() -> None:
    """Sixty bones over ten seconds."""
    summary, arrays = a_film(pictures=False)
    rng = np.random.default_rng(2)
    rods = [[k, k + 1, "link"] for k in range(60)]
    figure = {"fixed": [], "rods": rods, "balls": [[k, "link"] for k in range(61)]}
    summary["animation"] = summary["animation"] | {"figure": figure, "marks": []}
    for name in ("points", "recorded_points"):
        arrays[f"animation/{name}"] = rng.standard_normal((1000, 61, 3))
    for name in ("state", "recorded"):
        arrays[f"animation/{name}"] = rng.standard_normal((1000, 2))
    assert len(report.write_report(summary, arrays)) < 3_000_000


def test_an_entry_of_a_summary_is_plain() -> None:
    mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is absent")
    from sim2gp.systems.mujoco.figure import figure_of

    figure = figure_of(mujoco.MjModel.from_xml_string(CART), swing())
    entry = json.loads(json.dumps(figure_entry(figure)))
    scene = skeleton(entry, figure.moving)
    assert len(scene.shapes) == len(figure.rods) + len(figure.balls)
    assert not scene.camera.turns
    assert scene.camera.elevation == pytest.approx(0.0, abs=1e-9)


def test_no_back_end_is_no_picture_and_no_noise(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is absent")
    from sim2gp.systems.mujoco.film import backends, render_motion

    assert backends({}, "linux") == ["egl", "osmesa"]
    assert backends({}, "darwin") == [""]
    assert backends({"MUJOCO_GL": "OSMesa"}, "linux") == ["osmesa"]
    assert backends({"MUJOCO_GL": "disable"}, "linux") == []
    model = mujoco.MjModel.from_xml_string(CART)
    for name in ("disable", "nonsense"):  # nothing is tried; a child that fails
        monkeypatch.setenv("MUJOCO_GL", name)
        found = render_motion(
            model, swing(2), swing(2), lookat=np.zeros(3),
            view=(90.0, 0.0, 3.0, 45.0), size=(64, 48),
        )  # fmt: skip
        assert found == []
    assert capfd.readouterr() == ("", "")


@pytest.mark.nightly
@pytest.mark.parametrize("text", [ARM, SPATIAL])
def test_mujoco_sees_the_machine_where_the_figure_is(text: str) -> None:
    """Every joint of the figure lies on the machine that MuJoCo drew."""
    mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is absent")
    from sim2gp.reports.motion import _rendered_frames
    from sim2gp.systems.mujoco.figure import figure_of

    model = mujoco.MjModel.from_xml_string(text)
    q = swing(33)
    figure = figure_of(model, q)
    scene = skeleton(figure_entry(figure), figure.moving)
    about, arrays = _rendered_frames(model, [q + 0.3, q], scene, 8)
    if not about:
        pytest.skip("MuJoCo has no graphics back end here")
    every, size = (
        about["frames"]["every"],
        (scene.width * 3 // 4, scene.height * 3 // 4),
    )
    parts = np.split(arrays["animation/frames"], arrays["animation/frame_ends"][:-1])
    assert len(parts) == len(range(0, len(q), every))
    for k, part in enumerate(parts):
        with Image.open(io.BytesIO(part.tobytes())) as image:
            assert image.size == size
            seen = np.asarray(image.convert("RGBA")).astype(int)
        pixels, _ = scenes.project(scene, figure.moving[k * every])
        for u, v in np.rint(0.75 * pixels).astype(int):
            assert seen[v - 2 : v + 3, u - 2 : u + 3, 3].max() == 255
        orange = (seen[..., 0] > seen[..., 2] + 60) & (seen[..., 3] == 255)
        assert orange.sum() > 200  # the forecast, which is elsewhere
        assert (seen[..., 3] == 255).mean() < 0.5
