"""Bad inputs 110 to 114: project files that ask for what the machine cannot have."""

import sys
from pathlib import Path

from key_changes import GROUP, REFUSED, column_with, write_files
from sim2gp.project import load_project
from tests.catalogue.bad_inputs import Case, Input, Patch, case
from tests.catalogue.bad_project_files import file


def cart(key: str, text: str, *said: str) -> Input:
    plain = "" if text.startswith("system") else 'system = "cartpole"\n'
    return file(key, plain + text, *said)


def pendulum(key: str, text: str, *said: str) -> Input:
    return file(key, f'system = "furuta"\n{text}', *said)


def of_model(key: str, text: str, *said: str) -> Input:
    return file(key, f'system = "arm.xml"\n\n{text}', *said)


def tied(key: str, text: str, *said: str) -> Input:
    return file(key, f'system = "two_link"\n{text}', *said)


SUM = 'system = "uniform_rod_arm"\n[[weighed]]\nof = ["m1", "m2"]\n'


def weighed(key: str, old: str, new: str, *said: str) -> Input:
    text = f"{SUM}value = 1.24\nsd = 0.005\n"
    assert old in text
    return file(key, text.replace(old, new), *said)


def binary(folder: Path, patch: Patch) -> None:
    (folder / "project.toml").write_bytes(b"system = \xff")
    load_project(folder / "project.toml")


def without_mujoco(folder: Path, patch: Patch) -> None:
    patch.setitem(sys.modules, "mujoco", None)
    write_files(folder)
    (folder / "project.toml").write_text('system = "arm.xml"\n')
    load_project(folder / "project.toml")


