"""The commands on models and logs: init, identify, evaluate, explain, compare."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from sim2gp.cli.arguments import parse_numbers, parse_words, refuse, usage_error
from sim2gp.cli.late import (
    Call,
    FirstFolder,
    budget,
    command,
    executor_of,
    function,
    identification,
    in_cells,
    read_machines,
    read_project,
    run_directory,
    share_of,
)
from sim2gp.cli.options import (
    Chosen,
    Common,
    File,
    Flag,
    Folder,
    InCells,
    ManySeconds,
    Name,
    Reads,
    Seconds,
    Seed,
    SomeSeconds,
    Spread,
    option,
)
from sim2gp.runs.store import check_absent, read_run


@dataclass(kw_only=True)
class Example(Common):
    """Write a complete small project to begin with: model, logs, project file."""

    folder: Annotated[Positional[Path], arg(metavar="FOLDER")]
    """A new folder."""

    def run(self, call: Call) -> dict[str, Any]:
        check_absent(self.folder)
        path = command("example")(self.folder, progress=call.progress)
        return {"project": str(path)}


@dataclass(kw_only=True)
class Init(Common):
    """Draft a project file from a model and logs: columns, signs, units, zeros."""

    model: Annotated[Positional[str], arg(metavar="MODEL")]
    """A bundled machine's name, or an MJCF or URDF file."""
    logs: Annotated[Positional[tuple[Path, ...]], arg(metavar="LOGS...")] = ()
    """Recordings of the machine, alike in their columns; none designs the first one."""
    out: File = None
    """The project file; default MODEL's name, here."""
    root: Folder = None
    """The folder that holds all files of the model; default the model's own."""
    period: SomeSeconds = None
    """Time between rows in s, where no column says it."""
    constant: Annotated[tuple[str, ...], option("NAME=VALUE...")] = ()
    """Inputs that the logs have no column of, and the number they were held at."""
    column: Annotated[tuple[str, ...], option("NAME=COLUMN...")] = ()
    """Joints and inputs whose columns have other names."""
    budget: Seconds = 60.0
    """What it may take; readings that were not tried by then are named in the file."""
    no_readings: Flag = False
    """Use signs, zeros and units as they are in the logs."""
    seed: Seed = 0
    """Draws the phases of the first experiment."""

    def run(self, call: Call) -> dict[str, Any]:
        check_absent(self.out or Path(f"{Path(self.model).stem}.toml"))
        return command("init")(
            self.model,
            self.logs,
            out=self.out,
            root=self.root,
            period=self.period,
            constant=parse_numbers("--constant", self.constant),
            columns=parse_words("--column", self.column),
            readings=not self.no_readings,
            seconds=self.budget,
            seed=self.seed,
            progress=call.progress,
        )


@dataclass(kw_only=True)
class Identify(Reads, Spread):
    """Posterior of a machine's parameters from its logs, or of many machines'."""

    project: Annotated[Positional[Path], arg(metavar="PROJECT")]
    """The project file (TOML)."""
    seed: Seed = 0
    """Draws the starts of the fit."""
    check: Flag = False
    """Compare the posterior with the exact one (Pareto k); takes as long again."""
    nuts: Flag = False
    """Compare it with draws by NUTS, too (extra mcmc); half an hour and more."""
    quick: Flag = False
    """No second fit, which forecasts data that it has not seen."""
    each: Name = None
    """Machines of a kind, by this named part of the logs' patterns: {NAME}."""

    def run(self, call: Call) -> dict[str, Any]:
        out = run_directory(self.out, self.project.stem)
        if self.each is not None:
            return self._fleet(call, out, self.each)
        refuse(self, ("workers", "ray"), "one machine's logs", "or add --each NAME")
        read = read_project(self.project, self)
        first = FirstFolder(out)
        summary = call.saved(
            out,
            lambda: command("identify")(
                *read,
                seed=self.seed,
                check=self.check,
                nuts=self.nuts,
                held_out=not self.quick,
                first=first,
                progress=call.progress,
            ),
        )
        first.replaced()
        return summary

    def _fleet(self, call: Call, out: Path, each: str) -> dict[str, Any]:
        without = "check", "nuts", "quick"
        refuse(self, without, "--each alone", "or leave --each out")
        read = read_machines(self.project, self, each)
        identify = function("commands.fleet", "identify_fleet")
        how = {"seed": self.seed, "workers": executor_of(self)}
        return call.saved(out, lambda: identify(*read, progress=call.progress, **how))


