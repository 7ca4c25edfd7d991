"""Logs against closed forms: what is written to a file is what comes back."""

import math
from pathlib import Path

import numpy as np
import pytest

from recordings import Channel
from sim2gp.data.logs import (
    Column,
    Log,
    Note,
    note_lines,
    read_log,
    shared_rows,
)

STATES = (
    Channel("q", "rad", angle=True),
    Channel("x", "m", low=-1.0, high=1.0),
    Channel("q.velocity", "rad/s"),
    Channel("x.velocity", "m/s"),
)
ACTIONS = (Channel("u", "V"),)
COLUMNS = {"q": Column("pos"), "q.velocity": Column("vel"), "u": Column("cmd")}
HEADER = "t,pos,vel,cmd"


def swing(rows: int = 400, dt: float = 0.01) -> np.ndarray:
    """A swing ``q = sin(3 t)`` with its exact rate, and a chirp of an input."""
    t = dt * np.arange(rows)
    return np.stack([t, np.sin(3 * t), 3 * np.cos(3 * t), np.sin(t**2)], axis=1)


def write(path: Path, table: np.ndarray, header: str = HEADER, **style: str) -> Path:
    join = style.get("join", ",")
    rows = [join.join(repr(float(v)) for v in row) for row in table]
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


def read(path: Path, columns: object = None, **options: object) -> tuple[Log, ...]:
    options = {"states": STATES, "actions": ACTIONS, "time": "t"} | options
    return read_log(path, columns or COLUMNS, **options)


def codes(log: Log) -> list[str]:
    """What is said of a log, but for columns that a test leaves unused."""
    return [note.code for note in log.notes if note.code != "W105"]


def test_values_come_back_bit_by_bit(tmp_path: Path) -> None:
    table = swing()
    (log,) = read(write(tmp_path / "a.csv", table))
    assert log.name == "a"
    assert len(log) == 400
    np.testing.assert_array_equal(log.time, table[:, 0])
    np.testing.assert_array_equal(log.channels["q"], table[:, 1])
    np.testing.assert_array_equal(log.channels["q.velocity"], table[:, 2])
    np.testing.assert_array_equal(log.inputs["u"], table[:, 3])
    assert all(mask.all() for mask in log.mask.values())
    assert log.notes == ()
    assert log.period == pytest.approx(0.01)
    assert log.duration == pytest.approx(3.99)


def test_unmeasured_channels_are_masked(tmp_path: Path) -> None:
    (log,) = read(write(tmp_path / "a.csv", swing()))
    values, mask = log.measured([channel.name for channel in STATES])
    assert mask.all(axis=0).tolist() == [True, False, True, False]
    assert not values[:, 1].any()
    np.testing.assert_array_equal(log.commanded(["u"])[:, 0], log.inputs["u"])


@pytest.mark.parametrize(
    "text",
    [
        "\ufeff" + "{}",  # a byte-order mark
        "{}\n\n\n",  # blank lines at the end
        "\n{}",  # and at the start
    ],
)
def test_harmless_dress_is_accepted(tmp_path: Path, text: str) -> None:
    path = write(tmp_path / "a.csv", swing(), " t, pos , vel,  cmd")
    plain = path.read_text(encoding="utf-8")
    path.write_text(text.format(plain.replace("\n", "\r\n")), encoding="utf-8")
    (log,) = read(path)
    np.testing.assert_array_equal(log.channels["q"], swing()[:, 1])


