"""The next experiment: commands within limits, chosen by what they should tell."""

from sim2gp.experiment_design.experiment import (
    Experiment,
    after,
    information,
    trajectory,
)
from sim2gp.experiment_design.goals import AbstractGoal, Everything, Named, Prediction
from sim2gp.experiment_design.limits import LimitBox
from sim2gp.experiment_design.search import Designed, design, prediction_rows
from sim2gp.experiment_design.signals import AbstractSignal, Free, Multisine

__all__ = [
    "AbstractGoal",
    "AbstractSignal",
    "Designed",
    "Everything",
    "Experiment",
    "Free",
    "LimitBox",
    "Multisine",
    "Named",
    "Prediction",
    "after",
    "design",
    "information",
    "prediction_rows",
    "trajectory",
]
