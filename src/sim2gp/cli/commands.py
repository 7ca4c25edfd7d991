"""The commands: what each one takes, and which experiment it hands that to.

A command imports its experiment when it runs: help and a mistyped option cost nothing.
"""

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from sim2gp.cli.arguments import numbers, pairs, usage_error
from sim2gp.cli.late import (
    Call,
    FirstFolder,
    budget,
    command,
    function,
    identification,
    read_project,
    read_run,
    run_directory,
)
from sim2gp.cli.options import Chosen, Common, Reads, Wide, Writes
from sim2gp.runs.sinks import opened
from sim2gp.runs.store import check_absent


@dataclass(kw_only=True)
class Demo(Writes):
    """Learn to swing up a pendulum whose constants are unknown, in a few trials."""

    machine: Literal["furuta", "cartpole"] = "furuta"
    """Which pendulum."""
    seed: int = 0
    """Draws the truth, the noise and the plans."""
    seeds: int = 1
    """Run this many seeds, starting at the one given."""
    episodes: int = 3
    """Real episodes of each run, 5 s each."""
    truth: Literal["prior", "2sd", "3sd", "outside"] = "prior"
    """Hidden constants: as believed, each so far off, or beyond its bounds."""
    log_to: Literal["jsonl", "tensorboard", "wandb"] | None = None
    """Write each episode's numbers, as they come, beside the run directory."""

    def run(self, call: Call) -> dict[str, Any]:
        out = run_directory(self.out, "demo")
        about = ("machine", "seed", "seeds", "episodes", "truth")
        asked = {name: getattr(self, name) for name in about}
        with opened(self.log_to, out, asked) as sink:
            return call.saved(
                out,
                lambda: command("demo")(**asked, sink=sink, progress=call.progress),
            )


@dataclass(kw_only=True)
class Init(Common):
    """Draft a project file from a model and logs: columns, signs, units, zeros."""

    model: Annotated[Positional[str], arg(metavar="MODEL")]
    """A bundled machine's name, or an MJCF or URDF file."""
    logs: Annotated[Positional[tuple[Path, ...]], arg(metavar="LOGS...")] = ()
    """Recordings of the machine, alike in their columns; none designs the first one."""
    out: Annotated[Path | None, arg(metavar="FILE")] = None
    """The project file; default MODEL's name, here."""
    root: Annotated[Path | None, arg(metavar="DIR")] = None
    """The folder that holds all files of the model; default the model's own."""
    period: float | None = None
    """Time between rows in s, where no column says it."""
    constant: Annotated[tuple[str, ...], arg(metavar="NAME=VALUE...")] = ()
    """Inputs that the logs have no column of, and the number they were held at."""
    budget: Annotated[float, arg(metavar="SECONDS")] = 60.0
    """What it may take; readings that were not tried by then are named in the file."""
    no_readings: bool = False
    """Take signs, zeros and units as they stand."""
    seed: int = 0
    """Draws the phases of the first experiment."""

    def run(self, call: Call) -> dict[str, Any]:
        out = self.out or Path(Path(self.model).stem + ".toml")
        check_absent(out)
        return command("init")(
            self.model,
            self.logs,
            out=out,
            root=self.root,
            period=self.period,
            constant=numbers("--constant", self.constant),
            readings=not self.no_readings,
            seconds=self.budget,
            seed=self.seed,
            progress=call.progress,
        )


@dataclass(kw_only=True)
class Identify(Reads):
    """Posterior of a machine's constants from its logs."""

    project: Positional[Path]
    """The project file (TOML)."""
    seed: int = 0
    """Draws the starts of the fit."""
    check: bool = False
    """Hold the posterior against the exact one (Pareto k); takes as long again."""
    nuts: bool = False
    """Hold it against draws by NUTS, too (extra mcmc); half an hour and more."""
    longer: bool = False
    """Fit windows five times as long, too: do they tell more?"""
    quick: bool = False
    """No second fit, which forecasts data that it has not seen."""

    def run(self, call: Call) -> dict[str, Any]:
        out = run_directory(self.out, self.project.stem)
        read = read_project(self.project, self)
        first = FirstFolder(out)
        summary = call.saved(
            out,
            lambda: command("identify")(
                *read,
                seed=self.seed,
                check=self.check,
                nuts=self.nuts,
                longer=self.longer,
                held_out=not self.quick,
                first=first,
                progress=call.progress,
            ),
        )
        first.replaced()
        return summary


