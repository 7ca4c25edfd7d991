"""The name of a force: which shape of the registry is inside its band?

A curve is a Gaussian ``f ~ N(m, C)`` on a grid. A shape is ``Phi a``: a column of the
registry's law, and what is no force of its own, a constant and (of a velocity or an
input) the variable itself, which damping and gain do as well. It is fitted by
generalised least squares,

    a = (Phi^T S^-1 Phi)^-1 Phi^T S^-1 m,    S = C + s^2 I,    cov a = W C W^T,

with ``W`` the map from ``m`` to ``a`` and ``s`` a third of the band's rms sd: a basis
has no finer detail. If the shape is the truth, ``chi^2 = r^T S^-1 r`` of the residual
has the mean ``nu = tr(C S^-1)``, its effective degrees of freedom. A shape is the name
if

- chi^2 is below the 99 % point of the chi-square law with ``nu``,
- it is inside the 95 % band over 90 % of the range, and
- its magnitude has a sign that it can have, and is larger than two of its sd.

Of several, the name is the one of highest evidence, ``-chi^2 / 2 - d / 2 log nu`` with
``d`` parameters that shape it.
"""

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from itertools import product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
from jaxtyping import Float

from sim2gp.identification.missing_physics.curves import SHARE, Curve
from sim2gp.identification.words import digits
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.effects.base import AbstractEffect, AbstractJointForce
from sim2gp.systems.effects.inputs import DeadZone
from sim2gp.systems.effects.registry import FORCES, Candidate
from sim2gp.systems.effects.tables import (
    InputTable,
    PositionTable,
    VelocityTable,
)
from sim2gp.systems.machine import plant_of
from sim2gp.types import in_float64

LEVEL = 0.99  # of the chi-square law
RESOLVED = 1.0 / 3.0  # of the band's rms sd
CLEAR = 2.0  # sd of a magnitude
ABOUT = 0.05  # of a range: where a spring still pulls to zero
#: Of a range: velocities over which a friction's sign changes and over which it falls,
#: widths of a dead zone.
WIDTHS = (0.003, 0.01, 0.03, 0.1)
SPEEDS = (0.03, 0.06, 0.12, 0.25)
GAPS = tuple(0.005 * k for k in range(2, 101))


class Name(NamedTuple):
    """A shape of the registry inside the band: ``effect`` of the ``magnitude`` found.

    ``about`` is where a spring has no force, None of the others.
    """

    effect: AbstractEffect
    magnitude: float
    sd: float
    unit: str
    about: float | None
    about_unit: str

    @property
    def text(self) -> str:
        """``stiffness of a cable of 0.0198 ± 0.0006 N m/rad about 0.01 rad``."""
        size = f"{digits(self.magnitude, 3)} ± {digits(self.sd, 2)} {self.unit}"
        text = f"{self.effect.meaning} of {size}"
        if self.about is None:
            return text
        return f"{text} about {digits(self.about, 2)} {self.about_unit}"


@dataclass(frozen=True)
class Fit:
    """A shape fitted to a curve: its column's weight first."""

    effect: AbstractEffect | None
    weights: Float[np.ndarray, " a"]
    sd: float
    chi2: float
    freedom: float
    inside: float
    shaped: int

    @property
    def fits(self) -> bool:
        """Whether it lies within the band."""
        most = float(scipy.stats.chi2.ppf(LEVEL, max(self.freedom, 1.0)))
        return self.chi2 <= most and self.inside >= SHARE

    @property
    def clear(self) -> bool:
        """Whether its magnitude is one that it can have, and not about zero."""
        return bool(self.weights[0] > CLEAR * self.sd)

    @property
    def evidence(self) -> float:
        """Up to a constant, nats."""
        return -0.5 * (self.chi2 + self.shaped * np.log(max(self.freedom, 2.0)))


@in_float64
def name_of(curve: Curve, system: AbstractSystem) -> Name | None:
    """The registry's name of a force; None where no shape of it fits."""
    fits = [f for f in _fits(curve, system) if f.fits and f.clear]
    if not fits:
        return None
    best = max(fits, key=lambda f: f.evidence)
    assert best.effect is not None
    plant, about = plant_of(system), None
    magnitude, sd = float(best.weights[0]), best.sd
    if isinstance(best.effect, DeadZone):
        magnitude, sd = (
            best.effect.magnitude,
            _gap_sd(fits, best, float(np.max(np.abs(curve.at)))),
        )
    elif curve.of == curve.where:
        about = float(best.weights[1] / magnitude)
    unit = best.effect.unit(plant)
    return Name(best.effect, magnitude, sd, unit, about, curve.of_unit)


