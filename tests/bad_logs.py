"""Bad inputs 1 to 45: tables, logs, clocks, files and paths."""

import bz2
import gzip
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import bad_inputs as bad
from bad_inputs import (
    HEADER,
    IDENTIFY,
    PERIOD,
    PROJECT,
    ROWS,
    TEXTS,
    Case,
    Input,
    Patch,
    case,
    cell,
    changed,
    clock,
    column,
    log,
    named,
    npz,
    stored,
    swapped,
    table,
    text,
)
from sim2gp.data.logs import period_matches, shared_rows
from sim2gp.errors import InputError
from sim2gp.project import load_project

HEAD, BODY = TEXTS.split("\n", 1)
STRICT = (*IDENTIFY, "--strict")


def of_one_period(folder: Path, patch: Patch) -> None:
    """No command wants it: windows take the stamps as they are."""
    (folder / "project.toml").write_text(PROJECT)
    (folder / "a.csv").write_text(TEXTS)
    (found,) = load_project(folder / "project.toml").load_logs()
    period_matches(found, 0.02)


def in_two_files(folder: Path, patch: Patch) -> None:
    """`evaluate` says it after its fit, in the words of this function."""
    (folder / "project.toml").write_text(PROJECT)
    (folder / "a.csv").write_text(text(table()[:200]))
    (folder / "b.csv").write_text(text(table()[150:]))
    train, test = load_project(folder / "project.toml").load_logs()
    (note,) = shared_rows([train], [test])
    raise InputError(note.code, note.text, got="", expected="", fix="-")


def misspelt(files: str, key: str, *said: str) -> Input:
    """A project that names almost the file that is there."""

    def make(folder: Path, patch: Patch) -> Sequence[str]:
        (folder / "swing1.csv").write_text(TEXTS)
        (folder / "project.toml").write_text(PROJECT.replace("*.csv", files))
        return IDENTIFY

    return Input(key, said, make)


def words(command: str, key: str, *said: str) -> Input:
    """A command beside a project."""

    def make(folder: Path, patch: Patch) -> Sequence[str]:
        (folder / "project.toml").write_text(PROJECT)
        return command.split()

    return Input(key, said, make)


UNSTEADY = PERIOD * (np.arange(ROWS) + 0.2 * np.sin(np.arange(ROWS)))
PAUSED = np.delete(table(), slice(100, 120), axis=0)
MISSING_ID = np.where(np.arange(ROWS) == 7, np.nan, 0.0)

