"""A run directory read back as the object that a command returned."""

from pathlib import Path

from sim2gp.commands.bench import Bench
from sim2gp.commands.compare import Comparison
from sim2gp.commands.demo import Demonstration
from sim2gp.commands.design import FILE, NextExperiment
from sim2gp.commands.evaluation import Evaluation
from sim2gp.commands.explain import MissingPhysics
from sim2gp.commands.fleet import IdentifiedFleet
from sim2gp.commands.identification import Identification, restore_identification
from sim2gp.commands.result import AbstractResult
from sim2gp.commands.selftest import SelfTest
from sim2gp.runs import store
from sim2gp.systems.base import AbstractSystem


class StudyRun(AbstractResult):
    """A figure of the paper, or another run without an object of its own."""


KINDS: dict[str, type[AbstractResult]] = {
    "bench": Bench,
    "compare": Comparison,
    "demo": Demonstration,
    "design": NextExperiment,
    "evaluate": Evaluation,
    "identify each": IdentifiedFleet,
    "identify": Identification,  # a first answer, without a posterior
    "explain": MissingPhysics,
    "selftest": SelfTest,
}


def load_run(
    folder: Path | str, machine: AbstractSystem | None = None
) -> AbstractResult:
    """What a command saved: an `Identification` of identify, and so on.

    ``machine`` is the one that was given from Python, where no project file names it.
    Raises `InputError` E130, E183 or E185 for a folder that is not a whole run, E170 or
    E184 where an identification's project or model has changed since.
    """
    folder = Path(folder)
    stored = store.load_run(folder)
    command = str(stored.summary.get("command"))
    if command == "identify" and not stored.summary.get("first_answer"):
        return restore_identification(folder, machine)
    kind = KINDS.get(command, StudyRun)
    files = {}
    if kind is NextExperiment:
        files[FILE] = store.read_text(folder, FILE)
    return kind(stored.summary, stored.arrays, files, None, folder)
