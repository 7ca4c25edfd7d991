"""The slips that users make in a project file: one line with its place and the fix."""

from pathlib import Path

import pytest

from key_changes import GROUP, loaded, write_files
from sim2gp.errors import InputError
from sim2gp.project import load_project

SYSTEM = 'system = "cartpole"\n'
MASS = "[parameters.cart_mass]\n"
MOTOR = "[actuators.voltage]\n"
FIT = "[likelihood]\n"
QUOTES = "write the name in quotes"
COLUMNS = GROUP.split("time")[0] + "[logs.columns]\n"

#: What was written, its line, the code, and the fix.
SLIPS: tuple[tuple[str, int, str, str], ...] = (
    # Names of sections and keys
    ('system = "mujoco:arm.xml"\n', 1, "E160", 'write the file\'s name, "arm.xml"'),
    ('system = "mjcf: arm.xml"\n', 1, "E160", 'write the file\'s name, "arm.xml"'),
    ('system = "MuJoCo"\n', 1, "E160", 'write the file\'s name, as in "robot.xml"'),
    ('system = "cart-pole"\n', 1, "E160", "did you mean cartpole"),
    ('system = "Furuta"\n', 1, "E160", "did you mean furuta"),
    ('system = "arm.sdf"\n', 1, "E160", "name one of these"),
    ('# robot\nsytem = "furuta"\n', 2, "E160", "did you mean system"),
    ('\nrobot = "furuta"\n', 2, "E160", "did you mean system"),
    ('\nmodel = "arm.xml"\n', 2, "E160", 'write system = "arm.xml"'),
    ("[task]\nseconds = 5.0\n", 2, "E160", "remove it"),
    ('[model]\nkind = "sim2gp"\n', 2, "E160", "remove it"),
    ("[planner]\nsamples = 3\n", 2, "E160", "remove it"),
    ("[parameter.cart_mass]\nmean = 1.0\n", 2, "E160", "did you mean parameters"),
    ("[effect.x.spring]\nsd = 1.0\n", 2, "E160", "did you mean effects"),
    ('[[log]]\nfiles = ["a.csv"]\n', 2, "E160", "did you mean logs"),
    (GROUP.replace("columns", "column"), 5, "E160", "did you mean columns"),
    (GROUP.replace("files", "file"), 3, "E160", "did you mean files"),
    (GROUP.replace("files", "paths"), 3, "E160", "did you mean files"),
    (GROUP.replace('time = "t"', "dt = 0.01"), 4, "E160", "did you mean period"),
    (MASS + "min = 0.1\nmax = 1.0\n", 3, "E160", "did you mean low"),
    (MASS + "mean = 0.1\nstd = 1.0\n", 4, "E160", "did you mean sd"),
    (MASS + "fixed = 0.4\n", 3, "E160", "did you mean value"),
    (MASS + "gain = 0.4\n", 3, "E160", "gain is a key of [actuators.INPUT]"),
    ("delay = 0.01\n", 2, "E160", "delay is a key of [actuators.INPUT]"),
    ("window = 0.1\n", 2, "E160", "window is a key of [likelihood]"),
    (FIT + "limits = 1.0\n", 3, "E160", "write [limits] by itself"),
    # Brackets
    (GROUP.replace("[[logs]]", "[logs]"), 2, "E160", "write [[logs]]"),
    ("[weighed]\nvalue = 1.0\n", 2, "E160", "write [[weighed]]"),
    (GROUP + "[logs]\nname = 'b'\n", 6, "E160", "write [[logs]] for each"),
    ("[logs.columns]\nx = 'pos'\n" + GROUP, 4, "E160", "write [[logs]] for each"),
    (f"[{MASS.strip()}]\nmean = 1.0\n", 2, "E160", "[parameters.cart_mass], once"),
    ("[[likelihood]]\nwindow = 0.1\n", 2, "E160", "write [likelihood], once"),
    (GROUP.replace('["a.csv"]', '"a.csv"'), 3, "E160", 'write files = ["a.csv"]'),
    (GROUP.replace('["a.csv"]', "[]"), 3, "E160", "write a list that is not empty"),
    (
        GROUP.replace("time", "exclude = [1.0, 2.0]\ntime"),
        4,
        "E160",
        "exclude = [[12.0, 13.5]]",
    ),
    ("[limits]\nvoltage = 5.0\n", 3, "E160", "write voltage = [-5.0, 5.0]"),
    ("[limits]\nvoltage = [5.0]\n", 3, "E160", "write two numbers, [low, high]"),
    ("[parameters]\ncart_mass = [0.1, 1.0]\n", 3, "E160", "{low = 0.1, high = 1.0}"),
    (MOTOR + "delay = [0.0, 0.02]\n", 3, "E160", "{low = 0.0, high = 0.02}"),
    ("[actuators]\ndelay = 0.01\n", 3, "E160", "write [actuators.INPUT] and below it"),
    ("[effects]\nspring = 0.01\n", 3, "E160", "write [effects.CHANNEL.spring]"),
    ("[effects.spring]\nsd = 0.01\n", 3, "E103", "write [effects.CHANNEL.spring]"),
    (GROUP + "[logs.columns]\n", 6, "E160", "write [[logs]] for each"),
    # Names with a dot, a slash or a star
    (COLUMNS + 'x = "pos"\nx.velocity = "vel"\n', 6, "E160", QUOTES),
    (COLUMNS + 'x.velocity = "vel"\n', 5, "E160", QUOTES + ': "x.velocity"'),
    ("[limits]\nx.velocity = [-1.0, 1.0]\n", 3, "E160", QUOTES + ': "x.velocity"'),
    (FIT + "start_sd = {x.velocity = 1.0}\n", 3, "E160", QUOTES + ': "x.velocity"'),
    ("[actuators.elbow.control]\ndelay = 0.1\n", 2, "E160", '"elbow.control"'),
    ("[parameters.joint/elbow/damping]\nsd = 1.0\n", 2, "E160", QUOTES),
    ("[parameters]\njoint/elbow/damping = 1.0\n", 3, "E160", QUOTES),
    ("[parameters.body/*/mass]\nsd = 1.0\n", 2, "E160", QUOTES),
    # Numbers, words and quotes
    (MASS + 'mean = "0.4"\n', 3, "E160", "write the value without quotes"),
    (MASS + 'mean = "0.4 kg"\n', 3, "E160", "write 0.4, in the unit of its channel"),
    (MASS + "mean = 0.4 kg\n", 3, "E160", "write the number alone, without a unit"),
    (MASS + "mean = .4\n", 3, "E160", "a digit before the point, as in 0.5"),
    (MASS + "mean = 4.\n", 3, "E160", "a digit after the point, as in 5.0"),
    (MASS + "mean = 0,4\n", 3, "E160", "a decimal point instead of the comma"),
    (MASS + "mean = 0.4 +- 0.1\n", 3, "E160", "write {mean = 0.5, sd = 0.1}"),
    (MASS + "mean: 0.4\n", 3, "E160", "write = instead of :"),
    (MASS + "mean = 0.4 // kg\n", 3, "E160", "begin a comment with #"),
    ("[limits]\nx = (-1, 1)\n", 3, "E160", "a pair in brackets, [low, high]"),
    ("[limits]\nx = -1, 1\n", 3, "E160", "write a list in brackets"),
    (FIT + "robust = True\n", 3, "E160", "write true"),
    (FIT + "robust = no\n", 3, "E160", "write false"),
    (FIT + 'robust = "yes"\n', 3, "E160", "write true"),
    (FIT + "robust = 1\n", 3, "E160", "write true"),
    (FIT + 'start = "casual"\n', 3, "E160", "did you mean 'causal'"),
    (FIT + "start = causal\n", 3, "E160", "write text in quotes"),
    (MOTOR + "delay = free\n", 3, "E160", "write text in quotes"),
    (MOTOR + 'delay = "Free"\n', 3, "E160", "did you mean 'free'"),
    (MOTOR + "delay = {low = 0.0,\n high = 0.1}\n", 3, "E160", "on one line"),
    ('[[logs]]\nfiles = ["C:\\Users\\a.csv"]\n', 3, "E160", "write / in paths"),
    (GROUP.replace('"t"', "0.01"), 4, "E160", "write period = 0.01"),
    ("[options]\nlocked = true\n", 3, "E160", "a list in brackets"),
    ("[parameters.cart_mass\nmean = 1.0\n", 2, "E160", "close the brackets"),
)


