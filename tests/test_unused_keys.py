"""Keys that the machine at hand cannot use, each refused in one line with its fix."""

from pathlib import Path

import pytest

from key_changes import GROUP, REFUSED, column_with, loaded, write_files
from sim2gp.data.logs import Column, read_log
from sim2gp.errors import InputError
from sim2gp.project.project import system_class
from test_streams import asynchronous


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the files are, and the test."""
    write_files(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


WITHOUT_EFFECT: dict[str, tuple[str, str]] = {
    "a section that no command reads": (
        "[task]\n",
        "E160 .*not used by any command yet",
    ),
    "rail friction of a Furuta": (
        'system = "furuta"\n[effects.x.rail_friction]\nsd = 0.01\n',
        "E145 no rail_friction on this machine.*line 2.*expected one of .*coulomb",
    ),
    "a rail's tilt, of the pole": (
        "[effects.theta.tilt]\nsd = 0.01\n",
        r"E145 no tilt on theta.*line 2.*write \[effects\.x\.tilt\]",
    ),
    "the zero of what nothing depends on": (
        'system = "furuta"\n[effects.theta.encoder]\nsd = 0.01\n',
        r"E145 no encoder on theta.*write \[effects\.alpha\.encoder\]",
    ),
    "an effect that there is nowhere": (
        "[effects.x.damping]\nsd = 0.01\n",
        "E160 unknown effect.*line 2.*expected one of .*rail_friction",
    ),
    "an effect of an input, on a joint": (
        "[effects.x.dead_zone]\nsd = 0.01\n",
        r"E145 .*write \[effects\.voltage\.dead_zone\]",
    ),
    "an option of another effect": (
        "[effects.x.coulomb]\nsd = 0.1\nspeed = 1.0\n",
        "E160 unknown option of coulomb.*speed.*one of width",
    ),
    "an option of a model's encoder": (
        'system = "arm.xml"\n[effects.elbow.encoder]\nsd = 0.05\nwidth = 1.0\n',
        "E160 unknown option of encoder.*line 2",
    ),
    "a tie of one effect": (
        "[effects.x.spring]\nsd = 1.0\ntie = true\n",
        "E160 unknown key.*line 4.*tie",
    ),
    "a tie of one delay": (
        "[actuators.voltage]\ndelay = {low = 0.0, high = 0.1, tie = true}\n",
        "E160 unknown key.*line 3.*tie",
    ),
    "a pattern whose constants are all named": (
        'system = "arm.xml"\n[parameters."joint/*/damping"]\ntie = true\n'
        '[parameters]\n"joint/shoulder/damping" = 0.1\n"joint/elbow/damping" = 0.1\n',
        "E145 pattern without parameters of its own.*line 2",
    ),
    "an option of another machine": (
        "[options]\nlength1 = 0.2\n",
        "E160 unknown option.*line 3.*pinion_radius",
    ),
    "an option that is no number": (
        "[options]\ngravity = nan\n",
        "E160.*line 3.*finite",
    ),
    "a map that bounds overrule": (
        "[parameters.cart_mass]\nmean = 0.4\nsd = 0.1\nlow = 0.1\nhigh = 1.0\n"
        'map = "log"\n',
        "E160 .*map = log.*line 2.*bounded or log_bounded",
    ),
    "a map without moments": (
        '[parameters.cart_mass]\nmap = "identity"\n',
        "E160 .*map = identity.*line 2.*mean and sd",
    ),
    "a saturated clock": (
        REFUSED["logs.time.saturation"],
        "E160 saturation of a clock.*line 4",
    ),
    "a saturation that is reversed": (
        column_with("saturation = [1.0, -1.0]")[1],
        "E141 saturation of theta reversed.*line 5",
    ),
    "the start of an input": (
        GROUP + "[likelihood]\nstart_sd = {voltage = 0.1}\n",
        "E160 unknown state.*line 7.*theta",
    ),
    "noise of what is not measured": (
        GROUP + '[likelihood]\nnoise_floor = {"x.velocity" = 0.1}\n',
        "E160 unknown measured state.*line 7.*one of x, theta",
    ),
    "a start of windows without length": (
        GROUP + '[likelihood]\nwindow = 0.0\nstart = "causal"\n',
        "E160 start of windows of one step.*line 8",
    ),
    "limits of nothing": ("[limits]\ny = [0.0, 1.0]\n", "E160 unknown channel.*line 3"),
    "a rate of a state": ("[rates]\nx = 1.0\n", "E160 unknown input.*line 3.*voltage"),
}


@pytest.mark.parametrize("name", WITHOUT_EFFECT)
def test_what_the_machine_cannot_use_is_refused(name: str, folder: Path) -> None:
    said, words = WITHOUT_EFFECT[name]
    if "arm.xml" in said:
        pytest.importorskip("mujoco")
    with pytest.raises(InputError, match=words) as found:
        loaded(folder, said)
    assert "\n" not in str(found.value)
    assert len(str(found.value)) < 600


def test_resampling_and_clocks_without_effect_are_refused(folder: Path) -> None:
    alone = loaded(folder, GROUP.replace("time", 'resample = {method = "hold"}\ntime'))
    with pytest.raises(InputError, match=r"E160 nothing to resample.*a\.csv"):
        alone.load_logs()
    pytest.importorskip("mcap")
    asynchronous(folder / "a.mcap")
    channels = system_class("cartpole")()
    with pytest.raises(InputError, match=r"E160 unit of a recording's own clock"):
        read_log(
            folder / "a.mcap",
            {"theta": Column("/arm/q"), "voltage": Column("/cmd/u")},
            states=channels.physical_states,
            actions=channels.actions,
            time=Column("log", "ms"),
        )
