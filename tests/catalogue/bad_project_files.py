"""Bad inputs 107 to 109: project files, their keys, names and groups."""

from pathlib import Path

import pytest

from key_changes import write_files
from sim2gp.project import load_project
from sim2gp.systems import Furuta
from tests.catalogue.bad_inputs import Case, Input, Patch, case

BASE = """system = "two_link"

[options]
gravity = 9.81

[parameters.m2]
mean = 0.5
sd = 0.1

[[logs]]
files = ["logs/*.csv"]
time = "time"
exclude = [[12.0, 13.5]]

[logs.columns]
q1 = "pos_meas1"
q2 = {column = "pos_meas2", unit = "rad", sign = 1, offset = 0.0}
torque1 = {column = "tau_con1", scale = 1.0}
torque2 = "tau_con2"

[actuators.torque1]
delay = {low = 0.0, high = 0.02}

[likelihood]
window = 0.2

[limits]
"""


def with_lines(*lines: str, after: str = "[options]") -> str:
    return BASE.replace(f"{after}\n", "\n".join([after, *lines, ""]))


def file(key: str, text: str, *said: str) -> Input:
    """A project file next to some logs and a model."""

    def make(folder: Path, patch: Patch) -> None:
        if "arm.xml" in text:
            pytest.importorskip("mujoco")
        write_files(folder)
        (folder / "project.toml").write_text(text)
        load_project(folder / "project.toml").build_system()

    return Input(key, ("project.toml", *said), make)


# Groups of logs of one machine

FREE = ("motor_constant", "arm_damping")
COLUMNS = '{theta = "theta", alpha = "alpha", voltage = "u"}'
BARE = (
    '[[logs]]\nname = "bare"\nfiles = ["bare.csv"]\nfixed = {"alpha.payload" = 0.0}\n'
)
LOADED = '[[logs]]\nname = "loaded"\nfiles = ["loaded.csv"]\nfree = ["alpha.payload"]\n'


def grouped(*groups: str, more: str = "") -> str:
    """A project of a pendulum whose payload differs between groups."""
    nominal = Furuta().parameters.nominal()
    fixed = "\n".join(f"{n} = {v}" for n, v in nominal.items() if n not in FREE)
    parts = [f"{group}columns = {COLUMNS}\n" for group in groups]
    prior = "[effects.alpha.payload]\nlow = 0.0\nhigh = 0.02\n"
    return "\n".join(['system = "furuta"\n[parameters]', fixed, prior, *parts, more])


def furuta(key: str, groups: list[str], *said: str, more: str = "") -> Input:
    return file(key, grouped(*groups, more=more), *said)


