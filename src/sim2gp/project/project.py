"""A project file: the machine, what is believed of it, its logs, and what to do.

`load_project` checks everything but the logs themselves; `Project.build_system` and
`Project.load_logs` then cannot meet a misspelt name. Paths are relative to the file.
"""

import glob
import importlib
import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from sim2gp.data.logs import (
    Budget,
    Column,
    Log,
    RawLog,
    Resample,
    check_all_used,
    read_log,
)
from sim2gp.data.logs.file import display_path
from sim2gp.errors import InputError, error, nearest
from sim2gp.project.named_parts import as_glob, named_parts, names_in
from sim2gp.project.schema import (
    ColumnSpec,
    LogSpec,
    ProjectSpec,
    ResampleSpec,
)
from sim2gp.project.source import ProjectSource, read_source
from sim2gp.project.validate import validate_project

if TYPE_CHECKING:
    from sim2gp.systems import AbstractPlant, AbstractSystem

#: Names of a project file -> module and class in sim2gp.systems.
SYSTEMS = {
    "furuta": ("furuta", "Furuta"),
    "cartpole": ("cartpole", "CartPole"),
    "cart_pole": ("cartpole", "CartPole"),
    "two_link": ("two_link", "TwoLink"),
    "uniform_rod_arm": ("two_link", "UniformRodArm"),
}
#: The system's name of a machine that was made in Python.
IN_MEMORY = "in memory"
#: Windows where nothing says how long they are, s.
SHORT = 0.2
MODEL_FILES = (".xml", ".mjcf", ".urdf")
#: What other tools write before a model's file.
_PREFIX = re.compile(r"(?i)^(mujoco|mjcf|mjx|urdf|xml)\s*:\s*")


class LogFile(NamedTuple):
    """A file of logs, and what the named parts of its pattern stand for."""

    path: Path
    parts: Mapping[str, str]


