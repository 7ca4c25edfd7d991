"""Streams with clocks of their own: what may stand between stamps, what may not."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import recordings as rec
from recordings import Channel, numbers
from recordings import write_streams as write
from sim2gp.data.logs import Column, Log, Resample, read_log
from sim2gp.data.logs.resample import Track, join_tracks
from sim2gp.data.logs.table import Rows
from sim2gp.errors import InputError

STATES = (Channel("q", "rad", angle=True), Channel("x", "m"))
ACTIONS = (Channel("u", "V"),)
COLUMNS = {"q": Column("/arm/q"), "u": Column("/cmd/u")}


def read(path: Path, columns: Any = None, **options: Any) -> tuple[Log, ...]:
    columns = columns or COLUMNS
    return read_log(path, columns, states=STATES, actions=ACTIONS, **options)


def codes(log: Log) -> list[str]:
    return [note.code for note in log.notes]


ARM = 0.004 + 0.01 * np.arange(300)  # 100 Hz
CMD = 0.004 * np.arange(800)  # 250 Hz, and it starts and ends apart from the arm


def asynchronous(path: Path, turns: float = 0.0) -> tuple[Path, np.ndarray, np.ndarray]:
    q = np.sin(3 * ARM) + turns * ARM
    u = np.cos(7 * CMD)
    wrapped = np.angle(np.exp(1j * q))
    streams = {"/arm": (ARM, numbers("q", wrapped)), "/cmd": (CMD, numbers("u", u))}
    return write(path, streams), q, u


def test_default_keeps_measurements_and_holds_commands(tmp_path: Path) -> None:
    path, q, u = asynchronous(tmp_path / "a.mcap")
    (log,) = read(path)
    last = np.searchsorted(CMD, ARM + 1e-10, side="right") - 1
    np.testing.assert_allclose(log.time, ARM, atol=1e-15)
    np.testing.assert_allclose(log.channels["q"], q, rtol=1e-15)
    np.testing.assert_array_equal(log.inputs["u"], u[last])
    assert codes(log) == ["W154", "W154", "W153"]
    text = log.notes[2].text
    assert "at the stamps of /arm" in text
    assert "60 % of the samples of u fall between two rows" in text
    assert "log times" in log.notes[0].text


def test_an_angle_is_unwrapped_before_it_is_interpolated(tmp_path: Path) -> None:
    path, q, u = asynchronous(tmp_path / "a.mcap", turns=20.0)
    (log,) = read(path, resample=Resample(period=0.003))
    at = 0.004 + 0.003 * np.arange(len(log))
    np.testing.assert_allclose(log.time, at, atol=1e-12)
    np.testing.assert_allclose(log.channels["q"], np.interp(at, ARM, q), rtol=1e-9)
    last = np.searchsorted(CMD, at + 1e-10, side="right") - 1
    np.testing.assert_array_equal(log.inputs["u"], u[last])
    assert log.time[-1] <= ARM[-1] < log.time[-1] + 0.003
    # A sample of the angle counts once, at the row next to it.
    nearest = np.zeros(len(at), dtype=bool)
    nearest[np.argmin(np.abs(at[:, None] - ARM), axis=0)] = True
    np.testing.assert_array_equal(log.mask["q"], nearest)
    assert "samples of q are fewer than the rows: each counts once" in str(log.notes)


def test_stamps_of_a_named_stream_and_held_states(tmp_path: Path) -> None:
    path, q, u = asynchronous(tmp_path / "a.mcap")
    (log,) = read(path, resample=Resample("hold", stamps="/cmd"))
    known = (CMD >= ARM[0] - 1e-10) & (CMD <= ARM[-1] + 0.01)
    last = np.searchsorted(ARM, CMD[known] + 1e-10, side="right") - 1
    np.testing.assert_array_equal(log.inputs["u"], u[known])
    np.testing.assert_allclose(log.channels["q"], q[last], rtol=1e-15)
    np.testing.assert_array_equal(log.mask["q"], np.diff(last, prepend=-1) > 0)
    with pytest.raises(InputError, match=r"E103 no stream /cnd.*did you mean /cmd"):
        read(path, resample=Resample(stamps="/cnd"))


def test_nothing_is_taken_across_a_gap(tmp_path: Path) -> None:
    arm = np.delete(ARM, np.arange(100, 110))
    cmd = np.delete(CMD, np.arange(500, 520))
    streams = {
        "/arm": (arm, numbers("q", np.sin(arm))),
        "/cmd": (cmd, numbers("u", np.cos(cmd))),
    }
    path = write(tmp_path / "a.mcap", streams)
    pieces = read(path, resample=Resample(period=0.002))
    edges = [(ARM[0], ARM[99]), (ARM[110], CMD[499] + 0.004), (CMD[520], ARM[-1])]
    assert len(pieces) == 3
    for log, (start, end) in zip(pieces, edges, strict=True):
        assert start - 1e-9 <= log.time[0] <= start + 0.002
        assert end - 0.002 - 1e-9 <= log.time[-1] <= end + 1e-9
    gaps = [note.text for note in pieces[0].notes if note.code == "W111"]
    assert len(gaps) == 2
    assert "a.mcap /arm:message 100" in gaps[0]
    assert "a.mcap /cmd:message 500" in gaps[1]


def test_a_gap_between_two_rows_cuts_too() -> None:
    """A fast stream that pauses for less than the rows' period."""
    fast = np.concatenate([np.arange(50), np.arange(58, 100)]) * 1e-3
    slow = np.arange(0, 10) * 1e-2 + 5e-4
    whole, _ = join_tracks(
        [track("fast", fast, "x"), track("slow", slow, "q")], None, "a.bag"
    )
    # 49 ms is the last before the pause, 58 ms the first after it.
    assert whole.time[whole.cuts].tolist() == [slow[6]]
    assert slow[5] not in whole.time
    closer, _ = join_tracks(
        [track("slow", slow - 2e-3, "q"), track("fast", fast, "x")],
        Resample(stamps="slow"),
        "a.bag",
    )
    np.testing.assert_array_equal(closer.time, slow[1:] - 2e-3)
    assert closer.time[closer.cuts].tolist() == [slow[6] - 2e-3]


