"""The report: sections come and go with their data; the page stands on its own."""

import io
import json
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim2gp import report
from sim2gp.errors import InputError
from sim2gp.report import densities, markup, scenes, svg
from sim2gp.runs import store

Run = tuple[dict[str, Any], dict[str, np.ndarray]]

NAMES = ("motor_resistance", "arm_damping", "pendulum_mass", "m1r1", "I1", "m2")
BOXES = ((4.2, 16.8), (1e-6, 3e-3), (0.012, 0.048), (0.0, 1.2), (0.0, 0.4), (0.1, 1.0))
UNITS = ("ohm", "N m s/rad", "kg", "kg m", "kg m^2", "kg")
WORDS = (
    "identified", "prior_dominated", "at_bound", "traded_off", "weak", "dead"
)  # fmt: skip


def draws(rng: np.random.Generator, mean: float, sd: float, index: int) -> np.ndarray:
    """Draws of a parameter: normal in the virtual space of its box or log box."""
    low, high = BOXES[index]
    share = 1 / (1 + np.exp(-(mean + sd * rng.standard_normal(1500))))
    if low > 0 and high / low > 100:
        return low * (high / low) ** share
    return low + (high - low) * share


def parameters(rng: np.random.Generator) -> Run:
    """Six parameters, one for each verdict."""
    spread = (0.05, 1.2, 0.3, 0.8, 0.5, 1.5)
    centre = (-0.6, 0.3, 3.5, 0.2, -0.4, 0.0)
    prior = np.stack([draws(rng, 0.0, 1.5, i) for i in range(6)], axis=1)
    after = np.stack([draws(rng, centre[i], spread[i], i) for i in range(6)], axis=1)
    table = {
        name: {
            "unit": UNITS[i],
            "meaning": f"meaning of {name}",
            "prior_mean": float(prior[:, i].mean()),
            "prior_sd": float(prior[:, i].std()),
            "mean": float(after[:, i].mean()),
            "sd": float(after[:, i].std()),
            "q025": float(np.quantile(after[:, i], 0.025)),
            "q975": float(np.quantile(after[:, i], 0.975)),
            "low": BOXES[i][0],
            "high": BOXES[i][1],
            "verdict": WORDS[i],
            "note": "with I1 and m2" if WORDS[i] == "traded_off" else "",
            "truth": float(np.median(after[:, i])) if i < 3 else None,
        }
        for i, name in enumerate(NAMES)
    }
    factor = rng.standard_normal((6, 3))
    cov = factor @ factor.T + 0.2 * np.eye(6)
    sd = np.sqrt(np.diag(cov))
    summary = {
        "parameters": table,
        "directions": [
            {"text": "m2 + 2.1 m1r1 - 0.4 I1 is fixed", "combination": "m2 + 2.1 m1r1",
             "information": 812.0, "flat": False},
            {"text": "m1r1 rises while I1 falls", "combination": "m1r1 - 0.8 I1",
             "information": 0.2, "flat": True},
        ],
        "base_parameters": [
            {"text": "I1 + m2 l1^2", "value": 0.0312, "sd": 0.0004, "unit": "kg m^2",
             "verdict": "identified"},
        ],
    }  # fmt: skip
    arrays = {
        "parameters/prior_samples": prior,
        "parameters/samples": after,
        "parameters/correlation": cov / np.outer(sd, sd),
    }
    return summary, arrays


def logs(rng: np.random.Generator) -> Run:
    """Two recordings of 12 s and 2 s in windows, with bands on the first."""
    arrays: dict[str, np.ndarray] = {}
    for log, length, every in (("logs/excite_1.csv", 6000, 200), ("b.csv", 1000, 250)):
        time = np.arange(length) * 2e-3
        for k, channel in enumerate(("q1", "q2")):
            true = np.sin(2 * time + k) * np.exp(-time / 9) + 0.2 * np.sin(11 * time)
            off = 0.1 * np.sin(40 * time) * ((time > 7) & (time < 8.2)) + 0.01
            simulated = true + off
            simulated[every::every] = np.nan
            base = f"trace/{log}"
            arrays[f"{base}/time"] = time
            arrays[f"{base}/measured/{channel}"] = true + 0.004 * rng.standard_normal(
                length
            )
            arrays[f"{base}/predicted/{channel}"] = simulated
            if log.startswith("logs"):
                arrays[f"{base}/low/{channel}"] = simulated - 0.06
                arrays[f"{base}/high/{channel}"] = simulated + 0.06
    summary = {
        "units": {"q1": "rad", "q2": "rad"},
        "noise": {"q1": {"sd": 0.0041, "unit": "rad"}, "q2": {"sd": 0.0038}},
        "misfit": {
            "q1": {"whiteness_p": 0.34, "ratio": 1.02},
            "q2": {"whiteness_p": 2e-5, "ratio": 1.31},
            "text": "The residuals of q2 are not white: friction is not smooth.",
        },
    }  # fmt: skip
    return summary, arrays


