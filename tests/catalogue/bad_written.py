"""Bad inputs 133 to 136: what is read once more, drafted, changed or written back."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import sim2gp as sg
from crawler import written
from key_changes import GROUP, write_files
from sim2gp import systems as sy
from sim2gp.data.transitions import Transitions
from sim2gp.identification.misfit.tests import misfit
from sim2gp.inference.convergence import STALLED, Convergence
from sim2gp.models.nlm import checked
from sim2gp.project import Project, load_project
from sim2gp.project.amend import amend, amend_text
from sim2gp.project.columns import match, time_column
from sim2gp.project.draft import Request, draft_project
from sim2gp.systems import Candidate, Channel
from sim2gp.types import in_float64
from tests.catalogue.bad_inputs import TEXTS, Case, Input, Patch, case, refusal
from tests.catalogue.bad_models import TEXT, URDF
from tests.catalogue.bad_project_files import BARE, LOADED, grouped

CART = f'system = "cartpole"\n{GROUP}'


def project(
    key: str,
    text: str,
    *said: str,
    then: Callable[[Project], object] = lambda found: found.build_system(),
) -> Input:
    """A project that is loaded, and what is asked of it then."""

    def make(folder: Path, patch: Patch) -> None:
        if "arm.xml" in text:
            pytest.importorskip("mujoco")
        write_files(folder)
        (folder / "project.toml").write_text(text)
        then(load_project(folder / "project.toml"))

    return Input(key, said, make)


def alike(found: Project) -> object:
    return found.load_logs(alike=True)


BOTH = '"joint/*/damping" = 1.0\n"joint/s*/damping" = 2.0\n'

# Drafts and changes of a project's file

T = 0.01 * np.arange(200)
Q, U = np.sin(3 * T), np.sign(np.sin(9 * T))
HINGE = [Channel("hinge", "rad", angle=True), Channel("hinge.velocity", "rad/s")]
MOTOR = [Channel("motor", "1")]
SPRING = Candidate(sy.Spring("x", 8.0))
DELAY = Candidate(sy.Delay("voltage", 0.04))
LATE = f"{CART}[actuators.voltage]\ndelay = 0.01\n"


def matched(**columns: np.ndarray) -> object:
    return match(columns, T, HINGE, MOTOR, "log.csv")


def drafted(key: str, system: str, *said: str, log: str = "") -> Input:
    def make(folder: Path, patch: Patch) -> None:
        (folder / "log.csv").write_text(log or TEXTS)
        draft_project(Request(system, [folder / "log.csv"], folder / "p.toml"))

    return Input(key, said, make)


def spoilt(folder: Path, patch: Patch) -> None:
    """A change that would leave no project."""
    write_files(folder)
    (folder / "project.toml").write_text(CART)
    text = f"{CART}[effects.x.sprng]\n"
    patch.setattr("sim2gp.project.amend.amend_text", lambda *given: text)
    amend(folder / "project.toml", SPRING)


# Constants written into a model's file


def edited(
    key: str, text: str, values: dict[str, float], *said: str, later: str = ""
) -> Input:
    """``later`` replaces the file's text between its compilation and the edit."""

    def make(folder: Path, patch: Patch) -> None:
        pytest.importorskip("mujoco")
        from sim2gp.systems.mujoco.load import compiled
        from sim2gp.systems.mujoco.model_file import ModelFile

        path = written(folder, text)
        if text.lstrip().startswith("<robot"):
            path = path.rename(path.with_suffix(".urdf"))
        model = compiled(path)
        if later:
            path.write_text(later)
        ModelFile(path, model).edited(values)

    return Input(key, said, make)


def other_number(folder: Path, patch: Patch) -> None:
    """What was written is compared with what was wanted."""
    pytest.importorskip("mujoco")
    from sim2gp.systems.mujoco.load import compiled
    from sim2gp.systems.mujoco.model_file import ModelFile

    path = written(folder, TEXT)
    file = ModelFile(path, compiled(path))
    change = file.edited({"body/torso/mass": 0.9})
    file.check(change, compiled(path))


def without_file(folder: Path, patch: Patch) -> None:
    mujoco = pytest.importorskip("mujoco")
    sy.MuJoCo(mujoco.MjModel.from_xml_string(TEXT)).file()


LEGS = """<mujoco><worldbody><replicate count="2" offset="1 0 0">
  <body name="leg"><joint name="a" damping="1"/><geom size=".1"/></body>
  </replicate></worldbody></mujoco>"""
