"""Bad inputs 46 to 66: shapes, constants, project files."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from sim2gp.inference.arrowhead import Elimination
from sim2gp.inference.gaussian import from_covariance
from sim2gp.inference.laplace import Laplace
from sim2gp.inference.least_squares import prior_rows
from sim2gp.inference.levenberg_marquardt import Point
from sim2gp.types import in_float64
from tests.catalogue.bad_inputs import (
    GOOD,
    IDENTIFY,
    MODEL,
    Case,
    Input,
    Patch,
    case,
    model,
    npz,
    renamed,
    stored,
)


def project(more: str, key: str, *words: str, name: str = "project.toml") -> Input:
    """A project file with some lines more than its system."""
    return written(f'system = "cartpole"\n{more}', key, *words, name=name)


def written(text: str, key: str, *words: str, name: str = "project.toml") -> Input:
    def make(folder: Path, patch: Patch) -> Sequence[str]:
        (folder / name).write_text(text)
        return "identify", name

    return Input(key, (name, *words), make)


def words(command: str, key: str, *said: str) -> Input:
    """A command line that is at fault by itself."""
    return Input(key, ("the command line", *said), lambda *_: command.split())


# Shapes


def of_two_numbers(folder: Path, patch: Patch) -> None:
    """What both environments ask before they step (test_gymnasium.py)."""
    pytest.importorskip("gymnasium")
    from sim2gp.robot.gymnasium import validate_action

    validate_action(np.zeros(2), (1,))


def without_batch(folder: Path, patch: Patch) -> None:
    pytest.importorskip("gymnasium")
    from sim2gp.robot.gymnasium import validate_action

    validate_action(np.zeros(1), (8, 1))


X = np.stack([GOOD["pos"], GOOD["vel"]])
AS_TABLE = renamed('"pos"', '"state[0]"').replace('"vel"', '"state[1]"')


def arrays(content: Mapping[str, Any], key: str, *said: str) -> Input:
    """An archive whose ``state`` is a table."""

    def make(folder: Path, patch: Patch) -> Sequence[str]:
        (folder / "project.toml").write_text(AS_TABLE.replace("*.csv", "a.npz"))
        np.savez(folder / "a.npz", **content)
        return IDENTIFY

    return Input(key, said, make)


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
    blocks, rows = factor[None, None], prior_rows(z)
    at = Point(z, none, blocks, rows, zero + 0.5, z, none, jnp.zeros((1, 2)))
    arrow = Elimination(factor, jnp.zeros((1, 0, 0)), jnp.zeros((1, 0, 3)))
    found = Laplace(at, arrow, jnp.eye(3)).convergence(jnp.asarray(0))
    found.check(("mass", "length"), "arm.csv")


BOMB = "a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]\n"
OBJECT = "a: !!python/object/apply:os.system ['touch was-run']\n"

SECOND: tuple[Case, ...] = (
    case(
        46,
        "(N, D) where (N + 1, D)",
        stored(
            "a.npz",
            npz(cmd=GOOD["cmd"][:-1]),
            "columns_of_different_lengths",
            "300 rows of t, 299 of cmd",
        ),
    ),
    case(
        47,
        "transposed",
        arrays(
            NO_STATE | {"state": X},
            "array_transposed",
            "looks transposed",
            "save state.T",
        ),
        arrays(NO_STATE | {"state": X.T}, ""),
    ),
    case(
        48,
        "wrong action dimension",
        Input(
            "action_of_another_shape",
            ("got shape (2,)", "expected shape (1,)"),
            of_two_numbers,
        ),
    ),
    case(
        49,
        "batch axis",
        stored(
            "a.npz", npz(cmd=GOOD["cmd"][:, None, None]), "not_a_table", "(300, 1, 1)"
        ),
        Input(
            "action_of_another_shape",
            ("got shape (1,)", "expected shape (8, 1)"),
            without_batch,
        ),
    ),
    case(
        50,
        "min > max",
        project(
            "[parameters.cart_mass]\nlow = 1.0\nhigh = 0.5",
            "bounds_reversed",
            "line 2",
            "cart_mass reversed",
            "low = 1, high = 0.5",
        ),
        project(
            "[limits]\nx = [1.0, -1.0]",
            "interval_reversed",
            "line 3",
            "limits of x reversed",
        ),
        project(
            'logs = [{files = ["a.csv"], columns = {x = {column = "a", saturation = '
            "[1.0, -1.0]}, voltage = 0.0}}]",
            "interval_reversed",
            "line 2",
            "saturation of x reversed",
        ),
    ),
    case(
        51,
        "min == max",
        project(
            "[parameters.cart_mass]\nlow = 1.0\nhigh = 1.0",
            "bounds_without_room",
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
            "impossible_prior",
            "line 2",
            "mean = 2",
        ),
    ),
    case(
        54,
        "no covariance",
        Input("not_a_covariance", ("smallest eigenvalue of -1", "mass"), no_covariance),
        Input(
            "not_a_covariance",
            ("coordinate 0", "0.5 and 0.2", "symmetric"),
            no_symmetry,
        ),
    ),
    case(
        55,
        "variance <= 0 or NaN",
        project(
            "[parameters.cart_mass]\nmean = 0.4\nsd = 0.0", "wrong_moments", "line 2"
        ),
        project("[likelihood]\nnoise_floor = 0.0", "E144", "line 3"),
        project("[likelihood]\nnoise_floor = nan", "E144", "line 3", "nan"),
        project("[likelihood]\nstart_sd = {x = -1.0}", "E144", "line 3", "-1"),
        project(
            "[parameters.cart_mass]\nmean = 0.4\nrelative_sd = 0.0", "E144", "line 4"
        ),
        project(
            '[[weighed]]\nof = ["cart_mass"]\nvalue = 0.4\nsd = 0.0', "E144", "line 5"
        ),
    ),
    case(
        56,
        "duplicate or unknown parameter",
        project(
            "[parameters]\ncart_mass = 1.0\ncart_mass = 2.0",
            "duplicate_parameter",
            "line 4",
        ),
        project(
            "[parameters]\ncart_mas = 1.0",
            "unknown_parameter",
            "line 3",
            "mean cart_mass",
        ),
        project(
            "[effects.theta]\ntilt = 0.1",
            "impossible_effect",
            "line 3",
            "effects.x.tilt",
        ),
    ),
    # One such constant keeps its prior and its verdict is `dead`; all are an error.
    case(
        57,
        "parameter that reaches nothing",
        Input("no_parameter_reaches_data", ("arm.csv", "mass, length"), nothing_moves),
    ),
    case(
        58,
        "impossible mass or inertia",
        model(
            MODEL.replace('mass="1"', 'mass="-1"'),
            "impossible_body",
            "arm.xml",
            "'arm'",
        ),
        model(
            MODEL.replace("1 1 1", "1 1 5"), "impossible_body", "arm.xml", "A + B >= C"
        ),
        project("[parameters]\ncart_mass = -1.0", "negative_matter", "line 3", "-1 kg"),
        project(
            "[parameters.pole_mass]\nlow = -1.0\nhigh = 1.0",
            "negative_matter",
            "line 2",
            "-1 kg",
        ),
    ),
    case(
        59,
        "budget <= 0, more elites than samples",
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
        project("[likelyhood]\n", "unknown_key", "line 2", "did you mean likelihood"),
        project(
            "[options]\nlength1 = 0.2",
            "unknown_name",
            "line 3",
            "one of motor_resistance",
        ),
        written('sytem = "cartpole"', "unknown_key", "line 1", "did you mean system"),
        project("[task]", "reserved_section", "line 2", "not used by any command yet"),
        project("[model]", "reserved_section", "line 2", "not used by any command yet"),
        project(
            "[planner]\nelites = 3",
            "reserved_section",
            "line 2",
            "not used by any command",
        ),
    ),
    case(
        62,
        "wrong type",
        project("[likelihood]\nrobust = yes", "not_valid_toml", "line 3"),
        project('[likelihood]\nrobust = "yes"', "E160", "line 3", "true or false"),
        project('[likelihood]\nwindow = "1e-3"', "E160", "line 3", "without quotes"),
        project('[likelihood]\nwindow = "0.2 s"', "E160", "line 3", "write 0.2"),
        project("[logs]\nfiles = ['a.csv']", "E160", "line 2", "write [[logs]]"),
        written(
            'system = "mujoco:a.xml"', "unknown_system", "line 1", "the file's name"
        ),
    ),
    case(
        63,
        "YAML alias bomb",
        written(BOMB, "project_file_in_yaml", "aliases", name="project.yaml"),
        written(BOMB, "project_file_in_yaml", "aliases"),
        written("<mujoco/>", "model_as_project_file", "sim2gp init", name="arm.xml"),
    ),
    case(
        64,
        "YAML object",
        written(OBJECT, "project_file_in_yaml", "tags", name="project.yaml"),
        written(OBJECT, "project_file_in_yaml", "tags"),
        project(
            '[options]\na = "!!python/object:os"', "code_in_project_file", "line 3"
        ),
    ),
    case(
        65,
        "nested or large",
        project(
            "a = " + "[" * 65 + "]" * 65, "project_file_too_large", "nesting of 65"
        ),
        project("a = " + "[" * 100_000, "project_file_too_large", "nesting of 100000"),
        project(".".join("a" * 65) + " = 1", "project_file_too_large", "nesting of 65"),
        project("# " + "x" * 1_000_000, "project_file_too_large", "1000022 characters"),
    ),
    case(
        66,
        "code in a config",
        project('[options]\n_target_ = "os.system"', "code_in_project_file", "line 3"),
        written('system = "eval:print(1)"', "code_in_project_file", "line 1", "eval:"),
        written(
            'system = "${env:HOME}"', "code_in_project_file", "line 1", "${env:HOME}"
        ),
    ),
)
