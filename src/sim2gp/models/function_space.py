"""FS: a network alone, whose prior over functions is the simulator's (eq. 4).

    f(x) = c (.) W^T phi(x),     q(W) trained as in `matching`

Its target is the simulator's Gaussian process: mean ``f(x, tt*)``, covariance
``J Sq J^T + Se_sim``. At the first fit the network is first distilled from it, without
data; how well that succeeds bounds how well it predicts far from the data. Before any
data the belief is the simulator's prior itself.
"""

from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sim2gp import checks
from sim2gp.belief import AbstractBelief, AbstractModel
from sim2gp.data.transitions import Transitions
from sim2gp.errors import NotFinite
from sim2gp.inference.gaussian import Gaussian, lower_factor
from sim2gp.inference.linear_regression import LastLayer
from sim2gp.models import features, hybrid, nlm
from sim2gp.models import function_space_loss as matching
from sim2gp.models.features import Encoding
from sim2gp.models.function_space_loss import OBJECTIVES, Budget, Objective, Variational
from sim2gp.models.hybrid import HybridBelief
from sim2gp.models.sim2gp import Sim2GP, Sim2GPBelief
from sim2gp.types import Action, Key, State, in_float64

FS_PRIORS = ("posterior", "prior")
#: Measured on the Furuta: a faster rate, a narrower start and more inputs than a
#: residual needs halve the error of the distillation.
RATE, INITIAL_SCALE, POOL = 5e-3, 0.1, 16384
SCALE_SEED = 0  # of the inputs that set the outputs' scale, alike in all runs


class FunctionSpace(AbstractModel):
    """A network with the simulator as its prior over functions.

    objective: ``"recommended"``, or ``"literal"`` as the paper prints it: weight 1,
        marginals, the noise learned in the comparison, no distillation.
    fs_prior: compare with the simulator fitted to all data, or with its ``"prior"``.
    pretrain: steps of distillation before the first fit, three times ``steps`` unless
        given (none for ``"literal"``).
    steps, refit_steps: as in `ResidualFunctionSpace`; other options as in `NLM`.

    Raises `InputError` E145 for another word, E148 for a number that cannot be.
    """

    sim: Sim2GP
    encoding: Encoding
    objective: Objective
    hidden: tuple[int, ...] = eqx.field(static=True)
    pretrain: int = eqx.field(static=True)
    steps: int = eqx.field(static=True)
    refit_steps: int = eqx.field(static=True)
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
        checks.whole("FunctionSpace", pretrain=pretrain)
        self.sim = sim
        self.encoding = Encoding.of(sim.system, reach or {})
        self.objective = objective_of(objective)
        self.hidden = tuple(hidden)
        features.check_training(
            "FunctionSpace", self.hidden, steps=steps, refit_steps=refit_steps
        )
        pretrain = 3 * steps if pretrain is None else pretrain
        self.pretrain = 0 if objective == "literal" else pretrain
        self.steps = steps
        self.refit_steps = refit_steps
        self.fs_prior = fs_prior

    @in_float64
    def init(self, key: Key) -> HybridBelief:
        """The simulator's prior; the network adds nothing yet."""
        return hybrid.before_data(self.sim, self.encoding, self.hidden, key)

    @in_float64
    def fit(
        self, belief: AbstractBelief, data: Transitions, *, key: Key
    ) -> HybridBelief:
        """SIM2GP, then the network. Raises what SIM2GP's fit raises, `NotFinite`."""
        assert isinstance(belief, HybridBelief)
        if data.count == 0:
            return belief
        first, second = jax.random.split(key)
        sim = self.sim.fit(belief.sim, data, key=first)
        again = int(belief.count) > 0
        data = jax.tree.map(jnp.asarray, data)
        budget = (
            budget_of(0, self.refit_steps, RATE)
            if again
            else budget_of(self.pretrain, self.steps, RATE)
        )
        target = self.sim.prior if self.fs_prior == "prior" else sim.posterior
        towards = eqx.tree_at(lambda b: b.posterior, sim, target)
        fitted, lost = _fit(belief, sim, towards, data, second, budget, self.objective)
        if int(lost):
            raise NotFinite(
                "E203",
                "the simulator is not finite on its box",
                where="the inputs that a network is matched on",
                got=f"NaN or infinity at {int(lost)} of {POOL}",
                expected="a finite step and Jacobian at each",
                fix="narrow `reach`, or the channels' limits",
            )
        return nlm.checked(fitted, data)

    def update(
        self, belief: AbstractBelief, s: State, a: Action, s2: State
    ) -> HybridBelief:
        """Condition the layer on one transition; call in float64."""
        assert isinstance(belief, HybridBelief)
        return hybrid.conditioned(self.sim, belief, s, a, s2)


