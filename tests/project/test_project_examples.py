"""Every example of a project file in the README and docs/ is read, with its logs.

A block of TOML is a whole file, or a part of one: then the word after `toml` in its
fence is the system that completes it. Models have the names that pages use, and logs
are written for the columns that a block names.
"""

import json
import re
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim2gp.project import load_project
from sim2gp.project.schema import TABLES, ProjectSpec

ROOT = Path(__file__).resolve().parents[2]
PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").glob("**/*.md"))]
FENCE = re.compile(r"^```toml *(\S*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
EXAMPLES = sorted((ROOT / "examples").glob("*.toml"))
#: Pages whose code in a line is of project files.
ABOUT = ("project_file.md", "logs.md", "mujoco.md", "your_robot.md")
ARM = """<mujoco><worldbody><body name="upper">
<joint name="shoulder" axis="0 1 0" damping=".05"/>
<geom type="capsule" size=".02" fromto="0 0 0 0 0 -.4" mass="1"/>
<body name="{0}" pos="0 0 -.4"><joint name="elbow" axis="0 1 0" damping=".02"/>
<geom type="capsule" size=".02" fromto="0 0 0 0 0 -.3" mass=".5"/>
<body name="hand" pos="0 0 -.3"><geom size=".03" mass=".2"/></body></body></body>
</worldbody><actuator>{1}</actuator></mujoco>"""
MOTOR = '<motor name="{}" joint="{}"/>'
MODELS = {
    "robot.xml": ARM.format("forearm", MOTOR.format("elbow", "elbow")),
    "arm.xml": ARM.format(
        "lower",
        MOTOR.format("shoulder_motor", "shoulder")
        + MOTOR.format("elbow_motor", "elbow"),
    ),
}


@dataclass(frozen=True)
class Block:
    """A block of TOML: its place, its text, and the system that completes it."""

    place: str
    system: str
    text: str

    @property
    def whole(self) -> str:
        return f'system = "{self.system}"\n{self.text}' if self.system else self.text


def blocks(page: Path) -> Iterator[Block]:
    text = page.read_text(encoding="utf-8")
    for found in FENCE.finditer(text):
        line = text.count("\n", 0, found.start()) + 1
        yield Block(f"{page.name}:{line}", found[1], found[2])


BLOCKS = [block for page in PAGES for block in blocks(page)]


def columns_of(group: Mapping[str, Any]) -> dict[str, float]:
    """The columns that a group of logs names, and units of theirs in a second."""
    clock = group.get("time", "time")
    scale = {"ms": 1e3, "us": 1e6}
    if isinstance(clock, dict):
        found = {clock["column"]: scale.get(clock.get("unit", "s"), 1.0)}
    else:
        found = {clock: 1.0}
    for value in group["columns"].values():
        if not isinstance(value, int | float):
            found[value["column"] if isinstance(value, dict) else value] = 0.0
    return found


def write_log(path: Path, columns: Mapping[str, float]) -> None:
    """A second of motion: each column a wave of its own, or a clock."""
    t = 0.01 * np.arange(300)
    table = {
        name: unit * t if unit else 0.2 * np.sin((2.0 + i) * t) + 0.01 * np.sin(t**2)
        for i, (name, unit) in enumerate(columns.items())
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".mcap":
        write_messages(path, {n: x for n, x in table.items() if n.startswith("/")})
    elif path.suffix == ".parquet":
        write_parquet(path, table)
    else:
        values = np.stack([*table.values()], axis=1)
        header = ",".join(table)
        np.savetxt(path, values, delimiter=",", header=header, comments="")


def write_messages(path: Path, table: Mapping[str, np.ndarray]) -> None:
    """One JSON message a row and topic, for columns ``/topic/field``."""
    writer_module = pytest.importorskip("mcap.writer")
    topics: dict[str, list[str]] = {}
    for name in table:
        topics.setdefault(name.rpartition("/")[0], []).append(name)
    with path.open("wb") as file:
        writer = writer_module.Writer(file)
        writer.start()
        schema = writer.register_schema("any", "jsonschema", b"{}")
        for topic, names in topics.items():
            channel = writer.register_channel(topic, "json", schema)
            for i in range(300):
                said = {
                    name.rpartition("/")[2]: float(table[name][i]) for name in names
                }
                stamp = 10**18 + 10**7 * i
                writer.add_message(channel, stamp, json.dumps(said).encode(), stamp)
        writer.finish()


def write_parquet(path: Path, table: Mapping[str, np.ndarray]) -> None:
    """A column of lists for the names ``list[0]``, ``list[1]``."""
    pa = pytest.importorskip("pyarrow")
    lists: dict[str, list[np.ndarray]] = {}
    for name, values in table.items():
        lists.setdefault(name.partition("[")[0], []).append(values)
    columns = {
        name: pa.array(np.stack(each, 1).tolist()) if f"{name}[0]" in table else each[0]
        for name, each in lists.items()
    }
    import pyarrow.parquet

    pyarrow.parquet.write_table(pa.table(columns), path)


@pytest.mark.parametrize("block", BLOCKS, ids=lambda block: block.place)
def test_an_example_of_a_project_file_is_read(block: Block, tmp_path: Path) -> None:
    if ".xml" in block.whole:
        pytest.importorskip("mujoco")
    for name, model in MODELS.items():
        (tmp_path / name).write_text(model)
    groups = tomllib.loads(block.whole).get("logs", [])
    for group in groups:
        for pattern in group["files"]:
            file = tmp_path / pattern.replace("*", "a")
            write_log(file, columns_of(group))
    path = tmp_path / "project.toml"
    path.write_text(block.whole)
    project = load_project(path)
    assert len(project.system.parameters) > 0
    if groups:
        logs = project.load_logs()
        assert {log.group for log in logs} <= set(range(len(groups)))
        assert sum(len(log) for log in logs) > 250 * len(groups)


def test_there_are_examples() -> None:
    assert {"project_file.md", "logs.md", "mujoco.md", "your_robot.md"} <= {
        block.place.partition(":")[0] for block in BLOCKS
    }
    assert sum(block.system == "" for block in BLOCKS) >= 2


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.name)
def test_a_file_of_examples_is_read(path: Path) -> None:
    """Their recordings are read by the tests of real data."""
    assert load_project(path).system.parameters.names


def spans(page: Path) -> Iterator[str]:
    """Code in a line of a page, joined where the line is broken."""
    text = re.sub(r"^```.*?^```", "", page.read_text("utf-8"), flags=re.M | re.S)
    for found in re.findall(r"`([^`]+)`", text):
        yield re.sub(r"\s*\n\s*", " ", found)


def test_code_in_a_line_names_sections_and_keys_that_there_are() -> None:
    known = {key for _, _, model in TABLES for key in model.model_fields}
    known |= {"root", "locked", "gravity"}  # options
    odd, seen = [], 0
    for page in PAGES:
        for span in spans(page):
            header = re.match(r"\[\[?([a-z]+)[\].]", span)
            key = re.match(r"([a-z_]+) = ", span) if page.name in ABOUT else None
            seen += header is not None or key is not None
            if header and header[1] not in ProjectSpec.model_fields:
                odd.append(f"{page.name}: {span}")
            if key and key[1] not in known:
                odd.append(f"{page.name}: {span}")
    assert not odd
    assert seen >= 20