def evaluation() -> Run:
    """Error against horizon for two joints and three methods."""
    horizon = np.linspace(0.1, 1.0, 10)
    arrays = {"curve/horizon": horizon}
    for i, method in enumerate(("sim2gp", "least squares", "hold")):
        for k, channel in enumerate(("q1", "q2")):
            arrays[f"curve/{method}/{channel}"] = (0.01 + 0.02 * i + 0.01 * k) * (
                0.4 + horizon ** (1 + 0.3 * i)
            )
    summary = {
        "open_loop_rmse": {"q1": 0.0242, "q2": 0.0324},
        "one_step_rmse": {"q1": 3.1e-4, "q2": 4.2e-4},
        "coverage90": {"q1": 0.913, "q2": 0.887},
        "coverage95": {"q1": 0.951, "q2": 0.94},
        "nll": -3.21,
        "windows": 1423,
        "horizon": 1.0,
    }
    return summary, arrays


def swing_up(episodes: int = 3) -> Run:
    """A pendulum that is swung up better each time, and the returns of three models."""
    time = np.arange(250) * 0.02
    states, actions = [], []
    for episode in range(episodes):
        rise = 1 / (1 + np.exp(-(time - 3.2 + 0.5 * episode) * 3.5))
        alpha = (np.pi if episode else 0.4) * rise
        alpha = alpha + 1.1 * np.sin(8.5 * time) * np.exp(-(((time - 1.4) / 0.9) ** 2))
        theta = 0.7 * np.sin(4.2 * time) * np.exp(-time / 2.2)
        rates = np.gradient(theta, time), np.gradient(alpha, time)
        states.append(np.stack([theta, alpha, *rates], axis=1))
        actions.append(
            np.clip(4 * np.sin(8.5 * time + 1) * (1.02 - rise), -5, 5)[:, None]
        )
    rng = np.random.default_rng(7)
    learned = np.minimum(40 + 90 * np.arange(4), 168) + 4 * rng.standard_normal((10, 4))
    summary = {
        "animation": {
            "system": "furuta",
            "dt": 0.02,
            "params": {"arm_length": 0.085, "pendulum_length": 0.129},
            "title": "Three episodes of the demo",
            "marks": [
                {"time": 5.0 * k, "text": f"episode {k + 1}"} for k in range(episodes)
            ],
        },
        "oracle_return": 171.3,
        "hang_return": 33.0,
        "episodes_to_95": {
            "posterior_sampling": [2, 2, 2, 3, 2, 2, 2, 2, 2, 3],
            "point_estimate": [2, 2, 2, 2, 2, None, 2, 2, 2, 2],
            "prior_mean": [None] * 10,
        },
        "interaction_seconds": 10.0,
    }
    arrays = {
        "animation/state": np.concatenate(states),
        "animation/action": np.concatenate(actions),
        "returns/posterior_sampling": learned,
        "returns/point_estimate": learned - 3 + rng.standard_normal((10, 4)),
        "returns/prior_mean": 60 + 9 * rng.standard_normal((10, 4)),
    }
    return summary, arrays