@dataclass(frozen=True)
class Project:
    """A validated project file; ``budget`` is what reading one of its logs may take.

    ``own`` is one whose machine, model or folder was given from Python;
    ``chosen_window`` (s) a length that a fit has chosen, where the file says none.
    """

    path: Path
    source: ProjectSource
    spec: ProjectSpec
    system: "AbstractSystem"
    budget: Budget = field(default_factory=Budget)
    own: bool = False
    chosen_window: float | None = None

    @property
    def window(self) -> float:
        """Length of its windows in s: as stated, as chosen, or short."""
        stated = self.spec.likelihood.window
        return (self.chosen_window or SHORT) if stated is None else stated

    @property
    def chooses_window(self) -> bool:
        """Whether a fit has yet to choose their length."""
        return self.spec.likelihood.window is None and self.chosen_window is None

    def with_window(self, seconds: float) -> "Project":
        """The same with a length that a fit has chosen."""
        return replace(self, chosen_window=seconds)

    @property
    def can_be_loaded(self) -> bool:
        """Whether another process gets the same project from its file."""
        if self.own:
            return False
        try:
            return read_source(self.path).text == self.source.text
        except InputError:
            return False

    @property
    def name(self) -> str:
        """The file's name without its ending; names the default run folder."""
        return self.path.stem

    def build_system(self) -> "AbstractSystem":
        """The machine with the file's options, priors and actuators."""
        return self.system

    def load_logs(
        self, *, strict: bool = False, alike: bool = False
    ) -> tuple[Log, ...]:
        """Every log of every group, cut at gaps; names are unique (E101 to E131).

        ``strict``: every column is taken, or E105. ``alike``: of a machine in one
        configuration, or E160.
        """
        if alike:
            self.check_alike()
        return tuple(log for _, part in self._named_logs(strict) for log in part)

    def load_each(
        self, name: str, *, strict: bool = False
    ) -> dict[str, tuple[Log, ...]]:
        """The logs by what ``{name}`` stands for in the patterns of their files.

        Raises as `load_logs` does, and E160 where a pattern does not say it.
        """
        self.check_alike()
        for group, spec in enumerate(self.spec.logs):
            for i, pattern in enumerate(spec.files):
                if name not in names_in(pattern):
                    where = self.source.where("logs", group, "files", i)
                    asked = f"{{{name}}}"
                    raise error("no_such_part", where=where, got=pattern, part=asked)
        found: dict[str, list[Log]] = {}
        for file, part in self._named_logs(strict):
            found.setdefault(file.parts[name], []).extend(part)
        return {value: tuple(found[value]) for value in sorted(found)}

    def _named_logs(self, strict: bool) -> list[tuple[LogFile, tuple[Log, ...]]]:
        """Each file and its logs, with names that are unique among all."""
        read = list(self._read_files())
        logs = [log for _, part in read for log in part]
        if strict:
            check_all_used(logs)
        named = iter(_uniquely_named(logs))
        return [(file, tuple(islice(named, len(part)))) for file, part in read]

    def _read_files(self) -> Iterator[tuple[LogFile, tuple[Log, ...]]]:
        """Each file and its logs; E130 where there is none, or one twice."""
        seen: dict[str, int] = {}
        for group, spec in enumerate(self.spec.logs):
            for file in self._found(group):
                place = os.path.realpath(file.path)  # of links in a circle, too
                if place in seen:
                    where = self.source.where("logs", group, "files")
                    raise error(
                        "file_listed_twice",
                        where=where,
                        got=display_path(file.path),
                        other=seen[place] + 1,
                    )
                seen[place] = group
                yield file, self._read(file.path, group, spec)
        if not seen:
            where, got = self.source.where("logs"), "no [[logs]] table"
            raise error("no_logs_in_project", where=where, got=got)

    def read_logs(
        self, files: Iterable[Path | str | RawLog], configuration: str | None = None
    ) -> tuple[Log, ...]:
        """Other files or columns, each read like the first group whose columns it has.

        Of the groups of one ``configuration``, where it is named. Without any group
        columns are named as the machine's channels are.
        """
        logs: list[Log] = []
        groups = [
            (group, spec)
            for group, spec in enumerate(self.spec.logs)
            if configuration in (None, self.spec.configuration(group))
        ]
        for file in files:
            path, first = (file if isinstance(file, RawLog) else Path(file)), None
            if not self.spec.logs and isinstance(path, RawLog):
                logs += self._read(path, 0, self._by_channel(path))
                continue
            for group, spec in groups:
                try:
                    logs += self._read(path, group, spec)
                    break
                except InputError as caught:
                    first = first or caught
                    if caught.code != "E103":
                        raise
            else:
                raise first or _no_group(self.source)
        return tuple(_uniquely_named(logs))

    def _configuration(self, group: int) -> int:
        """The number of the configuration that a group recorded."""
        spec = self.spec
        if not spec.logs:
            return 0
        return spec.configurations.index(spec.configuration(group))

    def _by_channel(self, log: RawLog) -> LogSpec:
        """Of columns that are named as the machine's channels and inputs."""
        channels = (*self.system.physical_states, *self.system.actions)
        names = [c.name for c in channels if c.name in log.columns]
        return LogSpec(files=[log.name], columns={name: name for name in names})

    def check_alike(self) -> None:
        """The machine of all groups is in one configuration, or E160."""
        for group, spec in enumerate(self.spec.logs):
            if spec.fixed or spec.free:
                where = self.source.where("logs", group)
                got = ", ".join(self.spec.configurations)
                raise error("several_configurations", where=where, got=got)

    def files(self, group: int) -> list[Path]:
        """The files of a group, in the order of their names (E130 if there is none)."""
        return [file.path for file in self._found(group)]

    def _found(self, group: int) -> list[LogFile]:
        """They and the named parts of their paths."""
        found: dict[Path, LogFile] = {}
        folder = str(self.path.parent)
        for i, pattern in enumerate(self.spec.logs[group].files):
            where = self.source.where("logs", group, "files", i)
            if "\x00" in pattern:
                raise error("nul_in_pattern", where=where, got=repr(pattern))
            anchored = os.path.join(folder, as_glob(pattern))
            if not glob.has_magic(as_glob(pattern)):
                found.setdefault(Path(anchored), LogFile(Path(anchored), {}))
                continue
            matches = sorted(glob.glob(anchored, recursive=True))
            if not matches:
                got, place = repr(pattern), display_path(self.path.parent)
                raise error("no_file_matches", where=where, got=got, folder=place)
            for match in matches:
                parts = named_parts(pattern, match, folder)
                found.setdefault(Path(match), LogFile(Path(match), parts))
        return list(found.values())

    def _read(self, path: Path | RawLog, group: int, spec: LogSpec) -> tuple[Log, ...]:
        return read_log(
            path,
            {name: _column_of(value) for name, value in spec.columns.items()},
            states=self.system.physical_states,
            actions=self.system.actions,
            time=None if spec.time is None else _clock_column(spec.time),
            period=spec.period,
            episode=spec.episode,
            resample=_resample(spec.resample),
            exclude=[(a, b) for a, b in spec.exclude],
            drop_nonfinite=spec.drop_nonfinite,
            keep_first=spec.keep_first,
            limits={name: (a, b) for name, (a, b) in self.spec.limits.items()},
            fixed=spec.fixed,
            group=self._configuration(group),
            longest_delay=self.system.longest_delay,
            budget=self.budget,
        )


