"""Forces that a machine may lack, as curves with a band over where it has been."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.parameters import Parameters
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.effects.forces import AbstractUnknownFunction
from sim2gp.systems.machine import Machine, plant_of

POINTS = 201
#: A band holds so much of its curve, with this probability.
SHARE, LEVEL = 0.9, 0.95
DRAWS = 2000


@dataclass(frozen=True)
class Curve:
    """What acts on ``where`` as a function of the channel ``of``: mean and sd.

    ``kinds`` are the functions that it is the sum of. ``root`` is a root of the
    covariance of its values.
    """

    where: str
    of: str
    unit: str
    of_unit: str
    kinds: tuple[str, ...]
    at: Float[np.ndarray, " n"]
    mean: Float[np.ndarray, " n"]
    root: Float[np.ndarray, "n k"]

    @cached_property
    def sd(self) -> Float[np.ndarray, " n"]:
        """The sd of each of its values."""
        return np.asarray(np.linalg.norm(self.root, axis=1))

    @cached_property
    def half_band(self) -> Float[np.ndarray, " n"]:
        """Half the width of its 95 % band."""
        return band_width(self.root) * self.sd

    def entry(self) -> dict[str, Any]:
        """What a summary says of it: where, of what, how large where it is clearest."""
        mean, sd = self.largest
        about = {"where": self.where, "of": self.of}
        units = {"unit": self.unit, "of_unit": self.of_unit}
        return about | units | {"mean": mean, "sd": sd}

    @property
    def name(self) -> str:
        """``q1 by q1.velocity``."""
        return f"{self.where} by {self.of}"

    @property
    def largest(self) -> tuple[float, float]:
        """Mean and sd where the mean is largest in sd."""
        k = int(np.argmax(np.abs(self.mean) / np.maximum(self.sd, 1e-300)))
        return float(self.mean[k]), float(self.sd[k])


def curves_of(
    system: AbstractSystem,
    functions: Sequence[AbstractUnknownFunction],
    box: Mapping[str, tuple[float, float]],
    virtual: Gaussian,
) -> tuple[Curve, ...]:
    """Of each joint's position and velocity and of each input, all functions together.

    ``virtual`` are the parameters of ``system``, which has the functions free. Call it
    under `in_float64`.
    """
    plant, table = plant_of(system), system.parameters
    units = {c.name: c.unit for c in (*plant.physical_states, *plant.actions)}
    by: dict[tuple[str, str], list[AbstractUnknownFunction]] = {}
    for f in functions:
        by.setdefault((f.where, f.of), []).append(f)
    found = []
    for (where, of), own in by.items():
        at = np.linspace(*box[of], POINTS)
        features = [_features(f, table, at) for f in own]
        Phi = np.concatenate([each for each, _ in features], axis=1)
        places = np.concatenate([each for _, each in features])
        mean = Phi @ np.asarray(virtual.mean)[places]
        root = Phi @ np.asarray(virtual.scale)[places]
        kinds = tuple(f.what for f in own)
        about = own[0].unit(plant), units[of], kinds
        found.append(Curve(where, of, *about, at, mean, root))
    return tuple(found)


def functions_of(system: AbstractSystem) -> tuple[AbstractUnknownFunction, ...]:
    """The functions of a machine that may be missing."""
    effects = system.effects if isinstance(system, Machine) else ()
    return tuple(e for e in effects if isinstance(e, AbstractUnknownFunction))


def force_arrays(curves: Sequence[Curve]) -> dict[str, np.ndarray]:
    """Of a run: ``forces/NAME``, rows of the variable, the mean, the sd, and half the
    width of the band."""
    return {
        f"forces/{c.name}": np.stack([c.at, c.mean, c.sd, c.half_band]) for c in curves
    }


def band_width(root: Float[np.ndarray, "n k"]) -> float:
    """Half the width in sd of a band that holds `SHARE` of a curve, of `LEVEL`.

    ``root`` is a root of the covariance of the curve's values. With 1.96 sd each value
    is inside in 95 of 100 cases; smooth curves are over 90 % of their range in 78 to 91
    (with lengths of .03 to 1 of the range). By draws.
    """
    sd = np.maximum(np.linalg.norm(root, axis=1), 1e-300)
    normal = np.random.default_rng(0).standard_normal((root.shape[1], DRAWS))
    away = np.abs(root @ normal) / sd[:, None]
    return float(np.quantile(np.quantile(away, SHARE, axis=0), LEVEL))


def _features(
    f: AbstractUnknownFunction, table: Parameters, at: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n k"], np.ndarray]:
    """Values for each weight alone, shapes as they are given; the weights' places."""
    return np.asarray(f.basis.features(at)), table.groups[f.name]
