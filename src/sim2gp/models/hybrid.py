"""Physics plus network: one belief for the three models that have both.

    s' = s + g [f(s, a, tt*) + J (tt - tt*)] + c (.) W^T phi(s, a) + eps

``g`` is 1 where the physics is part of the function and 0 where a network has replaced
it; ``c`` is 0 where the network adds nothing. How ``W`` and ``tt`` are learned is what
tells the models apart; prediction, draws, updates and information gain are the same.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sim2gp.belief import AbstractBelief
from sim2gp.data.transitions import Transitions
from sim2gp.inference import linear_regression as last_layer
from sim2gp.inference import linearized
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.information import Sensitivity
from sim2gp.inference.linear_regression import LastLayer
from sim2gp.models.features import Encoding, Network, stepped
from sim2gp.models.nlm import (
    Head,
    Trained,
    lifted,
    with_noise,
)
from sim2gp.models.sim2gp import Sim2GP, Sim2GPBelief
from sim2gp.systems.base import AbstractSystem
from sim2gp.types import Action, Dynamics, Key, Scalar, State, double, in_float64


class HybridDraw(eqx.Module):
    """Physics, linearised at its MAP along one direction, plus ``W^T phi``.

    Only the branch that is needed is computed, unless draws are themselves batched:
    ``part`` 0 is no physics, 1 physics at ``tt``, 2 with its tangent along ``delta``.
    """

    system: AbstractSystem
    tt: Float[Array, " p"]
    delta: Float[Array, " p"]
    part: Float[Array, ""]
    network: Network
    W: Float[Array, "m d"]
    encoding: Encoding
    dt: float = eqx.field(static=True)

    def __call__(self, s: State, a: Action) -> State:
        d = self.W.shape[1]

        def f(tt: Array) -> Array:
            return self.system.transition(tt, s, a, self.dt)

        def tangent() -> Array:
            mean, slope = jax.jvp(f, (self.tt,), (self.delta,))
            return mean + slope

        branches = [
            lambda: stepped(s, a, jnp.zeros(d, s.dtype)),
            lambda: f(self.tt),
            tangent,
        ]
        base = jax.lax.switch(self.part.astype(jnp.int32), branches)
        phi = self.network(self.encoding(s, a))
        return base.at[:d].add(phi @ self.W.astype(phi.dtype))


class HybridBelief(AbstractBelief):
    """A belief over physical parameters and a last layer, perhaps correlated.

    sim: the simulator's own belief; `parameters` reads it.
    physics: the part of the function that ``tt`` still varies: the posterior, or the
        MAP with no spread where the network's variance has taken it over.
    keep: 1 where the physics is part of the function, 0 where it is replaced.
    kappa: how much wider ``physics`` is kept than its rows make it; 1 unless tempered.
    """

    sim: Sim2GPBelief
    physics: Gaussian
    keep: Scalar
    kappa: Scalar
    head: Head
    noise: Float[Array, " d"]  # sd of one step, state units
    count: Int[Array, ""]

    @in_float64
    def latent(self, s: State, a: Action) -> Gaussian:
        s, a = double(s, a)
        mean, shared, own = self.parts(s, a)
        spread = jnp.sqrt(jnp.sum(own**2, axis=1))
        scale = jnp.concatenate([shared, jnp.diag(spread)], axis=1)
        return lifted(s, a, Gaussian(mean, scale))

    @in_float64
    def predict(self, s: State, a: Action) -> Gaussian:
        return with_noise(self.latent(s, a), self.noise)

    @in_float64
    def sample(self, key: Key) -> Dynamics:
        first, second = jax.random.split(key)
        p, dtype = self.physics.scale.shape[1], self.physics.scale.dtype
        e0 = jax.random.normal(first, (p,), dtype)
        return self._draw(self.physics.scale @ e0, self.head.weights(e0, second))

    @in_float64
    def point(self) -> Dynamics:
        nothing = jnp.zeros_like(self.physics.mean)
        return self._draw(nothing, self.head.mean_weights())

    @in_float64
    def learnable(self) -> "HybridBelief":
        """Where tempered, the constants' spread is that of independent rows again."""
        plain = jnp.where(
            self.kappa > 1.0, self.sim.posterior.scale, self.physics.scale
        )
        return eqx.tree_at(lambda b: b.physics.scale, self, plain)

    def sensitivity(self, s: State, a: Action) -> Sensitivity:
        _, shared, own = self.parts(s, a)
        return shared / self.noise[:, None], own / self.noise[:, None]

    @property
    def coordinates(self) -> tuple[int, int, int]:
        d, m = self.head.layer.mean.shape
        return d, self.physics.scale.shape[1], m

    @in_float64
    def parameters(self) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
        """Virtual mean and sd of the simulator's constants."""
        return self.sim.parameters()

    def parts(
        self, s: State, a: Action
    ) -> tuple[Float[Array, " d"], Float[Array, "d p"], Float[Array, "d features"]]:
        """Mean of the change, and its scale along ``e_0`` and each output's ``e_k``."""
        d = self.noise.size

        def f(tt: Array) -> Array:
            return self.sim.system.transition(tt, s, a, self.sim.dt)[:d] - s[:d]

        change = linearized.latent(f, self.physics)
        mean, shared, own = self.head.moments(s, a)
        return (
            self.keep * change.mean + mean,
            self.keep * change.scale + shared,
            own,
        )

    def _draw(self, delta: Float[Array, " p"], W: Float[Array, "m d"]) -> HybridDraw:
        spread = jnp.any(delta != 0.0)
        tt = self.physics.mean
        if not self.sim.linear:  # the function itself, at the drawn constants
            tt, delta, spread = tt + delta, jnp.zeros_like(delta), jnp.zeros((), bool)
        part = jnp.where(self.keep > 0.0, jnp.where(spread, 2.0, 1.0), 0.0)
        return HybridDraw(
            self.sim.system,
            tt.astype(jnp.float32),
            delta.astype(jnp.float32),
            part.astype(jnp.float32),
            self.head.trained.network,
            W,
            self.head.encoding,
            self.sim.dt,
        )


