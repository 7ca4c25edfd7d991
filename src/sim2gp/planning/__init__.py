"""How a draw becomes actions. Planners know callables, never models."""

from sim2gp.planning.base import (
    AbstractObjective,
    AbstractPlanner,
    MarkovObjective,
    Resumed,
    World,
)
from sim2gp.planning.icem import ICEM
from sim2gp.planning.mpc import MPC
from sim2gp.planning.mppi import MPPI
from sim2gp.planning.signals import Chirp, Multisine, RandomInput
from sim2gp.planning.update import AbstractUpdate, Plan

__all__ = [
    "ICEM",
    "MPC",
    "MPPI",
    "AbstractObjective",
    "AbstractPlanner",
    "AbstractUpdate",
    "Chirp",
    "MarkovObjective",
    "Multisine",
    "Plan",
    "RandomInput",
    "Resumed",
    "World",
]
