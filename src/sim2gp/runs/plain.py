"""Results as plain data: JSON that every reader accepts, and what made them."""

import base64
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


def exact(value: Any) -> Any:
    """Arrays as their bytes, whichever numbers are in them: `from_exact` has them back.

    Of mappings and lists, as deep as they go.
    """
    if isinstance(value, Mapping):
        return {str(k): exact(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [exact(v) for v in value]
    if isinstance(value, np.generic) or not hasattr(value, "shape"):
        return value
    value = np.asarray(value)
    content = base64.b64encode(np.ascontiguousarray(value).tobytes()).decode("ascii")
    return {"dtype": value.dtype.str, "shape": list(value.shape), "base64": content}


def from_exact(value: Any) -> Any:
    """What `exact` was given; lists for tuples."""
    if isinstance(value, Mapping):
        if value.keys() == {"dtype", "shape", "base64"}:
            flat = np.frombuffer(base64.b64decode(value["base64"]), value["dtype"])
            return flat.reshape(value["shape"]).copy()
        return {k: from_exact(v) for k, v in value.items()}
    return [from_exact(v) for v in value] if isinstance(value, list) else value


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
