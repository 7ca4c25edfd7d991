"""Does `sim2gp explain` draw forces as they are? Planted curves that no registry has.

    python benchmarks/planted_forces.py [--truths N] [--first K] [--machines M...]
        [--shapes S...] [--workers N] [--out DIR] [--pictures DIR]
        [--refresh | --keep-old]

Hidden machines with parameters drawn from the prior: Furuta pendulum and cart-pole in
one-step transitions (`planted_effects.py`), two-link arms over windows of logs. Each
has one force of `force_shapes.py`, or nothing. A force is found as it is where the true
curve is inside the 95 % band over 90 % of the range that the data have visited (200
values between the 2.5 and the 97.5 % quantile). That is what the band is of
(`band_width`): 95 of 100 draws of the posterior are inside over 90 % of the range.

What curves are compared. Let ``B`` be the curves of one variable that move the machine
as its own parameters or another curve do: a constant (of a joint, that may be a force
by position, by velocity or by the input), damping ``v``, gain ``u``, the gravity of a
pendulum ``sin q``. A force ``f`` and ``f + b``, ``b`` in ``B``, with other parameters,
give the same trajectories: data determine the class ``f + span B`` and no member of it.
With ``P`` the projection onto ``span B`` (least squares at the values of the range),
``f -> f - P f`` maps a class to one curve. So ``(I - P) f`` of the truth is compared
with mean and covariance of ``(I - P) f`` of what was found. A gain ``c`` multiplies all
that arrives of an input ``u + h(u)``, so that the class is ``c (u + h) - u`` there: of
both curves ``c`` is first chosen so that ``u + h`` has the slope one on the whole.
"""

import argparse
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from force_shapes import SHAPES, Planted, ShapedForce, ShapedInput
from interval_arms import NOISE, PERIOD, SECONDS, multisine
from planted_effects import data_of
from sim2gp.data.logs import Log
from sim2gp.data.split_log import cut
from sim2gp.identification.missing_physics.curves import SHARE, Curve, band_width
from sim2gp.identification.missing_physics.data import AbstractData, WindowData
from sim2gp.identification.missing_physics.forces import find_forces
from sim2gp.planning.tasks import MACHINES
from sim2gp.runs import Progress
from sim2gp.runs.cell_work import AbstractCell, Values
from sim2gp.runs.cells import add_options
from sim2gp.runs.executors import cores
from sim2gp.runs.plain import to_json
from sim2gp.studies.study import run_cells
from sim2gp.systems import UniformRodArm, with_parts
from sim2gp.types import in_float64

ROOT = Path(__file__).resolve().parents[1]
NOTHING = "nothing"
ARM = "arm"
POINTS, WINDOW = 200, 0.2
#: Per machine: on which joint (or input) and how large, for each kind of variable.
PLACES: dict[str, dict[str, tuple[str, float]]] = {
    "furuta": {"position": ("theta", 6e-3), "velocity": ("theta", 4e-3)},
    "cartpole": {"position": ("x", 3.0), "velocity": ("x", 1.5)},
    ARM: {"position": ("q1", 0.1), "velocity": ("q1", 0.1)},
}
INPUT = {"furuta": "voltage", "cartpole": "voltage", ARM: "torque1"}
COGGING = {"furuta": ("theta", 5e-3), ARM: ("q2", 0.03)}


def planted_on(
    machine: str, shape: str, seen: Mapping[str, np.ndarray]
) -> Planted | None:
    """What is planted, where the machine is seen to move without it."""
    if shape == NOTHING:
        return None
    of = SHAPES[shape].of
    if of == "input":
        where = INPUT[machine]
        reach = float(np.quantile(np.abs(seen[where]), 0.975))
        return ShapedInput(where, reach, reach, shape)
    if shape == "cogging":
        where, size = COGGING[machine]
        return ShapedForce(where, size, 0.0, 1.0, shape)
    where, size = PLACES[machine][of]
    low, high = np.quantile(seen[where], [0.025, 0.975])
    centre, reach = 0.5 * float(low + high), 0.5 * float(high - low)
    if of == "velocity":
        speeds = np.abs(seen[f"{where}.velocity"])
        centre, reach = 0.0, float(np.quantile(speeds, 0.95))
    return ShapedForce(where, size, centre, reach, shape)


@dataclass(frozen=True)
class Case(AbstractCell):
    """One hidden machine, and the force on it."""

    machine: str
    shape: str
    index: int
    pictures: Path | None = field(default=None, compare=False)

    @property
    def name(self) -> str:
        return f"{self.machine}-{self.shape}-{self.index}"

    @property
    def arguments(self) -> Values:
        return {}

    @property
    def program(self) -> tuple[Hashable, ...]:
        return self.machine, self.shape

    def compute(self, needed: Values | None) -> Values:
        """What was found, and how much of the truth is inside."""
        del needed
        return inside_band(self)


