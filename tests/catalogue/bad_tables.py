"""Bad inputs 26 to 45: text and numbers of tables, files and paths."""

import bz2
import gzip
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sim2gp.data.logs import shared_rows
from sim2gp.errors import InputError
from sim2gp.project import load_project
from tests.catalogue import bad_inputs as bad
from tests.catalogue.bad_inputs import (
    IDENTIFY,
    PROJECT,
    ROWS,
    TEXTS,
    Case,
    Input,
    Patch,
    case,
    cell,
    column,
    log,
    named,
    npz,
    stored,
    table,
    text,
)

HEAD, BODY = TEXTS.split("\n", 1)


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


MISSING_ID = np.where(np.arange(ROWS) == 7, np.nan, 0.0)

TABLES: tuple[Case, ...] = (
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