def addition_of(curve: Curve, name: Name | None) -> Candidate:
    """What to add to a machine: the effect of that name, or the curve as a table.

    A spring of the registry pulls to zero; one about another place is a table.
    """
    reach = float(np.max(np.abs(curve.at)))
    if name is not None and abs(name.about or 0.0) <= ABOUT * reach:
        return Candidate(replace(name.effect, magnitude=abs(name.magnitude)))
    kind: Any = PositionTable if curve.of == curve.where else VelocityTable
    if curve.of_unit not in ("rad", "m") and curve.of == curve.where:
        kind = InputTable
    points = tuple(
        (float(f"{z:.6g}"), float(f"{f:.4g}"))
        for z, f in zip(curve.at, curve.mean, strict=True)
    )
    return Candidate(kind(curve.where, 1.0, points))


def is_nothing(curve: Curve) -> bool:
    """Whether what is no force of its own is inside the band: nothing to be drawn."""
    return _fit(curve, None, None, 0).fits


def _gap_sd(fits: list[Fit], best: Fit, reach: float) -> float:
    """Of a dead zone's width: how far the chi-square spreads, or a step of the grid."""
    each = [(f.effect.magnitude, f.chi2) for f in fits if f.effect is not None]
    widths, chi2 = np.asarray(each).T
    weights = np.exp(0.5 * (best.chi2 - chi2))
    weights = weights / weights.sum()
    spread = np.sqrt(weights @ (widths - weights @ widths) ** 2)
    return float(max(spread, (GAPS[1] - GAPS[0]) * reach))


def _fits(curve: Curve, system: AbstractSystem) -> Iterator[Fit]:
    """Every shape that a curve of this variable may have."""
    for effect, shaped in _shapes(curve, system):
        yield _fit(curve, effect, _law(effect, curve), shaped)


def _shapes(
    curve: Curve, system: AbstractSystem
) -> Iterator[tuple[AbstractEffect, int]]:
    span = float(np.max(np.abs(curve.at)))
    plant = plant_of(system)
    if curve.where in [c.name for c in plant.actions]:
        for share in GAPS:
            width = share * span
            yield DeadZone(curve.where, width, smoothing=0.1 * width), 1
        return
    by_position = curve.of == curve.where
    for kind in FORCES:
        if (kind.powers[0] > 0) != by_position:
            continue
        made: Any = kind
        known = {"width": WIDTHS, "speed": SPEEDS}
        grids = {f.name: known[f.name] for f in fields(made) if f.name in known}
        for shares in product(*grids.values()):  # once, of a law without options
            given = {k: x * span for k, x in zip(grids, shares, strict=True)}
            yield made(curve.where, 1.0, **given), len(grids)


def _law(effect: AbstractEffect, curve: Curve) -> Float[np.ndarray, " n"]:
    """The force at a magnitude of one; of a dead zone, at its width."""
    z, zero = jnp.asarray(curve.at), jnp.zeros(())
    if isinstance(effect, DeadZone):
        width = jnp.asarray(effect.magnitude)
        return np.asarray(jax.vmap(lambda u: effect.through(width, u) - u)(z))
    assert isinstance(effect, AbstractJointForce)
    one = jnp.ones(())
    if effect.powers[0] > 0:
        return np.asarray(jax.vmap(lambda q: effect.along(one, q, zero))(z))
    return np.asarray(jax.vmap(lambda v: effect.along(one, zero, v))(z))


def _fit(
    curve: Curve,
    effect: AbstractEffect | None,
    law: Float[np.ndarray, " n"] | None,
    shaped: int,
) -> Fit:
    """A shape by generalised least squares in the curve's posterior."""
    columns = [] if law is None else [law]
    columns.append(np.ones_like(curve.at))
    if curve.of != curve.where or isinstance(effect, DeadZone):
        columns.append(curve.at)
    Phi, n = np.stack(columns, axis=1), len(curve.at)
    C, sd = curve.root @ curve.root.T, curve.sd
    s2 = (RESOLVED**2) * float(np.mean(sd**2)) + 1e-300
    S = C + s2 * np.eye(n)
    size = np.linalg.norm(Phi, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    L = np.linalg.cholesky(S)
    white = np.linalg.solve(L, np.concatenate([Phi / size, curve.mean[:, None]], 1))
    W = np.linalg.pinv(white[:, :-1], rcond=1e-10)
    weights = W @ white[:, -1]
    map_ = np.linalg.solve(L.T, W.T).T  # from the curve to weights
    spread = np.linalg.norm(map_ @ curve.root, axis=1) / size
    left = curve.mean - (Phi / size) @ weights
    chi2 = float(np.sum((white[:, -1] - white[:, :-1] @ weights) ** 2))
    freedom = float(np.trace(np.linalg.solve(S, C)))
    inside = float(np.mean(np.abs(left) <= curve.half_band))
    about = weights / size, float(spread[0]), chi2, freedom, inside, shaped
    return Fit(effect, *about)
