"""What was freed goes back to the system, also from between what is kept."""

import ctypes
import subprocess
import sys
from pathlib import Path

import pytest

from sim2gp.compilation import give_back_freed

SIZE, COUNT, EACH = 1_000, 100_000, 1_000  # bytes; blocks; blocks to one that is kept
PAGE = 4096


def resident() -> int:
    """Bytes of this process that are in memory."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE


def share_returned() -> float:
    """Of many blocks that are freed, all but one in a thousand."""
    library = ctypes.CDLL(None)
    library.malloc.restype, library.free.argtypes = ctypes.c_void_p, (ctypes.c_void_p,)
    blocks = [library.malloc(SIZE) for _ in range(COUNT)]
    for block in blocks:
        ctypes.memset(block, 1, SIZE)
    for k, block in enumerate(blocks):
        if (k + 1) % EACH:
            library.free(block)
    before = resident()
    give_back_freed()
    return (before - resident()) / (SIZE * COUNT)


@pytest.mark.skipif(sys.platform != "linux", reason="of glibc")
def test_memory_between_blocks_that_are_kept_is_returned() -> None:
    """`free` cannot do it: it returns only what lies behind the last block.

    In a new process: in this one the blocks would fill holes.
    """
    if not hasattr(ctypes.CDLL(None), "malloc_trim"):
        pytest.skip("not glibc")
    command = [sys.executable, __file__]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert float(done.stdout) > 0.8


def test_another_system_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(ctypes, "CDLL", None)
    give_back_freed()


if __name__ == "__main__":
    print(share_returned())
