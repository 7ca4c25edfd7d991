"""What every run says of itself: its command, its versions, how long it took."""

import platform
import time
from importlib.metadata import version
from typing import Any

import jax

PACKAGES = ("sim2gp", "jax", "jaxlib", "equinox", "numpy", "scipy")


def provenance(command_line: str, started: float) -> dict[str, Any]:
    """Keys of the summary; ``started`` is the `time.perf_counter` of the start."""
    return {
        "command_line": command_line,
        "versions": {"python": platform.python_version()}
        | {name: version(name) for name in PACKAGES},
        "device": jax.devices()[0].platform,
        "wall_seconds": time.perf_counter() - started,
    }
