"""Bad inputs 46 to 76: shapes, constants, project files, models, stored files."""

import io
import json
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import bad_inputs as bad
from bad_inputs import (
    GOOD,
    IDENTIFY,
    PROJECT,
    ROWS,
    TEXTS,
    Case,
    Input,
    Patch,
    case,
    log,
    npz,
    renamed,
    stored,
)
from sim2gp import laplace
from sim2gp.arrowhead import Elimination
from sim2gp.gaussian import from_covariance
from sim2gp.project import load_project
from sim2gp.robot.policy import FORMAT, load_policy
from sim2gp.runs import new_run
from sim2gp.types import in_float64


def project(more: str, code: str, *words: str, name: str = "project.toml") -> Input:
    """A project file with some lines more than its system."""
    return written(f'system = "cartpole"\n{more}', code, *words, name=name)


def written(text: str, code: str, *words: str, name: str = "project.toml") -> Input:
    def make(folder: Path, patch: Patch) -> Sequence[str]:
        (folder / name).write_text(text)
        return "identify", name

    return Input(code, (name, *words), make)


def words(command: str, code: str, *said: str) -> Input:
    """A command line that is at fault by itself."""
    return Input(code, ("the command line", *said), lambda *_: command.split())


# Shapes


def of_two_numbers(folder: Path, patch: Patch) -> None:
    """What both environments ask before they step (test_gymnasium.py)."""
    pytest.importorskip("gymnasium")
    from sim2gp.robot.gymnasium import checked

    checked(np.zeros(2), (1,))


def without_batch(folder: Path, patch: Patch) -> None:
    pytest.importorskip("gymnasium")
    from sim2gp.robot.gymnasium import checked

    checked(np.zeros(1), (8, 1))


X = np.stack([GOOD["pos"], GOOD["vel"]])
AS_TABLE = renamed('"pos"', '"state[0]"').replace('"vel"', '"state[1]"')


def arrays(content: Mapping[str, Any], code: str, *said: str) -> Input:
    """An archive whose ``state`` is a table."""

    def make(folder: Path, patch: Patch) -> Sequence[str]:
        (folder / "project.toml").write_text(AS_TABLE.replace("*.csv", "a.npz"))
        np.savez(folder / "a.npz", **content)
        return IDENTIFY

    return Input(code, said, make)


NO_STATE = {name: GOOD[name] for name in ("t", "angle", "cmd")}

# Constants


@in_float64
def no_covariance(folder: Path, patch: Patch) -> None:
    """Beliefs are square roots of covariances; this is the way in for a matrix."""
    matrix = np.asarray([[1.0, 2.0], [2.0, 1.0]])
    from_covariance(np.zeros(2), matrix, ("mass", "length"))


@in_float64
def no_symmetry(folder: Path, patch: Patch) -> None:
    from_covariance(np.zeros(2), np.asarray([[1.0, 0.5], [0.2, 1.0]]))


@in_float64
def nothing_moves(folder: Path, patch: Patch) -> None:
    """Known after a linearisation and no sooner: a fit whose Jacobian is zero.

    That descents end so stands in test_laplace.py; `identify` then exits with 2.
    """
    factor, none = jnp.zeros((3, 3)).at[2, 2].set(1.0), jnp.zeros((1, 0))
    z, zero = jnp.zeros(2), jnp.zeros(())
    at = laplace.Point(z, none, factor[None, None], zero + 0.5, z, none)
    arrow = Elimination(factor, jnp.zeros((1, 0, 0)), jnp.zeros((1, 0, 3)))
    status, steps = jnp.asarray(laplace.CONVERGED), jnp.asarray(0)
    fit = laplace.Fit(at, arrow, factor, zero, status, steps)
    fit.raise_unless_converged(("mass", "length"), "arm.csv")


# Models

MODEL = """<mujoco><worldbody><body name="arm">
  <joint name="hip" damping=".1"/>
  <inertial pos="0 0 .1" mass="1" diaginertia="1 1 1"/>
</body></worldbody><actuator><motor name="push" joint="hip"/></actuator></mujoco>
"""
LOGS = """[[logs]]
files = ["a.csv"]
time = "t"
[logs.columns]
hip = "pos"
push = "cmd"
"""


def model(text: str, code: str, *said: str, more: str = "") -> Input:
    """A project about a model's file."""

    def make(folder: Path, patch: Patch) -> Sequence[str]:
        pytest.importorskip("mujoco")
        (folder / "arm.xml").write_text(text)
        (folder / "a.csv").write_text(TEXTS)
        (folder / "project.toml").write_text(f'system = "arm.xml"\n{LOGS}{more}')
        return IDENTIFY

    return Input(code, said, make)


