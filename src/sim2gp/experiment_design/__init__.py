"""The next experiment: commands within limits, chosen by what they should teach."""

from sim2gp.experiment_design.experiment import (
    Experiment,
    information,
    posterior_scale,
    trajectory,
)
from sim2gp.experiment_design.goals import (
    AbstractGoal,
    DOptimal,
    SubsetDOptimal,
    VOptimal,
)
from sim2gp.experiment_design.limits import LimitBox
from sim2gp.experiment_design.search import (
    DesignResult,
    optimise_commands,
    prediction_rows,
)
from sim2gp.experiment_design.signals import (
    AbstractCommandSignal,
    FreeCommands,
    MultisineCommands,
)

__all__ = [
    "AbstractCommandSignal",
    "AbstractGoal",
    "DOptimal",
    "DesignResult",
    "Experiment",
    "FreeCommands",
    "LimitBox",
    "MultisineCommands",
    "SubsetDOptimal",
    "VOptimal",
    "information",
    "optimise_commands",
    "posterior_scale",
    "prediction_rows",
    "trajectory",
]