FIRST: tuple[Case, ...] = (
    case(
        1,
        "NaN in a row",
        log(
            changed(7, 1, np.nan), "value_not_finite", "line 9", "pos", "drop_nonfinite"
        ),
        log(cell(7, 4, ""), "value_not_finite", "line 9", "cmd", "nan"),
        log(
            column(3, lambda v: np.where(v > 0, v, np.nan)),
            "value_not_finite",
            "angle",
            "142 such",
            "160, 161, 162, 163, 164, ...",
        ),
        stored(
            "a.npz", npz(pos=np.full(ROWS, np.nan)), "value_not_finite", "row 0", "pos"
        ),
    ),
    case(
        2,
        "infinity",
        log(changed(7, 4, np.inf), "value_not_finite", "line 9", "cmd", "inf"),
    ),
    case(
        3,
        "sentinel values",
        log(bad.marked(150), "W102", "line 2", "-9999", "0.67 %"),
        log(bad.marked(20), "sentinel_in_column", "line 2", "angle", "5.0 %"),
    ),
    case(
        4,
        "missing column",
        log(text(header="t,pos,vel,phi,cmd"), "missing_column", "column angle", "phi"),
        log(BODY, "no_header", "no header"),
    ),
    case(
        5,
        "misspelt column",
        log(text(header="t,pos,vel,Angle,cmd"), "missing_column", "did you mean Angle"),
        log(text(header="t,pos,vel,angel,cmd"), "missing_column", "did you mean angel"),
    ),
    case(
        6,
        "duplicate column names",
        log(text(header="t,pos,vel,pos,cmd"), "column_stands_twice", "columns 2 and 4"),
    ),
    case(
        7,
        "extra unknown columns",
        log(bad.episodes(np.zeros(ROWS)), "W105", "nothing takes: run"),
        log(
            bad.episodes(np.zeros(ROWS)),
            "columns_nothing_takes",
            "got run",
            command=STRICT,
        ),
        log(TEXTS, "", command=STRICT),
    ),
    case(
        8,
        "columns swapped",
        log(
            swapped(1, 2), "columns_swapped", "columns swapped", "slope", "correlation"
        ),
        log(column(2, np.cos), "position_and_velocity_disagree", "correlation"),
    ),
    case(
        9,
        "degrees as radians",
        log(
            column(1, np.degrees),
            "velocity_in_wrong_unit",
            "degrees",
            project=bad.DEGREES,
        ),
        log(TEXTS, "", project=bad.DEGREES),
    ),
    case(
        10,
        "mm for m, ms for s",
        log(column(1, lambda v: 1e3 * v), "travel_beyond_limits", "x", "mm"),
        log(
            column(0, lambda v: 1e3 * v),
            "time_in_another_unit",
            "period of 10 s",
            '"ms"',
        ),
        log(
            column(0, lambda v: 1e6 * v),
            "time_in_another_unit",
            "period of 10000 s",
            '"us"',
        ),
    ),
    case(
        11,
        "sign flip",
        log(
            column(2, np.negative),
            "position_and_velocity_disagree",
            "slope -1",
            "sign = -1",
        ),
    ),
    case(
        12,
        "time not increasing",
        log(
            changed(50, 0, 0.48),
            "time_does_not_increase",
            "line 52",
            "0.48 s after 0.49",
        ),
        log(column(0, np.negative), "time_does_not_increase", "line 3", "sort"),
    ),
    case(
        13,
        "duplicate stamps",
        log(
            changed(50, 0, 0.49),
            "duplicate_time_stamp",
            "line 52",
            "duplicate",
            "keep_first",
        ),
    ),
    case(
        14,
        "clock jump",
        log(clock(-0.5), "clock_jump", "line 102", "jump of -0.49"),
        log(clock(1e6), "clock_jump", "line 102", "jump of 1000000"),
        log(text(table()[[0, 1]] * [1e8, 1, 1, 1, 1]), "clock_jump", "line 3"),
    ),
    # A variable period is stated and used as it is (contracts.md).
    case(
        15,
        "variable rate",
        log(
            text(table(UNSTEADY)),
            "W110",
            "8.08, 10, 11.9 ms (minimum, median, maximum)",
            "resample = {period",
        ),
    ),
    case(
        16,
        "gap",
        log(text(PAUSED), "W111", "line 102", "gap of 0.21 s", n_transitions=278),
    ),
    case(
        17,
        "epoch seconds in float32",
        log(
            column(0, lambda v: np.float32(v + 1.7e9)),
            "stamps_lost_resolution",
            "float32",
            "resolved to 128 s",
        ),
    ),
    case(
        18,
        "period of another step",
        Input(
            "period_differs_from_step",
            ("a.csv", "got 0.01 s", "expected 0.02 s"),
            of_one_period,
        ),
    ),
    case(
        19,
        "time as text",
        log(cell(0, 0, "2024-05-01T12:00:00"), "time_as_date", "line 2", "12.345"),
        log(cell(0, 0, "12:00:01"), "time_as_date", "line 2", "'12:00:01'"),
    ),
    case(
        20,
        "empty file",
        log("", "empty_table", "empty file"),
        log("\n\n  \n", "empty_table", "empty file"),
        stored(
            "a.npz", lambda path: path.write_bytes(b""), "empty_recording", "empty file"
        ),
    ),
    case(21, "header only", log(HEADER + "\n", "no_rows_below_header", "no rows")),
    case(
        22,
        "one row",
        log(
            "\n".join(TEXTS.split("\n")[:2]),
            "no_transition",
            "1 usable row,",
            "at least 2",
        ),
    ),
    case(
        23,
        "no excitation",
        log(text(table() * [1, 0, 0, 0, 0]), "W117", "keep their prior"),
    ),
    case(
        24,
        "constant action",
        log(column(4, np.zeros_like), "W117", "constant input voltage"),
    ),
    case(
        25,
        "action and state misaligned",
        log(text(bad.late(3)), "W118", "voltage", "3 rows late"),
        log(text(bad.late(-2)), "W118", "voltage", "2 rows early"),
        log(text(bad.late(0)), "", warnings=1),  # that the pole does not move
    ),
    case(
        26,
        "wrong delimiter, decimal comma",
        log(
            TEXTS.replace(",", ";"), "wrong_delimiter", "line 1", "semicolons", "'t;pos"
        ),
        log(TEXTS.replace(",", "\t"), "wrong_delimiter", "line 1", "tabs"),
        log(
            HEAD + "\n" + BODY.replace(".", ","),
            "wrong_delimiter",
            "line 2",
            "decimal commas",
        ),
        log(
            HEAD + "\n" + BODY.replace(",", ";"),
            "wrong_delimiter",
            "line 2",
            "semicolons",
        ),
    ),
    case(
        27,
        "wrong encoding, NUL",
        log(TEXTS.encode("utf-16"), "not_utf8_text", "byte 0", "0xff"),
        log("° " + TEXTS, "not_utf8_text", "byte 0", "0xb0"),
        log(b"t,pos\x00" + TEXTS.encode(), "not_utf8_text", "byte 5", "0x00"),
        log(b"PAR1" + bytes(100), "not_utf8_text", "byte 0"),
        # A spreadsheet's byte-order mark harms nobody.
        log(TEXTS.encode("utf-8-sig"), ""),
    ),
    case(
        28,
        "ragged row",
        log(cell(7, 4, "1,2"), "ragged_row", "line 9", "6 fields", "5 fields"),
        log(TEXTS + "1.0,2.0\n", "ragged_row", "line 302", "2 fields"),
        log(cell(7, 3, '"1'), "quote_never_closes", "quote"),
    ),
    case(
        29,
        "text in a numeric column",
        log(
            cell(7, 3, "n/a " + 60 * "x"), "text_in_cell", "line 9", "angle", "xxx...'"
        ),
        stored(
            "a.npz",
            npz(pos=np.array(["a"] * ROWS)),
            "text_in_array",
            "column pos",
            "<U1",
        ),
    ),
    case(
        30,
        "numbers as strings",
        log(cell(7, 3, '"1,234"'), "thousands_separators", "line 9", "'1,234'", "1234"),
    ),
    case(
        31,
        "overflow, denormals",
        log(cell(7, 4, "1e400"), "value_not_finite", "line 9", "cmd", "inf"),
        log(cell(7, 4, "5e-324"), ""),
    ),
    case(
        32,
        "encoder overflow",
        log(
            column(1, lambda v: np.mod(np.arange(ROWS) * 3, 256)),
            "W122",
            "jumps by 2^8 3 times",
            project=bad.COUNTS,
        ),
    ),
    case(
        33,
        "angle wrap",
        log(column(3, lambda v: bad.WRAPPED), "W122", "theta", "wraps 4 times"),
    ),
    case(
        34,
        "complex, bool, object",
        log(cell(7, 3, "True"), "truth_or_complex_cell", "line 9", "'True'"),
        log(cell(7, 3, "1+2j"), "truth_or_complex_cell", "line 9", "'1+2j'"),
        stored(
            "a.npz",
            npz(cmd=bad.GOOD["cmd"] + 0j),
            "array_not_real",
            "cmd",
            "complex128",
        ),
        stored("a.npz", npz(cmd=bad.GOOD["cmd"] > 0), "array_not_real", "cmd", "bool"),
    ),
    case(
        35,
        "float16",
        stored(
            "a.npz",
            npz(pos=np.float16(bad.GOOD["pos"])),
            "too_few_digits",
            "pos",
            "float16",
        ),
    ),
    case(
        36,
        "truncated Parquet",
        stored("a.parquet", bad.short_parquet, "no_footer", "incomplete", "bytes"),
    ),
    case(
        37,
        "corrupt Parquet page",
        stored(
            "a.parquet",
            bad.damaged_page,
            "file_incomplete_or_damaged",
            "column pos, row group 1",
        ),
    ),
    case(
        38,
        "Parquet that declares too much",
        stored("a.parquet", bad.many_rows, "beyond_the_budget", "too many numbers"),
    ),
    case(
        39,
        "compressed bomb",
        log(
            gzip.compress(bytes(10_000_000)), "compressed_file", "compressed", "unpack"
        ),
        log(bz2.compress(bytes(1000)), "compressed_file", "compressed", "unpack"),
    ),
    case(
        40,
        "episode ids",
        log(
            bad.episodes(MISSING_ID),
            "episode_id_missing",
            "line 9",
            "missing",
            project=bad.BY_RUN,
        ),
        log(
            bad.episodes(np.arange(ROWS) // 100 % 2),
            "episodes_interleaved",
            "line 202",
            "interleaved",
            project=bad.BY_RUN,
        ),
    ),
    case(
        41,
        "train and test share rows",
        Input("W128", ("50 rows of", "b.csv"), in_two_files),
    ),
    case(
        42,
        "file that changes",
        Input("file_changed_while_read", ("a.csv",), bad.growing),
    ),
    case(
        43,
        "no regular file",
        stored("a.csv", Path.mkdir, "not_a_file", "a folder"),
        stored("a.csv", os.mkfifo, "not_a_file", "a pipe"),
        stored("a.csv", bad.bound_socket, "not_a_file", "a socket"),
        stored(
            "a.csv", lambda path: path.symlink_to("/dev/zero"), "not_a_file", "a device"
        ),
        named("/dev/zero", "not_a_file", "a device"),
    ),
    case(
        44,
        "unreadable file",
        stored("a.csv", bad.locked, "file_cannot_be_read"),
        stored(
            "a.csv", lambda path: path.symlink_to("gone"), "file_cannot_be_read", "gone"
        ),
        named("b.csv", "file_cannot_be_read", "b.csv", "no such file"),
        named("*.cvs", "no_file_matches", "no file matches", "*.cvs"),
        misspelt("swing.csv", "file_cannot_be_read", "did you mean swing1.csv"),
        words(
            "identify projekt.toml", "file_cannot_be_read", "did you mean project.toml"
        ),
    ),
    # The user's own logs may lie anywhere; what a file itself names may not.
    case(
        45,
        "path with NUL, or outside",
        named("a\\u0000.csv", "nul_in_pattern", "line 4", "NUL"),
        stored("a.h5", bad.outside, "data_in_another_file", "pos"),
    ),
)
