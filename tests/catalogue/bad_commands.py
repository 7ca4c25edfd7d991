"""Bad inputs 127 to 132: command lines, runs, and the files that they write."""

import errno
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

import sim2gp as sg
import stub_commands
from sim2gp.commands.explain import project_file
from sim2gp.planning import MPC, oracle
from sim2gp.planning.tasks import furuta_swingup
from sim2gp.project import load_project
from sim2gp.reports import scenes
from sim2gp.runs import load_run, new_run
from sim2gp.runs.cells import Cells
from sim2gp.runs.executors import Processes, RayCluster
from sim2gp.runs.shares import join_shares
from sim2gp.runs.sinks import JSONLines, TensorBoard, WandB
from sim2gp.studies.swingup import Cell
from sim2gp.systems import Furuta
from tests.catalogue.bad_files import run
from tests.catalogue.bad_inputs import PROJECT, TEXTS, Case, Input, Patch, case, refusal

KEY = jax.random.key(0)
PENDULUM = """system = "furuta"
[[logs]]
files = ["a.csv"]
time = "t"
columns = {theta = "pos", alpha = "angle", voltage = "cmd"}
"""


def line(
    key: str, words: str, *said: str, project: str = PROJECT, brief: bool = False
) -> Input:
    """Words of a command next to a project, its log, and somebody's folder."""

    def make(folder: Path, patch: Patch) -> Sequence[str]:
        (folder / "project.toml").write_text(project)
        (folder / "a.csv").write_text(TEXTS)
        (folder / "there").mkdir()
        (folder / "there" / "thesis.tex").write_text("")
        with new_run(folder / "other", "evaluate") as writer:
            writer.write_summary({"command": "evaluate"})
            writer.write_arrays("arrays.npz", {"x": np.zeros(1)})
        return words.split()

    return Input(key, said, make, brief=brief)


def designed(key: str, words: str, *said: str, brief: bool = False) -> Input:
    words = f"design project.toml --out next --period 0.01 --seconds 1 {words}"
    return line(key, words, *said, project=PENDULUM, brief=brief)


def fitted(key: str, words: str, *said: str) -> Input:
    """Of a run that `identify` could have written."""
    made = run(lambda folder: None, key)

    def make(folder: Path, patch: Patch) -> Sequence[str]:
        made.make(folder, patch)
        return words.split()

    return Input(key, said, make)


# Runs and what is written into them


def saved(path: Path, arrays: Any = None, summary: Any = None) -> Path:
    with new_run(path, "test") as writer:
        writer.write_summary({"value": 1.0} if summary is None else summary)
        writer.write_arrays("arrays.npz", arrays or {"a": np.arange(5.0)})
    return path


def stored(key: str, spoil: Callable[[Path], object], *said: str) -> Input:
    """A run that something happened to, and that is loaded."""

    def make(folder: Path, patch: Patch) -> None:
        spoil(saved(folder / "a"))
        load_run(folder / "a")

    return Input(key, said, make)


def written(key: str, write: Callable[[Any], object], *said: str) -> Input:
    """Something that is written into a new run."""

    def make(folder: Path, patch: Patch) -> None:
        with new_run(folder / "a", "test") as writer:
            write(writer)

    return Input(key, said, make)


def made(key: str, make: Callable[[Path], object], *said: str) -> Input:
    """A call that writes into a folder."""
    return Input(key, said, lambda folder, patch: make(folder))  # type: ignore[arg-type, return-value]


def replaced(make: Callable[[Path], object]) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        (folder / "manifest.json").unlink()
        make(folder / "manifest.json")

    return spoil


def without_summary(folder: Path) -> None:
    with new_run(folder / "a", "test") as writer:
        writer.write_arrays("arrays.npz", {"a": np.arange(5.0)})
    load_run(folder / "a")


def holding(name: str, content: bytes) -> Input:
    """A whole file, with its right checksum, that holds something else."""

    def make(folder: Path) -> None:
        with new_run(folder / "a", "test") as writer:
            writer.write_summary({"value": 1.0})
            writer.write_bytes(name, content)
        load_run(folder / "a")

    return made("damaged_run", make, name)


OTHER = (b"", b"[]", b"\xff\xff", b'{"a": 1, "a": 2}', b"PK\3\4", b"\x93NUMPY\1\0")


def failing(key: str, number: int) -> Input:
    """A disk that refuses the second call that changes it, at the lock's file."""

    def make(folder: Path, patch: Patch) -> None:
        opened = os.open

        def refuse(path: Any, *given: Any, **how: Any) -> int:
            if str(path).endswith(".lock"):
                raise OSError(number, os.strerror(number))
            return opened(path, *given, **how)

        patch.setattr(os, "open", refuse)
        saved(folder / "a")

    return Input(key, (), make)


def twice(folder: Path) -> None:
    """Two writers of one run."""
    with new_run(folder / "a", "test"):
        saved(folder / "a")