def track(stream: str, time: np.ndarray, name: str, **options: Any) -> Track:
    count = len(time)
    values = options.get("values", np.sin(time))
    return Track(
        stream,
        Rows(f"a.bag {stream}", np.arange(count), "message"),
        time,
        np.zeros(count, dtype=bool),
        {} if name == "u" else {name: values},
        {} if name == "u" else {name: options.get("mask", np.ones(count, dtype=bool))},
        {"u": values} if name == "u" else {},
        (),
    )


@given(
    st.lists(st.floats(1e-3, 0.1), min_size=3, max_size=30),
    st.lists(st.floats(1e-3, 0.1), min_size=3, max_size=30),
    st.integers(0, 29),
)
def test_each_row_by_its_definition(a: list[float], b: list[float], bad: int) -> None:
    """Against a loop over rows; steps vary a hundredfold, so that gaps abound."""
    time, other = np.cumsum(a), np.cumsum(b)
    mask = np.arange(len(other)) != bad
    tracks = [
        track("one", time, "q"),
        track("two", other, "x", values=np.cos(9 * other), mask=mask),
        track("three", other, "u", values=np.arange(len(other)) / 7),
    ]
    tracks[0].channels["y"], tracks[0].mask["y"] = time, np.ones(len(time), dtype=bool)
    expected, near = [], []
    median = np.median(np.diff(other))
    for t in time:
        after = np.flatnonzero(other >= t)
        before = np.flatnonzero(other <= t)
        if not before.size or not after.size:
            continue
        i, j = before[-1], after[0]
        if other[j] - other[i] > 5 * median:
            continue
        w = 0.0 if i == j else (t - other[i]) / (other[j] - other[i])
        x = np.cos(9 * other[i]) * (1 - w) + w * np.cos(9 * other[j])
        expected.append((t, x, mask[i] and mask[j], i / 7))
        near.append(j if w >= 0.5 else i)
    for n in set(near):  # a sample counts once
        rows = [k for k in range(len(near)) if near[k] == n]
        best = min(rows, key=lambda k: abs(expected[k][0] - other[n]))
        for k in set(rows) - {best}:
            expected[k] = (*expected[k][:2], False, expected[k][3])
    if len(expected) < 2:
        with pytest.raises(InputError, match="E116"):
            join_tracks(tracks, Resample(stamps="one"), "a.bag")
        return
    whole, _ = join_tracks(tracks, Resample(stamps="one"), "a.bag")
    times, x, counts, u = map(np.asarray, zip(*expected, strict=True))
    np.testing.assert_array_equal(whole.time, times)
    np.testing.assert_allclose(whole.channels["x"], x, atol=1e-12)
    np.testing.assert_array_equal(whole.mask["x"], counts)
    np.testing.assert_allclose(whole.inputs["u"], u)


