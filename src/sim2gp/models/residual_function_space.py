"""RES-FS: physics plus a residual whose prior is that there is none.

    f(x) = f(x, tt) + c (.) W^T phi(x),        c = 3 sig_sim

The residual is trained by `function_space_loss`, with mean zero and covariance
``Se_sim`` as its target: far from the data it returns to the simulator, with the
simulator's fitted discrepancy as *epistemic* variance. The parameters keep their own
spread, as wide as the data's parts disagree about them (`tempering`): beyond the box
of the comparison physics says how uncertainty grows, which saturated features cannot.
"""

from collections.abc import Mapping
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from sim2gp import checks
from sim2gp.data.transitions import Transitions
from sim2gp.models import features, hybrid
from sim2gp.models import function_space_loss as loss
from sim2gp.models.function_space_loss import OBJECTIVES, Objective
from sim2gp.models.function_space_training import Schedule, learned
from sim2gp.models.hybrid import AbstractHybrid, HybridBelief
from sim2gp.models.residual import SCALE
from sim2gp.models.sim2gp import Sim2GP, Sim2GPBelief
from sim2gp.models.tempering import tempered
from sim2gp.types import Key

#: Measured on the Furuta: a narrower start or a faster rate covers less.
RATE, INITIAL_SCALE, POOL = 2e-3, 0.3, 4096


class ResidualFunctionSpace(AbstractHybrid):
    """Simulator plus residual, which vanishes where there are no data.

    steps, refit_steps: Adam steps of the first fit and of later ones; the last third
    is on all data, after the noise has been fitted to the held-out fifth.
    Other options as in `NLM`.
    """

    #: The parameters' spread is how far whole parts of the data disagree. One row
    #: cannot show that.
    layer_alone: ClassVar[bool] = True

    objective: Objective

    def __init__(
        self,
        sim: Sim2GP,
        *,
        objective: str = "recommended",
        hidden: tuple[int, ...] = (64, 64),
        steps: int = 2000,
        refit_steps: int = 1000,
        reach: Mapping[str, float] | None = None,
    ) -> None:
        checks.one_of("ResidualFunctionSpace", OBJECTIVES, objective=objective)
        super().__init__(sim, hidden, steps, refit_steps, reach)
        self.objective = OBJECTIVES[objective]

    def learn(
        self,
        belief: HybridBelief,
        sim: Sim2GPBelief,
        data: Transitions,
        steps: int,
        key: Key,
    ) -> HybridBelief:
        """The residual, and the parameters as wide as the data's parts disagree."""
        schedule = Schedule.of(0, steps, RATE, INITIAL_SCALE)
        return _fit(belief, sim, data, key, schedule, self.objective)


@eqx.filter_jit
def _fit(
    belief: HybridBelief,
    sim: Sim2GPBelief,
    data: Transitions,
    key: Key,
    schedule: Schedule,
    objective: Objective,
) -> HybridBelief:
    pool, training = jax.random.split(key)
    head, mask = belief.head, data.mask
    X, y = features.encoded(head.encoding, data)
    r, _, J = hybrid.residuals(sim, data, y)
    physics, kappa = tempered(sim, r, J)
    c = SCALE * sim.noise
    S, A = loss.inputs(pool, head.encoding, data, POOL)
    target = loss.targets(
        jax.vmap(head.encoding)(S, A),
        jnp.zeros((len(S), c.size)),
        jnp.zeros((len(S), c.size, 0)),  # the parameters' spread is not the layer's
        sim.noise / c,
        objective.sets,
    )
    rows = X, r, mask
    head, noise = learned(belief, sim, c, rows, target, objective, schedule, training)
    kept = jnp.ones(())
    return HybridBelief(sim, physics, kept, kappa, head, noise, jnp.sum(mask))