def linked(folder: Path) -> None:
    """A link in the place of what an earlier writer left."""
    (folder / "thesis").mkdir()
    (folder / ".a.partial").symlink_to(folder / "thesis")
    saved(folder / "a")


def torn(folder: Path) -> None:
    """A cell of a study that is no JSON."""
    cells = Cells(folder / "out", Path(__file__))
    cells.save("one", {"n": 1}, {"x": 1.0})
    (cells.folder / "one.json").write_bytes(b"{}")
    cells.load("one", {"n": 1})


def on_ray(folder: Path) -> object:
    return list(RayCluster().spread(abs, [[1]]))


def not_all_shares(folder: Path, patch: Patch) -> None:
    """A study of which no share was computed."""
    del patch
    join_shares([Cell("furuta", "nominal", "oracle", 0, 0)], folder / "out")


def in_a_file(make: Callable[[Path], object]) -> Callable[[Path], object]:
    def call(folder: Path) -> object:
        (folder / "file").write_text("")
        return make(folder / "file" / "run")

    return call


def without(make: Callable[[Path], object], package: str, extra: str) -> Input:
    def call(folder: Path, patch: Patch) -> None:
        patch.setitem(__import__("sys").modules, package, None)
        make(folder)

    return Input("missing_extra", (f"sim2gp[{extra}]",), call)


def sampler(folder: Path) -> object:
    from sim2gp.identification.exact_posterior.nuts import sampler

    return sampler()


# Results of Python


def found(folder: Path, project: bool) -> stub_commands.Returned:
    path = folder / "project.toml"
    path.write_text(PROJECT)
    known = load_project(path) if project else None
    return stub_commands.Returned({"command": "identify"}, project=known)


def changed_since(folder: Path) -> None:
    result = found(folder, True)
    (folder / "project.toml").write_text(f"{PROJECT}# more\n")
    project_file(result)


def evaluated(folder: Path) -> None:
    """An identification without logs to forecast."""
    from sim2gp.commands.identification import Identification

    project = found(folder, True).project
    sg.evaluate(Identification({"command": "identify"}, {}, {}, project, None))


def no_logs(folder: Path) -> None:
    (folder / "project.toml").write_text('system = "cartpole"\n')
    sg.identify(load_project(folder / "project.toml"), [])


def hopeless(folder: Path, patch: Patch) -> None:
    """No truth that the planner can swing up."""

    def judge(task: Any, planner: Any, *, key: Any) -> oracle.OracleRun:
        return oracle.OracleRun(np.asarray([0.0]), False)

    patch.setattr(oracle, "run_oracle", judge)
    given = furuta_swingup, Furuta(), MPC()
    oracle.accept_truth(*given, key=KEY, attempts=2)


