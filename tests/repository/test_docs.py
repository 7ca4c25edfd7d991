"""Pages that repeat what the code says say the same, and no page is lost or unlinked.

`make docs` builds the site; these tests need nothing that it installs.
"""

import ast
import importlib
import importlib.util
import itertools
import json
import re
import signal
import tomllib
from dataclasses import fields
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from house_rules import LAYERS
from sim2gp import cli
from sim2gp.cli.commands import COMMANDS
from sim2gp.data.logs.arrays import missing_column
from sim2gp.errors import catalogue
from sim2gp.project.project import SYSTEMS, system_class
from sim2gp.project.schema import ProjectSpec
from sim2gp.systems.effects.registry import NAMES

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PACKAGE = ROOT / "src" / "sim2gp"
PAGES = [*sorted(DOCS.glob("*.md")), *sorted(ROOT.glob("*.md"))]
CODE = re.compile(r"[EW]\d{3}")


def of_site(name: str) -> ModuleType:
    """A module that makes the site, or pages of it."""
    spec = importlib.util.spec_from_file_location(name, DOCS / "site" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


STAGE, TABLES = of_site("stage"), of_site("tables")


def rows(text: str) -> list[list[str]]:
    """The cells of every row of every table, headings and rulers too."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    cells = [re.split(r"(?<!\\)\|", line)[1:-1] for line in lines]
    return [[cell.strip() for cell in row] for row in cells]


def section(page: str, heading: str) -> str:
    """What stands below one heading of a page."""
    text = (DOCS / page).read_text(encoding="utf-8")
    parts = re.split(r"^## (.*)$", text, flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))[heading]


# ---------------------------------------------------------------- the project file


@pytest.mark.parametrize("page", ["project_file.md", "codes.md"])
def test_a_page_has_the_tables_that_the_code_writes(page: str) -> None:
    """`python docs/site/tables.py` writes them."""
    assert (DOCS / page).read_text(encoding="utf-8") == TABLES.pages()[page]


def test_every_section_and_key_of_a_project_file_is_told() -> None:
    known = ProjectSpec.model_json_schema()["$defs"].keys() - {"PriorSpec"}
    models = {model.__name__ for model in TABLES.SECTIONS.values()}
    assert models == known | {"ProjectSpec"}
    text = (DOCS / "project_file.md").read_text(encoding="utf-8")
    headings = re.findall(r"^## (.*)$", text, re.MULTILINE)
    assert set(headings) == set(TABLES.SECTIONS) | {"Machines"}
    for model in TABLES.SECTIONS.values():
        own = set(model.__annotations__) - {"model_config"}
        assert set(TABLES.meanings(model)) == own


def test_every_machine_of_a_project_file_is_told() -> None:
    found: dict[str, tuple[set[str], set[str], set[str]]] = {}
    for row in rows(section("project_file.md", "Machines"))[2:-1]:
        names, *cells = (set(re.findall(r"`([\w.]+)`", cell)) for cell in row)
        found |= dict.fromkeys(names, (cells[0], cells[1], cells[2]))
    expected = {}
    for name in SYSTEMS:
        system = system_class(name)()
        states = {c.name for c in system.physical_states if ".velocity" not in c.name}
        options = set(type(system).__init__.__annotations__) - {"parameters", "return"}
        expected[name] = states, {c.name for c in system.actions}, options
    assert found == expected


def test_every_effect_of_a_project_file_is_told() -> None:
    text = section("project_file.md", "[effects.CHANNEL.NAME]")
    listed = text.split("can have them:")[1].split("Of a model's")[0]
    assert re.findall(r"`(\w+)`", listed) == list(NAMES)


# ------------------------------------------------------------------------- codes


def spoken_codes() -> set[str]:
    """Codes that begin a text of the package: what it raises, warns of, or reports."""
    found = set()
    for module in itertools.chain(*STAGE.modules().values()):
        for node in ast.walk(STAGE.tree(module)):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                code = node.value[:4]
                if CODE.fullmatch(code) and node.value[4:5] in ("", " "):
                    found.add(code)
    return found | {entry.code for entry in catalogue().values()}


def test_every_code_is_told_once_and_none_that_is_not_spoken() -> None:
    answer = [
        row[0].strip("`")
        for row in rows((DOCS / "codes.md").read_text(encoding="utf-8"))
        if CODE.fullmatch(row[0].strip("`"))
    ]
    assert len(answer) == len(set(answer))
    assert set(answer) == spoken_codes()


def test_every_exit_code_is_told() -> None:
    answer = {int(row[0]) for row in rows(section("codes.md", "Exit codes"))[2:]}
    signals = {128 + signal.SIGINT, 128 + signal.SIGTERM}
    codes = "OK BUG INPUT DISK OWNED".split()
    assert answer == {getattr(cli, name) for name in codes} | signals


def test_the_example_of_an_error_is_what_is_printed() -> None:
    error = missing_column("tau1", ["time", "pos1", "tau_1"], "runs/a.csv")
    assert str(error) in (DOCS / "codes.md").read_text(encoding="utf-8")


def test_every_command_is_told() -> None:
    answer = re.findall(r"`sim2gp (\w+)", section("choose.md", "Which command"))
    assert sorted(answer) == sorted([*COMMANDS, "COMMAND"])


def test_every_option_that_pages_give_a_command_is_there() -> None:
    seen, unknown = 0, []
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for name, rest in re.findall(r"sim2gp ([a-z]+)\b([^`\n|#]*)", text):
            options = re.findall(r"--([a-z][a-z-]*)", rest)
            if name in COMMANDS and options:
                known = {f.name.replace("_", "-") for f in fields(COMMANDS[name])}
                seen += len(options)
                unknown += [
                    f"{page.name}: {name} {o}" for o in options if o not in known
                ]
    assert seen > 30
    assert not unknown, "\n".join(unknown)


# ---------------------------------------------------------------------- the site


def navigation(entries: list[dict[str, Any]]) -> list[str]:
    """The pages that the site's navigation lists, in order."""
    pages = []
    for entry in entries:
        for target in entry.values():
            pages += [target] if isinstance(target, str) else navigation(target)
    return pages


def test_every_page_and_package_stands_in_the_navigation_once() -> None:
    project = tomllib.loads((ROOT / "zensical.toml").read_text())["project"]
    expected = [page.name for page in DOCS.glob("*.md")]
    expected += [f"reference/{name}.md" for name in ["index", *STAGE.modules()]]
    expected += STAGE.TOP.values()
    expected += [f"example_{file.stem}.md" for file in (ROOT / "examples").glob("*.py")]
    assert sorted(navigation(project["nav"])) == sorted(expected)


def test_every_module_and_public_name_stands_in_the_reference() -> None:
    import sim2gp

    files = {p.relative_to(PACKAGE).as_posix() for p in PACKAGE.rglob("*.py")}
    pages = STAGE.reference()
    answer = re.findall(r"^::: (\S+)$", "\n".join(pages.values()), re.MULTILINE)
    assert (
        len(answer) == len(set(answer)) == len(files - {"__init__.py", "__main__.py"})
    )
    assert {STAGE.file_of(name).relative_to(PACKAGE).as_posix() for name in answer} <= (
        files
    )
    names = re.findall(r"`sg\.(\w+)`\]\((\S+)\.md#([\w.]+)\) \| \S", pages["index"])
    assert {name for name, _, _ in names} == set(sim2gp.__all__) - {"__version__"}
    for _, page, path in names:  # the anchor is of a thing that the page documents
        assert {path, path.rpartition(".")[0]} & set(
            re.findall(r"^::: (\S+)$", pages[page], re.MULTILINE)
        )


def test_pages_are_staged(tmp_path: Path) -> None:
    fence = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```", re.MULTILINE | re.DOTALL)
    page = DOCS / "your_system.md"
    text = STAGE.staged(page, tmp_path)
    assert "```python\n" in text
    assert "```python nightly" not in text
    assert fence.findall(text) == fence.findall(page.read_text(encoding="utf-8"))
    assert "](contributing.md#how-to-add)" in text
    links = (
        "[a](images/demo.gif) [b](../README.md#c) [d](theory.md#e) [f](https://x.y/z)"
    )
    file = "files/docs/images/demo.gif"
    assert STAGE.relinked(links, page, tmp_path) == (
        f"[a]({file}) [b](reference/index.md#c) [d](theory.md#e) [f](https://x.y/z)"
    )
    assert (tmp_path / file).read_bytes() == (DOCS / "images/demo.gif").read_bytes()


def test_a_notebook_is_a_page_and_a_file() -> None:
    text = "# %% [markdown]\n# # A `b`\n#\n# word\n\n# %%\nx = 1\ny = 2\n"
    assert STAGE.as_page(text) == "# A `b`\n\nword\n\n```python\nx = 1\ny = 2\n```\n"
    made = json.loads(STAGE.as_notebook(text))
    assert [(c["cell_type"], "".join(c["source"])) for c in made["cells"]] == [
        ("markdown", "# A `b`\n\nword"),
        ("code", "x = 1\ny = 2"),
    ]
    assert (made["nbformat"], made["nbformat_minor"]) == (4, 5)


def test_code_keeps_what_looks_like_a_link(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("`[a](b)`\n\n```python logs\nx[0](y)\n```\n", encoding="utf-8")
    assert STAGE.staged(page, tmp_path).split() == (
        ["`[a](b)`", "```python", "x[0](y)", "```"]
    )


def anchors(page: Path) -> set[str]:
    """What a page's headings are called in a link."""
    text = re.sub(r"^```.*?^```", "", page.read_text("utf-8"), flags=re.M | re.S)
    titles = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    plain = [re.sub(r"[^\w\s-]", "", title.lower()).strip() for title in titles]
    return {title.replace(" ", "-") for title in plain}


def test_links_between_pages_find_their_heading() -> None:
    broken = []
    for page in PAGES:
        for target, heading in re.findall(
            r"\]\(([^)#\s:]*)#([^)]+)\)", page.read_text(encoding="utf-8")
        ):
            there = (page.parent / target).resolve() if target else page
            if there.suffix == ".md" and heading not in anchors(there):
                broken.append(f"{page.name}: {target}#{heading}")
    assert not broken, "\n".join(broken)


def test_pages_are_reached_from_the_first_one() -> None:
    reached, waiting = set(), [DOCS / "index.md"]
    while waiting:
        page = waiting.pop()
        if page not in reached and page.suffix == ".md" and page.parent == DOCS:
            reached.add(page)
            links = re.findall(r"\]\(([^)#\s:]+)", page.read_text(encoding="utf-8"))
            waiting += [(DOCS / link).resolve() for link in links]
    assert set(DOCS.glob("*.md")) <= reached


def defined(file: Path, path: str) -> bool:
    """Whether a file defines a function, a class, or a method, by its dotted path."""
    body = ast.parse(file.read_text(encoding="utf-8")).body
    for name in path.split("."):
        kinds = ast.ClassDef | ast.FunctionDef
        found = [n for n in body if isinstance(n, kinds) and n.name == name]
        if not found:
            return False
        body = found[0].body
    return True


@pytest.mark.parametrize("page", ["theory.md", "decisions.md"])
def test_a_page_names_code_tests_and_results_that_are_there(page: str) -> None:
    text = (DOCS / page).read_text(encoding="utf-8")
    lost = []
    for file, path in re.findall(r"`([\w/]+\.py)(?::([\w.]+))?`", text):
        places = [PACKAGE / file, ROOT / file, *(ROOT / "tests").rglob(file)]
        home = next((place for place in places if place.is_file()), None)
        if home is None or (path and not defined(home, path)):
            lost.append(f"{file}:{path}")
    paths = re.findall(r"(?<![\w/])(?:benchmarks|results)/[\w./]*\w", text)
    lost += [path for path in paths if not (ROOT / path).exists()]
    assert not lost, "\n".join(lost)


def test_the_theory_is_numbered_and_tested() -> None:
    text = (DOCS / "theory.md").read_text(encoding="utf-8")
    numbered = [row for row in rows(text) if re.fullmatch(r"\(\d+\)", row[0])]
    numbers = list(dict.fromkeys(int(row[0].strip("()")) for row in numbered))
    assert sorted(numbers) == list(range(1, max(numbers) + 1))
    assert all(len(row) == 4 and "`test_" in row[3] for row in numbered)


def test_the_architecture_is_that_of_the_tree() -> None:
    """Files that are there, with their lines; every folder; the layers as enforced."""
    text = (DOCS / "architecture.md").read_text(encoding="utf-8")
    paths = set(re.findall(r"`([\w/]+\.py)`", text))
    lost = {path for path in paths if not (PACKAGE / path).is_file()}
    assert lost <= {"tests/house_rules.py"}
    height = {}
    for layer, *cells in (row for row in rows(text) if row[0].isdigit()):
        for room in re.findall(r"`(\w+)(?:/|\.py)`", cells[0]):
            height[room] = int(layer)
    for layer, rooms in enumerate(LAYERS, start=1):
        assert {room for room, at in height.items() if at == layer} == rooms
    for line in re.findall(r"^- (`.*\(\d+ lines\))$", text.replace("\n  ", " "), re.M):
        files = re.findall(r"`([\w/]+\.py)`", line)
        found = sum(len((PACKAGE / f).read_text().splitlines()) for f in files)
        answer = int(re.findall(r"\((\d+) lines\)", line)[0])
        assert abs(found - answer) <= 0.1 * found, line


# ----------------------------------------------------------------- measured tables


@pytest.mark.parametrize(
    ("benchmark", "page"),
    [
        ("mjcf_table", "README.md"),
        ("mjcf_table", "docs/your_robot.md"),
        ("arm_and_sysid", "docs/your_robot.md"),
        ("arm_bound", "docs/your_robot.md"),
        ("arm_windows", "docs/decisions.md"),
        ("side_by_side", "docs/speed.md"),
    ],
)
def test_a_table_is_that_of_its_results(
    benchmark: str, page: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Printed by the benchmark's own function from the results that are checked in."""
    pytest.importorskip("mujoco", reason="the extra `mujoco` is not installed")
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    module = importlib.import_module(benchmark)
    file = {"side_by_side": "bench"}.get(benchmark, benchmark)
    results = json.loads((ROOT / "results" / f"{file}.json").read_text())
    assert module.table(results) in (ROOT / page).read_text(encoding="utf-8")