def test_a_sample_counts_if_both_neighbours_do(tmp_path: Path) -> None:
    q = np.sin(3 * ARM)
    q[[51, 200, 203]] = -9999.0
    streams = {
        "/arm": (ARM, numbers("q", q)),
        "/cmd": (CMD, numbers("u", np.cos(CMD))),
    }
    path = write(tmp_path / "a.mcap", streams)
    (log,) = read(path, resample=Resample(period=0.0125))
    place = (log.time - ARM[0]) / 0.01
    bad = np.isin(np.floor(place + 1e-6), [51, 200, 203])
    bad |= np.isin(np.ceil(place - 1e-6), [51, 200, 203])
    assert bad.sum() == 4  # at 51.25, 200, 202.5, 203.75 samples
    np.testing.assert_array_equal(log.mask["q"], ~bad)
    assert np.max(np.abs(log.channels["q"])) <= 1.0


def test_any_file_is_resampled_on_demand(tmp_path: Path) -> None:
    table = rec.motion()
    table[1::2, 0] += 0.003
    rec.write_csv(tmp_path / "a.csv", table)
    columns = {"q": Column("q"), "u": Column("u")}
    (log,) = read(tmp_path / "a.csv", columns)
    assert codes(log) == ["W110", "W105"]
    assert "resample = {period = 0.013}" in log.notes[0].text
    (log,) = read(tmp_path / "a.csv", columns, resample=Resample(period=0.01))
    np.testing.assert_allclose(np.diff(log.time), 0.01, rtol=1e-12)
    expected = np.interp(log.time, table[:, 0], table[:, 1])
    np.testing.assert_allclose(log.channels["q"], expected, atol=1e-12)
    assert codes(log) == ["W110", "W153", "W105"]


