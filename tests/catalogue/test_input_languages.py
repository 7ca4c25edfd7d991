"""What users write, drawn at random: logs, units, projects and models.

Each property has its own oracle: the numbers that were written, a reading of units by
their letters, or the rule that what is refused has one line of the catalogue.
"""

import csv
import io
import math
import re
import tomllib
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from crawler import CRAWLER, USUAL
from key_changes import GROUP
from sim2gp.data.logs import Column, columns_of, read_log
from sim2gp.data.logs.units import UNITS, unit_factor
from sim2gp.errors import CODES, InputError, Sim2GPError, Sim2GPWarning, catalogue
from sim2gp.project import load_project
from sim2gp.systems import Channel, MuJoCo
from sim2gp.systems.mujoco.sources import read_sources
from tests.catalogue.bad_inputs import PROJECT, TEXTS
from tests.catalogue.bad_project_files import BASE

KNOWN = {
    code
    for chapter in tomllib.loads(CODES.read_text(encoding="utf-8")).values()
    for code in chapter
}


def about(count: int) -> settings:
    """So many examples by default; by night as many times more as elsewhere."""
    count = count * settings.default.max_examples // 100
    return settings(max_examples=count, suppress_health_check=[HealthCheck.too_slow])


few = about(40)


@contextmanager
def a_result_or_one_line() -> Iterator[None]:
    """Nothing but an error of ours passes, and it is one line of the catalogue."""
    met: list[Sim2GPError] = []
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Sim2GPWarning)
            yield
    except Sim2GPError as error:
        met.append(error)
    for error in met:
        assert error.code in KNOWN, error
        assert not error.key or catalogue()[error.key].code == error.code
        assert "\n" not in str(error)
        assert len(str(error)) < 2000


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One folder for all examples; each writes its file again."""
    return tmp_path_factory.mktemp("languages")


# Logs

letters = st.characters(
    min_codepoint=32, max_codepoint=0x2FF, exclude_characters="\x7f"
)


def is_name(text: str) -> bool:
    """What a column can be called: no number, and no space that is taken off."""
    try:
        float(text)
    except ValueError:
        return text == text.strip() != "" and not re.search(r"[\x80-\xa0]", text)
    return False


names = st.text(letters, min_size=1, max_size=8).filter(is_name)
cells = st.one_of(st.none(), st.floats(allow_nan=False), st.integers(-(10**9), 10**9))


@st.composite
def tables(draw: Callable) -> tuple[list[str], list[list[float | None]]]:
    """A header and rows, of which the first has no gap."""
    header = ["time", *draw(st.lists(names, min_size=1, max_size=4, unique=True))]
    header = list(dict.fromkeys(header))
    count = len(header) - 1
    rows = draw(st.lists(st.tuples(*[cells] * count), max_size=6))
    first = [0.0] * count
    return header, [[float(i), *row] for i, row in enumerate([first, *rows])]


@few
@given(table=tables(), end=st.sampled_from(["\n", "\r\n"]), bom=st.booleans())
def test_what_is_written_as_text_is_read(
    place: Path, table: tuple, end: str, bom: bool
) -> None:
    """Names of any letters, quoted where they must be; every digit; gaps as NaN."""
    header, rows = table
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator=end).writerows([header, *rows])
    encoding = "utf-8-sig" if bom else "utf-8"
    (place / "a.csv").write_bytes(buffer.getvalue().encode(encoding))
    found = columns_of(place / "a.csv")
    assert list(found) == header
    for i, name in enumerate(header):
        wanted = [math.nan if row[i] is None else float(row[i]) for row in rows]
        np.testing.assert_array_equal(found[name], wanted)


SNIPPETS = (
    *(",", ";", "\t", '"', "'", "\n", "\r", "\r\n", " ", ".", "-", "e", "#", "\0"),
    *("nan", "inf", "1e999", "-9999", "1,5", "true", "1+2j", "2024-05-01", "t", "pos"),
    *("\xff", "\x80", "\xef\xbb\xbf", "PK\3\4", "\x1f\x8b"),
)
edits = st.lists(
    st.tuples(st.integers(0, 10**6), st.integers(0, 30), st.sampled_from(SNIPPETS)),
    min_size=1,
    max_size=4,
)


def edited(text: str, changes: list[tuple[int, int, str]]) -> str:
    """Pieces taken out, and others put in their places."""
    for where, length, piece in changes:
        at = where % (len(text) + 1)
        text = text[:at] + piece + text[at + length :]
    return text


@few
@given(changes=edits, head=st.booleans())
def test_no_change_of_a_log_breaks_its_reader(
    place: Path, changes: list[tuple[int, int, str]], head: bool
) -> None:
    """Of the whole file, or near its first lines, where the header is."""
    if head:
        changes = [(where % 60, *rest) for where, *rest in changes]
    (place / "project.toml").write_text(PROJECT)
    (place / "a.csv").write_bytes(edited(TEXTS, changes).encode("latin-1"))
    with a_result_or_one_line():
        load_project(place / "project.toml").load_logs()


# Units

PREFIXES = {"c": 1e-2, "m": 1e-3, "u": 1e-6, "n": 1e-9}
ATOMS = {
    "deg": ("rad", math.pi / 180.0),
    "turn": ("rad", 2.0 * math.pi),
    **{name: (name, 1.0) for name in ("rad", "m", "s", "V", "A", "N")},
}


def meant(unit: str) -> tuple[dict[str, int], float]:
    """Dimensions and size of a unit, from its letters alone."""
    if unit == "rpm":
        unit, size = "turn/s", 1.0 / 60.0
    else:
        size = 1.0
    above, _, below = unit.partition("/")
    powers: Counter[str] = Counter()
    for words, sign in ((above, 1), (below, -1)):
        for word in words.split():
            prefix = 1.0 if word in ATOMS else PREFIXES[word[0]]
            base, ratio = ATOMS[word if word in ATOMS else word[1:]]
            powers[base] += sign
            size *= (prefix * ratio) ** sign
    return dict(powers), size


units = st.sampled_from(sorted(UNITS))


@given(one=units, other=units, third=units)
def test_a_unit_is_what_its_letters_say(one: str, other: str, third: str) -> None:
    """And two conversions in a row are one."""
    (kind, size), (wanted, to) = meant(one), meant(other)
    if kind != wanted:
        with pytest.raises(InputError) as caught:
            unit_factor(one, other, "here")
        assert caught.value.key == "unit_of_another_kind"
        return
    assert unit_factor(one, other, "here") == pytest.approx(size / to, rel=1e-14)
    assert unit_factor(one, other, "") * unit_factor(other, one, "") == pytest.approx(
        1.0
    )
    if meant(third)[0] == kind:
        through = unit_factor(one, third, "") * unit_factor(third, other, "")
        assert through == pytest.approx(unit_factor(one, other, ""), rel=1e-14)


sizes = st.floats(-1e6, 1e6).filter(lambda x: x == 0.0 or abs(x) > 1e-6)


@few
@given(
    pair=st.sampled_from([("deg", "rad"), ("mm", "m"), ("turn", "rad"), (None, "m")]),
    sign=st.sampled_from([1, -1]),
    scale=sizes.filter(bool),
    offset=sizes,
    saturation=st.none() | st.floats(0.5, 2.0),
)
def test_a_column_becomes_a_channel_by_its_formula(
    place: Path,
    pair: tuple[str | None, str],
    sign: int,
    scale: float,
    offset: float,
    saturation: float | None,
) -> None:
    unit, target = pair
    numbers = np.sin(0.3 * np.arange(40)) * 1.9
    rows = [f"{0.01 * i!r},{x!r},0" for i, x in enumerate(numbers.tolist())]
    (place / "b.csv").write_text("\n".join(["time,raw,u", *rows]))
    ends = None if saturation is None else (-saturation, saturation)
    (log,) = read_log(
        place / "b.csv",
        {"q": Column("raw", unit, sign, scale, offset, ends), "u": Column("u")},
        states=(Channel("q", target),),
        actions=(Channel("u", "V"),),
    )
    size = 1.0 if unit is None else meant(unit)[1]
    np.testing.assert_allclose(
        log.channels["q"],
        sign * scale * size * numbers + offset,
        rtol=1e-12,
        atol=1e-12 * abs(scale * size),
    )
    seen = np.ones(40, bool) if saturation is None else np.abs(numbers) < saturation
    np.testing.assert_array_equal(log.mask["q"], seen)


# Project files

WORDS = (
    *("=", "[", "]", "[[", "]]", "{", "}", ",", '"', "'''", "\n", "#", ".", "-", "@"),
    *("true", "nan", "inf", "-1", "0", "1e9", "9223372036854775808", "1979-05-27"),
    *('"free"', "[]", "{}", "[[1.0, 2.0]]", "mean = 0.4", "sd = -1", "low = 2.0"),
    *("[parameters]\n", "[effects.x.spring]\nsd = 1.0\n", "[limits]\n", "[rates]\n"),
    *("[options]\n", "[likelihood]\nwindow = 0.1\n", "[[weighed]]\n", "tie = true\n"),
    *('system = "furuta"\n', '"joint/*/damping"', "theta", "voltage", "cart_mass"),
)
PROJECTS = (BASE, PROJECT, f'system = "cartpole"\n{GROUP}')
rewritten = st.lists(
    st.tuples(st.integers(0, 10**6), st.integers(0, 12), st.sampled_from(WORDS)),
    min_size=1,
    max_size=4,
)


@about(100)
@given(text=st.sampled_from(PROJECTS), changes=rewritten, lines=st.booleans())
def test_no_change_of_a_project_breaks_its_reader(
    place: Path, text: str, changes: list[tuple[int, int, str]], lines: bool
) -> None:
    """Pieces in any place, or in place of what a line says after its key."""
    if lines:
        said = text.splitlines()
        for where, _, piece in changes:
            key = said[where % len(said)].partition("=")[0]
            said[where % len(said)] = f"{key}= {piece}"
        text = "\n".join(said)
    else:
        text = edited(text, changes)
    (place / "p.toml").write_text(text)
    with a_result_or_one_line():
        load_project(place / "p.toml").build_system()


# Models

MODEL = CRAWLER.format(**USUAL)
VALUES = re.compile(r'(\w+)="([^"]*)"')
NUMBERS = (
    *("0", "-1", "1e-320", "1e30", "nan", "inf", "1e999", "0 0 0", "1 2 3 4 5 6 7"),
    *("", " ", "true", "auto", "hinge", "ball", "free", "filter", "user", "x", "&#48;"),
    *("../secret", "hip", "-.5 .5", "1e-9 1e-9 1e-9", "&lt;", "\u00e9"),
)
drawn_values = st.lists(
    st.tuples(st.integers(0, 10**6), st.sampled_from(NUMBERS)), min_size=1, max_size=3
)
TAGS = re.compile(r"</?\w+[^>]*>")
ELEMENTS = (
    "",
    "<joint/>",
    '<geom size=".1"/>',
    "<freejoint/>",
    '<body mocap="true"/>',
    '<include file="x.xml"/>',
    "</body>",
    "<!-- -->",
    '<site name="s"/>',
    '<motor joint="hip"/>',
)
drawn_elements = st.lists(
    st.tuples(st.integers(0, 10**6), st.sampled_from(ELEMENTS)), max_size=2
)


def replaced(
    pattern: re.Pattern[str], text: str, where: int, change: Callable[[str], str]
) -> str:
    """One match of a pattern, changed."""
    found = list(pattern.finditer(text))
    at = found[where % len(found)]
    return text[: at.start()] + change(at.group()) + text[at.end() :]


def mutated(values: list[tuple[int, str]], elements: list[tuple[int, str]]) -> str:
    """The crawler with other values of attributes, and elements more or less."""
    text = MODEL
    for where, value in values:

        def stated(old: str, value: str = value) -> str:
            return f'{old.partition("=")[0]}="{value}"'

        text = replaced(VALUES, text, where, stated)
    for where, element in elements:
        text = replaced(TAGS, text, where, lambda old, new=element: new)
    return text


@few
@given(values=drawn_values, elements=drawn_elements)
def test_no_change_of_a_model_breaks_what_guards_it(
    place: Path, values: list[tuple[int, str]], elements: list[tuple[int, str]]
) -> None:
    """Before MuJoCo is asked: what a file names, and that its numbers are numbers."""
    pytest.importorskip("lxml")
    (place / "m.xml").write_text(mutated(values, elements), encoding="utf-8")
    with a_result_or_one_line():
        read_sources(place / "m.xml", place)


@about(25)
@given(values=drawn_values)
def test_what_mujoco_compiles_is_a_machine_or_refused(
    values: list[tuple[int, str]],
) -> None:
    """As a machine it has finite priors and a state for every joint."""
    mujoco = pytest.importorskip("mujoco")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = mujoco.MjModel.from_xml_string(mutated(values, []))
    except (ValueError, mujoco.FatalError):
        return
    with a_result_or_one_line():
        system = MuJoCo(model)
        assert len(system.states) == 2 * model.njnt + model.na
        assert all(math.isfinite(p.mean) and p.sd > 0 for p in system.parameters.free)
