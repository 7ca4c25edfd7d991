"""The drawings of a report: densities, axes, machines, films and figure 1."""

import io
import json

import numpy as np
import pytest

from report_example import swing_up, two_data_sets
from sim2gp import reports as report
from sim2gp.reports import densities, scenes, svg


def test_a_density_integrates_its_draws_and_respects_its_bounds() -> None:
    """Oracle: draws of a uniform on [0, 1], whose density is flat up to both ends."""
    draws = (np.arange(20_000) + 0.5) / 20_000
    axis = densities.view([draws], 0.0, 1.0, None)
    assert axis is not None
    assert (axis.low, axis.high, axis.log) == (0.0, 1.0, False)
    at, height = densities.curve(draws, axis)
    assert (at[0], at[-1]) == (0.0, 1.0)
    np.testing.assert_allclose(height, 1.0, atol=0.01)


def test_a_density_of_a_gaussian_has_its_shape() -> None:
    draws = 2.0 + 0.1 * np.random.default_rng(5).standard_normal(200_000)
    axis = densities.view([draws], None, None, 3.0)
    assert axis is not None
    assert axis.low < 1.75
    assert axis.high > 3.0
    at, height = densities.curve(draws, axis)
    exact = np.exp(-0.5 * ((at - 2.0) / 0.1) ** 2)
    np.testing.assert_allclose(height, exact, atol=0.03)


def test_a_box_of_decades_is_drawn_in_decades() -> None:
    draws = 10 ** np.linspace(-6, -3, 1000)
    axis = densities.view([draws], 1e-6, 1e-3, None)
    assert axis is not None
    assert axis.log
    _, height = densities.curve(draws, axis)
    np.testing.assert_allclose(height, 1.0, atol=0.03)
    linear = densities.view([draws], 0.0, 1.0, None)
    assert linear is not None
    assert not linear.log


def test_thinning_keeps_extremes_and_gaps() -> None:
    x = np.arange(10_000.0)
    y = np.sin(x / 500)
    y[1234], y[7777], y[5000] = 9.0, -9.0, np.nan
    thin_x, thin_y = svg.thin(x, y, 300)
    assert thin_x.size <= 300
    assert {1234.0, 7777.0, 5000.0} <= set(thin_x)
    assert np.all(np.diff(thin_x) > 0)
    assert np.isnan(thin_y[thin_x == 5000.0]).all()


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0.0, 1.0, ["0.00", "0.25", "0.50", "0.75", "1.00"]),
        (-3.0, 11.0, ["0", "5", "10"]),
        (0.0, 2e-5, ["0", "5e−06", "1e−05", "1.5e−05", "2e−05"]),
    ],
)
def test_ticks_are_round(low: float, high: float, expected: list[str]) -> None:
    assert [text for _, text in svg.ticks(low, high)] == expected
    assert [text for _, text in svg.log_ticks(2e-4, 0.2)] == ["10⁻³", "10⁻²", "10⁻¹"]


def test_the_furuta_hangs_stands_and_swings_with_its_arm() -> None:
    """Oracles: lengths of arm and rod; M12 = +B cos(alpha), from the tip's speed."""
    state = np.array(
        [[0.3, 0.0, 0, 0], [0.3, np.pi, 0, 0], [0.3, 0.01, 0, 0], [0.31, 0.0, 0, 0]]
    )
    scene = scenes.furuta(state, {"arm_length": 0.1, "pendulum_length": 0.2})
    joint, tip = scene.moving[:, 0], scene.moving[:, 1]
    np.testing.assert_allclose(np.linalg.norm(joint, axis=1), 0.1)
    np.testing.assert_allclose(np.linalg.norm(tip - joint, axis=1), 0.2)
    np.testing.assert_allclose(tip[0] - joint[0], [0, 0, -0.2], atol=1e-12)
    np.testing.assert_allclose(tip[1] - joint[1], [0, 0, 0.2], atol=1e-12)
    by_alpha, by_theta = tip[2] - tip[0], tip[3] - tip[0]
    assert by_alpha @ by_theta > 0


