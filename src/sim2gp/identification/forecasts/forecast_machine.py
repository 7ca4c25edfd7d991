"""The machine that forecasts are made with: the fitted one, or one with more forces.

A force that the simulator lacks is part of it where it has predicted recordings that
were left out (`sim2gp.identification.missing_physics.held_out_gain`). The windows are
fitted once more with these forces free. Parameters and intervals that are reported are
not these: those allow for all forces (`sim2gp.identification.intervals.discrepancy`).
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from sim2gp.errors import DeadParameters, NotConverged, NotFinite
from sim2gp.identification.fit import fit_windows
from sim2gp.identification.missing_physics.at_zero import (
    AtZero,
    forces_at_zero,
    forces_of,
    kinds_of,
)
from sim2gp.identification.missing_physics.held_out_gain import (
    LeaveOneOut,
    helpful_kinds,
    recordings_or_parts,
)
from sim2gp.identification.missing_physics.reach import Range
from sim2gp.identification.words import digits, join_names
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.prior import ParameterPrior
from sim2gp.systems.assemble import free_parts
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.effects.forces import AbstractUnknownFunction
from sim2gp.systems.machine import as_machine, plant_of
from sim2gp.types import in_float64


@dataclass(frozen=True)
class ForecastMachine:
    """A machine and the posterior of its parameters, and of forces that it has more.

    ``scales`` are those of the kinds of force that it has, of their prior sd, ``box``
    where the machine moved in what was fitted.
    """

    system: AbstractSystem
    posterior: Gaussian
    scales: Mapping[str, float] = field(default_factory=dict)
    box: Mapping[str, Range] = field(default_factory=dict)

    def entries(self) -> dict[str, Any]:
        """What a summary says of its forces; nothing if it has none."""
        if not self.scales:
            return {}
        box = {name: list(ends) for name, ends in self.box.items()}
        return {"forecast_forces": dict(self.scales), "forecast_box": box}

    def arrays(self) -> dict[str, np.ndarray]:
        """Of a run: the posterior, where there are forces; else it is the run's own."""
        if not self.scales:
            return {}
        known = self.posterior
        return {
            "forecast/mean": np.asarray(known.mean),
            "forecast/scale": np.asarray(known.scale),
        }


@in_float64
def stored_forecast_machine(
    system: AbstractSystem, summary: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
) -> ForecastMachine:
    """From what `ForecastMachine.entries` and `ForecastMachine.arrays` made.

    Raises ValueError, in few words, for what they cannot have made.
    """
    scales, box = summary["forecast_forces"], summary.get("forecast_box")
    if not isinstance(scales, Mapping) or not isinstance(box, Mapping):
        raise ValueError("forces without scales or a box")
    plant = plant_of(system)
    channels = {c.name for c in (*plant.physical_states, *plant.actions)}
    if set(box) != channels or any(np.shape(x) != (2,) for x in box.values()):
        raise ValueError("forces of other channels")
    if not all(_finite(x) for x in (*box.values(), *scales.values())):
        raise ValueError("forces that are no numbers")
    ranges = {name: (float(low), float(high)) for name, (low, high) in box.items()}
    known = {f.what for f in forces_of(system, ranges)}
    if any(low >= high for low, high in ranges.values()) or not set(scales) <= known:
        raise ValueError("forces of another machine")
    if min(scales.values(), default=0.0) <= 0.0:
        raise ValueError("forces without a size")
    wider = _with_fixed_scales(free_parts(system, _of_kinds(system, ranges, scales)))
    p = len(wider.parameters)
    found = [arrays.get(f"forecast/{name}") for name in ("mean", "scale")]
    for x, shape in zip(found, ((p,), (p, p)), strict=True):
        if x is None or x.shape != shape or not _finite(x):
            raise ValueError("a posterior of other forces")
    mean, scale = (jnp.asarray(x, float) for x in found)
    return ForecastMachine(wider, Gaussian(mean, scale), dict(scales), ranges)


