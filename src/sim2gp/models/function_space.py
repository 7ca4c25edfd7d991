"""FS: a network alone, whose prior over functions is the simulator's (eq. 4).

    f(x) = c (.) W^T phi(x),     q(W) trained as in `function_space_loss`

Its target is the simulator's Gaussian process: mean ``f(x, tt*)``, covariance
``J Sq J^T + Se_sim``. At the first fit the network is first distilled from it, without
data; how well that succeeds bounds how well it predicts far from the data. Before any
data the belief is the simulator's prior itself.
"""

from collections.abc import Mapping
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from sim2gp import checks
from sim2gp.data.transitions import Transitions
from sim2gp.errors import NotFinite, error
from sim2gp.inference.gaussian import Gaussian
from sim2gp.models import features, hybrid
from sim2gp.models import function_space_loss as loss
from sim2gp.models.function_space_loss import OBJECTIVES, Objective
from sim2gp.models.function_space_training import Schedule, learned
from sim2gp.models.hybrid import AbstractHybrid, HybridBelief
from sim2gp.models.sim2gp import Sim2GP, Sim2GPBelief
from sim2gp.types import Key

FS_PRIORS = ("posterior", "prior")
#: Measured on the Furuta: a faster rate, a narrower start and more inputs than a
#: residual needs halve the error of the distillation.
RATE, INITIAL_SCALE, POOL = 5e-3, 0.1, 16384
SCALE_SEED = 0  # of the inputs that set the outputs' scale, alike in all runs


class FunctionSpace(AbstractHybrid):
    """A network with the simulator as its prior over functions.

    objective: ``"recommended"``, or ``"literal"`` as the paper prints it: weight 1,
        marginals, the noise learned in the comparison, no distillation.
    fs_prior: compare with the simulator fitted to all data, or with its ``"prior"``.
    pretrain: steps of distillation before the first fit, three times ``steps`` unless
        given (none for ``"literal"``).
    steps, refit_steps: as in `ResidualFunctionSpace`; other options as in `NLM`.

    Raises `InputError` E145 for another word, E148 for a number that cannot be.
    """

    layer_alone: ClassVar[bool] = True

    objective: Objective
    pretrain: int = eqx.field(static=True)
    fs_prior: str = eqx.field(static=True)

    def __init__(
        self,
        sim: Sim2GP,
        *,
        objective: str = "recommended",
        fs_prior: str = "posterior",
        hidden: tuple[int, ...] = (128, 128),
        pretrain: int | None = None,
        steps: int = 2000,
        refit_steps: int = 1000,
        reach: Mapping[str, float] | None = None,
    ) -> None:
        checks.one_of("FunctionSpace", FS_PRIORS, fs_prior=fs_prior)
        checks.one_of("FunctionSpace", OBJECTIVES, objective=objective)
        checks.whole("FunctionSpace", pretrain=pretrain)
        super().__init__(sim, hidden, steps, refit_steps, reach)
        self.objective = OBJECTIVES[objective]
        pretrain = 3 * steps if pretrain is None else pretrain
        self.pretrain = 0 if objective == "literal" else pretrain
        self.fs_prior = fs_prior

    def learn(
        self,
        belief: HybridBelief,
        sim: Sim2GPBelief,
        data: Transitions,
        steps: int,
        key: Key,
    ) -> HybridBelief:
        """The network in the simulator's place; E203 where that is not finite."""
        alone = 0 if int(belief.count) else self.pretrain
        schedule = Schedule.of(alone, steps, RATE, INITIAL_SCALE)
        target = self.sim.prior if self.fs_prior == "prior" else sim.posterior
        towards = eqx.tree_at(lambda b: b.posterior, sim, target)
        fitted, lost = _fit(belief, sim, towards, data, key, schedule, self.objective)
        if int(lost):
            where = "the inputs that a network is matched on"
            got = f"NaN or infinity at {int(lost)} of {POOL}"
            raise error("simulator_not_finite_on_box", NotFinite, where=where, got=got)
        return fitted


@eqx.filter_jit
def _fit(
    belief: HybridBelief,
    sim: Sim2GPBelief,
    towards: Sim2GPBelief,
    data: Transitions,
    key: Key,
    schedule: Schedule,
    objective: Objective,
) -> tuple[HybridBelief, Int[Array, ""]]:
    """The belief, and how many simulated inputs were not finite."""
    pool, training = jax.random.split(key)
    head, mask = belief.head, data.mask
    X, y = features.encoded(head.encoding, data)
    S, A = loss.inputs(pool, head.encoding, data, POOL)
    every, tt = jnp.ones(len(S), bool), towards.posterior.mean
    f, J = hybrid.physics_rows(towards, tt, S, A, every)
    # Once and for all from the simulator's prior, so that the scales never jump.
    some = loss.inputs(jax.random.key(SCALE_SEED), head.encoding, data, POOL)
    g, _ = hybrid.physics_rows(towards, sim.prior.mean, *some, every)
    finite = jnp.isfinite(jnp.concatenate([f, g], axis=1)).all(axis=1)
    lost = jnp.sum(~(finite & jnp.isfinite(J).all(axis=(1, 2))))
    c = jnp.where(belief.count > 0, head.output_scale, jnp.std(g, axis=0))
    c = jnp.where(c > 0.0, c, sim.noise)
    target = loss.targets(
        jax.vmap(head.encoding)(S, A),
        f / c[None],
        (J @ towards.posterior.scale) / c[None, :, None],
        sim.noise / c,
        objective.sets,
    )
    rows = X, y, mask
    head, noise = learned(belief, sim, c, rows, target, objective, schedule, training)
    replaced, plain = jnp.zeros(()), jnp.ones(())
    count = jnp.sum(mask)
    return HybridBelief(sim, at_map(sim), replaced, plain, head, noise, count), lost


def at_map(sim: Sim2GPBelief) -> Gaussian:
    """The parameters' MAP without spread: the layer's variance represents it."""
    nothing = jnp.zeros_like(sim.posterior.scale)
    return eqx.tree_at(lambda g: g.scale, sim.posterior, nothing)
