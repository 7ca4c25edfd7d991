"""The mismatch map's settings: registered effects of a machine at three strengths."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

from sim2gp.errors import error, nearest
from sim2gp.systems.actuators import Delay
from sim2gp.systems.effects.friction import Coulomb, Drag, RailFriction
from sim2gp.systems.effects.geometry import PoleGeometry, RodInertia
from sim2gp.systems.effects.inputs import DeadZone
from sim2gp.systems.effects.loads import RailTilt
from sim2gp.systems.effects.springs import Spring
from sim2gp.systems.parts import AbstractPart

STRENGTHS = ("mild", "middle", "strong")

# The mild and strong magnitudes are published or measured (the amplifier's dead zone,
# the rail's friction) where there is such a value; the middle one is near their
# geometric mean. Drag, tilt and the cart's cable have none: these strengths are ours.
# The rod's inertia is there or not, at any strength.
_STRENGTHS: dict[str, dict[str, tuple[AbstractPart, tuple[float, float, float]]]] = {
    "furuta": {
        "coulomb": (Coulomb("theta", 0.0), (1.5e-3, 2.5e-3, 4e-3)),
        "dead_zone": (DeadZone("voltage", 0.0), (0.65, 0.9, 1.2)),
        "spring": (Spring("theta", 0.0), (2e-3, 4.5e-3, 1e-2)),
        "delay": (Delay("voltage", 0.0), (0.010, 0.015, 0.020)),
        "rod_inertia": (RodInertia(), (1.0, 1.0, 1.0)),
        "drag": (Drag("alpha", 0.0), (2e-6, 4.5e-6, 1e-5)),
    },
    "cartpole": {
        "coulomb": (RailFriction(), (0.02, 0.045, 0.1)),
        "dead_zone": (DeadZone("voltage", 0.0), (0.5, 0.7, 1.0)),
        "spring": (Spring("x", 0.0), (2.0, 4.5, 10.0)),
        "delay": (Delay("voltage", 0.0), (0.010, 0.015, 0.020)),
        "geometry": (PoleGeometry(), (0.0095, 0.019, 0.038)),
        "tilt": (
            RailTilt(),
            (math.radians(0.5), math.radians(1.0), math.radians(2.0)),
        ),
        "drag": (Drag("x", 0.0), (0.5, 1.2, 3.0)),
    },
}


def catalogue(machine: str) -> tuple[str, ...]:
    """Names of the effects registered for ``furuta`` or ``cartpole``."""
    return tuple(_known(_STRENGTHS, machine))


def graded(machine: str) -> tuple[str, ...]:
    """Those of the catalogue whose strengths differ: the rows of the mismatch map."""
    known = _known(_STRENGTHS, machine)
    return tuple(name for name, (_, sizes) in known.items() if len(set(sizes)) > 1)


def effect(machine: str, name: str, strength: str) -> AbstractPart:
    """A registered effect at one of `STRENGTHS`; E145 names the nearest known one."""
    made, magnitudes = _known(_known(_STRENGTHS, machine), name)
    strengths = dict(zip(STRENGTHS, magnitudes, strict=True))
    return dataclasses.replace(made, magnitude=_known(strengths, strength))


def _known(table: Mapping[str, Any], name: str) -> Any:
    if name not in table:
        close = nearest(name, table)
        fix = f"did you mean {close}?" if close else ""
        raise error("unknown_in_effects", got=name, fix=fix, known=", ".join(table))
    return table[name]