MACHINES: tuple[Case, ...] = (
    case(
        110,
        "project: effects and inputs",
        pendulum(
            "unknown_name", "[effects.theta]\ncoulom = 1.0", "did you mean coulomb"
        ),
        pendulum(
            "unknown_channel_of_effect",
            "[effects.thetta]\ncoulomb = 1.0",
            "did you mean theta",
        ),
        pendulum("unknown_name", "[effects.theta]\ndrag = {value = 1.0, width = 0.1}"),
        pendulum("incomplete_prior", "[effects.theta.coulomb]\nmean = 1.0"),
        pendulum(
            "points_of_table",
            "[effects.theta.position_table]\npoints = [[0.0, 1.0]]",
            "position_table",
        ),
        pendulum(
            "points_of_table",
            "[effects.voltage.input_table]\npoints = [[1.0, 0.0], [1.0, 2.0]]",
            "2 points",
        ),
        pendulum("E160", "[effects.theta.coulomb]\nwidth = -1.0\nvalue = 1.0", "width"),
        tied("unknown_name", '[actuators."motor*"]\ngain = 2.0', "line 2", "torque1"),
        tied(
            "input_named_twice",
            '[actuators."torque*"]\ngain = 2.0\n[actuators."*1"]\ngain = 1.0',
            "line 4",
            "torque1",
        ),
        tied(
            "pattern_without_own_inputs",
            '[actuators."*2"]\ngain = 2.0\n[actuators.torque2]\ngain = 1.0',
            "line 2",
        ),
        tied(
            "tie_of_one_input",
            '[actuators."*1"]\ngain = 2.0\ntie = true',
            "line 4",
            "torque1",
        ),
        tied(
            "negative_delay",
            '[actuators."torque*"]\ntie = true\ndelay = -0.1',
            "line 4",
        ),
    ),
    case(
        111,
        "project: a model's file",
        of_model(
            "unknown_model_constant",
            '[parameters."joint/wrist/damping"]\nmean = 1.0\nsd = 0.1',
            "line 3",
        ),
        of_model(
            "incomplete_prior",
            '[parameters."joint/*/frictionloss"]\ntie = true',
            "line 3",
        ),
        of_model(
            "incomplete_prior",
            '[parameters."joint/*/stiffness"]\nrelative_sd = 0.1',
            "relative_sd",
        ),
        of_model("unknown_name", "[options]\ngravity = 9.8", "line 4", "root"),
        of_model(
            "impossible_effect",
            "[effects.shoulder.payload]\nmean = 0.0\nsd = 1.0",
            "encoder",
        ),
        of_model(
            "unknown_channel_of_effect", "[effects.wrist.encoder]\nsd = 0.1", "line 3"
        ),
        of_model("unknown_name", "[limits]\nwrist = [0.0, 1.0]", "line 4"),
    ),
    case(
        112,
        "project: measured sums",
        weighed("measured_sum_out_of_bounds", "1.24", "-1.0"),
        weighed("E144", "0.005", "0.0"),
        weighed("unknown_parameter", '"m2"', '"mm2"', "did you mean m2"),
        weighed("constant_twice_in_sum", '"m2"', '"m1"'),
        weighed("weights_of_sum", "sd =", "weights = [1.0]\nsd ="),
        weighed("unknown_key", "sd =", "weight = 1.0\nsd =", "did you mean weights"),
        weighed(
            "sum_without_unknowns",
            "[[weighed]]",
            "[parameters]\nm1 = 1.0\nm2 = 0.24\n[[weighed]]",
        ),
    ),
    case(
        113,
        "project: what the machine cannot use",
        cart("reserved_section", "[task]\n"),
        cart(
            "impossible_effect",
            'system = "furuta"\n[effects.x.rail_friction]\nsd = 0.01\n',
            "line 2",
        ),
        cart(
            "impossible_effect",
            "[effects.theta.tilt]\nsd = 0.01\n",
            "line 2",
            "write [effects.x.tilt]",
        ),
        cart(
            "impossible_effect",
            'system = "furuta"\n[effects.theta.encoder]\nsd = 0.01\n',
            "write [effects.alpha.encoder]",
        ),
        cart("unknown_name", "[effects.x.damping]\nsd = 0.01\n", "line 2"),
        cart(
            "impossible_effect",
            "[effects.x.dead_zone]\nsd = 0.01\n",
            "write [effects.voltage.dead_zone]",
        ),
        cart("unknown_name", "[effects.x.coulomb]\nsd = 0.1\nspeed = 1.0\n", "speed"),
        cart(
            "unknown_name",
            'system = "arm.xml"\n[effects.elbow.encoder]\nsd = 0.05\nwidth = 1.0\n',
            "line 2",
        ),
        cart(
            "unknown_key", "[effects.x.spring]\nsd = 1.0\ntie = true\n", "line 4", "tie"
        ),
        cart(
            "unknown_key",
            "[actuators.voltage]\ndelay = {low = 0.0, high = 0.1, tie = true}\n",
            "line 3",
            "tie",
        ),
        cart(
            "pattern_without_own_constants",
            'system = "arm.xml"\n[parameters."joint/*/damping"]\ntie = true\n'
            '[parameters]\n"joint/shoulder/damping" = 0.1\n'
            '"joint/elbow/damping" = 0.1\n',
            "line 2",
        ),
        cart("unknown_name", "[options]\nlength1 = 0.2\n", "line 3", "pinion_radius"),
        cart("E160", "[options]\ngravity = nan\n", "line 3"),
        cart(
            "incomplete_prior",
            "[parameters.cart_mass]\nmean = 0.4\nsd = 0.1\nlow = 0.1\nhigh = 1.0\n"
            'map = "log"\n',
            "line 2",
        ),
        cart(
            "incomplete_prior", '[parameters.cart_mass]\nmap = "identity"\n', "line 2"
        ),
        cart("saturation_of_clock", REFUSED["logs.time.saturation"], "line 4"),
        cart("interval_reversed", column_with("saturation = [1.0, -1.0]")[1], "line 5"),
        cart(
            "unknown_name",
            GROUP + "[likelihood]\nstart_sd = {voltage = 0.1}\n",
            "line 7",
            "theta",
        ),
        cart(
            "unknown_name",
            GROUP + '[likelihood]\nnoise_floor = {"x.velocity" = 0.1}\n',
            "line 7",
        ),
        cart(
            "start_of_one_step",
            GROUP + '[likelihood]\nwindow = 0.0\nstart = "causal"\n',
            "line 8",
        ),
        cart("unknown_name", "[limits]\ny = [0.0, 1.0]\n", "line 3"),
        cart("unknown_name", "[rates]\nx = 1.0\n", "line 3", "voltage"),
    ),
    case(
        114,
        "project: files",
        cart("unknown_name", "[parameters.cart_mass]\ntie = true\n", "line 2", "tie"),
        file("unreadable_file", 'system = "gone.xml"\n', "gone.xml"),
        cart("E160", GROUP.replace('"t"', "1979-05-27"), "line 4"),
        cart("E160", "[actuators]\ndelay = 1979-05-27\n", "line 3"),
        Input("not_utf8_text", ("byte 9",), binary),
        Input("missing_extra", ("pip install 'sim2gp[mujoco]'",), without_mujoco),
    ),
)
