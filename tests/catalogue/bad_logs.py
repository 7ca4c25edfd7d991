"""Bad inputs 1 to 25: values, columns and clocks of logs."""

from pathlib import Path

import numpy as np

from sim2gp.data.logs import period_matches
from sim2gp.project import load_project
from tests.catalogue import bad_inputs as bad
from tests.catalogue.bad_inputs import (
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
    npz,
    stored,
    swapped,
    table,
    text,
)

HEAD, BODY = TEXTS.split("\n", 1)
STRICT = (*IDENTIFY, "--strict")


def of_one_period(folder: Path, patch: Patch) -> None:
    """No command wants it: windows take the stamps as they are."""
    (folder / "project.toml").write_text(PROJECT)
    (folder / "a.csv").write_text(TEXTS)
    (found,) = load_project(folder / "project.toml").load_logs()
    period_matches(found, 0.02)


UNSTEADY = PERIOD * (np.arange(ROWS) + 0.2 * np.sin(np.arange(ROWS)))
PAUSED = np.delete(table(), slice(100, 120), axis=0)

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
        log(text(header="t,pos,vel,pos,cmd"), "repeated_column", "columns 2 and 4"),
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
        log(text(bad.late(3)), "W118", "voltage", "3 rows behind"),
        log(text(bad.late(-2)), "W118", "voltage", "2 rows ahead"),
        log(text(bad.late(0)), "", warnings=1),  # that the pole does not move
    ),
)
