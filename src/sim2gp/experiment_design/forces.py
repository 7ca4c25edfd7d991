"""What an experiment would say of forces that the machine may have and its model lacks.

A force that an experiment does not excite is not excluded by it. So the information is
counted once more, of the machine with all forces (`sim2gp.systems.effects.missing`) at
the scale of their priors. If a force is there, and as large as its prior, how strongly
would the experiment say so?
"""

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from sim2gp.experiment_design.experiment import Experiment
from sim2gp.experiment_design.search import DesignResult, scale_after
from sim2gp.identification.missing_physics.curves import curves_of
from sim2gp.identification.missing_physics.reach import box_of_rows
from sim2gp.identification.words import digits, join_names
from sim2gp.inference.relevance import EARNED
from sim2gp.models.features import Encoding
from sim2gp.systems.assemble import free_parts
from sim2gp.systems.effects.missing import missing_forces
from sim2gp.systems.machine import plant_of
from sim2gp.systems.mechanism import takes_forces
from sim2gp.types import in_float64

#: Of where a channel may be, what it must cover to say anything of a force there.
COVERED = 0.1
CERTAIN = 100  # nats


@in_float64
def forces_shown(
    experiment: Experiment, found: DesignResult
) -> dict[str, dict[str, Any]]:
    """Of each force, by joint and variable: ``nats`` for it, and the prior's sd.

    ``nats`` is what the evidence for the force is expected to be where it is there: the
    ratio of prior and posterior density at no force. A variable that hardly moves gives
    none. The sd is a root mean square over where the motion goes, in ``unit``. Empty
    for a plant that takes no forces.
    """
    system = experiment.system
    if not takes_forces(plant_of(system)):
        return {}
    where = box_of_rows(system, found.states[:-1], found.commands)
    reach = Encoding.of(system, {}).box()
    moves = {k: b - a >= COVERED * np.diff(reach[k])[0] for k, (a, b) in where.items()}
    box = {name: where[name] if moves[name] else reach[name] for name in where}
    forces = missing_forces(system, box)
    wide = free_parts(system, forces, period=experiment.period)
    own = experiment.belief
    belief = wide.parameters.prior().with_block(np.arange(own.mean.size), own)
    asked = replace(experiment, system=wide, belief=belief, corrected=None)
    after = np.asarray(scale_after(asked, found.commands))
    root = np.asarray(asked.belief.scale)
    left = np.linalg.solve(root, after)  # a root of the covariance, in prior sd
    shown = {}
    for curve in curves_of(wide, forces, box, belief):
        names = [f"{curve.where}.{kind}" for kind in curve.kinds]
        places = np.concatenate([wide.parameters.groups[name] for name in names])
        shown[curve.name] = {
            "unit": curve.unit,
            "nats": evidence_if_there(left[places]) if moves[curve.of] else 0.0,
            "sd": float(np.sqrt(np.mean(curve.sd**2))),
        }
    return shown


def evidence_if_there(root: Float[np.ndarray, "k p"]) -> float:
    """Expected log ratio of prior and posterior density at zero, of ``x ~ N(0, I)``.

    ``root`` is one of the covariance that data leave of x. With its eigenvalues l and a
    posterior mean of covariance ``I - C``, that is the sum of
    ``(log l + 1 / l - 1) / 2``.
    """
    variances = np.linalg.svd(root, compute_uv=False) ** 2
    return float(0.5 * np.sum(np.log(variances) + 1.0 / variances - 1.0))


def not_excited(shown: dict[str, dict[str, Any]]) -> list[str]:
    """A note on forces that the experiment would not exclude; none without any."""
    names = [name for name, entry in shown.items() if entry["nats"] < EARNED]
    if not names:
        return []
    return [f"it would not exclude a force on {join_names(names)}: too little excited"]


def forces_table(shown: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """The same as a table of the summary."""
    rows = [
        [name, _in_words(e["nats"]), f"{digits(e['sd'], 2)} {e['unit']}"]
        for name, e in shown.items()
    ]
    return {
        "title": "Forces that may be missing: would the experiment show them?",
        "columns": ["force", "evidence, nats", "if it is about"],
        "rows": rows,
        "note": "What the experiment is expected to say for a force of that size (the "
        f"prior's sd). Below {EARNED:g} nats, a factor of 20, it does not exclude it.",
    }


def _in_words(nats: float) -> str:
    """Beyond a hundred nobody doubts any more."""
    return digits(nats, 2) if nats < CERTAIN else f"over {CERTAIN}"