def headed(
    offset: float, values: np.ndarray, times: np.ndarray
) -> list[dict[str, Any]]:
    """Contents whose header is ``offset`` s before the log time."""
    stamps = rec.START + np.round(1e9 * (times - offset)).astype(np.int64)
    return [
        {
            "header": {"stamp": {"sec": int(s) // 10**9, "nanosec": int(s) % 10**9}},
            "q": float(v),
        }
        for s, v in zip(stamps, values, strict=True)
    ]


def test_header_stamps_where_they_are_of_the_same_clock(tmp_path: Path) -> None:
    late, q, u = ARM + 0.0015, np.sin(3 * ARM), np.cos(CMD)
    cmd = (CMD, numbers("u", u))
    path = write(
        tmp_path / "a.mcap", {"/arm": (late, headed(0.0015, q, late)), "/cmd": cmd}
    )
    (log,) = read(path)
    np.testing.assert_allclose(log.time, ARM, atol=2e-9)
    assert "/arm in" in log.notes[0].text
    assert "its headers" in log.notes[0].text
    assert "its log times" in log.notes[1].text
    (log,) = read(path, time="log")
    np.testing.assert_allclose(log.time, late, atol=2e-9)
    with pytest.raises(InputError, match=r"E103 no header stamps.*/cmd"):
        read(path, time="header")
    with pytest.raises(InputError, match=r"E160 no such clock.*'stamp'"):
        read(path, time="stamp")
    # A clock since the robot was switched on is not mixed with the recorder's.
    boot = rec.START / 1e9 - 100
    far = {"/arm": (late, headed(boot, q, late)), "/cmd": cmd}
    (log,) = read(write(tmp_path / "b.mcap", far))
    np.testing.assert_allclose(log.time, late, atol=2e-9)
    alone = {"q": Column("/arm/q"), "u": 0.0}
    (log,) = read(tmp_path / "b.mcap", alone)
    np.testing.assert_allclose(log.time, ARM - ARM[0], atol=5e-7)


def test_zero_stamps_are_no_stamps(tmp_path: Path) -> None:
    rec.write_bag(tmp_path / "bag", rec.motion(), "sqlite3", headed=False)
    names = ("/joint_states/elbow/position", "/cmd/data[0]")
    columns = {n: Column(c) for n, c in zip(("q", "u"), names, strict=True)}
    (log,) = read(tmp_path / "bag", columns)
    np.testing.assert_array_equal(log.time, rec.motion()[:, 0])
    assert "its log times" in log.notes[0].text


def test_excluded_times_and_repeated_stamps(tmp_path: Path) -> None:
    arm = np.sort(np.concatenate([ARM, ARM[[20, 200]]]))
    q = np.sin(3 * arm)
    q[21] += 0.1  # the second row of its stamp
    path = write(
        tmp_path / "a.mcap",
        {"/arm": (arm, numbers("q", q)), "/cmd": (CMD, numbers("u", np.cos(CMD)))},
    )
    with pytest.raises(InputError, match=r"E108 dup.*/arm:message 21.*keep_first"):
        read(path)
    one, two = read(path, keep_first=True, exclude=[(1.0, 1.1)])
    np.testing.assert_allclose(
        np.concatenate([one.time, two.time]), ARM[(ARM < 1) | (ARM > 1.1)], atol=1e-15
    )
    np.testing.assert_allclose(one.channels["q"], np.sin(3 * one.time), atol=1e-12)
    assert "W108" in codes(one)


def test_topics_that_several_nodes_share(tmp_path: Path) -> None:
    """Two arms on one topic are two streams; a field that comes and goes is refused."""
    times = np.sort(np.concatenate([ARM, ARM + 0.005]))
    names, parts = (["left"], ["right"]), [np.sin(ARM), np.cos(ARM)]
    contents = [
        {"name": names[i % 2], "position": [float(parts[i % 2][i // 2])]}
        for i in range(600)
    ]
    cmd = (CMD, numbers("u", np.cos(CMD)))
    path = write(tmp_path / "a.mcap", {"/joints": (times, contents), "/cmd": cmd})
    columns = {
        "q": Column("/joints/left/position"),
        "x": Column("/joints/right/position"),
        "u": Column("/cmd/u"),
    }
    (log,) = read(path, columns)
    np.testing.assert_allclose(log.channels["q"], np.sin(log.time), rtol=1e-9)
    expected = np.interp(log.time, ARM + 0.005, parts[1])
    np.testing.assert_allclose(log.channels["x"], expected, rtol=1e-9)
    contents[7] |= {"name": ["left", "right"], "position": [0.0, 0.0]}
    path = write(tmp_path / "b.mcap", {"/joints": (times, contents), "/cmd": cmd})
    with pytest.raises(InputError, match=r"E140 field that comes and goes.*message 7"):
        read(path, columns)


def test_the_order_of_joints_and_bare_numbers(tmp_path: Path) -> None:
    names, values = ["left", "right"], [np.sin(ARM), np.cos(ARM)]
    contents = [
        {
            "name": names[:: 1 - 2 * (i % 2)],
            "position": [float(v[i]) for v in values[:: 1 - 2 * (i % 2)]],
        }
        for i in range(len(ARM))
    ]
    commands = [[float(v)] for v in np.cos(CMD)]
    path = write(tmp_path / "a.mcap", {"/j": (ARM, contents), "/cmd": (CMD, commands)})
    columns = {"q": Column("/j/left/position"), "x": Column("/j/right/position")}
    (log,) = read(path, columns | {"u": Column("/cmd[0]")})
    np.testing.assert_allclose(log.channels["q"], values[0], rtol=1e-15)
    np.testing.assert_allclose(log.channels["x"], values[1], rtol=1e-15)
