"""A machine and logs from Python, as a project file would have them."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tomlkit

from sim2gp.data.logs import Log, RawLog, check_all_used
from sim2gp.errors import error
from sim2gp.project.project import IN_MEMORY, Project
from sim2gp.project.source import parse_project
from sim2gp.project.validate import validate_project, wrong_value
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.machine import as_machine
from sim2gp.systems.variants import index_of, which

Logs = Sequence[Log | RawLog] | Log | RawLog


def project_of_machine(
    machine: AbstractSystem,
    *,
    name: str = "machine",
    likelihood: Mapping[str, Any] | None = None,
    limits: Mapping[str, Any] | None = None,
    rates: Mapping[str, Any] | None = None,
) -> Project:
    """A project without a file; the tables are those of the project file.

    Raises `InputError` E141, E144 and E160 as `load_project` does.
    """
    tables = {"likelihood": likelihood, "limits": limits, "rates": rates}
    stated = {
        table: _python_values(values) for table, values in tables.items() if values
    }
    where = f"{name} (in memory)"
    try:
        text = tomlkit.dumps({"system": IN_MEMORY} | stated)
    except (ValueError, TypeError) as caught:
        got, expected = repr(stated), "numbers, text, lists and tables of them"
        raise wrong_value("E160", where, got, expected, "") from caught
    source = parse_project(text, where)
    spec, path = validate_project(source), Path(f"{name}.toml")
    return Project(path, source, spec, as_machine(machine), own=True)


def project_and_logs(
    machine: Project | AbstractSystem, logs: Logs | None, *, alike: bool = False
) -> tuple[Project, tuple[Log, ...]]:
    """Both as a command needs them: of a project its own logs, where none are given.

    ``alike``: of a machine in one configuration, or E160.
    """
    project = machine if isinstance(machine, Project) else project_of_machine(machine)
    if logs is None:
        return project, project.load_logs(alike=alike)
    if alike:
        project.check_alike()
    return project, as_logs(project, logs)


def as_logs(project: Project, logs: Logs) -> tuple[Log, ...]:
    """Logs as they are, columns read and checked by the project (E101 to E160)."""
    given = (logs,) if isinstance(logs, Log | RawLog) else tuple(logs)
    found: list[Log] = []
    for log in given:
        found += [log] if isinstance(log, Log) else project.read_logs([log])
    if not found:
        raise error("empty_list_of_logs", where="logs", got="an empty list")
    return tuple(found)


def read_logs(
    files: Iterable[Path | str] | Path | str,
    machine: Project,
    configuration: str | None = None,
    *,
    strict: bool = False,
) -> tuple[Log, ...]:
    """Files of a project's machine, read as its own logs are (E101 to E141).

    ``configuration`` names the machine's, where it has several, or a group of logs
    whose columns these files have (E152); ``strict`` refuses columns that nothing takes
    (E105).
    """
    if machine.system.variants:
        index_of(configuration, machine.system.variants)
    elif configuration is not None and configuration not in machine.spec.configurations:
        raise which(configuration, machine.spec.configurations)
    given = [files] if isinstance(files, Path | str) else list(files)
    found = machine.read_logs(given, configuration)
    if strict:
        check_all_used(found)
    return found


def _python_values(value: Any) -> Any:
    """Numbers of NumPy and JAX as Python's, mappings as dictionaries."""
    if isinstance(value, Mapping):
        return {str(key): _python_values(x) for key, x in value.items()}
    if isinstance(value, tuple | list):
        return [_python_values(x) for x in value]
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return np.asarray(value).tolist()
    return value
