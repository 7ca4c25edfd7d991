"""The pictures that MuJoCo rendered of a motion, as the page's player has them."""

import base64
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from sim2gp.reports.parameters import Arrays


def pictures(about: Mapping[str, Any], arrays: Arrays) -> str:
    """The frames that MuJoCo rendered, as more of the film's JSON."""
    frames, ends = arrays.get("animation/frames"), arrays.get("animation/frame_ends")
    if "frames" not in about or frames is None or ends is None:
        return ""
    parts = np.split(np.asarray(frames, np.uint8), np.asarray(ends)[:-1])
    coded = [base64.b64encode(part.tobytes()).decode("ascii") for part in parts]
    apart = float(about["dt"]) * int(about["frames"]["every"])
    return f',"apart":{apart:.6g},"frames":{json.dumps(coded, separators=(",", ":"))}'