def two_data_sets() -> Run:
    """The beliefs of figure 1 and what their draws predict."""
    rng = np.random.default_rng(3)
    time = np.arange(150) * 0.02
    q2 = 1.2 * np.sin(2.1 * time) + 0.5 * time
    q1 = 0.8 * np.sin(1.6 * time + 0.3)
    first = np.stack([0 * time, q2, 0 * time, np.gradient(q2, time)], axis=1)
    second = np.stack([q1, 0.6 * q2, np.gradient(q1, time), q2], axis=1)
    sds = {
        "prior": np.full(4, 1.5),
        "posterior1": np.array([1.5, 1.5, 0.019, 0.018]),
        "posterior2": np.array([0.029, 0.094, 0.013, 0.008]),
    }
    truth = np.array([-0.8, 0.4, 0.7, -0.3])
    arrays = {"figure1/data1/state": first, "figure1/data2/state": second}
    for name, sd in sds.items():
        pull = (sd < 0.5) * truth + 0.5 * sd * (sd < 0.5)
        arrays[f"figure1/{name}/mean"] = pull
        arrays[f"figure1/{name}/scale"] = np.diag(sd) @ (
            np.eye(4) + 0.3 * np.tri(4, k=-1)
        )
    arrays["figure1/truth"] = truth
    for data, state, pair in (
        ("data1", first, {"prior": 0.5, "posterior1": 0.02}),
        ("data2", second, {"posterior1": 0.4, "posterior2": 0.03}),
    ):
        for stage, size in pair.items():
            factor = 1 + size * rng.standard_normal((40, 1, 1))
            arrays[f"figure1/{data}/draws/{stage}"] = state * factor
    names = ["mass1", "damping1", "mass2", "damping2"]
    summary = {
        "figure1": {"names": names, "lengths": [0.5, 0.4], "dt": 0.02},
        "claims": {
            "link_1_stays_at_the_prior": {"holds": True, "figure": 0.99,
                                          "text": "sd after data set 1 over prior sd"},
            "coverage": {"holds": False, "figure": "181 of 200", "text": ""},
        },
    }  # fmt: skip
    return summary, arrays


@pytest.fixture(scope="module")
def run() -> Run:
    """A run that has everything a report can show."""
    rng = np.random.default_rng(0)
    summary: dict[str, Any] = {
        "command": "identify",
        "command_line": ["sim2gp", "identify", "arm.toml", "--out", "runs/my arm"],
        "headline": "Six logs determine 3 of 6 constants; one combination stays open.",
        "versions": {"sim2gp": "0.1.0", "jax": "0.8.1", "python": "3.11.2"},
        "converged": True,
        "status": "ok",
        "wall_seconds": 21.37,
        "n_transitions": 30124,
        "log_evidence": 81234.5,
        "seed": 0,
        "warnings": [{"code": "W110", "text": "the period varies by 8 %"}],
        "prior_conflicts": ["pendulum_mass lies 3.4 prior sd from its mean."],
        "tables": [
            {"title": "Leave one log out", "columns": ["log", "joint", "ratio"],
             "rows": [["excite_1.csv", "q1", 0.874], ["excite_1.csv", "q2", 0.913]],
             "note": "Error over that of plain least squares."},
        ],
    }  # fmt: skip
    arrays: dict[str, np.ndarray] = {}
    for part in (parameters(rng), logs(rng), evaluation(), swing_up(), two_data_sets()):
        summary |= part[0]
        arrays |= part[1]
    return summary, arrays