@pytest.mark.parametrize("slip", SLIPS, ids=lambda slip: slip[0].strip()[:40])
def test_a_slip_is_answered_with_what_to_write(
    slip: tuple[str, int, str, str], tmp_path: Path
) -> None:
    said, line, code, fix = slip
    write_files(tmp_path)
    path = tmp_path / "project.toml"
    path.write_text(said if said.startswith(("system", "#", "\n")) else SYSTEM + said)
    with pytest.raises(InputError) as found:
        load_project(path)
    error = found.value
    assert error.code == code
    assert f"project.toml:line {line}" in error.where
    assert fix in error.fix
    assert "\n" not in str(error)
    assert len(str(error)) < 600


def test_what_is_meant_is_accepted(tmp_path: Path) -> None:
    """The fixes are what the reader takes."""
    write_files(tmp_path)
    project = loaded(
        tmp_path,
        SYSTEM
        + GROUP
        + '[limits]\n"x.velocity" = [-1.0, 1.0]\n'
        + "[actuators.voltage]\ndelay = {low = 0.0, high = 0.02}\n"
        + "[parameters]\ncart_mass = {low = 0.1, high = 1.0}\n"
        + "[effects.x.spring]\nsd = 0.01\n",
    )
    assert "x.spring" in project.system.parameters.names
    assert len(project.load_logs()) == 1