def crashing(folder: Path, patch: Patch) -> Sequence[str]:
    """No file is known that crashes this parser: its process is one that dies."""
    from sim2gp.systems import mjcf_load

    child = folder / "child.py"
    child.write_text("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
    patch.setattr(mjcf_load, "_CHILD", str(child))
    found = model(MODEL, "E171").make(folder, patch)
    assert found is not None
    return found


# Archives


def archive(*members: tuple[str, bytes]) -> Callable[[Path], object]:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members:
            file.writestr(name, content)
    return lambda path: path.write_bytes(buffer.getvalue())


def header(*shape: int) -> bytes:
    """The start of an array that claims a shape."""
    buffer = io.BytesIO()
    spec = {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(buffer, spec)
    return buffer.getvalue()


def raw(content: bytes) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(content)


class Touch:
    """Loading a pickle of this would make a folder, which a test would see."""

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return Path.mkdir, (Path("was-unpickled"),)  # type: ignore[return-value]


PICKLE = b"\x80\x04\x95" + bytes(40)
TORCH = archive(("a/data.pkl", b"\x80\x02."), ("a/0", b""))
TENSORS = (8).to_bytes(8, "little") + b'{"a":{}}'

# Runs


def policy(changes: Mapping[str, Any], code: str, *said: str) -> Input:
    """What `export_policy` writes, of one layer, with some arrays changed."""

    def make(folder: Path, patch: Patch) -> None:
        one = np.ones((1, 1), np.float32)
        stored = {"weights/0": one, "biases/0": one[0], "scale": one[0]}
        stored |= {"low": -one[0], "high": one[0]}
        about = {"format": FORMAT, "layers": 1, "angle": None}
        about |= {"states": ["x"], "actions": ["u"]}
        with new_run(folder / "policy", "export policy") as writer:
            writer.write_arrays("arrays.npz", stored | dict(changes))
            writer.write_summary({"policy": about})
        load_policy(folder / "policy")

    return Input(code, said, make)


NAN = np.full((1, 1), np.nan, np.float32)


def run(spoil: Callable[[Path], object], code: str, *said: str) -> Input:
    """An identification that something happened to since; `evaluate` reads it."""

    def make(folder: Path, patch: Patch) -> Sequence[str]:
        (folder / "project.toml").write_text(PROJECT)
        (folder / "a.csv").write_text(TEXTS)
        table = load_project(folder / "project.toml").system.parameters
        summary = {
            "command": "identify",
            "parameters": {name: {"mean": 1.0} for name in table.names},
            "noise": {"x": 1e-3},
            "period": 0.01,
        }
        zeros = np.zeros(len(table))
        with new_run(folder / "run", "identify") as writer:
            writer.write_summary(summary)
            writer.write_text("project.toml", PROJECT)
            belief = {"belief/mean": zeros, "belief/scale": np.diag(zeros)}
            writer.write_arrays("arrays.npz", belief)
        spoil(folder / "run")
        return "evaluate", "run", "--logs", "a.csv"

    return Input(code, ("run", *said), make)


def flipped(folder: Path) -> None:
    content = bytearray((folder / "arrays.npz").read_bytes())
    content[len(content) // 2] ^= 1
    (folder / "arrays.npz").write_bytes(content)


def newer(folder: Path) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    (folder / "manifest.json").write_text(json.dumps(manifest | {"format": 99}))


def fixed_since(folder: Path) -> None:
    (folder / "project.toml").write_text(f"{PROJECT}[parameters]\ncart_mass = 0.4\n")


BOMB = "a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]\n"
OBJECT = "a: !!python/object/apply:os.system ['touch was-run']\n"

SECOND: tuple[Case, ...] = (
    case(
        46,
        "(N, D) where (N + 1, D)",
        stored("a.npz", npz(cmd=GOOD["cmd"][:-1]), "E140", "300 rows of t, 299 of cmd"),
    ),
    case(
        47,
        "transposed",
        arrays(NO_STATE | {"state": X}, "E140", "looks transposed", "save state.T"),
        arrays(NO_STATE | {"state": X.T}, ""),
    ),
    case(
        48,
        "wrong action dimension",
        Input("E140", ("got shape (2,)", "expected shape (1,)"), of_two_numbers),
    ),
    case(
        49,
        "batch axis",
        stored("a.npz", npz(cmd=GOOD["cmd"][:, None, None]), "E140", "(300, 1, 1)"),
        Input("E140", ("got shape (1,)", "expected shape (8, 1)"), without_batch),
    ),
    case(
        50,
        "min > max",
        project(
            "[parameters.cart_mass]\nlow = 1.0\nhigh = 0.5",
            "E141",
            "line 2",
            "cart_mass reversed",
            "low = 1, high = 0.5",
        ),
        project("[limits]\nx = [1.0, -1.0]", "E141", "line 3", "limits of x reversed"),
    ),
    case(
        51,
        "min == max",
        project(
            "[parameters.cart_mass]\nlow = 1.0\nhigh = 1.0",
            "E141",
            "line 2",
            "fix it instead: value = 1",
        ),
    ),
    case(
        52,
        "NaN or infinite bound",
        project("[parameters.cart_mass]\nlow = 0.1\nhigh = inf", "E141", "line 4"),
        project("[parameters.cart_mass]\nlow = nan\nhigh = 1.0", "E141", "line 3"),
    ),
    case(
        53,
        "prior mean outside its bounds",
        project(
            "[parameters.cart_mass]\nmean = 2.0\nsd = 0.1\nlow = 0.1\nhigh = 1.0",
            "E142",
            "line 2",
            "mean = 2",
        ),
    ),
    case(
        54,
        "no covariance",
        Input("E143", ("smallest eigenvalue of -1", "mass"), no_covariance),
        Input("E143", ("coordinate 0", "0.5 and 0.2", "symmetric"), no_symmetry),
    ),
    case(
        55,
        "variance <= 0 or NaN",
        project("[parameters.cart_mass]\nmean = 0.4\nsd = 0.0", "E144", "line 2"),
        project("[likelihood]\nnoise_floor = 0.0", "E144", "line 3"),
        project("[likelihood]\nnoise_floor = nan", "E144", "line 3", "nan"),
        project("[likelihood]\nstart_sd = {x = -1.0}", "E144", "line 3", "-1"),
    ),
    case(
        56,
        "duplicate or unknown parameter",
        project("[parameters]\ncart_mass = 1.0\ncart_mass = 2.0", "E145", "line 4"),
        project("[parameters]\ncart_mas = 1.0", "E145", "line 3", "mean cart_mass"),
    ),
    # One such constant keeps its prior and its verdict is `dead`; all are an error.
    case(
        57,
        "parameter that reaches nothing",
        Input("E146", ("arm.csv", "mass, length"), nothing_moves),
    ),
    case(
        58,
        "impossible mass or inertia",
        model(MODEL.replace('mass="1"', 'mass="-1"'), "E147", "arm.xml", "'arm'"),
        model(MODEL.replace("1 1 1", "1 1 5"), "E147", "arm.xml", "A + B >= C"),
        project("[parameters]\ncart_mass = -1.0", "E147", "line 3", "-1 kg"),
        project(
            "[parameters.pole_mass]\nlow = -1.0\nhigh = 1.0", "E147", "line 2", "-1 kg"
        ),
    ),
    case(
        59,
        "budget <= 0, more elites than samples",
        project("[planner]\nsamples = 0", "E148", "line 3", "samples", "got 0"),
        project("[planner]\nhorizon = -1", "E148", "line 3", "horizon"),
        project("[planner]\nsamples = 8\nelites = 9", "E148", "line 4", "9 of 8"),
        words("demo --episodes 0", "E148", "--episodes", "got 0"),
    ),
    case(
        60,
        "seed",
        words("demo --seed -1", "E149", "got -1"),
        words("demo --seed 1.5", "E149", "got 1.5"),
        words("demo --seed 4294967296", "E149", "4294967295"),
    ),
    case(
        61,
        "unknown config key",
        project("[likelyhood]\n", "E160", "line 2", "did you mean likelihood"),
        project("[planner]\nelite = 3", "E160", "line 3", "did you mean elites"),
    ),
    case(
        62,
        "wrong type",
        project("[likelihood]\nrobust = yes", "E160", "line 3"),
        project('[likelihood]\nrobust = "yes"', "E160", "line 3", "true or false"),
        project('[likelihood]\nwindow = "1e-3"', "E160", "line 3", "without quotes"),
    ),
    case(
        63,
        "YAML alias bomb",
        written(BOMB, "E161", "aliases", name="project.yaml"),
        written(BOMB, "E161", "aliases"),
    ),
    case(
        64,
        "YAML object",
        written(OBJECT, "E161", "tags", name="project.yaml"),
        written(OBJECT, "E161", "tags"),
        project('[options]\na = "!!python/object:os"', "E162", "line 3"),
    ),
    case(
        65,
        "nested or large",
        project("a = " + "[" * 65 + "]" * 65, "E161", "nesting of 65"),
        project("a = " + "[" * 100_000, "E161", "nesting of 100000"),
        project("# " + "x" * 1_000_000, "E161", "1000022 characters"),
    ),
    case(
        66,
        "code in a config",
        project('[options]\n_target_ = "os.system"', "E162", "line 3"),
        written('system = "eval:print(1)"', "E162", "line 1", "eval:"),
        written('system = "${env:HOME}"', "E162", "line 1", "${env:HOME}"),
    ),
    # Channels are named in the words of the project, whatever its machine (E160).
    case(
        67,
        "MJCF: no such joint, actuator",
        model(
            MODEL,
            "E170",
            "project.toml:line 9",
            "did you mean joint/hip/damping",
            more='[parameters]\n"joint/hop/damping" = 1.0',
        ),
        model(
            MODEL,
            "E160",
            "project.toml:line 8",
            "one of push",
            more="[actuators.pusj]\ngain = 1.0",
        ),
    ),
    case(
        68,
        "MJCF: syntax, mesh",
        model("<mujoco>\n<worldbody>\n</mujoco>", "E170", "arm.xml"),
        model(
            MODEL.replace(
                "<worldbody>", '<asset><mesh file="no.stl"/></asset><worldbody>'
            ),
            "E170",
            "arm.xml",
            "no.stl",
        ),
    ),
    case(
        69,
        "MJCF: crash, foreign file",
        Input("E171", ("arm.xml", "exit -11"), crashing),
        model(
            '<mujoco><include file="/etc/passwd"/></mujoco>', "E171", "got /etc/passwd"
        ),
    ),
    # No project chooses MJX; what that lacks is refused in test_mujoco_mjx.py.
    case(
        70,
        "MJCF: unsupported",
        model(
            MODEL.replace('<joint name="hip" damping=".1"/>', '<freejoint name="hip"/>')
            .replace('<actuator><motor name="push" joint="hip"/></actuator>', ""),
            "E172",
            "quaternion",
            "hip",
        ),
    ),
    case(
        71,
        "pickle by another name",
        stored("a.npz", raw(PICKLE), "E180", "pickle refused"),
        stored("a.csv", raw(PICKLE), "E180", "pickle refused"),
        stored("a.safetensors", raw(PICKLE), "E180", "pickle refused"),
        stored("a.pt", raw(b"never read"), "E180", "pickle refused"),
        stored("a.joblib", raw(b"never read"), "E180", "pickle refused"),
        stored("a.npz", TORCH, "E180", "data.pkl"),
        stored("a.safetensors", TORCH, "E180", "pickle refused"),
    ),
    case(
        72,
        "objects in an npz",
        stored("a.npz", npz(pos=np.array([Touch()] * ROWS)), "E180", "column pos"),
    ),
    case(
        73,
        "header that declares too much",
        stored(
            "a.npz", archive(("pos.npy", header(65536, 65536))), "E126", "(65536, 65536)"
        ),
    ),
    # No tensor file is read at all; a policy is a run of ours, with its checksums.
    case(
        74,
        "tensors",
        stored("a.safetensors", raw(TENSORS), "E181", "numpy.savez"),
        policy({"weights/0": NAN}, "E181", "weights/0", "1 of 1"),
        policy({"weights/0": np.ones((1, 1))}, "E133", "float64"),
        stored(
            "a.npz",
            archive(("pos.npy", b"\x93NUMPY\x02\x00" + b"\xff" * 3 + b"\x7f")),
            "E125",
        ),
    ),
    case(
        75,
        "archive entry outside",
        stored("a.npz", archive(("../../evil.npy", header(0))), "E182", "../../evil"),
        stored("a.npz", archive(("/etc/evil.npy", header(0))), "E182", "/etc/evil"),
        stored("a.npz", archive(("C:\\evil.npy", header(0))), "E182", "evil"),
    ),
    case(
        76,
        "run that is not as it was",
        run(flipped, "E183", "arrays.npz", "another checksum"),
        run(newer, "E185", "got 99", "at most 1"),
        run(fixed_since, "E184", "project.toml", "expected cart_mass"),
    ),
)
