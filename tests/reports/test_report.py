"""The report: sections come and go with their data; the page stands on its own."""

import json
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from report_example import Run, a_film, full_run
from sim2gp import reports as report
from sim2gp.errors import InputError
from sim2gp.reports import numbers
from sim2gp.runs import store
from sim2gp.systems.mujoco.film import BYTES


@pytest.fixture(scope="module")
def run() -> Run:
    """A run that has everything a report can show."""
    return full_run()


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
    "claims", "figure1", "machine", "returns", "experiment", "parameters", "directions",
    "misfit", "heldout", "calibration", "traces", "densities", "correlation", "tables",
    "made",
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
        ("experiment", ["design/"]),
        ("densities", ["parameters/samples"]),
        ("correlation", ["parameters/correlation"]),
        ("directions", ["directions", "base_parameters"]),
        ("misfit", ["noise", "misfit"]),
        ("calibration", ["calibration/"]),
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
    assert 'name="viewport" content="width=device-width, initial-scale=1"' in text


def test_the_heaviest_page_is_small_enough(run: Run) -> None:
    """Everything at once, each as large as it may be; random bytes for pictures."""
    rng = np.random.default_rng(3)
    summary, arrays = a_film()
    rods = [[k, k + 1, "link"] for k in range(60)]
    figure = {"fixed": [], "rods": rods, "balls": []}
    summary = run[0] | summary
    summary["animation"] = summary["animation"] | {"figure": figure, "marks": []}
    for name in ("points", "recorded_points"):
        arrays[f"animation/{name}"] = rng.standard_normal((1000, 61, 3))
    for name in ("state", "recorded"):
        arrays[f"animation/{name}"] = rng.standard_normal((1000, 2))
    arrays["animation/frames"] = rng.integers(0, 256, BYTES, np.uint8)
    arrays["animation/frame_ends"] = np.linspace(0, BYTES, 126).astype(int)[1:]
    logs = {key: x for key, x in run[1].items() if not key.startswith("animation/")}
    time = np.arange(3000) * 1e-2
    for log in range(30):
        for base in (f"trace/{log}", f"unseen/{log}"):
            logs[f"{base}/time"] = time
            for kind in ("measured", "predicted", "low", "high"):
                logs[f"{base}/{kind}/q1"] = rng.standard_normal(3000)
    text = report.write_report(summary, logs | arrays)
    read(text)
    assert len(text.encode()) < 3_000_000


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


class Pictures(HTMLParser):
    """Collects what each picture says to those who cannot see it."""

    def __init__(self) -> None:
        super().__init__()
        self.said: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        if tag == "img":
            self.said.append(str(given["alt"]))
        if tag == "svg" and "viewbox" in given:  # not the field inside a chart
            assert given["role"] == "img"
            self.said.append(str(given["aria-label"]))


def test_every_picture_says_what_it_shows(run: Run) -> None:
    pictures = Pictures()
    pictures.feed(report.write_report(*run))
    assert len(pictures.said) > 10
    for said in pictures.said:
        name, _, text = said.partition(": ")
        assert name
        assert text
        assert "nan" not in text
    (q1,) = (x for x in pictures.said if x.startswith("arm angle theta"))
    low, high = (float(x.replace("−", "-")) for x in re.findall(r"[−\d.]+", q1)[:2])
    theta = np.rad2deg(run[1]["animation/state"][:, 0])
    np.testing.assert_allclose([low, high], [theta.min(), theta.max()], rtol=5e-3)


def test_gaps_and_missing_numbers_never_reach_the_page() -> None:
    nothing = np.full(4, np.nan)
    summary = {
        "command": "demo",
        "parameters": {"a": {"mean": None, "sd": None, "verdict": None}},
        "oracle_return": None,
        "episodes_to_95": None,
        "open_loop_rmse": {"q1": None},
        "animation": {"dt": 0.1, "system": "furuta", "params": {}},
        "misfit": {"alarm": True, "tests": {"chi2": {"p": None}}},
    }
    arrays = {
        "returns/nothing": np.full(3, np.nan),
        "animation/state": np.zeros((4, 4)),
        "animation/action": nothing[:, None],
        "design/time": np.arange(4.0),
        "design/command/u": nothing[:-1],
        "calibration/level": np.array([0.5, 0.9]),
        "calibration/share/q": nothing[:2],
        "trace/one/time": np.array([1.0]),
        "trace/one/measured/q": np.array([2.0]),
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
    pictures = Pictures()
    pictures.feed(text)
    for said in pictures.said:
        assert not re.search(r"from +(to|over|$)|–, of|[;:,] *$", said), said
    assert "u: no values, time from 0.00 to 2.00 s" in pictures.said
    assert "q: measured, time from 1.00 to 1.00 s" in pictures.said


def test_correlations_that_are_not_known_are_not_the_strongest() -> None:
    entries = {name: {"mean": 1.0, "sd": 0.1} for name in "abc"}
    matrix = np.full((3, 3), np.nan)
    for known, words in (({}, "none is known"), ({(2, 1): -0.5}, "of c and b")):
        for place, r in known.items():
            matrix[place] = r
        arrays = {"parameters/correlation": matrix}
        pictures = Pictures()
        pictures.feed(report.write_report({"parameters": entries}, arrays))
        assert words in pictures.said[-1]


@pytest.mark.parametrize("columns", ["abc", "abcd"])
def test_a_row_longer_than_its_header_is_drawn(columns: str) -> None:
    rows = [[str(k) for k in range(len(columns) + 1)]]
    entry = {"title": "t", "columns": list(columns), "rows": rows}
    assert f">{len(columns)}<" in report.write_report({"tables": [entry]}, {})


def test_many_series_of_returns_are_counted() -> None:
    arrays = {f"returns/{k}": np.arange(3.0) for k in range(7)}
    text = report.write_report({}, arrays)
    assert "7 series of returns are in arrays.npz" in text


def test_trouble_stands_before_the_result(run: Run) -> None:
    text = report.write_report(run[0] | {"converged": False}, {})
    order = [
        text.index(words)
        for words in ("did not converge", "W110 the period", run[0]["headline"])
    ]
    assert order == sorted(order)
    for words in (
        "pendulum_mass is at the upper end of its range", "do not depend on: m2",
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
    assert numbers.plus_minus(mean, sd) == text


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
    assert numbers.format_number(value) == text


def test_other_words_for_numbers() -> None:
    assert numbers.format_interval(8.3123, 8.5123) == "8.312 to 8.512"
    assert numbers.format_interval(1e-6, 3e-3) == "1.0 × 10⁻⁶ to 0.0030"
    assert numbers.format_duration(21.37) == "21.4 s"
    assert numbers.format_duration(754.0) == "12 min 34 s"
    assert numbers.format_duration(7500) == "2 h 05 min"
    assert numbers.unit_text("kg m^2 s^-1") == "kg m² s⁻¹"


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
    summary, arrays = report.load_summary(target)
    assert summary["headline"] == run[0]["headline"]
    assert set(arrays) == set(run[1])


def test_redraw_of_something_else_is_the_users_fault(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="E130"):
        report.redraw(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_importing_the_report_draws_nothing_yet() -> None:
    code = (
        "import sys, sim2gp.reports; "
        "sys.exit(any(m.split('.')[0] in ('matplotlib', 'PIL') for m in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
