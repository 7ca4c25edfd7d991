"""Bad input gets one clear line, exit code 2, and leaves nothing behind.

The cases are numbered as a bad table or a bad project file usually comes about; each
names its code and the words a reader needs: the place, the value, the way out.
"""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import stub_experiments
from sim2gp.cli import main

PROJECT = """system = "cartpole"

[[logs]]
files = ["*.csv"]
time = "t"

[logs.columns]
x = "pos"
"x.velocity" = "vel"
theta = "angle"
voltage = "cmd"
"""
HEADER = "t,pos,vel,angle,cmd"
PERIOD, ROWS = 0.01, 300


def table() -> np.ndarray:
    t = PERIOD * np.arange(ROWS)
    x, v = 0.2 * np.sin(3 * t), 0.6 * np.cos(3 * t)
    return np.stack([t, x, v, np.cos(t), np.sin(t * t)], axis=1)


def text(values: np.ndarray | None = None, header: str = HEADER) -> str:
    values = table() if values is None else values
    rows = [",".join(repr(float(v)) for v in row) for row in values]
    return "\n".join([header, *rows]) + "\n"


def changed(row: int, column: int, value: float) -> str:
    values = table()
    values[row, column] = value
    return text(values)


def cell(row: int, column: int, value: str) -> str:
    """The text with one cell replaced; row 0 is line 2."""
    lines = text().splitlines()
    cells = lines[row + 1].split(",")
    cells[column] = value
    lines[row + 1] = ",".join(cells)
    return "\n".join(lines)


def column(index: int, function: object) -> str:
    values = table()
    values[:, index] = function(values[:, index])  # type: ignore[operator]
    return text(values)


def swapped(one: int, other: int) -> str:
    values = table()
    values[:, [one, other]] = values[:, [other, one]]
    return text(values)


def repeated(value: float) -> str:
    values = table()
    values[::20, 3] = value
    return text(values)


def clock(jump: float, row: int = 100) -> str:
    values = table()
    values[row:, 0] += jump
    return text(values)


TABLES = {
    "nan": (changed(7, 1, np.nan), "E101", ["line 9", "pos", "drop_nonfinite"]),
    "many nan": (
        column(3, lambda v: np.where(v > 0, v, np.nan)),
        "E101",
        ["angle", "lines", "..."],
    ),
    "inf": (changed(7, 4, np.inf), "E101", ["line 9", "cmd", "inf"]),
    "overflow": (cell(7, 4, "1e400"), "E101", ["line 9", "cmd", "inf"]),
    "empty cell": (cell(7, 4, ""), "E101", ["line 9", "cmd", "nan"]),
    "sentinel": (repeated(-9999.0), "E102", ["line 2", "angle", "5.0 %"]),
    "missing column": (text(header="t,pos,vel,phi,cmd"), "E103", ["angle", "phi"]),
    "misspelt column": (text(header="t,pos,vel,Angle,cmd"), "E103", ["mean Angle"]),
    "no header": (text().split("\n", 1)[1], "E103", ["no header"]),
    "double column": (text(header="t,pos,vel,pos,cmd"), "E104", ["2 and 4"]),
    "swapped": (swapped(1, 2), "E106", ["columns swapped"]),
    "unrelated": (column(2, np.cos), "E106", ["correlation"]),
    "sign": (column(2, np.negative), "E106", ["slope -1", "sign = -1"]),
    "mm": (column(1, lambda v: 1e3 * v), "E107", ["x", "mm"]),
    "ms": (column(0, lambda v: 1e3 * v), "E107", ["period of 10 s", '"ms"']),
    "us": (column(0, lambda v: 1e6 * v), "E107", ["period of 10000 s", '"us"']),
    "backwards": (changed(50, 0, 0.48), "E108", ["line 52", "0.48 s after 0.49"]),
    "reversed": (column(0, np.negative), "E108", ["line 3", "sort"]),
    "double stamp": (changed(50, 0, 0.49), "E108", ["line 52", "duplicate"]),
    "clock back": (clock(-0.5), "E109", ["line 102", "jump of -0.49"]),
    "clock ahead": (clock(1e6), "E109", ["line 102", "jump of 1000000"]),
    "float32 time": (
        column(0, lambda v: np.float32(v + 1.7e9)),
        "E112",
        ["float32", "resolved to 128 s"],
    ),
    "iso time": (cell(0, 0, "2024-05-01T12:00:00"), "E114", ["line 2", "12.345"]),
    "clock time": (cell(0, 0, "12:00:01"), "E114", ["line 2", "'12:00:01'"]),
    "empty": ("", "E115", ["empty file"]),
    "blank": ("\n\n  \n", "E115", ["empty file"]),
    "header only": (HEADER + "\n", "E115", ["no rows"]),
    "one row": ("\n".join(text().split("\n")[:2]), "E116", ["1 usable row,"]),
    "only gaps": (text(table()[[0, 1]] * [1e8, 1, 1, 1, 1]), "E109", ["line 3"]),
    "semicolons": (text().replace(",", ";"), "E119", ["semicolons", "'t;pos"]),
    "tabs": (text().replace(",", "\t"), "E119", ["tabs"]),
    "decimal commas": (
        HEADER + "\n" + text().split("\n", 1)[1].replace(".", ","),
        "E119",
        ["line 2", "decimal commas"],
    ),
    "half semicolons": (
        HEADER + "\n" + text().split("\n", 1)[1].replace(",", ";"),
        "E119",
        ["line 2", "semicolons"],
    ),
    "utf-16": (text().encode("utf-16"), "E120", ["byte 0", "0xff"]),
    "latin-1": ("° " + text(), "E120", ["byte 0", "0xb0"]),
    "nul": (b"t,pos\x00" + text().encode(), "E120", ["byte 5", "0x00"]),
    "ragged": (cell(7, 4, "1,2"), "E121", ["line 9", "6 fields", "5 fields"]),
    "short": (text() + "1.0,2.0\n", "E121", ["line 302", "2 fields"]),
    "text": (cell(7, 3, "n/a " + 60 * "x"), "E121", ["line 9", "angle", "xxx...'"]),
    "thousands": (cell(7, 3, '"1,234"'), "E121", ["line 9", "'1,234'", "1234"]),
    "open quote": (cell(7, 3, '"1'), "E121", ["quote"]),
    "truth": (cell(7, 3, "True"), "E123", ["line 9", "'True'"]),
    "complex": (cell(7, 3, "1+2j"), "E123", ["line 9", "'1+2j'"]),
    "gzip": (b"\x1f\x8b" + bytes(100), "E126", ["compressed", "unpack"]),
    "parquet": (b"PAR1" + bytes(100), "E120", ["byte 0"]),
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    stub_experiments.install(monkeypatch, identify=stub_experiments.identify)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "project.toml").write_text(PROJECT)
    return tmp_path