class Page(HTMLParser):
    """Checks that every element is closed in its order; collects links and ids."""

    VOID = frozenset({"meta", "img", "input", "br", "wbr", "hr"})

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in self.VOID:
            self.open.append(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(str(value))
            if name in ("href", "src"):
                self.links.append(str(value))

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """An element of SVG that closes itself."""

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag, f"</{tag}> at {self.getpos()}"

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def read(text: str) -> Page:
    """The parsed page."""
    page = Page()
    page.feed(text)
    page.close()
    assert not page.open
    return page


EVERY_SECTION = [
    "claims", "figure1", "machine", "returns", "parameters", "densities",
    "directions", "correlation", "misfit", "traces", "heldout", "tables",
]  # fmt: skip


def test_a_full_run_shows_every_section_well_formed(run: Run) -> None:
    page = read(report.write_report(*run))
    assert page.ids == EVERY_SECTION
    inside = {link for link in page.links if link.startswith("#")}
    assert inside == {f"#{anchor}" for anchor in EVERY_SECTION}


def test_an_empty_run_is_a_page_without_sections() -> None:
    text = report.write_report({"command": "demo"}, {})
    page = read(text)
    assert page.ids == []
    assert "<script" not in text


@pytest.mark.parametrize(
    ("section", "keys"),
    [
        ("claims", ["claims"]),
        ("figure1", ["figure1"]),
        ("machine", ["animation"]),
        ("machine", ["animation/"]),
        ("returns", ["returns/"]),
        ("densities", ["parameters/samples"]),
        ("correlation", ["parameters/correlation"]),
        ("directions", ["directions", "base_parameters"]),
        ("misfit", ["noise", "misfit"]),
        ("traces", ["trace/"]),
        ("tables", ["tables"]),
    ],
)
def test_a_section_vanishes_with_its_data(
    run: Run, section: str, keys: list[str]
) -> None:
    summary = {k: v for k, v in run[0].items() if k not in keys}
    arrays = {k: v for k, v in run[1].items() if not k.startswith(tuple(keys))}
    # Only this section: figure 1 would be drawn for each case again.
    if section != "figure1":
        summary.pop("figure1", None)
    ids = read(report.write_report(summary, arrays)).ids
    assert section not in ids
    assert set(EVERY_SECTION) - set(ids) <= {section, "figure1"}


def test_the_page_needs_nothing_from_outside_and_stays_small(run: Run) -> None:
    text = report.write_report(*run)
    bare = re.sub('base64,[^"]*', "", text)
    assert not re.search(r"https?:|src=\"//|@import|url\(|<link|<iframe", bare)
    assert all(link.startswith(("#", "data:image/png")) for link in read(text).links)
    assert len(text.encode()) < 3_000_000


def test_long_logs_do_not_make_a_heavy_page() -> None:
    rng = np.random.default_rng(1)
    time = np.arange(30_000) * 1e-3
    arrays = {}
    for log in range(60):
        arrays[f"trace/{log}/time"] = time
        for kind in ("measured", "predicted", "low", "high"):
            arrays[f"trace/{log}/{kind}/q1"] = rng.standard_normal(30_000)
    text = report.write_report({"command": "identify"}, arrays)
    assert len(text.encode()) < 3_000_000
    assert "40 more logs" in text


def test_the_same_run_gives_the_same_bytes(run: Run) -> None:
    assert report.write_report(*run) == report.write_report(*run)


def test_strings_of_a_run_are_text_not_markup(run: Run) -> None:
    evil = "<script>alert(1)</script>&\"'"
    summary = json.loads(json.dumps(run[0]))
    summary.pop("figure1")
    entry = dict(summary["parameters"]["m2"])
    entry |= {"unit": evil, "meaning": evil, "note": evil, "verdict": evil}
    summary["parameters"] = dict(summary["parameters"]) | {"m2": entry, evil: entry}
    summary |= {
        "command": evil, "headline": evil, "command_line": evil,
        "versions": {evil: evil},
        "warnings": [evil, {"code": evil, "text": evil}], "status": evil, "seed": evil,
        "prior_conflicts": [evil], "units": {evil: evil, "q1": evil}, "misfit": [evil],
        "noise": {evil: {evil: evil, "unit": evil}}, "trace_note": evil,
        "directions": [{"text": evil, "combination": evil + "x"}],
        "base_parameters": [{"text": evil, "unit": evil, "verdict": evil}],
        "claims": {evil: {"holds": True, "figure": evil, "text": evil}},
        "tables": [{"title": evil, "columns": [evil], "rows": [[evil]], "note": evil}],
    }  # fmt: skip
    summary["animation"] |= {"title": evil, "marks": [{"time": 0.0, "text": evil}]}
    arrays = dict(run[1])
    names = len(summary["parameters"])
    arrays["parameters/samples"] = np.ones((9, names)) * np.arange(1, 10)[:, None]
    arrays["parameters/prior_samples"] = arrays["parameters/samples"] * 2
    arrays["parameters/correlation"] = np.eye(names)
    arrays[f"returns/{evil}"] = np.arange(3.0)
    arrays[f"curve/{evil.replace('/', '')}/q1"] = np.arange(10.0)
    for kind in ("time", f"measured/{evil}", f"predicted/{evil}"):
        arrays[f"trace/{evil}/{kind}"] = np.arange(3.0)
    text = report.write_report(summary, arrays)
    read(text)
    assert "<script>alert" not in text
    # Two script elements of the page's own: the film and the player.
    assert text.count("<script") == text.count("</script") == 2


def test_gaps_and_missing_numbers_never_reach_the_page(run: Run) -> None:
    summary = {
        "command": "demo",
        "parameters": {"a": {"mean": None, "sd": None, "verdict": None}},
        "oracle_return": None,
        "episodes_to_95": None,
        "open_loop_rmse": {"q1": None},
    }
    arrays = {
        "returns/x": np.array([1.0, np.nan, 3.0]),
        "trace/a/time": np.array([0.0, 1.0, np.nan, 2.0]),
        "trace/a/measured/q": np.array([0.0, np.nan, 1.0, 2.0]),
        "trace/a/predicted/q": np.full(4, np.nan),
        "parameters/samples": np.full((5, 1), 3.0),
        "parameters/correlation": np.full((1, 1), np.nan),
    }
    text = report.write_report(summary, arrays)
    read(text)
    body = text.split("</style>")[1]
    assert not re.search(r"\b(nan|inf|None)\b", body)


def test_trouble_stands_before_the_result(run: Run) -> None:
    text = report.write_report(run[0] | {"converged": False}, {})
    order = [
        text.index(words)
        for words in ("did not converge", "W110 the period", run[0]["headline"])
    ]
    assert order == sorted(order)
    for words in (
        "edge of their range: pendulum_mass", "do not depend on: m2",
        "1 combination is left open", "3.4 prior sd",
    ):  # fmt: skip
        assert words in text
    assert "No warnings" in report.write_report({"converged": True}, {})


@pytest.mark.parametrize(
    ("mean", "sd", "text"),
    [
        (8.4123, 0.0532, "8.412 ± 0.053"),
        (2.7123e-4, 1.23e-5, "(2.71 ± 0.12) × 10⁻⁴"),
        (-1234.5, 67.8, "−1234 ± 68"),
        (0.0, 0.5, "0.00 ± 0.50"),
        (3.0, 0.0, "3.00"),
        (None, 1.0, "–"),
        (1.5, float("nan"), "1.50"),
    ],
)
def test_means_are_rounded_by_their_uncertainty(
    mean: float | None, sd: float, text: str
) -> None:
    assert markup.plus_minus(mean, sd) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.012345, "0.0123"), (1.0, "1.00"), (-3.14159, "−3.14"),
        (1.5e-7, "1.50 × 10⁻⁷"),
        (30124, "30\u202f124"), (81234.5, "81\u202f234"), (0.0, "0.00"), (True, "–"),
        (np.float32(0.5), "0.500"), (np.int64(7), "7"), (float("inf"), "–"),
    ],
)  # fmt: skip
def test_numbers_have_three_digits(value: object, text: str) -> None:
    assert markup.number(value) == text