@dataclass(kw_only=True)
class Evaluate(Reads, Chosen):
    """Prediction of logs that a fit has not seen."""

    run_or_project: Annotated[Positional[Path], arg(metavar="RUN|PROJECT")]
    """An identify run to test; a project file leaves out its logs one by one."""
    logs: Annotated[tuple[Path, ...], arg(metavar="FILE...")] = ()
    """The logs to predict (with a run)."""
    horizon: float = 0.2
    """Open-loop horizon in s."""

    def run(self, call: Call) -> dict[str, Any]:
        path = self.run_or_project
        out = run_directory(self.out, f"evaluate-{path.stem}")
        how = {"horizon": self.horizon, "progress": call.progress}
        if path.suffix == ".toml":
            for option in ("logs", "configuration"):
                if getattr(self, option):
                    fix = f"leave --{option} out, or name a run"
                    expected = "a project file alone: its own logs are left out"
                    raise usage_error("too much", f"--{option}", expected, fix)
            read = read_project(path, self)
            return call.saved(out, lambda: command("evaluate")(*read, **how))
        read_run(path)
        if not self.logs:
            expected, fix = "--logs FILE...", "name the logs to predict"
            raise usage_error("no logs", "no --logs", expected, fix)
        fit = identification(path).within(budget(self.budget))
        tested = fit.read_logs(self.logs, self.configuration, strict=self.strict)
        return call.saved(out, lambda: command("evaluate")(fit, tested, **how))


@dataclass(kw_only=True)
class Explain(Reads):
    """What physics a simulator lacks: nothing, an effect, or none of these."""

    path: Annotated[Positional[Path], arg(metavar="RUN")]
    """The folder of identify or demo."""
    add: bool = False
    """Write the winner into the project file, so that identify fits it."""

    def run(self, call: Call) -> dict[str, Any]:
        out = run_directory(self.out, f"explain-{self.path.name}")
        module = "commands.explain"
        run = function(module, "explainable")(
            self.path, budget(self.budget), strict=self.strict
        )
        file = function(module, "project_file")(run) if self.add else None

        def found() -> Any:
            missing = command("explain")(run, progress=call.progress)
            return missing if file is None else missing.add_to(file)

        return call.saved(out, found)


@dataclass(kw_only=True)
class Compare(Reads):
    """Which model the logs support: simulator, residual, function space, black box."""

    project: Positional[Path]
    """The project file (TOML)."""
    seed: int = 0
    """Draws networks and forecasts."""
    horizon: Annotated[tuple[float, ...], arg(metavar="S...")] = (0.2, 0.5)
    """Open-loop horizons in s."""

    def run(self, call: Call) -> dict[str, Any]:
        out = run_directory(self.out, f"compare-{self.project.stem}")
        read = read_project(self.project, self, alike=True)
        how = {"horizons": self.horizon, "seed": self.seed, "progress": call.progress}
        return call.saved(out, lambda: command("compare")(*read, **how))