@dataclass(kw_only=True)
class Evaluate(Reads, Chosen, InCells):
    """Prediction of logs that a fit has not seen."""

    run_or_project: Annotated[Positional[Path], arg(metavar="RUN|PROJECT")]
    """An identify run to test; a project file leaves out its logs one by one."""
    logs: Annotated[tuple[Path, ...], option("FILE...")] = ()
    """The logs to predict (with a run)."""
    horizon: Seconds = 0.2
    """Open-loop horizon in s."""

    def run(self, call: Call) -> dict[str, Any]:
        path = self.run_or_project
        out = run_directory(self.out, f"evaluate-{path.stem}")
        if path.suffix == ".toml":
            expected = "a project file alone: its own logs are left out"
            refuse(self, ("logs", "configuration"), expected, "or name a run")
            share_of(self)
            work = function("commands.leave_one_out", "LeaveOneOut")(
                *read_project(path, self), self.horizon
            )
            return folds(self, call, out, work)
        if not self.logs:
            read_run(path)  # a folder that is no run is the first thing to say
            expected, fix = "--logs FILE...", "name the logs to predict"
            raise usage_error("no logs", "no --logs", expected, fix)
        fit = identification(path).within(budget(self.budget))
        tested = fit.read_logs(self.logs, self.configuration, strict=self.strict)
        how = {"horizon": self.horizon, "progress": call.progress}
        return call.saved(out, lambda: command("evaluate")(fit, tested, **how))


@dataclass(kw_only=True)
class Explain(Reads, Spread):
    """What physics a simulator lacks: nothing, an effect, or none of these."""

    path: Annotated[Positional[Path], arg(metavar="RUN")]
    """The folder of identify or demo."""
    add: Flag = False
    """Write the winner into the project file, so that identify fits it."""

    def run(self, call: Call) -> dict[str, Any]:
        out = run_directory(self.out, f"explain-{self.path.name}")
        module = "commands.explain"
        run = function(module, "load_explainable")(
            self.path, budget(self.budget), strict=self.strict
        )
        file = function(module, "project_file")(run) if self.add else None
        workers = executor_of(self) or 1

        def found() -> Any:
            missing = command("explain")(run, workers=workers, progress=call.progress)
            return missing if file is None else missing.add_to(file)

        return call.saved(out, found)


@dataclass(kw_only=True)
class Compare(Reads, InCells):
    """Which model the logs support: simulator, residual, function space, black box."""

    project: Annotated[Positional[Path], arg(metavar="PROJECT")]
    """The project file (TOML)."""
    seed: Seed = 0
    """Draws networks and forecasts."""
    horizon: ManySeconds = (0.2, 0.5)
    """Open-loop horizons in s."""

    def run(self, call: Call) -> dict[str, Any]:
        out = run_directory(self.out, f"compare-{self.project.stem}")
        share_of(self)
        work = function("commands.compare", "CompareWork")(
            *read_project(self.project, self, alike=True),
            horizons=self.horizon,
            seed=self.seed,
        )
        return folds(self, call, out, work)


def folds(given: InCells, call: Call, out: Path, work: Any) -> dict[str, Any]:
    """The run of some folds, or a share of them."""
    executor = executor_of(given)

    def make(store: Any) -> dict[str, Any]:
        how = executor, call.progress, store
        return call.saved(out, lambda: work.run(*how))

    return in_cells(given, call, out, work.cells, make)
