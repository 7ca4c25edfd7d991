"""What unpacks to gigabytes is refused before it does, in a measured process."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import bombs

MIB = 2**20
#: Reads one file and prints what came of it, the seconds and the memory that it took.
CHILD = """
import json, resource, sys, time
import h5py, lz4.frame, mcap.reader, pyarrow.parquet, rosbags.rosbag2, zstandard
import rosbags.typesys
from sim2gp.errors import InputError
from sim2gp.data.logs import Column, read_log

class Channel:
    def __init__(self, name, unit):
        self.name, self.unit, self.angle = name, unit, False
        self.low, self.high = -1e9, 1e9

def peak():
    # Not ru_maxrss: that of a child begins with what its parent had.
    with open("/proc/self/status") as file:
        (line,) = (x for x in file if x.startswith("VmHWM"))
    return int(line.split()[1])

path, *names = sys.argv[1:]
with open("/proc/self/statm") as file:
    held = int(file.read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (held + 2**31, held + 2**31))
states = [Channel("q", "m"), Channel("q.velocity", "m/s")]
columns = {n: Column(c) for n, c in zip(("q", "q.velocity", "u"), names)}
before = peak()
started = time.perf_counter()
try:
    logs = read_log(path, columns, states=states, actions=[Channel("u", "V")])
    found = ["read", len(logs[0])]
except InputError as error:
    found = [error.code, str(error)]
took = time.perf_counter() - started
print(json.dumps([*found, took, (peak() - before) / 1024]))
"""
MEMORY, SECONDS = 200.0, 5.0  # MiB more than before, and the time of reading

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="/proc and RLIMIT_AS")


def measured(path: Path, names: tuple[str, str, str]) -> tuple[str, Any, float, float]:
    """What reading gave, the seconds and MiB; it must end, and with an answer."""
    words = [sys.executable, "-c", CHILD, str(path), *names]
    done = subprocess.run(words, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr[-600:]
    found, about, seconds, memory = json.loads(done.stdout)
    print(f"{path.name}: {found}, {memory:.0f} MiB, {seconds:.2f} s")
    return found, about, seconds, memory


@pytest.mark.parametrize("name", bombs.BOMBS)
def test_bombs_take_neither_memory_nor_time(name: str, tmp_path: Path) -> None:
    """Four are refused; a column that nobody asks for is never unpacked."""
    write, names = bombs.BOMBS[name]
    path = tmp_path / name
    write(path)
    assert path.stat().st_size < 4 * MIB
    found, about, seconds, memory = measured(path, names)
    expected = ("read", bombs.ROWS) if name == "a.parquet" else ("E126", about)
    assert (found, about) == expected
    assert memory < MEMORY
    assert seconds < SECONDS
