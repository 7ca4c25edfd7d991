"""Options that several commands share."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg


@dataclass(kw_only=True)
class Common:
    """Options that every command has."""

    json: bool = False
    """Print the summary alone, as JSON, on stdout."""
    quiet: bool = False
    """No progress and no notes."""
    debug: bool = False
    """Show the traceback of an error."""


@dataclass(kw_only=True)
class Writes(Common):
    """Options of a command that writes a run directory."""

    out: Annotated[Path | None, arg(metavar="DIR")] = None
    """The run directory; default runs/NAME."""


@dataclass(kw_only=True)
class Chosen(Common):
    """The option of a command that needs the machine as it stands."""

    configuration: Annotated[str | None, arg(metavar="NAME")] = None
    """Which one, where groups of logs are of several."""


@dataclass(kw_only=True)
class Wide(Chosen):
    """The option of a command that hands an identified machine on."""

    posterior: Literal["corrected", "plain"] = "corrected"
    """The report's intervals, or Laplace's, which counts the model as right."""


@dataclass(kw_only=True)
class Budgeted(Common):
    """The option of a command that reads recordings."""

    budget: Annotated[float, arg(metavar="FACTOR")] = 1.0
    """Times 2 GiB and 60 s: what a log may unpack to, and how long reading may take."""


@dataclass(kw_only=True)
class Reads(Writes, Budgeted):
    """Options of a command that reads logs."""

    strict: bool = False
    """Refuse logs with columns that nothing takes."""
