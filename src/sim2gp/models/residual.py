"""RES: the simulator is the mean, a neural linear model learns what it leaves (eq. 3).

    f(x) = f(x, tt) + c (.) W^T phi(x),        c = 3 sig_sim

Two stages, because a network fitted together with the parameters absorbs physics: first
SIM2GP with its own noise; then features and layer on the residuals, by `nlm.type_two`
with all its safeguards. An output where the network does not predict held-out rows
better than the simulator alone keeps the simulator's answer, to the last digit (under
``joint``, which learns the parameters once more, only where no output has a residual).
"""

from collections.abc import Mapping
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sim2gp import checks
from sim2gp.data.transitions import Transitions
from sim2gp.inference import linear_regression as last_layer
from sim2gp.inference.gaussian import LOG_2PI
from sim2gp.inference.linear_regression import LastLayer
from sim2gp.models import features, hybrid, nlm
from sim2gp.models.hybrid import AbstractHybrid, HybridBelief
from sim2gp.models.sim2gp import Sim2GP, Sim2GPBelief
from sim2gp.models.training import chosen
from sim2gp.types import Key

SCALE = 3.0  # a residual's prior sd, in fitted noises of the simulator
MODES = ("seq_sum", "joint")


class Residual(AbstractHybrid):
    """Simulator plus learned residual.

    mode: ``"seq_sum"`` adds two independent posteriors (slightly conservative: both may
        claim the same residual), ``"joint"`` is the exact posterior of parameters and
        layer together, linearised at the simulator's MAP.
    Other options as in `NLM`. Raises `InputError` E145 for another mode.
    """

    layer_alone: ClassVar[bool] = False

    mode: str = eqx.field(static=True)

    def __init__(
        self,
        sim: Sim2GP,
        *,
        mode: str = "seq_sum",
        hidden: tuple[int, ...] = (128, 128),
        steps: int = 1500,
        refit_steps: int = 500,
        reach: Mapping[str, float] | None = None,
    ) -> None:
        checks.one_of("Residual", MODES, mode=mode)
        super().__init__(sim, hidden, steps, refit_steps, reach)
        self.mode = mode

    def learn(
        self,
        belief: HybridBelief,
        sim: Sim2GPBelief,
        data: Transitions,
        steps: int,
        key: Key,
    ) -> HybridBelief:
        """The network on what the simulator leaves, then both posteriors."""
        return _fit(belief, sim, data, key, jnp.asarray(steps), self.mode)


@eqx.filter_jit
def _fit(
    belief: HybridBelief,
    sim: Sim2GPBelief,
    data: Transitions,
    key: Key,
    steps: Int[Array, ""],
    mode: str,
) -> HybridBelief:
    head, mask = belief.head, data.mask
    X, y = features.encoded(head.encoding, data)
    r, variance, J = hybrid.residuals(sim, data, y)
    c = SCALE * sim.noise
    Y, extra = r / c[None], variance / c[None] ** 2
    best = nlm.type_two(head.trained, X, Y, extra, mask, key, steps)

    # The simulator alone, on the same held-out rows and with its own noise. The
    # network has chosen its noise there: it must be better by what that is worth.
    out = features.held_out_rows(mask)
    count = jnp.sum(out, dtype=y.dtype)
    total = variance + sim.noise[None] ** 2
    each = 0.5 * (jnp.log(total / c[None] ** 2) + r**2 / total + LOG_2PI)
    alone = jnp.sum(jnp.where(out[:, None], each, 0.0), axis=0) / jnp.maximum(count, 1)
    helps = (best.losses + 1.0 / jnp.maximum(count, 1) < alone) & (count > 0)

    noise = jnp.where(helps, best.noise * c, sim.noise)
    c = jnp.where(helps, c, 0.0)
    physics, layer = _posterior(best, sim, X, r, J, mask, noise, c, mode)
    return HybridBelief(
        sim,
        physics,
        jnp.ones(()),
        jnp.ones(()),
        nlm.Head(best.trained, layer, c, head.encoding),
        noise,
        jnp.sum(mask),
    )


def _posterior(
    best: nlm.Selected,
    sim: Sim2GPBelief,
    X: Float[Array, "N e"],
    r: Float[Array, "N d"],
    J: Float[Array, "N d p"],
    mask: Array,
    noise: Float[Array, " d"],
    c: Float[Array, " d"],
    mode: str,
) -> tuple:
    """Parameters and layer given all rows; ``c`` is 0 where there is no residual."""
    Phi, alpha = best.trained.features(X), best.trained.alpha
    d, p = noise.size, sim.prior.mean.size
    prior = LastLayer.prior(d, Phi.shape[1], p, alpha)
    absent = c == 0.0
    if mode == "joint":
        tt = sim.posterior.mean
        offset = eqx.tree_at(lambda g: g.mean, sim.prior, sim.prior.mean - tt)
        delta, layer = last_layer.joint_regression(
            Phi, J, r, mask, noise, alpha, offset, c
        )
        physics = eqx.tree_at(lambda g: g.mean, delta, delta.mean + tt)
        # Nothing left to add: the MAP of the curved problem is the better answer.
        physics = chosen(jnp.all(absent), sim.posterior, physics)
    else:
        scale = jnp.where(absent, 1.0, c)
        R = last_layer.data_factor(Phi, r / scale[None], mask)
        count = jnp.sum(mask, dtype=r.dtype)
        layer, _ = last_layer.regression(R, count, noise / scale, alpha)
        layer = eqx.tree_at(lambda l: l.shared, layer, prior.shared)
        physics = sim.posterior
    # A layer that is not used keeps its prior: updates must find nothing in it.
    keep = [~absent.reshape(-1, *[1] * (x.ndim - 1)) for x in jax.tree.leaves(layer)]
    pairs = zip(keep, jax.tree.leaves(layer), jax.tree.leaves(prior), strict=True)
    leaves = [jnp.where(k, new, old) for k, new, old in pairs]
    return physics, jax.tree.unflatten(jax.tree.structure(layer), leaves)