def load_project(
    path: Path | str,
    folder: Path | None = None,
    model: Path | None = None,
    *,
    system: "AbstractSystem | None" = None,
) -> Project:
    """Read and check a project file; logs are not opened yet (E120 to E162).

    A model's file is named relative to ``folder``, the project's own if None; ``model``
    is another file. ``system`` is one of your own: the file's ``system`` is then any
    name for it, and priors, effects and actuators of the file are for yours.
    """
    path = Path(path)
    source, spec = read_spec(path, own=system is not None)
    # Imported late: a misspelt key is reported before the simulators are loaded.
    from sim2gp.project.build import build_own, build_system, check_known_names
    from sim2gp.project.configure import with_configurations, with_linear_measurements
    from sim2gp.systems.machine import as_machine

    if system is not None and spec.system == IN_MEMORY:
        return Project(path, source, spec, as_machine(system), own=True)
    moved = folder is not None and folder.resolve() != path.parent.resolve()
    own = system is not None or model is not None or moved
    if system is not None:
        system = build_own(spec, source, system)
    elif is_model(spec.system):
        from sim2gp.project.model import build_model

        folder = path.parent if folder is None else folder
        system = build_model(spec, source, folder, model)
    else:
        system = build_system(spec, source, system_class(spec.system))
    check_known_names(spec, source, system)
    system = with_linear_measurements(
        spec, source, with_configurations(spec, source, system)
    )
    return Project(path, source, spec, system, own=own)


def read_spec(
    path: Path | str, *, own: bool = False
) -> tuple[ProjectSource, ProjectSpec]:
    """The file's text and its validated values, without loading any simulator.

    The system of the file must be known, but for a user's ``own``.
    """
    source = read_source(Path(path))
    spec = validate_project(source)
    if not (own or spec.system in SYSTEMS or is_model(spec.system)):
        raise unknown_system(spec.system, source.where("system"))
    return source, spec


def is_model(name: str) -> bool:
    """Whether a system is a file of MuJoCo's, MJCF or URDF."""
    return name.lower().endswith(MODEL_FILES) and _PREFIX.match(name) is None


def unknown_system(name: str, where: str) -> InputError:
    """E160 for a system that is neither a bundled machine nor a model's file."""
    close = nearest(name, SYSTEMS)
    file = _PREFIX.sub("", name)
    if name == IN_MEMORY:
        fix = "give the machine: load_run(folder, machine=...)"
    elif file.lower().endswith(MODEL_FILES):
        fix = f"write the file's name, {json.dumps(file)}"
    elif _PREFIX.match(f"{name}:"):
        fix = 'write the file\'s name, as in "robot.xml"'
    else:
        fix = f"did you mean {close}" if close else "name one of these"
    known = ", ".join(SYSTEMS)
    return error("unknown_system", where=where, got=repr(name), known=known, fix=fix)


def system_class(name: str) -> "type[AbstractPlant]":
    """The class behind a name of `SYSTEMS`."""
    module, kind = SYSTEMS[name]
    found: type[AbstractPlant] = getattr(
        importlib.import_module(f"sim2gp.systems.plants.{module}"), kind
    )
    return found


def _column_of(value: str | float | ColumnSpec) -> Column | float:
    if isinstance(value, str):
        return Column(value)
    if not isinstance(value, ColumnSpec):
        return float(value)
    low_high = value.saturation
    return Column(
        value.column,
        value.unit,
        value.sign,
        value.scale,
        value.offset,
        None if low_high is None else (low_high[0], low_high[1]),
    )


def _clock_column(value: str | ColumnSpec) -> Column | str:
    found = _column_of(value)
    return found if isinstance(found, Column) else str(found)


def _resample(spec: ResampleSpec | None) -> Resample | None:
    if spec is None:
        return None
    return Resample(spec.method, spec.period, spec.stamps)


def _no_group(source: ProjectSource) -> InputError:
    where = source.where("logs")
    return error("no_group_of_logs", where=where, got="no [[logs]] table")


def _uniquely_named(logs: Sequence[Log]) -> list[Log]:
    """Files of one name in several folders get their folder's name in front."""
    folders: dict[str, set[str]] = {}
    for log in logs:
        folders.setdefault(log.name, set()).add(log.source)
    return [
        log
        if len(folders[log.name]) == 1
        else replace(log, name=f"{Path(log.source).parent.name}/{log.name}")
        for log in logs
    ]