def before_data(
    sim: Sim2GP, encoding: Encoding, hidden: tuple[int, ...], key: Key
) -> HybridBelief:
    """The simulator's prior, beside a network that adds nothing yet."""
    physics = sim.init(key)
    trained = Trained.random(key, encoding, hidden)
    d, p = encoding.outputs, sim.prior.mean.size
    layer = LastLayer.prior(d, trained.network.features, p, trained.alpha)
    head = Head(trained, layer, jnp.zeros(d), encoding)
    one = jnp.ones(())
    nothing = jnp.zeros((), int)
    return HybridBelief(physics, sim.prior, one, one, head, physics.noise, nothing)


def conditioned(
    model: Sim2GP, belief: HybridBelief, s: State, a: Action, s2: State
) -> HybridBelief:
    """One more transition: the exact Gaussian update of ``(tt, W)``, features kept.

    What ``tt`` and ``W`` then have in common is kept (`LastLayer.shared`), also where
    the fit had left them independent. The simulator's own belief learns by itself.
    """
    d, head = belief.noise.size, belief.head

    def f(tt: Array) -> Array:
        return belief.sim.system.transition(tt, s, a, belief.sim.dt)[:d] - s[:d]

    value, J = linearized.value_and_jacobian(f, belief.physics.mean)
    mean, _, _ = head.moments(s, a)
    residual = (s2 - s)[:d] - belief.keep * value - mean
    phi = head.output_scale[:, None] * head.phi(s, a)[None]
    physics, layer = last_layer.condition(
        belief.physics, head.layer, belief.keep * J, phi, residual, belief.noise
    )
    new = (model.update(belief.sim, s, a, s2), physics, layer, belief.count + 1)
    return eqx.tree_at(lambda b: (b.sim, b.physics, b.head.layer, b.count), belief, new)


def physics_rows(
    belief: Sim2GPBelief,
    tt: Float[Array, " p"],
    S: Float[Array, "N n"],
    A: Float[Array, "N m"],
    mask: Bool[Array, " N"],
) -> tuple[Float[Array, "N d"], Float[Array, "N d p"]]:
    """The simulator's changes and their Jacobians at ``tt``; masked rows are zero."""
    d = belief.noise.size

    def one(s: Array, a: Array, valid: Array) -> tuple[Array, Array]:
        def f(tt: Array) -> Array:
            return belief.system.transition(tt, s, a, belief.dt)[:d] - s[:d]

        value, J = linearized.value_and_jacobian(f, tt)
        return jnp.where(valid, value, 0.0), jnp.where(valid, J, 0.0)

    return jax.vmap(one)(S, A, mask)


def residuals(
    sim: Sim2GPBelief, data: Transitions, y: Float[Array, "N d"]
) -> tuple[Float[Array, "N d"], Float[Array, "N d"], Float[Array, "N d p"]]:
    """What the MAP leaves of ``y``, the variance of its prediction, the Jacobians."""
    tt, mask = sim.posterior.mean, data.mask
    value, J = physics_rows(sim, tt, data.state, data.action, mask)
    variance = jnp.sum((J @ sim.posterior.scale) ** 2, axis=2)
    return jnp.where(mask[:, None], y - value, 0.0), variance, J
