"""Physics only: machines as differential equations, with published parameters."""

from sim2gp.systems.actuators import (
    Delay,
    Gain,
    Lag,
    Offset,
    delayed_means,
    lagged_means,
    neutral_actuators,
)
from sim2gp.systems.assemble import free_parts, one_variant, with_parts, with_variants
from sim2gp.systems.base import (
    AbstractODE,
    AbstractPlant,
    AbstractSystem,
    Bound,
    Channel,
    rk4,
)
from sim2gp.systems.effects.base import AbstractEffect
from sim2gp.systems.effects.friction import (
    Coulomb,
    Drag,
    RailFriction,
    Stribeck,
    Viscous,
)
from sim2gp.systems.effects.geometry import PoleGeometry, RodInertia
from sim2gp.systems.effects.inputs import DeadZone
from sim2gp.systems.effects.loads import BaseTilt, BaseTiltSide, Payload, RailTilt
from sim2gp.systems.effects.registry import Candidate, candidates
from sim2gp.systems.effects.springs import Spring
from sim2gp.systems.effects.strengths import STRENGTHS, catalogue, effect
from sim2gp.systems.machine import Machine, MachineParams, plant_of
from sim2gp.systems.mechanism import AbstractMechanism
from sim2gp.systems.mujoco.sysid import read_sysid, write_sysid
from sim2gp.systems.mujoco.system import MuJoCo
from sim2gp.systems.parts import AbstractPart
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
from sim2gp.systems.sensors import EncoderOffset
from sim2gp.systems.trigonometry import cosine, sine
from sim2gp.systems.variants import Variant

__all__ = [
    "ODE",
    "STRENGTHS",
    "AbstractEffect",
    "AbstractMechanism",
    "AbstractODE",
    "AbstractPart",
    "AbstractPlant",
    "AbstractSystem",
    "BaseTilt",
    "BaseTiltSide",
    "BlackBox",
    "Bound",
    "Candidate",
    "CartPole",
    "CartPoleParams",
    "Channel",
    "Coulomb",
    "DeadZone",
    "Delay",
    "Drag",
    "EncoderOffset",
    "Furuta",
    "FurutaParams",
    "Gain",
    "Lag",
    "Machine",
    "MachineParams",
    "MuJoCo",
    "Offset",
    "Payload",
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
    "Variant",
    "Viscous",
    "candidates",
    "catalogue",
    "cosine",
    "delayed_means",
    "effect",
    "free_parts",
    "lagged_means",
    "neutral_actuators",
    "one_variant",
    "plant_of",
    "read_sysid",
    "rk4",
    "sine",
    "with_parts",
    "with_variants",
    "write_sysid",
]
