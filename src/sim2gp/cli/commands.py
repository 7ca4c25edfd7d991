"""The commands: what each one takes, and which function it calls with that.

A command imports its function when it runs: help and a mistyped option cost nothing.
"""

from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from sim2gp.cli.arguments import pairs, parse_numbers, usage_error
from sim2gp.cli.late import (
    Call,
    command,
    executor_of,
    function,
    identification,
    in_cells,
    run_directory,
)
from sim2gp.cli.log_commands import (
    Compare,
    Evaluate,
    Example,
    Explain,
    Identify,
    Init,
)
from sim2gp.cli.options import (
    Chosen,
    Common,
    Count,
    File,
    Flag,
    InCells,
    Percent,
    Seconds,
    Seed,
    SomeCount,
    SomeSeconds,
    Wide,
    Writes,
    option,
)
from sim2gp.runs.sinks import opened
from sim2gp.runs.store import check_absent, read_run


@dataclass(kw_only=True)
class Demo(Writes):
    """Learn to swing up a pendulum whose parameters are unknown, in a few trials."""

    machine: Literal["furuta", "cartpole"] = "furuta"
    """Which pendulum."""
    seed: Seed = 0
    """Draws the truth, the noise and the plans."""
    seeds: Count = 1
    """Run this many seeds, starting at the one given."""
    episodes: Count = 3
    """Real episodes of each run, 5 s each."""
    truth: Literal["prior", "2sd", "3sd", "outside"] = "prior"
    """Hidden parameters: as believed, each so far off, or beyond its bounds."""
    mismatch: Flag = False
    """The machine has a force that its simulator lacks."""
    log_to: Annotated[
        Literal["jsonl", "tensorboard", "wandb"] | None,
        option("{jsonl,tensorboard,wandb}"),
    ] = None
    """Write each episode's numbers, as they come, next to the run directory."""

    def run(self, call: Call) -> dict[str, Any]:
        out = run_directory(self.out, "demo")
        about = ("machine", "seed", "seeds", "episodes", "truth", "mismatch")
        asked = {name: getattr(self, name) for name in about}
        with opened(self.log_to, out, asked) as sink:
            return call.saved(
                out,
                lambda: command("demo")(**asked, sink=sink, progress=call.progress),
            )


@dataclass(kw_only=True)
class Design(Writes, Chosen):
    """The next experiment on a machine, and how much it should narrow intervals."""

    run_or_project: Annotated[Positional[Path], arg(metavar="RUN|PROJECT")]
    """An identify run; a project file where there is no log yet."""
    seconds: Seconds = 10.0
    """Duration in s."""
    kind: Literal["free", "multisine"] = "free"
    """Family of the commands."""
    about: Annotated[tuple[str, ...], option("NAME...")] = ()
    """Parameters to learn; default all."""
    predict: SomeSeconds = None
    """Learn what predictions so far ahead depend on."""
    within: Percent = 2.0
    """Known within so much is known well enough."""
    limit: Annotated[tuple[str, ...], option("NAME=LOW:HIGH...")] = ()
    """Limits of inputs and states, in addition to the project's."""
    rate: Annotated[tuple[str, ...], option("NAME=RATE...")] = ()
    """Largest change of an input per s, in addition to the project's."""
    start: Annotated[tuple[str, ...], option("NAME=VALUE...")] = ()
    """Where the machine rests before; default zero."""
    period: SomeSeconds = None
    """Of commands and samples in s; default the logs'."""
    starts: Count = 1
    """Random motions that are improved; the best one counts."""
    seed: Seed = 0
    """Draws machines and motions."""

    def run(self, call: Call) -> dict[str, Any]:
        out = run_directory(self.out, f"design-{self.run_or_project.stem}")
        path = self.run_or_project
        if path.suffix == ".toml":
            source = import_module("sim2gp.project").load_project(path)
        else:
            source = identification(path)
        limits = function("experiment_design.verdict", "Limits")
        names = "seconds kind about predict within period starts configuration seed"
        asked = {name: getattr(self, name) for name in names.split()} | {
            "limits": limits(
                pairs("--limit", self.limit), rates=parse_numbers("--rate", self.rate)
            ),
            "start": parse_numbers("--start", self.start),
            "progress": call.progress,
        }
        return call.saved(out, lambda: command("design")(source, **asked))