@eqx.filter_jit
def _fit(
    belief: HybridBelief,
    sim: Sim2GPBelief,
    towards: Sim2GPBelief,
    data: Transitions,
    key: Key,
    budget: Budget,
    objective: Objective,
) -> tuple[HybridBelief, Int[Array, ""]]:
    """The belief, and how many simulated inputs were not finite."""
    pool, training = jax.random.split(key)
    head, mask = belief.head, data.mask
    X, y = features.encoded(head.encoding, data)
    S, A = matching.inputs(pool, head.encoding, data, POOL)
    every, tt = jnp.ones(len(S), bool), towards.posterior.mean
    f, J = hybrid.physics_rows(towards, tt, S, A, every)
    # Once and for all from the simulator's prior, so that the scales never jump.
    some = matching.inputs(jax.random.key(SCALE_SEED), head.encoding, data, POOL)
    g, _ = hybrid.physics_rows(towards, sim.prior.mean, *some, every)
    finite = jnp.isfinite(jnp.concatenate([f, g], axis=1)).all(axis=1)
    lost = jnp.sum(~(finite & jnp.isfinite(J).all(axis=(1, 2))))
    c = jnp.where(belief.count > 0, head.output_scale, jnp.std(g, axis=0))
    c = jnp.where(c > 0.0, c, sim.noise)
    target = matching.targets(
        jax.vmap(head.encoding)(S, A),
        f / c[None],
        (J @ towards.posterior.scale) / c[None, :, None],
        sim.noise / c,
        objective.sets,
    )
    q, noise = matching.train(
        start(belief, sim, c, INITIAL_SCALE),
        X,
        y / c[None],
        mask,
        target,
        objective,
        budget,
        training,
    )
    head = head_of(belief, q, noise, c)
    replaced, plain = jnp.zeros(()), jnp.ones(())
    count = jnp.sum(mask)
    fitted = HybridBelief(sim, at_map(sim), replaced, plain, head, noise * c, count)
    return fitted, lost


def objective_of(name: str) -> Objective:
    """The named objective (E145)."""
    checks.one_of("matching", OBJECTIVES, objective=name)
    return OBJECTIVES[name]


def budget_of(alone: int, steps: int, rate: float) -> Budget:
    """The last third of ``steps`` is on all data, rounded down to whole blocks."""
    last = steps // 3 // matching.BLOCK * matching.BLOCK
    most = jnp.asarray(steps - last)
    return Budget(jnp.asarray(alone), most, jnp.asarray(last), rate)


def start(
    belief: HybridBelief, sim: Sim2GPBelief, c: Float[Array, " d"], initial: float
) -> Variational:
    """Where training begins: at nothing, or at the last posterior in the new units."""
    head, first = belief.head, belief.count == 0
    ratio = jnp.where(first, 0.0, head.output_scale / c)
    # Updates leave scales that are no longer triangular.
    kept = jax.vmap(lower_factor)(head.layer.scale) * ratio[:, None, None]
    eye = initial * jnp.eye(kept.shape[1])
    factor = jnp.where(first, eye[None], kept)
    noise = jnp.where(first, sim.noise, belief.noise) / c
    mean = head.layer.mean * ratio[:, None]
    return Variational(
        head.trained.network,
        mean.astype(jnp.float32),
        factor.astype(jnp.float32),
        jnp.log(noise),
    )


def head_of(
    belief: HybridBelief,
    q: Variational,
    noise: Float[Array, " d"],
    c: Float[Array, " d"],
) -> nlm.Head:
    """The trained posterior, in float64, as a layer that shares nothing with ``tt``."""
    old = belief.head
    trained = nlm.Trained(q.network, old.trained.log_alpha, jnp.log(noise))
    mean, factor = q.mean.astype(noise.dtype), jnp.tril(q.factor).astype(noise.dtype)
    layer = LastLayer(mean, jnp.zeros_like(old.layer.shared), factor)
    return nlm.Head(trained, layer, c, old.encoding)


def at_map(sim: Sim2GPBelief) -> Gaussian:
    """The constants' MAP without spread: the layer's variance speaks for it."""
    nothing = jnp.zeros_like(sim.posterior.scale)
    return eqx.tree_at(lambda g: g.scale, sim.posterior, nothing)