def test_other_words_for_numbers() -> None:
    assert markup.interval(8.3123, 8.5123) == "8.312 to 8.512"
    assert markup.interval(1e-6, 3e-3) == "1.0 × 10⁻⁶ to 0.0030"
    assert markup.duration(21.37) == "21.4 s"
    assert markup.duration(754.0) == "12 min 34 s"
    assert markup.duration(7500) == "2 h 05 min"
    assert markup.unit_text("kg m^2 s^-1") == "kg m² s⁻¹"


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


def test_an_unknown_machine_names_the_nearest() -> None:
    with pytest.raises(InputError, match=r"E195.*did you mean furuta"):
        scenes.scene_of({"system": "furtua"}, np.zeros((2, 4)))


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


def test_redraw_gives_the_same_bytes_from_the_files_alone(
    run: Run, tmp_path: Path
) -> None:
    target = tmp_path / "run"
    text = report.write_report(*run)
    with store.new_run(target, "identify") as writer:
        writer.write_summary(run[0])
        writer.write_arrays(store.ARRAYS, run[1])
        writer.write_text("report.html", text)
    first = (target / "report.html").read_bytes()
    (target / "report.html").unlink()
    before = sorted(path.name for path in target.iterdir())
    path = report.redraw(target)
    assert path.read_bytes() == first == text.encode()
    assert sorted(p.name for p in target.iterdir()) == sorted([*before, "report.html"])
    summary, arrays = report.load_run(target)
    assert summary["headline"] == run[0]["headline"]
    assert set(arrays) == set(run[1])


def test_redraw_of_something_else_is_the_users_fault(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="E130"):
        report.redraw(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_importing_the_report_draws_nothing_yet() -> None:
    code = (
        "import sys, sim2gp.report; "
        "sys.exit(any(m.split('.')[0] in ('matplotlib', 'PIL') for m in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
