"""Options that several commands share, and the types of all."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import arg

MAX = 2**32 - 1


@dataclass(frozen=True)
class Range:
    """Where a number must lie, and the code of an error for one that does not."""

    low: int | float
    high: int | float
    words: str
    code: str = "E148"

    def holds(self, value: int | float) -> bool:
        """Whether it does; never for NaN."""
        return math.isfinite(value) and self.low <= value <= self.high


def option(metavar: str) -> Any:
    """How the help shows a value; a default of nothing is not shown."""

    def hint(default: str) -> str:
        return "" if default in ("None", "") else f"(default: {default})"

    return arg(metavar=metavar, help_behavior_hint=hint)


_SEEDS = Range(0, MAX, f"a whole number from 0 to {MAX}", "E149")
_COUNTS = Range(1, MAX, f"a whole number from 1 to {MAX}")
_POSITIVE = Range(math.ulp(0.0), math.inf, "a positive number")

_FROM_ZERO = Range(0.0, math.inf, "a number from 0")

Flag = Annotated[bool, arg(help_behavior_hint="")]
Seed = Annotated[int, option("INT"), _SEEDS]
Count = Annotated[int, option("N"), _COUNTS]
SomeCount = Annotated[int | None, option("N"), _COUNTS]
Seconds = Annotated[float, option("S"), _POSITIVE]
SomeSeconds = Annotated[float | None, option("S"), _POSITIVE]
ManySeconds = Annotated[tuple[float, ...], option("S..."), _POSITIVE]
Percent = Annotated[float, option("PERCENT"), _POSITIVE]
Factor = Annotated[float, option("FACTOR"), _POSITIVE]
Cores = Annotated[float, option("CORES"), _POSITIVE]
GPUs = Annotated[float, option("GPUS"), _FROM_ZERO]
Folder = Annotated[Path | None, option("DIR")]
File = Annotated[Path | None, option("FILE")]
Name = Annotated[str | None, option("NAME")]


@dataclass(kw_only=True)
class Common:
    """Options that every command has."""

    json: Flag = False
    """Print the summary alone, as JSON, on stdout."""
    quiet: Flag = False
    """No progress and no notes."""
    verbose: Flag = False
    """Print all numbers of the summary, not only what matters."""
    debug: Flag = False
    """Show the traceback of an error."""
    no_cache: Flag = False
    """Use no programs of earlier commands, and keep none for the next."""


@dataclass(kw_only=True)
class Writes(Common):
    """Options of a command that writes a run directory."""

    out: Folder = None
    """The run directory; default runs/NAME."""


@dataclass(kw_only=True)
class Chosen(Common):
    """The option of a command that needs one configuration of the machine."""

    configuration: Name = None
    """Which one, where groups of logs are of several."""


@dataclass(kw_only=True)
class Wide(Chosen):
    """The option of a command that hands an identified machine on."""

    posterior: Literal["corrected", "plain"] = "corrected"
    """The report's intervals, or Laplace's, which counts the model as right."""


@dataclass(kw_only=True)
class Budgeted(Common):
    """The option of a command that reads recordings."""

    budget: Factor = 1.0
    """Times 2 GiB and 60 s: what a log may unpack to, and how long reading may take."""


@dataclass(kw_only=True)
class Reads(Writes, Budgeted):
    """Options of a command that reads logs."""

    strict: Flag = False
    """Refuse logs with columns that nothing takes."""


@dataclass(kw_only=True)
class Spread(Common):
    """Options of a command that computes in many places."""

    workers: SomeCount = None
    """Processes; default one, for a figure one per core."""
    ray: Annotated[tuple[str, ...] | None, option("[ADDRESS]")] = None
    """Use a Ray cluster (extra ray); without an address one is started here."""
    cell_cores: Cores = 1.0
    """Cores of each cell on a Ray cluster."""
    cell_gpus: GPUs = 0.0
    """GPUs of each cell on a Ray cluster, or a share of one."""


@dataclass(kw_only=True)
class InCells(Spread):
    """Options of a command whose cells are stored and joined."""

    shard: Annotated[str | None, option("I/N")] = None
    """Compute the I-th of N shares of the cells, and nothing else."""
    merge: Annotated[tuple[Path, ...] | None, option("[DIR...]")] = None
    """Compute nothing: join the shares that are stored here and at other runs."""