@in_float64
def fit_forecast_machine(
    fit: AtZero, recording: Int[np.ndarray, " W"], *, robust: bool = False
) -> ForecastMachine:
    """With the forces that predict recordings left out, fitted from ``fit`` on.

    ``recording`` numbers the windows' recordings; windows without measurements are not
    used. Without forces where none helps, or where a fit with them fails.
    """
    system, box = fit.machine, fit.box
    plain = ForecastMachine(system, fit.alone.posterior)
    scales = _helpful(fit, recording)
    if not scales:
        return plain
    kinds = _of_kinds(system, box, scales)
    free, start, _ = forces_at_zero(system, fit.alone, kinds)
    table = free.parameters
    each = np.asarray([scales[name.rsplit(".", 1)[-1]] for name in table.groups])
    prior = ParameterPrior(table.prior(), table, each).as_gaussian()
    wider = _with_fixed_scales(free)
    try:
        found = fit_windows(
            wider,
            fit.likelihood.windows,
            key=jax.random.key(0),  # of starts that it does not draw
            prior=prior,
            robust=robust,
            starts=1,
            warm_start=start,
        )
    except (NotConverged, NotFinite, DeadParameters):
        return plain
    return ForecastMachine(wider, found.posterior, scales, box)


def _with_fixed_scales(system: AbstractSystem) -> AbstractSystem:
    """The machine with forces whose scales no fit changes."""
    machine = as_machine(system)
    return replace(machine, parameters=machine.parameters.without_groups())


def forces_sentence(kinds: Iterable[str]) -> str:
    """Which missing forces forecasts have, after a space; nothing if none."""
    names = [kind.replace("_", " ") for kind in dict.fromkeys(kinds)]
    if not names:
        return ""
    return (
        f" Forecasts have forces that the simulator lacks ({join_names(names)}): "
        "with them fits predict recordings that they have not seen better."
    )


def forces_table(forces: Mapping[str, Mapping[str, float]]) -> dict[str, Any]:
    """The forces of each fold, by the name of what is left out."""
    kinds = list(dict.fromkeys(kind for each in forces.values() for kind in each))
    rows = [
        [name, *(digits(each[k], 2) if k in each else "-" for k in kinds)]
        for name, each in forces.items()
    ]
    return {
        "title": "Forces that forecasts have in addition",
        "columns": ["without", *(kind.replace("_", " ") for kind in kinds)],
        "rows": rows,
        "note": "The scale of their prior sd. A kind of force is chosen where it "
        "lowers the error of recordings that are left out of the others in turn.",
    }


def _helpful(fit: AtZero, recording: Int[np.ndarray, " W"]) -> dict[str, float]:
    """Scales of the kinds that predict recordings left out."""
    if not fit.forces:
        return {}
    whole, own, rows = fit.fitted, fit.own, fit.rows
    if not rows.finite:
        return {}
    data = np.asarray(fit.likelihood.counts).any(axis=1)
    seen = np.logical_or.reduceat(data, rows.first)
    factors, part = rows.factors[seen], recordings_or_parts(recording[rows.first][seen])
    k = factors.shape[-1]
    each = [factors[part == one].reshape(-1, k) for one in np.unique(part)]
    at = np.asarray(whole.z())[own]
    kinds = kinds_of(fit.likelihood.system.parameters.groups)
    return helpful_kinds(LeaveOneOut(each, own, at, kinds))


def _finite(x: Any) -> bool:
    """Whether all are finite numbers."""
    values = np.asarray(x)
    return values.dtype.kind in "fiu" and bool(np.isfinite(values).all())


def _of_kinds(
    system: AbstractSystem, box: Mapping[str, Range], kinds: Iterable[str]
) -> list[AbstractUnknownFunction]:
    """The forces of these kinds."""
    return [f for f in forces_of(system, box) if f.what in set(kinds)]