@dataclass(kw_only=True)
class Apply(Wide):
    """Write identified parameters into the MuJoCo model's own file; shows the diff."""

    path: Annotated[Positional[Path], arg(metavar="RUN")]
    """The folder of identify."""
    out: File = None
    """The new file; without it, and without --in-place, nothing is written."""
    model: File = None
    """Another copy of the model than the one that was fitted."""
    in_place: Flag = False
    """Change the model's file itself."""

    def run(self, call: Call) -> dict[str, Any]:
        if self.out is not None and self.in_place:
            got, fix = "--out and --in-place", "leave one of the two out"
            raise usage_error("output file", got, "one of the two", fix, "E132")
        if self.out is not None:
            check_absent(self.out)
        run = function("commands.apply", "for_model")(self.path, self.model)
        found = command("apply")(
            run,
            configuration=self.configuration,
            posterior=self.posterior,
            progress=call.progress,
        )
        if self.out is not None:
            found = found.save_model(self.out)
        elif self.in_place:
            found = found.replace_model()
        summary: dict[str, Any] = found.summary
        return summary


@dataclass(kw_only=True)
class Export(Writes, Wide):
    """Draws of an identified machine for domain randomisation: arrays, MJCF files."""

    path: Annotated[Positional[Path], arg(metavar="RUN")]
    """The folder of identify."""
    draws: Count = 100
    """Machines to draw."""
    seed: Seed = 0
    """Draws them."""

    def run(self, call: Call) -> dict[str, Any]:
        out = run_directory(self.out, f"export-{self.path.name}")
        return command("export")(
            identification(self.path),
            out,
            draws=self.draws,
            seed=self.seed,
            configuration=self.configuration,
            posterior=self.posterior,
            progress=call.progress,
        )


@dataclass(kw_only=True)
class Report(Common):
    """Draw the report of a run again."""

    path: Annotated[Positional[Path], arg(metavar="RUN")]
    """The folder of an earlier command."""

    def run(self, call: Call) -> dict[str, Any]:
        summary: dict[str, Any] = read_run(self.path).summary
        redraw = import_module("sim2gp.reports").redraw
        call.progress.say(f"report: {redraw(self.path)}")
        return summary


@dataclass(kw_only=True)
class Selftest(Common):
    """Is this installation right? Exactness and calibration in a minute."""

    seed: Seed = 0
    """Draws the problems."""

    def run(self, call: Call) -> dict[str, Any]:
        found = command("selftest")(seed=self.seed, progress=call.progress)
        summary: dict[str, Any] = found.with_entries(command_line=call.line).summary
        return summary


@dataclass(kw_only=True)
class Bench(Common):
    """How fast is it here? Ratios of times to what bounds them, in a few minutes."""

    def run(self, call: Call) -> dict[str, Any]:
        found = command("bench")(progress=call.progress)
        summary: dict[str, Any] = found.with_entries(command_line=call.line).summary
        return summary


@dataclass(kw_only=True)
class Reproduce(Writes, InCells):
    """A figure of the paper: its data, the picture, and the claims checked."""

    figure: Annotated[
        Positional[Literal["fig1", "fig2", "fig3", "fig4", "fig5", "mismatch"]],
        arg(metavar="FIGURE"),
    ]
    """A figure of the paper, or the mismatch map."""
    seed: Seed = 0
    """Draws the data."""
    seeds: SomeCount = None
    """How many seeds (figure 1: arms); default the paper's."""
    episodes: SomeCount = None
    """Episodes of each seed (not figure 1); default the paper's."""
    quick: Flag = False
    """A look: fewer seeds or arms, fewer episodes (fig2: fewer plans, too)."""
    refresh: Flag = False
    """Compute stored cells again that other code or versions computed."""
    keep_old: Flag = False
    """Use them; the summary says how many."""

    def run(self, call: Call) -> dict[str, Any]:
        if self.refresh and self.keep_old:
            where, one = "--refresh with --keep-old", "one of them"
            raise usage_error(where, "both", one, "leave one out")
        old = "refresh" if self.refresh else "keep" if self.keep_old else "refuse"
        out = run_directory(self.out, self.figure)
        study = function("commands.reproduce", "study_of")(
            self.figure,
            seed=self.seed,
            seeds=self.seeds,
            episodes=self.episodes,
            quick=self.quick,
        )
        how = {"workers": executor_of(self), "progress": call.progress, "old": old}
        make = partial(study.run, out, **how)
        place = study.cells_of(out)
        return in_cells(self, call, place, study.cells, lambda _: make(), old)


COMMANDS: dict[str, type[Common]] = {
    "demo": Demo,
    "example": Example,
    "init": Init,
    "identify": Identify,
    "evaluate": Evaluate,
    "explain": Explain,
    "compare": Compare,
    "design": Design,
    "apply": Apply,
    "export": Export,
    "report": Report,
    "selftest": Selftest,
    "bench": Bench,
    "reproduce": Reproduce,
}