def test_the_other_machines_follow_their_angles() -> None:
    state = np.array([[0.1, 0.0, 0, 0], [0.1, np.pi / 2, 0, 0], [-0.2, np.pi, 0, 0]])
    scene = scenes.cartpole(state, {"pole_half_length": 0.15})
    offset = scene.moving[:, 1] - scene.moving[:, 0]
    expected = [[0, 0, -0.3], [0.3, 0, 0], [0, 0, 0.3]]
    np.testing.assert_allclose(offset, expected, atol=1e-12)
    np.testing.assert_allclose(scene.moving[:, 0, 0], state[:, 0])
    state = np.array([[np.pi / 2, -np.pi / 2, 0, 0]])
    elbow, tip = scenes.two_link_points(state, (0.5, 0.4), vertical=False)
    np.testing.assert_allclose(elbow[0], [0, 0.5], atol=1e-12)
    np.testing.assert_allclose(tip[0], [0.4, 0.5], atol=1e-12)
    hanging = scenes.two_link_points(0 * state, (0.5, 0.4), vertical=True)[1]
    np.testing.assert_allclose(hanging[0], [0, -0.9], atol=1e-12)


@pytest.mark.parametrize("system", sorted(scenes.SCENES))
def test_every_machine_stays_inside_its_picture(system: str) -> None:
    """All poses of the machine, seen from where the camera stands."""
    angle = np.linspace(-np.pi, np.pi, 25)
    first, second = (grid.ravel() for grid in np.meshgrid(angle, angle))
    if system == "cartpole":
        first = first / np.pi * 0.4
    state = np.stack([first, second, 0 * first, 0 * first], axis=1)
    scene = scenes.scene_of({"system": system}, state)
    for frame in range(len(state)):
        pixels, depth = scenes.project(scene, scene.points(frame))
        assert (pixels > 0).all()
        assert (pixels < [scene.width, scene.height]).all()
        assert (depth > 0).all()


def test_the_film_restarts_where_an_episode_starts() -> None:
    summary, arrays = swing_up(2)
    text = report.write_report(summary, arrays)
    film = json.loads(
        text.split('<script type="application/json">')[1].split("</script>")[0]
    )
    assert film["starts"] == [250]
    assert film["marks"] == [[0.0, "episode 1"], [5.0, "episode 2"]]
    assert len(film["moving"]) == 500
    moving = np.array(film["moving"]).reshape(500, -1, 3) * film["grain"]
    scene = scenes.scene_of(summary["animation"], arrays["animation/state"])
    np.testing.assert_allclose(moving, scene.moving, atol=film["grain"])


def test_the_pictures_are_files_and_repeat() -> None:
    from PIL import Image

    summary, arrays = swing_up(1)
    about, state = summary["animation"], arrays["animation/state"][:50]
    gif = report.animation_gif(about, state, width=160)
    assert gif == report.animation_gif(about, state, width=160)
    with Image.open(io.BytesIO(gif)) as image:
        assert image.size == (160, 105)
        assert image.n_frames == 25
        assert image.info["loop"] == 0
    png = report.animation_png(about, state, row=-1, width=200)
    with Image.open(io.BytesIO(png)) as image:
        assert image.width == 200
        colours = {colour for _, colour in image.getcolors(100_000)}
        assert len(colours) > 20


@pytest.mark.parametrize("kind", ["svg", "png"])
def test_figure_1_has_its_panels_and_repeats(kind: str) -> None:
    summary, arrays = two_data_sets()
    files = [
        report.figure_bytes(report.figure1(arrays, summary), kind, dpi=50.0)
        for _ in range(2)
    ]
    assert files[0] == files[1]
    figure = report.figure1(arrays, summary)
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert [t[:3] for t in titles if t.startswith("(")] == ["(a)", "(b)", "(c)", "(d)"]


def test_figure_1_without_draws_compares_marginals() -> None:
    summary, arrays = two_data_sets()
    arrays = {k: v for k, v in arrays.items() if "/draws/" not in k}
    figure = report.figure1(arrays, summary)
    # Two arms, four marginals each in (b) and (c), ten panels in (d), one legend.
    assert len(figure.axes) == 2 + 4 + 4 + 10 + 1
    assert report.figure_bytes(figure, "png", dpi=40.0)
