"""Physics only: machines as differential equations, with published constants."""

from sim2gp.systems.actuator import Actuated, ActuatedParams, actuator_prior
from sim2gp.systems.base import (
    AbstractMechanism,
    AbstractSystem,
    Bound,
    Channel,
    delayed_means,
    rk4,
)
from sim2gp.systems.cartpole import CartPole, CartPoleParams
from sim2gp.systems.effects import (
    AbstractEffect,
    Coulomb,
    DeadZone,
    Drag,
    PoleGeometry,
    RailFriction,
    RailTilt,
    RodInertia,
    Spring,
)
from sim2gp.systems.furuta import Furuta, FurutaParams
from sim2gp.systems.perturbed import (
    STRENGTHS,
    InputDelay,
    Perturbed,
    PerturbedParams,
    catalogue,
    effect,
    perturb,
)
from sim2gp.systems.two_link import (
    TwoLink,
    TwoLinkParams,
    UniformRodArm,
    UniformRodParams,
)

__all__ = [
    "STRENGTHS",
    "AbstractEffect",
    "AbstractMechanism",
    "AbstractSystem",
    "Actuated",
    "ActuatedParams",
    "Bound",
    "CartPole",
    "CartPoleParams",
    "Channel",
    "Coulomb",
    "DeadZone",
    "Drag",
    "Furuta",
    "FurutaParams",
    "InputDelay",
    "Perturbed",
    "PerturbedParams",
    "PoleGeometry",
    "RailFriction",
    "RailTilt",
    "RodInertia",
    "Spring",
    "TwoLink",
    "TwoLinkParams",
    "UniformRodArm",
    "UniformRodParams",
    "actuator_prior",
    "catalogue",
    "delayed_means",
    "effect",
    "perturb",
    "rk4",
]
