"""How a draw becomes actions. Planners know callables, never models."""

from sim2gp.planning.icem import ICEM
from sim2gp.planning.mpc import MPC
from sim2gp.planning.mppi import MPPI
from sim2gp.planning.networks import Policy
from sim2gp.planning.sac import SAC
from sim2gp.planning.signals import Chirp, Multisine, RandomInput
from sim2gp.planning.update import AbstractUpdate, Plan
from sim2gp.planning.world import (
    AbstractObjective,
    AbstractPlanner,
    MarkovObjective,
    Observation,
    Resumed,
    World,
    rollout,
)

__all__ = [
    "ICEM",
    "MPC",
    "MPPI",
    "SAC",
    "AbstractObjective",
    "AbstractPlanner",
    "AbstractUpdate",
    "Chirp",
    "MarkovObjective",
    "Multisine",
    "Observation",
    "Plan",
    "Policy",
    "RandomInput",
    "Resumed",
    "World",
    "rollout",
]
