"""What an experiment would say of forces that the machine may have and its model lacks.

A force that an experiment does not excite is not excluded by it. So the information is
counted once more, of the machine with all forces (`sim2gp.systems.effects.missing`) at
the scale of their priors. If a force is there, and as large as its prior, how strongly
would the experiment say so?
"""

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sim2gp.experiment_design.experiment import Experiment
from sim2gp.experiment_design.limits import LimitBox
from sim2gp.experiment_design.search import DesignResult, scale_after
from sim2gp.experiment_design.signals import AbstractCommandSignal
from sim2gp.identification.missing_physics.curves import curves_of
from sim2gp.identification.missing_physics.reach import box_of_rows
from sim2gp.identification.words import digits, join_names
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.relevance import EARNED
from sim2gp.models.features import Encoding
from sim2gp.systems.assemble import free_parts
from sim2gp.systems.effects.missing import missing_forces
from sim2gp.systems.machine import plant_of
from sim2gp.systems.mechanism import takes_forces
from sim2gp.types import in_float64

#: Of where a channel may be, what it must cover to say anything of a force there.
COVERED = 0.1


@in_float64
def forces_shown(
    experiment: Experiment,
    limits: LimitBox,
    signal: AbstractCommandSignal,
    found: DesignResult,
) -> dict[str, dict[str, Any]]:
    """Of each force, by joint and variable: ``nats`` for it, prior and expected sd.

    ``nats`` is what the evidence for the force is expected to be where it is there: the
    ratio of prior and posterior density at no force. A variable that hardly moves gives
    none. Sd are root mean squares over where the motion goes, in ``unit``. Empty for a
    plant that takes no forces.
    """
    system = experiment.system
    if not takes_forces(plant_of(system)):
        return {}
    where = box_of_rows(system, found.states, found.commands)
    reach = Encoding.of(system, {}).box()
    moves = {k: b - a >= COVERED * np.diff(reach[k])[0] for k, (a, b) in where.items()}
    box = {name: where[name] if moves[name] else reach[name] for name in where}
    forces = missing_forces(system, box)
    wide = free_parts(system, forces, period=experiment.period)
    belief = _with_forces(experiment.belief, wide.parameters.prior())
    asked = replace(experiment, system=wide, belief=belief, corrected=None)
    after = scale_after(asked, limits, signal, found.commands)
    root = np.asarray(asked.belief.scale)
    left = np.linalg.solve(root, after)  # a root of the covariance, in prior sd
    now, then = (
        curves_of(wide, forces, box, Gaussian(belief.mean, jnp.asarray(scale)))
        for scale in (root, after)
    )
    shown = {}
    for before, later in zip(now, then, strict=True):
        names = [f"{before.where}.{kind}" for kind in before.kinds]
        places = np.concatenate([wide.parameters.groups[name] for name in names])
        sd, expected = (float(np.sqrt(np.mean(c.sd**2))) for c in (before, later))
        shown[before.name] = {
            "unit": before.unit,
            "nats": evidence_if_there(left[places]) if moves[before.of] else 0.0,
            "sd": sd,
            "expected_sd": expected if moves[before.of] else sd,
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
        [
            name,
            digits(e["nats"], 2),
            f"{digits(e['sd'], 2)} {e['unit']}",
            digits(e["expected_sd"], 2),
        ]
        for name, e in shown.items()
    ]
    return {
        "title": "Forces that may be missing: would the experiment show them?",
        "columns": ["force", "evidence if there", "prior sd", "sd after"],
        "rows": rows,
        "note": f"Evidence in nats, on average; below {EARNED:g} the experiment does "
        "not exclude the force. Sd are root mean squares over where the motion goes.",
    }


def _with_forces(belief: Gaussian, prior: Gaussian) -> Gaussian:
    """The belief about the machine's own parameters, the prior about its forces."""
    p = belief.mean.size
    mean = prior.mean.at[:p].set(belief.mean)
    return Gaussian(mean, prior.scale.at[:p, :p].set(belief.scale))
