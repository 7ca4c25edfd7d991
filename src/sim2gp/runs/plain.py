"""Results as plain data: JSON that every reader accepts, and what made them."""

import importlib.metadata
import json
import math
import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sim2gp.errors import Sim2GPError, error


def to_json(values: Mapping[str, Any]) -> str:
    """JSON with finite numbers only; arrays become lists (E203 names the key)."""
    plain = _plain_values(values, "")
    return json.dumps(plain, indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def _plain_values(value: Any, key: str) -> Any:
    if isinstance(value, Mapping):
        return {str(k): _plain_values(v, f"{key}.{k}") for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain_values(v, f"{key}[{i}]") for i, v in enumerate(value)]
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float):
        if not math.isfinite(value):
            where = key.lstrip(".")
            raise error("result_not_finite", Sim2GPError, where=where, got=value)
        return float(value)
    return _plain_values(np.asarray(value).tolist(), key)


def environment() -> dict[str, str]:
    """Versions and machine that a result was made with."""
    names = ("sim2gp", "jax", "jaxlib", "equinox", "numpy", "scipy")
    found = {name: version(name) for name in names}
    return found | {"python": platform.python_version(), "machine": platform.machine()}


def version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"