def test_spaces_quotes_and_denormals_are_numbers(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = ['0.0, 1.0, "0.0", 5e-324', "0.1, 1.0, 0.0, 1", "0.2, 1.0, 0.0, 2"]
    path.write_text("\n".join([HEADER, *rows]))
    (log,) = read(path)
    assert log.inputs["u"].tolist() == [5e-324, 1.0, 2.0]


def test_sign_scale_offset_unit_and_time(tmp_path: Path) -> None:
    table = swing()
    raw = table * np.array([1e3, -180 / np.pi, 60 / (2 * np.pi), 0.5])
    raw[:, 1] += 90.0
    columns = {
        "q": Column("pos", unit="deg", sign=-1, offset=math.pi / 2),
        "q.velocity": Column("vel", unit="rpm"),
        "u": Column("cmd", scale=2.0),
    }
    path = write(tmp_path / "a.csv", raw)
    (log,) = read(path, columns, time=Column("t", unit="ms"))
    np.testing.assert_allclose(log.time, table[:, 0], atol=1e-14)
    np.testing.assert_allclose(log.channels["q"], table[:, 1], atol=1e-13)
    np.testing.assert_allclose(log.channels["q.velocity"], table[:, 2], atol=1e-13)
    np.testing.assert_allclose(log.inputs["u"], table[:, 3], atol=1e-15)


def test_wrapped_angles_are_unwrapped_and_it_is_said(tmp_path: Path) -> None:
    table = swing()
    table[:, 1] = 4.0 * table[:, 0] ** 2
    table[:, 2] = 8.0 * table[:, 0]
    wrapped = table.copy()
    wrapped[:, 1] = np.angle(np.exp(1j * table[:, 1]))
    (log,) = read(write(tmp_path / "a.csv", wrapped))
    np.testing.assert_allclose(log.channels["q"], table[:, 1], atol=1e-12)
    assert codes(log) == ["W122"]
    assert f"wraps {np.sum(np.diff(wrapped[:, 1]) < -3)} times" in log.notes[0].text


def test_a_length_is_never_unwrapped(tmp_path: Path) -> None:
    table = swing()
    table[200:, 1] += 0.8
    columns = {"x": Column("pos", scale=6.0), "u": Column("cmd")}
    (log,) = read(write(tmp_path / "a.csv", table), columns)
    np.testing.assert_allclose(log.channels["x"], 6.0 * table[:, 1])


def test_gap_starts_a_new_episode(tmp_path: Path) -> None:
    table = swing()
    table[150:, 0] += 0.06
    table[300, 0] += 0.004  # jitter is no gap
    first, second = read(write(tmp_path / "a.csv", table))
    assert (first.name, len(first)) == ("a[0]", 150)
    assert (second.name, len(second)) == ("a[1]", 250)
    assert codes(first) == ["W110", "W111"]
    assert "before line 152" in first.notes[1].text
    assert np.max(np.diff(second.time)) < 0.02


def test_a_row_alone_between_gaps_is_no_episode(tmp_path: Path) -> None:
    table = swing()
    table[150:, 0] += 0.1
    table[151:, 0] += 0.1
    logs = read(write(tmp_path / "a.csv", table))
    assert [len(log) for log in logs] == [150, 249]
    assert [log.name for log in logs] == ["a[0]", "a[1]"]


def test_excluded_times_are_cut_out(tmp_path: Path) -> None:
    table = swing()
    table[100:120, 1] = np.nan  # what is excluded may be anything
    path = write(tmp_path / "a.csv", table)
    first, second = read(path, exclude=[(0.995, 1.195)])
    assert (len(first), len(second)) == (100, 280)
    assert first.time[-1] == table[99, 0]
    assert second.time[0] == table[120, 0]
    assert codes(first) == []


def test_dropped_values_are_masked_and_counted(tmp_path: Path) -> None:
    table = swing()
    table[50:53, 1] = np.nan
    table[70, 3] = np.inf
    first, second = read(write(tmp_path / "a.csv", table), drop_nonfinite=True)
    assert (len(first), len(second)) == (70, 329)  # no command, no transition
    assert np.flatnonzero(~first.mask["q"]).tolist() == [50, 51, 52]
    assert first.mask["q.velocity"].all()
    assert second.mask["q"].all()
    np.testing.assert_allclose(first.channels["q"], np.sin(3 * first.time), atol=2e-3)
    assert codes(first) == ["W101", "W152"]
    assert "1 rows" in first.notes[0].text
    assert "3 samples" in first.notes[1].text


def test_saturation_masks_measurements_and_clips_commands(tmp_path: Path) -> None:
    columns = {
        "q": Column("pos", unit="rad", sign=-1, saturation=(-0.5, 0.9)),
        "u": Column("cmd", scale=2.0, saturation=(-0.25, 0.75)),
    }
    table = swing()
    (log,) = read(write(tmp_path / "a.csv", table), columns)
    inside = (table[:, 1] > -0.5) & (table[:, 1] < 0.9)
    np.testing.assert_array_equal(log.mask["q"], inside)
    np.testing.assert_array_equal(log.inputs["u"], 2 * table[:, 3].clip(-0.25, 0.75))
    assert sorted(codes(log)) == ["W151", "W152"]


def test_end_stops_mask_samples(tmp_path: Path) -> None:
    table = swing()
    (log,) = read(write(tmp_path / "a.csv", table), limits={"q": (-0.9, 0.9)})
    np.testing.assert_array_equal(log.mask["q"], np.abs(table[:, 1]) < 0.9)


def test_constant_inputs_need_no_column(tmp_path: Path) -> None:
    columns = {"q": Column("pos"), "u": 1.5}
    (log,) = read(write(tmp_path / "a.csv", swing()), columns)
    assert set(log.inputs["u"]) == {1.5}
    assert codes(log) == ["W117"]


def test_rare_sentinels_are_masked(tmp_path: Path) -> None:
    table = swing()
    table[[10, 200], 1] = -9999.0
    (log,) = read(write(tmp_path / "a.csv", table))
    assert np.flatnonzero(~log.mask["q"]).tolist() == [10, 200]
    assert np.max(np.abs(log.channels["q"])) < 1.1
    assert codes(log)[0] == "W102"


def test_jitter_is_stated_not_refused(tmp_path: Path) -> None:
    table = swing()
    table[1::2, 0] += 0.003
    (log,) = read(write(tmp_path / "a.csv", table))
    assert codes(log) == ["W110"]
    assert "7, 13, 13 ms" in log.notes[0].text


def test_nothing_moves_and_counters_wrap_are_said(tmp_path: Path) -> None:
    still = swing()
    still[:, 1:3] = 0.0
    (log,) = read(write(tmp_path / "still.csv", still))
    assert codes(log) == ["W117"]
    counts = swing()
    counts[:, 1] = np.mod(np.arange(400) * 3, 256)
    columns = {"x": Column("pos", scale=1e-3), "u": Column("cmd")}
    (log,) = read(write(tmp_path / "counts.csv", counts), columns)
    assert codes(log) == ["W122"]


def test_shared_rows_are_counted(tmp_path: Path) -> None:
    table = swing()
    (train,) = read(write(tmp_path / "a.csv", table[:300]))
    (test,) = read(write(tmp_path / "b.csv", table[250:]))
    (note,) = shared_rows([train], [test])
    assert note.code == "W128"
    assert note.text.startswith("50 rows")
    (other,) = read(write(tmp_path / "c.csv", table[300:]))
    assert shared_rows([train], [other]) == []


def test_logs_that_begin_at_rest_share_no_rows(tmp_path: Path) -> None:
    still, table = swing(), swing()
    still[:50, 1:] = 0.0
    table[:, 1:] = 0.5 * np.maximum(still[:, 1:], 0.0)
    (train,) = read(write(tmp_path / "a.csv", still), {"q": Column("pos"), "u": 0.0})
    (test,) = read(write(tmp_path / "b.csv", table), {"q": Column("pos"), "u": 0.0})
    assert shared_rows([train], [test]) == []
    (note,) = shared_rows([train], [train])
    assert note.text.startswith("350 rows")


def test_real_arm(shared_data: Path) -> None:
    states = (
        *(Channel(f"q{i}", "rad", angle=True) for i in (1, 2)),
        *(Channel(f"q{i}.velocity", "rad/s") for i in (1, 2)),
    )
    actions = tuple(Channel(f"torque{i}", "N m") for i in (1, 2))
    columns = {
        f"{name}{i}{end}": Column(f"{column}{i}")
        for i in (1, 2)
        for name, end, column in [
            ("q", "", "pos_meas"),
            ("q", ".velocity", "vel_meas"),
            ("torque", "", "tau_con"),
        ]
    }
    files = sorted((shared_data / "double_pendulum" / "excitation").glob("*.csv"))
    logs = [read_log(f, columns, states=states, actions=actions) for f in files]
    assert [len(pieces) for pieces in logs] == [1] * 6
    assert sum(len(log) for (log,) in logs) == 29987
    raw = np.genfromtxt(files[0], delimiter=",", names=True)
    np.testing.assert_array_equal(logs[0][0].channels["q2"], raw["pos_meas2"])


def test_real_furuta_has_spaces_in_its_header(shared_data: Path) -> None:
    states = (Channel("theta", "rad", True), Channel("alpha", "rad", True))
    columns = {
        "theta": Column("theta"),
        "alpha": Column("alpha", offset=math.pi),
        "voltage": Column("plant_input"),
    }
    for file in sorted((shared_data / "qube").glob("*.csv")):
        (log,) = read_log(
            file, columns, states=states, actions=(Channel("voltage", "V"),), time="t"
        )
        assert len(log) == 10000
        assert log.period == pytest.approx(0.002)
        assert np.all(np.abs(log.channels["alpha"] - math.pi) < 0.3)


def noted(source: str, *notes: Note) -> Log:
    t = np.arange(2.0)
    return Log(source[:-4], source, t, {}, {}, {}, notes=notes)


def test_what_holds_for_many_logs_is_said_once(tmp_path: Path) -> None:
    """43 files with one unused column and uneven stamps: two lines, not 86."""
    logs = []
    for k in range(43):
        table = np.column_stack([swing(60), np.zeros(60)])
        table[30:, 0] += 2e-3 + 1e-4 * k  # another period in each file
        path = write(tmp_path / f"log{k}.csv", table, f"{HEADER},spare{k // 40}")
        logs += read(path)
    lines = note_lines(logs)
    assert len(lines) == 3
    assert lines[0].startswith("W110 in 43 logs, the first: period varies in")
    assert f"{logs[0].source}: 10, 10, 12 ms" in lines[0]
    assert lines[1].startswith("W105 in 40 logs, the first: columns of")
    assert lines[1].endswith("nothing takes: spare0")
    assert lines[2].startswith("W105 in 3 logs")
    assert lines[2].endswith("nothing takes: spare1")


def test_what_several_notes_say_of_one_log_is_kept() -> None:
    gaps = [Note("W111", f"gap of {k} s in a.csv before line {9 * k}") for k in (1, 2)]
    one = noted("a.csv", *gaps, Note("W117", "constant input u in a.csv"))
    other = noted("b.csv", Note("W117", "constant input v in b.csv"))
    assert note_lines([one, other]) == [
        *(str(note) for note in gaps),
        "W117 constant input u in a.csv",
        "W117 constant input v in b.csv",
    ]
    shared = [Note("W128", f"{k} rows of {k}.csv were also fitted to") for k in "ab"]
    assert note_lines([noted("a.csv"), noted("b.csv")], [shared[0], *shared]) == [
        "W128 a rows of a.csv were also fitted to",
        "W128 b rows of b.csv were also fitted to",
    ]
    more = [Note("W128", f"{k} rows of {'ab'[k]}.csv are known") for k in (0, 1)]
    assert note_lines([noted("a.csv"), noted("b.csv")], more) == [
        "W128 in 2 logs, the first: 0 rows of a.csv are known"
    ]
    assert note_lines([]) == []