MUSCLE = '<actuator><cylinder joint="a" area="2"/></actuator></mujoco>'
ONE = re.sub("</?replicate[^>]*>", "", LEGS).replace("</mujoco>", MUSCLE)

# Results of fits


@in_float64
def stalled() -> None:
    one = jnp.ones(())
    Convergence(jnp.asarray(STALLED), one, one, 7, jnp.ones(1)).check(("k",), "here")


def not_finite() -> Any:
    return checked(jnp.asarray([jnp.nan]), Transitions.empty(8, 3, 2))


WRITTEN: tuple[Case, ...] = (
    case(
        133,
        "project: logs and machine",
        project(
            "no_logs_in_project",
            'system = "cartpole"\n',
            then=lambda found: found.load_logs(),
        ),
        project(
            "file_listed_twice", CART + GROUP, "a.csv", then=lambda f: f.load_logs()
        ),
        project("several_configurations", grouped(BARE, LOADED), "loaded", then=alike),
        project(
            "unknown_configuration",
            CART.replace("files", 'name = "bench"\nfiles'),
            "bench",
            then=lambda found: sg.read_logs("a.csv", found, "bank"),
        ),
        project(
            "no_group_of_logs",
            'system = "cartpole"\n',
            "project.toml",
            then=lambda found: found.read_logs([Path("a.csv")]),
        ),
        project("two_keys_for_one", CART + "period = 0.02\n", "line"),
        project("interval_empty", f"{CART}[limits]\nx = [1.0, 1.0]\n", "line 7"),
        project(
            "half_a_box",
            f"{CART}[effects.x.spring]\nlow = 1.0\n",
            "x.spring",
        ),
        project("effect_for_channel", f"{CART}[effects.spring]\nsd = 1.0\n", "line 7"),
        project(
            "constant_of_two_patterns",
            f'system = "arm.xml"\n[parameters]\n{BOTH}',
            "line 2",
        ),
    ),
    case(
        134,
        "drafts and changes of a project",
        refusal("too_short_to_draft", lambda: time_column({"t": T[:2]}, "log.csv")),
        refusal("no_column_of_time", lambda: time_column({"u": U, "q": Q}, "log.csv")),
        refusal("no_columns_found", lambda: matched(foo=0 * T, u=U), "hinge"),
        refusal("no_columns_found", lambda: matched(hinge=Q, foo=Q, bar=U), "motor"),
        drafted("unknown_system", "two_lnik"),
        drafted(
            "unknown_system", "mujoco:arm.xml", 'write the file\'s name, "arm.xml"'
        ),
        drafted(
            "no_columns_found",
            "furuta",
            "voltage",
            log="time,q1\n0,0\n0.1,1\n0.2,3\n",
        ),
        refusal("stated_already", lambda: amend_text(LATE, DELAY), "got 0.01"),
        refusal(
            "lag_in_project_file",
            lambda: amend_text(CART, Candidate(sy.Lag("voltage", 0.04))),
        ),
        Input("cannot_be_added", ("x.spring",), spoilt),
    ),
    case(
        135,
        "constants written into a model",
        edited(
            "text_cannot_be_changed",
            LEGS,
            {"body/leg0/mass": 2.0},
            later=LEGS.replace("</mujoco>", ""),
        ),
        edited("element_not_found", LEGS, {"body/leg0/mass": 2.0}, "replicate"),
        edited("element_not_found", LEGS, {"joint/a0/damping": 2.0}, "replicate"),
        edited("unsayable_constant", ONE, {"actuator/actuator0/gain": 3.0}, "cylinder"),
        edited(
            "urdf_element_not_found",
            URDF,
            {"joint/shoulder/damping": 2.0},
            "shoulder",
            later=URDF.replace('joint name="shoulder"', 'joint name="hip"'),
        ),
        edited(
            "link_without_inertial",
            URDF,
            {"body/upper/com_z": 2.0},
            "upper",
            later=re.sub("<inertial>.*</inertial>", "", URDF, flags=re.DOTALL),
        ),
        Input("constant_not_written", ("body/torso/mass",), other_number),
        Input("model_without_file", (), without_file),
    ),
    case(
        136,
        "fits that fail",
        refusal("map_not_reached", stalled, "k (1 sd)"),
        refusal(
            "results_not_finite",
            lambda: misfit(np.full((9, 1), np.nan), np.zeros((9, 1))),
            "9 of 9",
        ),
        refusal("no_finite_checkpoint", not_finite, "0 transitions"),
    ),
)
