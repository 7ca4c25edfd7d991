"""Bad inputs 67 to 76: models, archives, runs."""

import io
import json
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sim2gp.project import load_project
from sim2gp.robot.format import FORMAT
from sim2gp.robot.policy import load_policy
from sim2gp.runs import new_run
from tests.catalogue.bad_inputs import (
    MODEL,
    PROJECT,
    ROWS,
    TEXTS,
    Case,
    Input,
    Patch,
    case,
    model,
    npz,
    stored,
)

# Models


def crashing(folder: Path, patch: Patch) -> Sequence[str]:
    """No file is known that crashes this parser: its process is one that dies."""
    from sim2gp.systems.mujoco import load as mjcf_load

    child = folder / "child.py"
    child.write_text("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
    patch.setattr(mjcf_load, "_CHILD", str(child))
    found = model(MODEL, "parser_died").make(folder, patch)
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


def policy(
    changes: Mapping[str, Any], key: str, *said: str, form: int = FORMAT
) -> Input:
    """What `export_policy` writes, of one layer, with some arrays changed."""

    def make(folder: Path, patch: Patch) -> None:
        two, one = np.ones((1, 2), np.float32), np.ones(1, np.float32)
        stored = {"weights/0": two, "biases/0": two[0], "scale": one}
        stored |= {"low": -one, "high": one}
        about = {"format": form, "layers": 1, "angle": None}
        about |= {"states": ["x"], "actions": ["u"], "units": {"x": "m", "u": "V"}}
        with new_run(folder / "policy", "export policy") as writer:
            writer.write_arrays("arrays.npz", stored | dict(changes))
            writer.write_summary({"policy": about})
        load_policy(folder / "policy")

    return Input(key, said, make)


NAN = np.full((1, 2), np.nan, np.float32)


def run(spoil: Callable[[Path], object], key: str, *said: str) -> Input:
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
            wide = {"intervals/mean": zeros, "intervals/scale": np.diag(zeros)}
            belief = {"belief/mean": zeros, "belief/scale": np.diag(zeros), **wide}
            writer.write_arrays("arrays.npz", belief)
        spoil(folder / "run")
        return "evaluate", "run", "--logs", "a.csv"

    return Input(key, ("run", *said), make)


def flipped(folder: Path) -> None:
    content = bytearray((folder / "arrays.npz").read_bytes())
    content[len(content) // 2] ^= 1
    (folder / "arrays.npz").write_bytes(content)


def newer(folder: Path) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    (folder / "manifest.json").write_text(json.dumps(manifest | {"format": 99}))


def odd(*manifests: str) -> Sequence[Input]:
    """The manifest is JSON, or nearly, but not the one of a run."""

    def spoiling(text: str) -> Callable[[Path], object]:
        return lambda folder: (folder / "manifest.json").write_text(text)

    return [run(spoiling(m), "damaged_run", "manifest.json") for m in manifests]


def fixed_since(folder: Path) -> None:
    (folder / "project.toml").write_text(f"{PROJECT}[parameters]\ncart_mass = 0.4\n")


THIRD: tuple[Case, ...] = (
    # Channels are named in the words of the project, whatever its machine (E160).
    case(
        67,
        "MJCF: no such joint, actuator",
        model(
            MODEL,
            "unknown_model_constant",
            "project.toml:line 9",
            "did you mean joint/hip/damping",
            more='[parameters]\n"joint/hop/damping" = 1.0',
        ),
        model(
            MODEL,
            "unknown_name",
            "project.toml:line 8",
            "one of push",
            more="[actuators.pusj]\ngain = 1.0",
        ),
    ),
    case(
        68,
        "MJCF: syntax, mesh",
        model("<mujoco>\n<worldbody>\n</mujoco>", "not_plain_xml", "arm.xml"),
        model(
            MODEL.replace(
                "<worldbody>", '<asset><mesh file="no.stl"/></asset><worldbody>'
            ),
            "missing_model_part",
            "arm.xml",
            "no.stl",
        ),
    ),
    case(
        69,
        "MJCF: crash, foreign file",
        Input("parser_died", ("arm.xml", "exit -11"), crashing),
        model(
            '<mujoco><include file="/etc/passwd"/></mujoco>',
            "file_outside_model_folder",
            "got /etc/passwd",
        ),
    ),
    # No project chooses MJX; what that lacks is refused in test_mujoco_mjx.py.
    case(
        70,
        "MJCF: unsupported",
        model(
            MODEL.replace(
                '<joint name="hip" damping=".1"/>', '<freejoint name="hip"/>'
            ).replace('<actuator><motor name="push" joint="hip"/></actuator>', ""),
            "joint_with_quaternion",
            "quaternion",
            "hip",
        ),
    ),
    case(
        71,
        "pickle by another name",
        stored("a.npz", raw(PICKLE), "pickle_refused", "pickle refused"),
        stored("a.csv", raw(PICKLE), "pickle_refused", "pickle refused"),
        stored("a.safetensors", raw(PICKLE), "pickle_refused", "pickle refused"),
        stored("a.pt", raw(b"never read"), "pickle_refused", "pickle refused"),
        stored("a.joblib", raw(b"never read"), "pickle_refused", "pickle refused"),
        stored("a.PICKLE", raw(b"never read"), "pickle_refused", "pickle refused"),
        stored("a.npz", TORCH, "pickle_refused", "data.pkl"),
        stored("a.safetensors", TORCH, "pickle_refused", "pickle refused"),
    ),
    case(
        72,
        "objects in an npz",
        stored(
            "a.npz",
            npz(pos=np.array([Touch()] * ROWS)),
            "array_of_objects",
            "column pos",
        ),
    ),
    case(
        73,
        "header that declares too much",
        stored(
            "a.npz",
            archive(("pos.npy", header(65536, 65536))),
            "array_header_and_size_differ",
            "(65536, 65536)",
        ),
    ),
    # No tensor file is read at all; a policy is a run of ours, with its checksums.
    case(
        74,
        "tensors",
        stored("a.safetensors", raw(TENSORS), "safetensors_refused", "numpy.savez"),
        policy({"weights/0": NAN}, "policy_not_finite", "weights/0", "2 of 2"),
        policy({"weights/0": np.ones((1, 2))}, "not_a_policy", "float64"),
        policy({}, "newer_policy", "got 99", form=99),
        stored(
            "a.npz",
            archive(("pos.npy", b"\x93NUMPY\x02\x00" + b"\xff" * 3 + b"\x7f")),
            "beyond_the_budget",
        ),
    ),
    case(
        75,
        "archive entry outside",
        stored(
            "a.npz",
            archive(("../../evil.npy", header(0))),
            "entry_outside_archive",
            "../../evil",
        ),
        stored(
            "a.npz",
            archive(("/etc/evil.npy", header(0))),
            "entry_outside_archive",
            "/etc/evil",
        ),
        stored(
            "a.npz",
            archive(("C:\\evil.npy", header(0))),
            "entry_outside_archive",
            "evil",
        ),
    ),
    case(
        76,
        "run that was changed",
        run(flipped, "damaged_run", "arrays.npz", "another checksum"),
        run(newer, "newer_run", "got 99", "at most 2"),
        *odd(
            '{"format": "1", "files": {}}',
            '{"format": null, "files": {}}',
            '{"format": 1, "files": []}',
            '{"format": 1, "files": {"summary.json": 3}}',
            '{"format": 1, "files": {"summary.json": {}}}',
            '{"format": 1, "files": {"summary.json": {"sha256": 5}}}',
            "[" * 100_000,
            "[1]",
        ),
        run(
            fixed_since,
            "other_parameters_than_fitted",
            "project.toml",
            "expected cart_mass",
        ),
    ),
)