@dataclass(kw_only=True)
class Design(Writes, Chosen):
    """The next experiment on a machine, and what it should tell."""

    run_or_project: Annotated[Positional[Path], arg(metavar="RUN|PROJECT")]
    """An identify run; a project file where there is no log yet."""
    seconds: float = 10.0
    """Duration in s."""
    kind: Literal["free", "multisine"] = "free"
    """Family of the commands."""
    about: Annotated[tuple[str, ...], arg(metavar="NAME...")] = ()
    """Constants to learn; default all."""
    predict: Annotated[float | None, arg(metavar="S")] = None
    """Learn what predictions so far ahead depend on."""
    within: Annotated[float, arg(metavar="PERCENT")] = 2.0
    """Known within so much is known well enough."""
    limit: Annotated[tuple[str, ...], arg(metavar="NAME=LOW:HIGH...")] = ()
    """Limits of inputs and states, beside the project's."""
    rate: Annotated[tuple[str, ...], arg(metavar="NAME=RATE...")] = ()
    """Largest change of an input per s, beside the project's."""
    start: Annotated[tuple[str, ...], arg(metavar="NAME=VALUE...")] = ()
    """Where the machine rests before; default zero."""
    period: float | None = None
    """Of commands and samples in s; default the logs'."""
    starts: int = 1
    """Random motions that are improved; the best one counts."""
    seed: int = 0
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
                pairs("--limit", self.limit), rates=numbers("--rate", self.rate)
            ),
            "start": numbers("--start", self.start),
            "progress": call.progress,
        }
        return call.saved(out, lambda: command("design")(source, **asked))


@dataclass(kw_only=True)
class Apply(Wide):
    """Write identified constants into the MuJoCo model's own file; shows the diff."""

    path: Annotated[Positional[Path], arg(metavar="RUN")]
    """The folder of identify."""
    out: Annotated[Path | None, arg(metavar="FILE")] = None
    """The new file; without it, and without --in-place, nothing is written."""
    model: Annotated[Path | None, arg(metavar="FILE")] = None
    """Another copy of the model than the one that was fitted."""
    in_place: bool = False
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
    draws: int = 100
    """Machines to draw."""
    seed: int = 0
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
    """Draw the report of a run anew."""

    path: Annotated[Positional[Path], arg(metavar="RUN")]
    """The folder of an earlier command."""

    def run(self, call: Call) -> dict[str, Any]:
        summary = read_run(self.path).summary
        redraw = import_module("sim2gp.reports").redraw
        call.progress.say(f"report: {redraw(self.path)}")
        return summary


@dataclass(kw_only=True)
class Selftest(Common):
    """Is this installation right? Exactness and calibration in a minute."""

    seed: int = 0
    """Draws the problems."""

    def run(self, call: Call) -> dict[str, Any]:
        found = command("selftest")(seed=self.seed, progress=call.progress)
        summary: dict[str, Any] = found.with_entries(command_line=call.line).summary
        return summary


@dataclass(kw_only=True)
class Reproduce(Writes):
    """A figure of the paper: its data, the picture, and the claims checked."""

    figure: Annotated[
        Positional[Literal["fig1", "fig2", "fig3", "fig4", "fig5", "mismatch"]],
        arg(metavar="FIGURE"),
    ]
    """A figure of the paper, or the mismatch map."""
    seed: int = 0
    """Draws the data."""
    seeds: int | None = None
    """How many seeds (not figure 1); default the paper's."""
    episodes: int | None = None
    """Episodes of each seed (not figure 1); default the paper's."""
    quick: bool = False
    """A look: fewer seeds or arms, fewer episodes (fig2: fewer plans, too)."""
    workers: int | None = None
    """Processes (not figure 1); default one per core."""
    refresh: bool = False
    """Compute stored cells again that other code or versions computed."""
    keep_old: bool = False
    """Use them; the summary says how many."""

    def run(self, call: Call) -> dict[str, Any]:
        if self.refresh and self.keep_old:
            where, one = "--refresh with --keep-old", "one of them"
            raise usage_error(where, "both", one, "leave one out")
        old = "refresh" if self.refresh else "keep" if self.keep_old else "refuse"
        found = command("reproduce")(
            self.figure,
            run_directory(self.out, self.figure),
            seed=self.seed,
            seeds=self.seeds,
            episodes=self.episodes,
            quick=self.quick,
            workers=self.workers,
            old=old,
            progress=call.progress,
        )
        summary: dict[str, Any] = found.summary
        return summary


COMMANDS: dict[str, type[Common]] = {
    "demo": Demo,
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
    "reproduce": Reproduce,
}
