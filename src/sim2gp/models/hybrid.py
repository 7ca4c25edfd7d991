"""Physics plus network: one belief for the three models that have both.

    s' = s + g [f(s, a, tt*) + J (tt - tt*)] + c (.) W^T phi(s, a) + eps

``g`` is 1 where the physics is part of the function and 0 where a network has replaced
it; ``c`` is 0 where the network adds nothing. The recipes differ in how ``W`` and
``tt`` are learned (`AbstractHybrid.learn`); prediction, draws, updates and information
gain are the same.
"""

from abc import abstractmethod
from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
from equinox import AbstractClassVar
from jaxtyping import Array, Bool, Float, Int

from sim2gp.belief import AbstractBelief, AbstractModel
from sim2gp.data.transitions import Transitions
from sim2gp.inference import linear_regression as last_layer
from sim2gp.inference import linearized
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.information import Sensitivity
from sim2gp.inference.linear_regression import LastLayer
from sim2gp.models import draws
from sim2gp.models.features import Encoding, Network, check_training, stepped
from sim2gp.models.nlm import Head, Trained, checked, lifted, with_noise
from sim2gp.models.sim2gp import Sim2GP, Sim2GPBelief
from sim2gp.models.training import chosen
from sim2gp.types import Action, Dynamics, Key, Scalar, State, double, in_float64


class HybridDraw(eqx.Module):
    """A function of the simulator plus ``W^T phi``.

    ``keep`` is 0 where the network has replaced the physics, which is not computed
    then.
    """

    physics: Dynamics
    keep: Float[Array, ""]
    network: Network
    W: Float[Array, "m d"]
    encoding: Encoding

    def __call__(self, s: State, a: Action) -> State:
        d = self.W.shape[1]
        base = jax.lax.cond(
            self.keep > 0.0,
            lambda: self.physics(s, a),
            lambda: stepped(s, a, jnp.zeros(d, s.dtype)),
        )
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
        delta = self.physics.scale @ e0
        physics = draws.linearized(
            self.sim.system, self.physics.mean, delta, self.sim.dt
        )
        return self._function(physics, self.head.weights(e0, second))

    @in_float64
    def point(self) -> Dynamics:
        physics = draws.physics_at(self.sim.system, self.physics.mean, self.sim.dt)
        return self._function(physics, self.head.mean_weights())

    @in_float64
    def untempered(self) -> "HybridBelief":
        """Where tempered, the parameters' spread is that of independent rows again."""
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
        """Virtual mean and sd of the simulator's parameters."""
        return self.sim.parameters()

    def parts(
        self, s: State, a: Action
    ) -> tuple[Float[Array, " d"], Float[Array, "d p"], Float[Array, "d features"]]:
        """Mean of the change, and its scale along ``e_0`` and each output's ``e_k``."""
        change = linearized.latent(lambda tt: _change(self.sim, tt, s, a), self.physics)
        mean, shared, own = self.head.moments(s, a)
        return (
            self.keep * change.mean + mean,
            self.keep * change.scale + shared,
            own,
        )

    def _function(self, physics: Dynamics, W: Float[Array, "m d"]) -> HybridDraw:
        keep, head = self.keep.astype(jnp.float32), self.head
        return HybridDraw(physics, keep, head.trained.network, W, head.encoding)