def listing(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def fault(folder: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """Run identify, which must fail on its input; returns the line it says."""
    before = listing(folder)
    assert main(["identify", "project.toml"]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert said.err.endswith(".\n")
    assert len(said.err) < 600
    assert "Traceback" not in said.err
    assert listing(folder) == before
    return said.err


def test_the_good_case_is_good(folder: Path) -> None:
    (folder / "a.csv").write_text(text())
    assert main(["identify", "project.toml", "--quiet"]) == 0
    assert (folder / "runs" / "project" / "summary.json").is_file()


@pytest.mark.parametrize("name", TABLES)
def test_bad_table(name: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content, code, words = TABLES[name]
    if isinstance(content, str):
        content = content.encode("latin-1")
    (folder / "a.csv").write_bytes(content)
    line = fault(folder, capsys)
    assert line.startswith(f"{code} ")
    assert "a.csv" in line
    for word in (*words, "Fix: ", "got ", "expected "):
        assert word in line


def test_degrees_for_radians(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    columns = 'theta = "pos"\n"theta.velocity" = "vel"\nvoltage = "cmd"\n'
    project = PROJECT.split("x =")[0] + columns
    (folder / "project.toml").write_text(project)
    (folder / "a.csv").write_text(text())
    assert main(["identify", "project.toml", "--out", "good"]) == 0
    capsys.readouterr()
    (folder / "a.csv").write_text(column(1, np.degrees))
    line = fault(folder, capsys)
    assert line.startswith("E107 ")
    assert "degrees" in line


def test_path_problems(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "no file matches" in fault(folder, capsys)
    for name, make, words in (
        ("folder.csv", lambda p: p.mkdir(), ["a folder"]),
        ("pipe.csv", os.mkfifo, ["a pipe"]),
        ("link.csv", lambda p: p.symlink_to("gone.csv"), ["gone.csv"]),
        ("device.csv", lambda p: p.symlink_to("/dev/zero"), ["a device"]),
    ):
        path = folder / name
        make(path)
        line = fault(folder, capsys)
        assert line.startswith("E130 ")
        for word in (*words, name):
            assert word in line
        path.rmdir() if path.is_dir() else path.unlink()


def test_missing_files_name_the_nearest(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "swing1.csv").write_text(text())
    (folder / "project.toml").write_text(PROJECT.replace("*.csv", "swing.csv"))
    line = fault(folder, capsys)
    assert line.startswith("E130 ")
    assert "did you mean swing1.csv" in line
    nul = PROJECT.replace("*.csv", "a\\u0000.csv")
    (folder / "project.toml").write_text(nul)
    assert fault(folder, capsys).startswith("E131 ")
    assert main(["identify", "projekt.toml"]) == 2
    line = capsys.readouterr().err
    assert line.startswith("E130 ")
    assert "did you mean project.toml" in line


def test_file_growing_while_read(
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = folder / "a.csv"
    path.write_text(text())
    read = Path.read_bytes

    def grow(self: Path) -> bytes:
        content = read(self)
        if self.name == "a.csv":
            with open(self, "ab") as file:
                file.write(b"x")
        return content

    monkeypatch.setattr(Path, "read_bytes", grow)
    assert fault(folder, capsys).startswith("E129 ")


REAL_CASES = {
    "missing file": ("missing", None),
    "missing column": ("E103", text(header="t,pos,vel,phi,cmd")),
    "nan rows": ("E101", changed(7, 1, np.nan)),
    "time stands still": ("E108", changed(50, 0, 0.49)),
    "empty log": ("E115", ""),
}


@pytest.mark.parametrize("name", REAL_CASES)
def test_the_installed_command(name: str, tmp_path: Path) -> None:
    """The real command in a process of its own, as a user meets it."""
    pytest.importorskip("sim2gp.experiments.identify")
    code, content = REAL_CASES[name]
    (tmp_path / "project.toml").write_text(PROJECT)
    if content is not None:
        (tmp_path / "a.csv").write_text(content)
    before = listing(tmp_path)
    call = (
        "import sys; from sim2gp.cli import main; raise SystemExit(main(sys.argv[1:]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", call, "identify", "project.toml"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
    )
    assert done.returncode == 2, done.stderr
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("E130 " if code == "missing" else code)
    assert listing(tmp_path) == before
