"""Physics only: machines as differential equations, with published constants."""

from sim2gp.systems.base import (
    AbstractMechanism,
    AbstractSystem,
    Bound,
    Channel,
    rk4,
)
from sim2gp.systems.cartpole import CartPole, CartPoleParams
from sim2gp.systems.furuta import Furuta, FurutaParams

__all__ = [
    "AbstractMechanism",
    "AbstractSystem",
    "Bound",
    "CartPole",
    "CartPoleParams",
    "Channel",
    "Furuta",
    "FurutaParams",
    "rk4",
]