class AbstractHybrid(AbstractModel):
    """A simulator and a network; a recipe says how both are learned.

    Options as in `NLM`.
    """

    #: Whether an update after the first fit leaves the parameters as they are.
    layer_alone: AbstractClassVar[bool]

    sim: Sim2GP
    encoding: Encoding
    hidden: tuple[int, ...] = eqx.field(static=True)
    steps: int = eqx.field(static=True)
    refit_steps: int = eqx.field(static=True)

    def __init__(
        self,
        sim: Sim2GP,
        hidden: tuple[int, ...],
        steps: int,
        refit_steps: int,
        reach: Mapping[str, float] | None,
    ) -> None:
        self.sim = sim
        self.encoding = Encoding.of(sim.system, reach or {})
        self.hidden = tuple(hidden)
        name = type(self).__name__
        check_training(name, self.hidden, steps=steps, refit_steps=refit_steps)
        self.steps = steps
        self.refit_steps = refit_steps

    @property
    def history(self) -> int:
        return self.sim.history

    @abstractmethod
    def learn(
        self,
        belief: HybridBelief,
        sim: Sim2GPBelief,
        data: Transitions,
        steps: int,
        key: Key,
    ) -> HybridBelief:
        """Parameters and layer given all data, in so many steps; ``sim`` has seen them.

        Called in float64.
        """

    @in_float64
    def init(self, key: Key) -> HybridBelief:
        """The simulator's prior; the network adds nothing yet."""
        physics = self.sim.init(key)
        trained = Trained.random(key, self.encoding, self.hidden)
        d, p = self.encoding.outputs, self.sim.prior.mean.size
        layer = LastLayer.prior(d, trained.network.features, p, trained.alpha)
        head = Head(trained, layer, jnp.zeros(d), self.encoding)
        one, none = jnp.ones(()), jnp.zeros((), int)
        prior = self.sim.prior
        return HybridBelief(physics, prior, one, one, head, physics.noise, none)

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
        steps = self.refit_steps if int(belief.count) else self.steps
        data = jax.tree.map(jnp.asarray, data)
        return checked(self.learn(belief, sim, data, steps, second), data)

    def update(
        self, belief: AbstractBelief, s: State, a: Action, s2: State
    ) -> HybridBelief:
        """One more transition: the exact Gaussian update of ``(tt, W)``, features kept.

        What ``tt`` and ``W`` then have in common is kept (`LastLayer.shared`), also
        where the fit had left them independent. The simulator's own belief learns by
        itself. Call it in float64.
        """
        assert isinstance(belief, HybridBelief)
        before, head = belief.physics, belief.head

        def f(tt: Array) -> Array:
            return _change(belief.sim, tt, s, a)

        value, J = linearized.value_and_jacobian(f, before.mean)
        mean, _, _ = head.moments(s, a)
        residual = (s2 - s)[: belief.noise.size] - belief.keep * value - mean
        phi = head.output_scale[:, None] * head.phi(s, a)[None]
        # Before the first fit there is no residual: the parameters learn.
        fixed = self.layer_alone & jnp.any(head.output_scale > 0.0)
        scale = jnp.where(fixed, 0.0, before.scale)
        physics, layer = last_layer.condition(
            Gaussian(before.mean, scale),
            head.layer,
            belief.keep * J,
            phi,
            residual,
            belief.noise,
        )
        sim, physics = (
            self.sim.update(belief.sim, s, a, s2),
            chosen(fixed, before, physics),
        )
        new = sim, physics, layer, belief.count + 1
        return eqx.tree_at(
            lambda b: (b.sim, b.physics, b.head.layer, b.count), belief, new
        )


def _change(
    belief: Sim2GPBelief, tt: Float[Array, " p"], s: State, a: Action
) -> Float[Array, " d"]:
    """The simulator's change of the physical states in one step."""
    d = belief.noise.size
    return belief.system.transition(tt, s, a, belief.dt)[:d] - s[:d]


def physics_rows(
    belief: Sim2GPBelief,
    tt: Float[Array, " p"],
    S: Float[Array, "N n"],
    A: Float[Array, "N m"],
    mask: Bool[Array, " N"],
) -> tuple[Float[Array, "N d"], Float[Array, "N d p"]]:
    """The simulator's changes and their Jacobians at ``tt``; masked rows are zero."""

    def one(s: Array, a: Array, valid: Array) -> tuple[Array, Array]:
        value, J = linearized.value_and_jacobian(
            lambda tt: _change(belief, tt, s, a), tt
        )
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
