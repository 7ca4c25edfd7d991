"""Physics only: machines as differential equations, with published constants."""

from sim2gp.inference.variants import Configuration
from sim2gp.systems.actuators import Actuated, ActuatedParams, actuator_prior
from sim2gp.systems.base import (
    AbstractMechanism,
    AbstractODE,
    AbstractPlant,
    AbstractSystem,
    Bound,
    Channel,
    delayed_means,
    rk4,
)
from sim2gp.systems.effects.base import (
    AbstractEffect,
    BackEmf,
    Coulomb,
    DeadZone,
    Drag,
    PoleGeometry,
    RailFriction,
    RailTilt,
    RodInertia,
    Spring,
    Stribeck,
)
from sim2gp.systems.effects.library import Candidate, InputLag, library
from sim2gp.systems.effects.perturbed import (
    STRENGTHS,
    InputDelay,
    Perturbed,
    PerturbedParams,
    catalogue,
    effect,
    perturb,
)
from sim2gp.systems.effects.placement import (
    BaseTilt,
    BaseTiltSide,
    EncoderOffset,
    Payload,
)
from sim2gp.systems.lag import Lagged, LaggedParams, lagged_means
from sim2gp.systems.mujoco.sysid import read_sysid, write_sysid
from sim2gp.systems.mujoco.system import MuJoCo
from sim2gp.systems.plants.black_box import BlackBox
from sim2gp.systems.plants.cartpole import CartPole, CartPoleParams
from sim2gp.systems.plants.functions import ODE
from sim2gp.systems.plants.furuta import Furuta, FurutaParams
from sim2gp.systems.plants.two_link import (
    TwoLink,
    TwoLinkParams,
    UniformRodArm,
    UniformRodParams,
)
from sim2gp.systems.sensors import Zeroed
from sim2gp.systems.variants import Configured, alone, configured

__all__ = [
    "ODE",
    "STRENGTHS",
    "AbstractEffect",
    "AbstractMechanism",
    "AbstractODE",
    "AbstractPlant",
    "AbstractSystem",
    "Actuated",
    "ActuatedParams",
    "BackEmf",
    "BaseTilt",
    "BaseTiltSide",
    "BlackBox",
    "Bound",
    "Candidate",
    "CartPole",
    "CartPoleParams",
    "Channel",
    "Configuration",
    "Configured",
    "Coulomb",
    "DeadZone",
    "Drag",
    "EncoderOffset",
    "Furuta",
    "FurutaParams",
    "InputDelay",
    "InputLag",
    "Lagged",
    "LaggedParams",
    "MuJoCo",
    "Payload",
    "Perturbed",
    "PerturbedParams",
    "PoleGeometry",
    "RailFriction",
    "RailTilt",
    "RodInertia",
    "Spring",
    "Stribeck",
    "TwoLink",
    "TwoLinkParams",
    "UniformRodArm",
    "UniformRodParams",
    "Zeroed",
    "actuator_prior",
    "alone",
    "catalogue",
    "configured",
    "delayed_means",
    "effect",
    "lagged_means",
    "library",
    "perturb",
    "read_sysid",
    "rk4",
    "write_sysid",
]