def cases(
    truths: int, first: int, machines: Sequence[str], pictures: Path | None
) -> list[Case]:
    """``truths`` machines with a force, and two fifths as many with nothing."""
    possible = [
        (machine, shape)
        for shape in SHAPES
        for machine in machines
        if shape != "cogging" or machine in COGGING
    ]
    planted = [possible[k % len(possible)] for k in range(truths)]
    sound = [(machines[k % len(machines)], NOTHING) for k in range(truths * 2 // 5)]
    return [Case(*x, first + k, pictures) for k, x in enumerate([*planted, *sound])]


def data_for(
    case: Case,
) -> tuple[AbstractData, dict[str, np.ndarray], Planted | None]:
    """A hidden machine's data, the values that each channel has visited, the force.

    The force is placed where the same machine moves without it, under the same inputs.
    """
    make = _arm_data if case.machine == ARM else _task_data
    data, seen = make(case.machine, None, case.index)
    planted = planted_on(case.machine, case.shape, seen)
    if planted is not None:
        data, seen = make(case.machine, planted, case.index)
    return data, seen, planted


def _task_data(
    machine: str, planted: Planted | None, index: int
) -> tuple[AbstractData, dict[str, np.ndarray]]:
    """Two episodes of a task (`planted_effects.py`)."""
    data = data_of(machine, planted, jax.random.fold_in(jax.random.key(77), index))
    S = np.concatenate([S for S, _ in data.episodes])
    A = np.concatenate([A for _, A in data.episodes])
    return data, _by_channel(data.system, S, A)


def _by_channel(system: Any, S: np.ndarray, A: np.ndarray) -> dict[str, np.ndarray]:
    names = [c.name for c in (*system.physical_states, *system.actions)]
    return dict(zip(names, [*S.T, *A.T], strict=True))


def _arm_data(
    machine: str, planted: Planted | None, index: int
) -> tuple[WindowData, dict[str, np.ndarray]]:
    """An arm's log in windows."""
    del machine  # there is one
    system, (log, S, torque) = UniformRodArm(), _arm_log(planted, index)

    def windows(machine: Any) -> Any:
        return cut([log], machine, window=WINDOW)[0]

    count = len(windows(system))
    second = np.arange(count) // round(1.0 / WINDOW)
    data = WindowData(system, windows, second, np.zeros(count, int))
    return data, _by_channel(system, S, torque)


def arm_log_of(case: Case) -> tuple[Log, Planted]:
    """The recording of an arm, and the force on it."""
    seen = _arm_data(ARM, None, case.index)[1]
    planted = planted_on(ARM, case.shape, seen)
    assert planted is not None
    return _arm_log(planted, case.index)[0], planted


@in_float64
def _arm_log(planted: Planted | None, index: int) -> tuple[Log, np.ndarray, np.ndarray]:
    """An arm under multisines, its encoders at 100 Hz for ten seconds."""
    rng = np.random.default_rng([31, index])
    system = UniformRodArm()
    prior = system.parameters.prior()
    tt = np.asarray(prior.mean + prior.scale @ rng.standard_normal(prior.mean.size))
    torque = multisine(rng, SECONDS)
    true = with_parts(system, [planted]) if planted else system
    values = system.parameters.values(jnp.asarray(tt))
    fixed = {k: jnp.asarray(v, float) for k, v in true.parameters.fixed}
    record = true.record({**fixed, **values})

    def step(x: Any, u: Any) -> tuple[Any, Any]:
        return true.flow(record, x, u, PERIOD), x

    S = np.asarray(jax.jit(lambda u: jax.lax.scan(step, jnp.zeros(4), u)[1])(torque))
    measured = S[:, :2] + NOISE * rng.standard_normal((len(torque), 2))
    joints, inputs = ("q1", "q2"), ("torque1", "torque2")
    log = Log(
        name=f"arm{index}",
        source=f"arm{index}.csv",
        time=PERIOD * np.arange(len(torque)),
        channels=dict(zip(joints, measured.T, strict=True)),
        inputs=dict(zip(inputs, torque.T, strict=True)),
        mask={n: np.ones(len(torque), bool) for n in joints},
    )
    return log, S, torque


def compared(
    curve: Curve, true: np.ndarray, at: np.ndarray, gravity: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Truth, mean and a root of the covariance, without what parameters do as well."""
    columns = [np.ones_like(at)]
    if curve.of != curve.where or curve.of_unit not in ("rad", "m"):
        columns.append(at)  # damping, or a gain
    if gravity:
        columns += [np.sin(at)]
    Q = np.linalg.qr(np.stack(columns, axis=1))[0]

    def rest(f: np.ndarray) -> np.ndarray:
        return np.asarray(f - Q @ (Q.T @ f))

    mean = np.interp(at, curve.at, curve.mean)
    root = np.stack([np.interp(at, curve.at, c) for c in curve.root.T], axis=1)
    if curve.of == curve.where and curve.of_unit not in ("rad", "m"):
        # A gain multiplies all that arrives of an input: the slope on the whole is one.
        by = (at - at.mean()) / ((at - at.mean()) @ at)
        gain, true_gain = by @ (at + mean), by @ (at + true)
        root = (root - np.outer(at + mean, by @ root) / gain) / gain
        mean, true = (at + mean) / gain - at, (at + true) / true_gain - at
    return rest(true), rest(mean), rest(root)


def values_between(seen: np.ndarray) -> Float[np.ndarray, " n"]:
    """Evenly, between the quantiles of what was visited."""
    return np.linspace(*np.quantile(seen, [0.025, 0.975]), POINTS)


def inside_band(case: Case) -> Values:
    """What was found on one hidden machine, and how much of the truth is inside."""
    data, seen, planted = data_for(case)
    found = find_forces(data, data.fit())
    names = [c.name for c in found.found]
    about = {"machine": case.machine, "shape": case.shape, "index": case.index}
    result: Values = {**about, "reported": names}
    result["probability"] = {k: round(p, 4) for k, p in found.each.items()}
    if found.failure:  # a fit did not converge: nothing is said of any force
        return result | {"failure": found.failure, "named": False, "inside": 0.0}
    if planted is None:
        return result
    curve = next(
        c for c in found.curves if (c.where, c.of) == (planted.where, planted.of)
    )
    at = values_between(seen[planted.of])
    true, mean, root = compared(curve, np.asarray(planted.value(at)), at, gravity=False)
    sd = np.linalg.norm(root, axis=1)
    half = band_width(root) * sd
    inside = np.abs(true - mean) <= half
    result |= {
        "true": curve.name,
        "of": curve.of,
        "of_unit": curve.of_unit,
        "unit": curve.unit,
        "named": curve.name in names,
        "inside": float(np.mean(inside)),
        "error": float(np.sqrt(np.mean((true - mean) ** 2))),
        "sd": float(np.sqrt(np.mean(sd**2))),
        "two_sided": float(np.mean(np.abs(true - mean) <= 1.96 * sd)),
        "size": float(np.sqrt(np.mean(true**2))),
    }
    if case.pictures is not None:
        _draw(case.pictures, case, at, true, mean, half, result)
    return result


def _draw(
    folder: Path,
    case: Case,
    at: np.ndarray,
    true: np.ndarray,
    mean: np.ndarray,
    half: np.ndarray,
    result: dict[str, Any],
) -> None:
    import matplotlib.pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    _, axes = plt.subplots(figsize=(5.0, 3.0), layout="tight")
    band = mean - half, mean + half
    axes.fill_between(at, *band, alpha=0.3, lw=0, label="95 % band")
    axes.plot(at, mean, label="found")
    axes.plot(at, true, "k--", label="true")
    axes.set_xlabel(f"{result['of']} ({result['of_unit']})")
    axes.set_ylabel(f"force ({result['unit']})")
    axes.legend(frameon=False)
    plt.savefig(folder / f"{case.name}.png", dpi=120)
    plt.close()


def claims(found: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The two bars, and the counts by shape."""
    planted = [c for c in found if c["shape"] != NOTHING]
    sound = [c for c in found if c["shape"] == NOTHING]
    right = [c["inside"] >= SHARE for c in planted]
    alarms = [bool(c["reported"]) for c in sound]
    by = {
        shape: {
            "of": len(own),
            "inside": sum(c["inside"] >= SHARE for c in own),
            "reported": sum(c["named"] for c in own),
        }
        for shape in SHAPES
        if (own := [c for c in planted if c["shape"] == shape])
    }
    return {
        "inside": {"right": sum(right), "of": len(right), "bar": 0.9},
        "failed": sum("failure" in c for c in found),
        "reported where none is": {"count": sum(alarms), "of": len(alarms), "bar": 2},
        "shapes": by,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--truths", type=int, default=100)
    parser.add_argument("--first", type=int, default=1000)
    parser.add_argument("--machines", nargs="+", default=[*MACHINES, ARM])
    parser.add_argument("--shapes", nargs="+", default=[*SHAPES, NOTHING])
    parser.add_argument("--workers", type=int, default=cores())
    parser.add_argument("--out", type=Path, default=ROOT / "runs" / "planted_forces")
    parser.add_argument("--pictures", type=Path)
    add_options(parser)
    options = parser.parse_args()
    every = cases(options.truths, options.first, options.machines, options.pictures)
    todo = [case for case in every if case.shape in options.shapes]
    values, source = run_cells(
        {"cells": todo},
        options.out,
        workers=options.workers,
        progress=Progress(),
        old=options.old,
    )
    found = [values[case] for case in todo]
    said = claims(found)
    print(to_json(said))
    options.out.mkdir(parents=True, exist_ok=True)
    about = {"truths": options.truths, "first": options.first}
    summary = {**about, **source, "claims": said, "cells": found}
    (options.out / "summary.json").write_text(to_json(summary))


if __name__ == "__main__":
    main()