PROJECT_FILES: tuple[Case, ...] = (
    case(
        107,
        "project: keys and values",
        file(
            "unknown_key",
            BASE.replace("[likelihood]", "[likelyhood]"),
            "line 24",
            "likelihood",
        ),
        file(
            "unknown_name", with_lines("gravty = 1"), "line 4", "gravty", "mean gravity"
        ),
        file(
            "unknown_key",
            BASE.replace("sd = 0.1", "sdd = 0.1"),
            "line 8",
            "did you mean sd",
        ),
        file(
            "unknown_key",
            BASE.replace("sign = 1", "sgn = 1"),
            "line 17",
            "did you mean sign",
        ),
        file("E160", BASE.replace("sign = 1", "sign = 2"), "line 17", "one of 1 or -1"),
        file(
            "unknown_key",
            BASE.replace("delay", "dealy"),
            "line 22",
            "did you mean delay",
        ),
        file(
            "unknown_key",
            BASE.replace("high = 0.02", "hi = 1"),
            "line 22",
            "did you mean high",
        ),
        file(
            "unknown_key",
            BASE.replace("time =", "tiem ="),
            "line 12",
            "did you mean time",
        ),
        file(
            "unknown_system",
            BASE.replace('"two_link"', '"twolink"'),
            "line 1",
            "mean two_link",
        ),
        file("E160", BASE.replace("mean = 0.5", 'mean = "1e-3"'), "line 7", "quotes"),
        file("E160", BASE.replace("mean = 0.5", "mean = true"), "line 7", "True"),
        file(
            "E160",
            BASE.replace('["logs/*.csv"]', '"logs"'),
            "line 11",
            'files = ["logs"]',
        ),
        file("E160", BASE.replace("[[12.0, 13.5]]", "[[1.0]]"), "line 13", "exclude"),
        file(
            "E160",
            BASE.replace("window = 0.2", "window = -1"),
            "line 25",
            "or equal to 0",
        ),
        file(
            "not_valid_toml",
            BASE.replace("window = 0.2", "window = yes"),
            "line 25",
            "TOML",
        ),
        file(
            "missing_key", BASE.replace('system = "two_link"', ""), "missing key system"
        ),
        file("repeated_key", with_lines('gravity = "9.81"'), "twice", "line 5"),
        file("E160", BASE.replace("9.81", '"9.81"'), "line 4", "number"),
        file("E160", with_lines("locked = [true]"), "line 4", "locked"),
        file("E141", BASE.replace("high = 0.02", "high = inf"), "line 22", "finite"),
        file(
            "duplicate_parameter",
            BASE.replace("mean = 0.5", "mean = 0.5\nmean = 1"),
            "line 8",
            "duplicate",
        ),
        file("E160", BASE.replace("window", "window = 0.2\nrobust = 1\nx"), "robust"),
    ),
    case(
        108,
        "project: names, priors, limits",
        file(
            "unknown_parameter",
            BASE.replace("parameters.m2", "parameters.m22"),
            "line 6",
            "mean m2",
        ),
        file("unknown_parameter", BASE + "[parameters]\nmm2 = 1.0", "line 29", "m2"),
        file(
            "unknown_name",
            BASE.replace("torque1]", "torqe1]"),
            "line 21",
            "mean torque1",
        ),
        file("unknown_name", BASE.replace("q1 =", "q_1 ="), "line 16", "mean q1"),
        file(
            "no_column_for_channel",
            BASE.replace('torque2 = "tau_con2"', ""),
            "line 15",
            "torque2",
        ),
        file(
            "constant_measured_channel",
            BASE.replace('q1 = "pos_meas1"', "q1 = 1.0"),
            "line 16",
            "constant",
        ),
        file(
            "bounds_reversed",
            BASE.replace("sd = 0.1", "low = 1.0\nhigh = 0.5"),
            "line 6",
            "swap",
        ),
        file(
            "bounds_without_room",
            BASE.replace("sd = 0.1", "low = 1.0\nhigh = 1.0"),
            "value = 1",
        ),
        file(
            "bounds_reversed",
            BASE.replace("high = 0.02", "high = -0.1"),
            "line 22",
            "-0.1",
        ),
        file(
            "negative_delay",
            BASE.replace("low = 0.0", "low = -0.1"),
            "line 22",
            "negative delay",
        ),
        file(
            "impossible_prior",
            BASE.replace("sd = 0.1", "sd = 0.1\nlow = 0.6\nhigh = 1"),
            "line 6",
        ),
        file("wrong_moments", BASE.replace("sd = 0.1", "sd = 0.0"), "line 6"),
        file("incomplete_prior", BASE.replace("sd = 0.1", ""), "line 6", "mean and sd"),
        file(
            "incomplete_prior",
            BASE.replace("sd = 0.1", "value = 1.0"),
            "line 6",
            "value alone",
        ),
        file(
            "incomplete_prior",
            BASE.replace("mean = 0.5\nsd = 0.1", ""),
            "line 6",
            "nothing stated",
        ),
        file(
            "interval_reversed",
            BASE.replace("[[12.0, 13.5]]", "[[2.0, 1.0]]"),
            "line 13",
            "[2, 1]",
        ),
        file(
            "interval_reversed",
            with_lines("q1 = [1, -1]", after="[limits]"),
            "limits of q1",
        ),
        file(
            "unknown_name",
            with_lines("q7 = [-1, 1]", after="[limits]"),
            "line 28",
            "q7",
        ),
        file(
            "unknown_name",
            with_lines("start_sd.q9 = 1", after="[likelihood]"),
            "line 25",
            "q9",
        ),
        file(
            "unknown_parameter",
            BASE.replace("[actuators", "[logs.fixed]\nm3 = 1.0\n[actuators"),
            "line 22",
            "m3",
        ),
        file("project_file_too_large", ".".join("a" * 70) + " = 1"),
        file("code_in_project_file", 'system = "import:os"'),
        file("not_valid_toml", "system = "),
        file("not_valid_toml", "{}"),
    ),
    case(
        109,
        "project: configurations",
        furuta("unknown_parameter", [BARE.replace("payload", "paylaod")], "line 16"),
        furuta("unknown_parameter", [LOADED.replace("payload", "paylaod")], "line 16"),
        furuta(
            "constant_stated_twice",
            [LOADED + "fixed = {'alpha.payload' = 0.1}\n"],
            "line 16",
        ),
        furuta(
            "unknown_parameter", [LOADED.replace("alpha.payload", "gravity")], "line 16"
        ),
        furuta(
            "fixed_constant_freed",
            [LOADED.replace("alpha.payload", "arm_mass")],
            "line 16",
        ),
        furuta(
            "configuration_in_two_ways",
            [BARE, LOADED.replace("loaded", "bare")],
            "line 20",
        ),
        furuta("E160", [LOADED.replace('"loaded"', '"a b"')], "line 14"),
        furuta(
            "duplicate_parameter",
            [BARE],
            "line 19",
            more='[parameters]\n"alpha.payload @ bare" = 1.0',
        ),
        furuta(
            "unknown_parameter",
            [BARE],
            "line 19",
            more='[parameters."alpha.payload @ bare"]\nvalue = 1.0',
        ),
        furuta(
            "no_prior_of_column",
            [LOADED],
            "line 19",
            more='[parameters."alpha.payload @ loaded"]\nvalue = 1.0',
        ),
        furuta(
            "unknown_parameter",
            [],
            "line 13",
            more='[parameters."arm_damping @ loaded"]\nvalue = 1.0',
        ),
    ),
)
