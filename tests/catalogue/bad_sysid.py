"""Bad inputs 97 and 98: files of `mujoco.sysid`."""

import math
from pathlib import Path
from typing import Any

from sim2gp import systems as sy
from sim2gp.inference.parameters import Parameter, Parameters
from tests.catalogue.bad_inputs import Case, Input, Patch, case

GOOD = "a:\n  frozen: false\n" + "".join(
    f"  {name}:\n  - {x}\n"
    for name, x in [("max_value", 2), ("min_value", 1), ("nominal", 1.5), ("value", 1)]
)
SEVERAL = GOOD.replace("a:", "inertia:").replace("- 1.5", "- 1.5\n  - 1.5")
SEVERAL = SEVERAL.replace("- 2\n", "- 2\n  - 2\n").replace("- 1\n", "- 1\n  - 1\n")
ONES = Parameters((Parameter("gain", "N", "", "log_bounded", 1e-7, 2.5, nominal=1e-5),))


def read(key: str, text: str, *said: str, names: Any = None) -> Input:
    def make(folder: Path, patch: Patch) -> None:
        (folder / "a.yaml").write_text(text)
        sy.read_sysid(folder / "a.yaml", *([] if names is None else [names]))

    return Input(key, said, make)


def changed(key: str, old: str, new: str, *said: str) -> Input:
    assert old in GOOD
    return read(key, GOOD.replace(old, new), *said)


def saved(key: str, place: str, *given: Any) -> Input:
    return Input(
        key, (), lambda folder, patch: sy.write_sysid(folder / place, ONES, *given)
    )


def vast(folder: Path, patch: Patch) -> None:
    from sim2gp.systems.mujoco import sysid

    patch.setattr(sysid, "LARGEST", 10)
    read("", GOOD).make(folder, patch)


SYSID: tuple[Case, ...] = (
    case(
        97,
        "mujoco.sysid: lines and entries",
        changed("odd_parameter_line", "- 1.5", "- &x 1.5", "line 8", "&x"),
        changed("odd_parameter_line", "- 1.5", "- 1e5x", "line 8"),
        changed("odd_parameter_line", "a:\n", "!!python/object:os.system\na:\n", "e 1"),
        changed("odd_parameter_line", "a:\n", "a: {b: 1}\n", "line 1"),
        changed("odd_parameter_line", "false", "maybe", "line 2"),
        changed("incomplete_entry", "  frozen: false\n", "", "entry a"),
        changed("incomplete_entry", "  - 1.5\n", "  - 1.5\n  - 2.5\n", "entry a"),
        changed("odd_parameter_line", "nominal", "nominel", "line 7"),
        changed("nominal_outside_box", "- 1.5", "- 3", "within [1, 2]"),
        changed("wrong_bounds", "- 2\n", "- 1\n", "low = 1, high = 1"),
        changed("wrong_bounds", "- 2\n", "- .nan\n", "nan"),
        changed("parameter_twice_in_file", GOOD, GOOD + GOOD, "line 11"),
        Input("large_parameter_file", ("a.yaml",), vast),
    ),
    case(
        98,
        "mujoco.sysid: names",
        read(
            "unknown_parameter",
            SEVERAL,
            "did you mean inertia[",
            names={"inertia": "a"},
        ),
        read(
            "constant_read_twice",
            SEVERAL,
            names={"inertia[0]": "a", "inertia[1]": "a"},
        ),
        saved("unknown_parameter", "a.yaml", {"gian": 1.0}),
        saved("unknown_parameter", "a.yaml", {}, {"x": "gian"}),
        saved("parameter_value_not_finite", "a.yaml", {"gain": math.nan}),
        saved("unreadable_parameter_file", "no/where"),
        Input(
            "unreadable_parameter_file",
            ("nothing",),
            lambda folder, patch: sy.read_sysid(folder / "nothing"),
        ),
    ),
)