COMMANDS: tuple[Case, ...] = (
    case(
        127,
        "words of a command line",
        line("E160", "identfy a.toml", "did you mean identify", brief=True),
        line("E160", "--verison", "did you mean --version", brief=True),
        line("E160", "demo --sed 3", "did you mean --seed", brief=True),
        *[
            line(code, words, said)
            for code, words, said in (
                ("E160", "demo --seed", "--seed VALUE"),
                ("E160", "demo --machine furutta", "did you mean furuta"),
                ("E160", "demo --log-to tensorbord", "did you mean tensorboard"),
                ("E160", "demo now", "now"),
                ("E160", "demo --json=maybe", "got maybe"),
                ("E160", "identify", "missing PROJECT"),
                ("E160", "identify a.toml b.toml", "got b.toml"),
                ("E160", "evaluate", "missing RUN|PROJECT"),
                ("E160", "evaluate gone.toml --logs a.csv", "--logs"),
                ("E148", "evaluate there --horizon nan", "nan"),
                ("E160", "reproduce", "missing FIGURE"),
                ("E160", "reproduce fig11", "did you mean fig1"),
                ("figure_without_episodes", "reproduce fig1 --episodes 2", "got 2"),
                ("E160", "reproduce fig2 --refresh --keep-old", "--keep-old"),
                ("file_cannot_be_read", "identify gone.toml", "gone.toml"),
                ("file_cannot_be_read", "evaluate gone.toml", "gone.toml"),
                ("output_is_not_a_run", "identify gone.toml --out there", "there"),
                ("not_a_run", "evaluate gone --logs a.csv", "gone"),
                ("not_a_run", "evaluate gone --logs", "gone"),
                ("not_a_run", "report there", "there"),
                ("not_a_run", "design gone", "gone"),
            )
        ],
    ),
    case(
        128,
        "runs and horizons of commands",
        line("not_an_identification", "evaluate other --logs a.csv", "got evaluate"),
        line("nothing_to_explain", "explain other", "got evaluate"),
        line("file_in_place_of_a_run", "explain project.toml", "runs/project"),
        line("one_recording", "evaluate project.toml"),
        line("no_such_part", "identify project.toml --each robot", "{robot}"),
        line(
            "one_machine",
            "identify project.toml --each robot",
            "a",
            project=PROJECT.replace("*.csv", "{robot}.csv"),
        ),
        line("horizon_out_of_range", "compare project.toml --horizon 100", "100 s"),
        line("horizon_out_of_range", "evaluate project.toml --horizon 100", "100 s"),
        line("E148", "compare project.toml --horizon soon", "soon"),
        line("nothing_to_compare", "compare project.toml --horizon 0.2 2", "horizon"),
        line(
            "unmeasured_position",
            "compare project.toml",
            "theta",
            project=PROJECT.replace('theta = "angle"\n', ""),
        ),
        fitted(
            "no_window_to_predict", "evaluate run --logs a.csv --horizon 5", "of 5 s"
        ),
        fitted("no_model_file", "apply run", "cartpole"),
    ),
    case(
        129,
        "designs from the command line",
        designed("unknown_parameter", "--about arm_dampin", "mean arm_damping"),
        designed("experiment_too_short", "--seconds 0.005", "0.005 s"),
        designed("no_motion_in_limits", "--limit voltage=1:2", "voltage"),
        designed("E141", "--limit theta=2:1"),
        designed("E160", "--limit theta", "NAME=VALUE"),
        designed("E160", "--limit theta=1", "LOW:HIGH"),
        designed("E160", "--limit theta=a:b"),
        designed("no_such_channel", "--limit thata=-1:1", "did you mean theta"),
        designed("no_such_channel", "--rate theta=1", "voltage", brief=True),
        designed("rate_admits_no_motion", "--rate voltage=0", "voltage"),
        designed("no_such_channel", "--start alpa=1", "theta"),
        designed("no_motion_in_limits", "--start alpha=4 --limit alpha=-1:1", "alpha"),
        designed("prediction_too_long", "--predict 3", "3 s"),
        designed("E148", "--period nan"),
        designed("E160", "--kind chirp", "free, multisine"),
    ),
    case(
        130,
        "folders of runs",
        stored("not_a_run", replaced(os.mkfifo)),
        stored("not_a_run", replaced(Path.mkdir)),
        stored("not_a_run", lambda folder: (folder / "manifest.json").unlink()),
        made("not_a_run", without_summary),
        made("not_a_run", lambda folder: sg.show(folder / "nothing")),
        *[holding(n, x) for n in ("summary.json", "arrays.npz") for x in OTHER],
        made("run_owned", twice),
        made("output_cannot_be_written", linked),
        failing("disk_failure", errno.ENOSPC),
        failing("disk_failure", errno.EIO),
        failing("output_cannot_be_written", errno.EACCES),
        *[
            written("file_outside_run", lambda w, name=name: w.write_text(name, ""))
            for name in ("../x", "/x", "a/../../x", "")
        ],
        written(
            "run_array_of_objects",
            lambda w: w.write_arrays("a.npz", {"a": np.array([{}], dtype=object)}),
        ),
        written(
            "result_not_finite",
            lambda w: w.write_summary({"b": {"c": [1.0, float("nan")]}}),
            "b.c[1]",
        ),
        written(
            "result_not_finite",
            lambda w: w.write_summary({"d": np.array(np.inf)}),
            "d",
        ),
        made("cells_of_others", torn, "1 damaged"),
    ),
    case(
        131,
        "files and packages",
        made("no_folder_for_file", lambda folder: sg.example(folder / "no" / "where")),
        made("file_exists", lambda folder: (sg.example(folder), sg.example(folder))),
        made("output_cannot_be_written", in_a_file(JSONLines)),
        made("output_cannot_be_written", in_a_file(TensorBoard)),
        without(TensorBoard, "tensorboardX.event_file_writer", "tensorboard"),
        without(WandB, "wandb", "wandb"),
        without(sampler, "blackjax", "mcmc"),
        without(on_ray, "ray", "ray"),
    ),
    case(
        132,
        "results of Python",
        made("no_project_to_add_to", lambda folder: project_file(found(folder, False))),
        made("project_changed_since_run", changed_since, "project.toml"),
        made("no_logs_to_evaluate", evaluated),
        made("empty_list_of_logs", no_logs),
        refusal(
            "no_drawing",
            lambda: scenes.scene_of({"system": "furtua"}, np.zeros((2, 4))),
            "did you mean furuta",
        ),
        refusal(
            "worker_died",
            lambda: list(Processes(2).spread(os._exit, [[3], [3]])),
            "exit code 3",
        ),
        refusal(
            "no_ray_cluster",
            lambda: list(RayCluster("nowhere").spread(abs, [[1]])),
            "nowhere",
        ),
        Input("cells_missing", ("1 of 1",), not_all_shares),
        Input("no_truth_swung_up", ("MPC", "2 draws"), hopeless),
    ),
)
