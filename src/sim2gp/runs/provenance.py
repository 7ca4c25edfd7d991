"""What every run says of itself: its command, its versions, how long it took."""

import platform
import sys
import time
from importlib.metadata import version
from typing import Any

import jax

PACKAGES = ("sim2gp", "jax", "jaxlib", "equinox", "numpy", "scipy")
OPTIONAL = ("mujoco",)  # named where a run has used them


def provenance(started: float, line: str | None = None) -> dict[str, Any]:
    """Keys of the summary; ``started`` is the `time.perf_counter` of the start.

    ``line`` is a command that makes the same run, where that is not the one typed.
    """
    return ({} if line is None else {"command_line": line}) | {
        "versions": {"python": platform.python_version()}
        | {name: version(name) for name in PACKAGES}
        | {name: version(name) for name in OPTIONAL if name in sys.modules},
        "device": jax.devices()[0].platform,
        "wall_seconds": time.perf_counter() - started,
    }
