"""Neural linear models: a Bayesian last layer on learned features, no physics.

    s' = s + c (.) W^T phi(s, a) + eps,      W[:, k] ~ N(0, I / alpha_k)

Features, ``alpha`` and the noise are trained by type-II maximum likelihood on
minibatches: the evidence of 256 transitions, averaged over which. That over-fits (noise
below the truth, confidence where no data are), hence: a held-out fifth picks the
checkpoint, the noise is fitted again to its residuals, and only then all data make the
posterior. ``c`` is the rms change of each output.
"""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sim2gp.belief import AbstractBelief, AbstractModel
from sim2gp.data.transitions import Transitions
from sim2gp.errors import NotFinite, error
from sim2gp.inference import linear_regression as last_layer
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.information import Sensitivity
from sim2gp.inference.linalg import cholesky, solve_triangular
from sim2gp.inference.linear_regression import LastLayer
from sim2gp.models import features
from sim2gp.models.features import Encoding, Network, stepped
from sim2gp.models.training import adamw, chosen, descend
from sim2gp.systems.base import AbstractSystem
from sim2gp.types import Action, Dynamics, Key, Scalar, State, double, in_float64

BLOCK = 100  # steps between two looks at the held-out rows
BATCH = 256
RATE = 3e-3
NOISE_FLOOR = 1e-2  # while training, in units of the output's scale
PRIOR_REACH = 0.05  # before data, a step changes a state by this share of its box


class Trained(eqx.Module):
    """What type-II maximum likelihood moves."""

    network: Network
    log_alpha: Float[Array, " d"]
    log_noise: Float[Array, " d"]

    @classmethod
    def random(cls, key: Key, encoding: Encoding, hidden: tuple[int, ...]) -> "Trained":
        """Random features, unit prior on the layer, noise of a third of the output."""
        d = encoding.outputs
        network = Network.random(key, encoding.size, hidden)
        return cls(network, jnp.zeros(d), jnp.log(0.3 * jnp.ones(d)))

    @property
    def alpha(self) -> Float[Array, " d"]:
        """Prior precision of each output's layer."""
        return jnp.exp(self.log_alpha)

    @property
    def noise(self) -> Float[Array, " d"]:
        """Noise sd while training, with its floor, in units of the output's scale."""
        return jnp.sqrt(NOISE_FLOOR**2 + jnp.exp(2.0 * self.log_noise))

    def rates(self) -> Any:
        """Adam's rates; the scalars are few and well determined: they may hurry."""
        slow = jax.tree.map(lambda _: RATE, self)
        return eqx.tree_at(
            lambda t: (t.log_alpha, t.log_noise), slow, (10.0 * RATE, 10.0 * RATE)
        )

    def features(self, X: Float[Array, "N e"]) -> Float[Array, "N m"]:
        """All rows' features in the precision of ``X``."""
        return jax.vmap(self.network)(X)


class Head(eqx.Module):
    """A network with its posterior layer: ``delta = c (.) W^T phi``."""

    trained: Trained
    layer: LastLayer
    output_scale: Float[Array, " d"]  # c, state units
    encoding: Encoding

    def phi(self, s: State, a: Action) -> Float[Array, " features"]:
        """Features at one point."""
        return self.trained.network(self.encoding(s, a))

    def moments(
        self, s: State, a: Action
    ) -> tuple[Float[Array, " d"], Float[Array, "d p"], Float[Array, "d features"]]:
        """Mean of the change, its scale along ``e_0`` and ``e_k``, state units."""
        mean, shared, own = last_layer.moments(self.layer, self.phi(s, a))
        c = self.output_scale
        return c * mean, c[:, None] * shared, c[:, None] * own

    def weights(self, e0: Float[Array, " p"], key: Key) -> Float[Array, "m d"]:
        """One draw of ``W c``, given what it shares with the parameters; float32."""
        layer = self.layer
        eps = jax.random.normal(key, layer.mean.shape, layer.mean.dtype)
        W = layer.mean + layer.shared @ e0 + jnp.einsum("dmj,dj->dm", layer.scale, eps)
        return (self.output_scale[:, None] * W).T.astype(jnp.float32)

    def mean_weights(self) -> Float[Array, "m d"]:
        """The mean of ``W c``; float32."""
        return (self.output_scale[:, None] * self.layer.mean).T.astype(jnp.float32)


class NeuralDraw(eqx.Module):
    """``s + W^T phi(s, a)``: a few matrix products."""

    network: Network
    W: Float[Array, "m d"]
    encoding: Encoding

    def __call__(self, s: State, a: Action) -> State:
        phi = self.network(self.encoding(s, a))
        return stepped(s, a, phi @ self.W.astype(phi.dtype))


class NLMBelief(AbstractBelief):
    """A posterior over the last layer; the outputs are independent of each other."""

    head: Head
    noise: Float[Array, " d"]  # sd of one step, state units
    count: Int[Array, ""]

    @in_float64
    def latent(self, s: State, a: Action) -> Gaussian:
        s, a = double(s, a)
        mean, _, own = self.head.moments(s, a)
        spread = jnp.sqrt(jnp.sum(own**2, axis=1))
        return lifted(s, a, Gaussian(mean, jnp.diag(spread)))

    @in_float64
    def predict(self, s: State, a: Action) -> Gaussian:
        return with_noise(self.latent(s, a), self.noise)

    @in_float64
    def sample(self, key: Key) -> Dynamics:
        W = self.head.weights(jnp.zeros(0), key)
        return NeuralDraw(self.head.trained.network, W, self.head.encoding)

    @in_float64
    def point(self) -> Dynamics:
        W = self.head.mean_weights()
        return NeuralDraw(self.head.trained.network, W, self.head.encoding)

    def sensitivity(self, s: State, a: Action) -> Sensitivity:
        _, shared, own = self.head.moments(s, a)
        return shared, own / self.noise[:, None]

    @property
    def coordinates(self) -> tuple[int, int, int]:
        d, m = self.head.layer.mean.shape
        return d, 0, m


class NLM(AbstractModel):
    """The black box: knows the names and limits of the channels and nothing else.

    hidden: widths of the tanh layers; there is one feature more than the last width.
    steps, refit_steps: Adam steps of the first fit and of later, warm-started ones.
    reach: half-widths of the box of states by channel name, where the channels' own
    limits do not say (`features.REACH`).

    Raises `InputError` E148 for a width, a number of steps or a reach that cannot be.
    """

    encoding: Encoding
    hidden: tuple[int, ...] = eqx.field(static=True)
    steps: int = eqx.field(static=True)
    refit_steps: int = eqx.field(static=True)

    def __init__(
        self,
        system: AbstractSystem,
        *,
        hidden: tuple[int, ...] = (128, 128),
        steps: int = 1500,
        refit_steps: int = 500,
        reach: Mapping[str, float] | None = None,
    ) -> None:
        self.encoding = Encoding.of(system, reach or {})
        self.hidden = tuple(hidden)
        features.check_training(
            "NLM", self.hidden, steps=steps, refit_steps=refit_steps
        )
        self.steps = steps
        self.refit_steps = refit_steps

    @property
    def history(self) -> int:
        return self.encoding.history

    @in_float64
    def init(self, key: Key) -> NLMBelief:
        """Random features under the layer's prior: a random smooth machine."""
        trained = Trained.random(key, self.encoding, self.hidden)
        d, m = self.encoding.outputs, trained.network.features
        c = PRIOR_REACH * self.encoding.half_widths()
        layer = LastLayer.prior(d, m, 0, trained.alpha)
        head = Head(trained, layer, c, self.encoding)
        return NLMBelief(head, trained.noise * c, jnp.zeros((), int))

    @in_float64
    def fit(self, belief: AbstractBelief, data: Transitions, *, key: Key) -> NLMBelief:
        """Type-II maximum likelihood, noise from held-out rows, exact last layer.

        Raises `NotFinite` where data or posterior are not finite.
        """
        assert isinstance(belief, NLMBelief)
        if data.count == 0:
            return belief
        steps = self.refit_steps if int(belief.count) else self.steps
        data = jax.tree.map(jnp.asarray, data)
        fitted = _fit(belief, data, key, jnp.asarray(steps))
        return checked(fitted, data)

    def update(
        self, belief: AbstractBelief, s: State, a: Action, s2: State
    ) -> NLMBelief:
        """Condition the layer on one transition, features kept; call in float64."""
        assert isinstance(belief, NLMBelief)
        head, d = belief.head, belief.noise.size
        mean, _, _ = head.moments(s, a)
        phi = head.output_scale[:, None] * head.phi(s, a)[None]
        nothing = Gaussian(jnp.zeros(0, s.dtype), jnp.zeros((0, 0), s.dtype))
        _, layer = last_layer.condition(
            nothing,
            head.layer,
            jnp.zeros((d, 0), s.dtype),
            phi,
            (s2 - s)[:d] - mean,
            belief.noise,
        )
        return eqx.tree_at(
            lambda b: (b.head.layer, b.count), belief, (layer, belief.count + 1)
        )


class Selected(eqx.Module):
    """The best checkpoint by its held-out rows."""

    trained: Trained
    noise: Float[Array, " d"]  # recalibrated, in units of the output's scale
    losses: Float[Array, " d"]  # held-out, nats per transition, likewise


def type_two(
    trained: Trained,
    X: Float[Array, "N e"],
    Y: Float[Array, "N d"],
    extra: Float[Array, "N d"],
    mask: Bool[Array, " N"],
    key: Key,
    steps: Int[Array, ""],
) -> Selected:
    """Train on four fifths, look at the rest every `BLOCK` steps, keep the best.

    ``extra`` is variance that others contribute to the prediction (the physics).
    """
    out = features.held_out_rows(mask)
    train = mask & ~out
    # The held-out rows alone, padded to the fifth of the capacity.
    some = min(len(mask), len(mask) // features.HELD_OUT + features.CHUNK)
    held = jnp.argsort(~out)[:some]
    X32, count = X.astype(jnp.float32), jnp.sum(train, dtype=Y.dtype)

    def look(trained: Trained) -> Selected:
        R = last_layer.data_factor(trained.features(X), Y, train)
        layer, _ = last_layer.regression(R, count, trained.noise, trained.alpha)
        Phi = trained.features(X[held])
        spread = jnp.sum(jnp.einsum("nm,dmj->ndj", Phi, layer.scale) ** 2, axis=2)
        r = Y[held] - Phi @ layer.mean.T
        noise, losses = last_layer.recalibrated(
            extra[held] + spread, r, out[held], trained.noise
        )
        return Selected(trained, noise, losses)

    def block(i: Array, carry: tuple) -> tuple:
        trained, state, best = carry
        rows = features.Minibatches.shuffled(jax.random.fold_in(key, i), train)

        def gradient(trained: Trained, t: Array, key: Key) -> Trained:
            index, valid = rows.batch(t, BATCH)
            return jax.grad(evidence_loss)(trained, X32[index], Y[index], valid)

        trained, state = descend(
            gradient,
            trained,
            state,
            rates,
            steps=BLOCK,
            start=i * BLOCK,
            total=steps,
            key=key,
        )
        new = look(trained)
        better = jnp.sum(new.losses) < jnp.sum(best.losses)
        return trained, state, chosen(better, new, best)

    rates = trained.rates()
    start = (trained, adamw().init(trained), look(trained))
    return jax.lax.fori_loop(0, steps // BLOCK, block, start)[2]


def evidence_loss(
    trained: Trained,
    X: Float[Array, "B e"],
    Y: Float[Array, "B d"],
    valid: Bool[Array, " B"],
) -> Scalar:
    """A function whose gradient is that of minus the log evidence per row and output.

    With the posterior's mean ``m`` and covariance ``S`` held fixed, the evidence has
    the gradient of ``-||y - Phi m||^2 / 2 sig^2 - alpha ||m||^2 / 2 - tr(S Lam) / 2``
    and its normalisers: no derivative of a Cholesky is taken. Normal equations in
    float64 are enough for a direction; posteriors are by QR.
    """
    Phi = jnp.where(valid[:, None], trained.features(X), 0.0).astype(Y.dtype)
    Y = jnp.where(valid[:, None], Y, 0.0)
    count = jnp.maximum(jnp.sum(valid, dtype=Y.dtype), 1.0)
    G, b = Phi.T @ Phi, Phi.T @ Y
    sd, alpha = trained.noise, trained.alpha
    eye = jnp.eye(Phi.shape[1], dtype=Y.dtype)
    still, *rows = jax.lax.stop_gradient((G, b.T, sd, alpha))

    def posterior(b: Array, sd: Array, a: Array) -> tuple[Array, Array]:
        L = cholesky(still / sd**2 + a * eye)
        root = solve_triangular(L, eye, lower=True)
        half = solve_triangular(L, b / sd**2, lower=True)
        return solve_triangular(L, half, lower=True, transposed=True), root.T @ root

    m, S = jax.vmap(posterior)(*rows)
    misfit = jnp.sum((Y - Phi @ m.T) ** 2, axis=0) / sd**2
    trace = jnp.einsum("dij,ij->d", S, G) / sd**2
    ridge = alpha * (jnp.sum(m**2, axis=1) + jnp.trace(S, axis1=1, axis2=2))
    normaliser = count * jnp.log(sd) - 0.5 * eye.shape[0] * jnp.log(alpha)
    return jnp.sum(0.5 * (misfit + trace + ridge) + normaliser) / count


@eqx.filter_jit
def _fit(
    belief: NLMBelief, data: Transitions, key: Key, steps: Int[Array, ""]
) -> NLMBelief:
    head, mask = belief.head, data.mask
    X, y = features.encoded(head.encoding, data)
    N = jnp.sum(mask, dtype=y.dtype)
    rms = jnp.sqrt(jnp.sum(y**2, axis=0) / N)
    c = jnp.where(rms > 0.0, rms, head.output_scale)
    # The warm start's noise is in the old units.
    old = head.trained.log_noise + jnp.log(head.output_scale / c)
    log_noise = jnp.where(belief.count > 0, old, head.trained.log_noise)
    trained = eqx.tree_at(lambda t: t.log_noise, head.trained, log_noise)
    Y = y / c[None]
    best = type_two(trained, X, Y, jnp.zeros_like(Y), mask, key, steps)
    R = last_layer.data_factor(best.trained.features(X), Y, mask)
    layer, _ = last_layer.regression(R, N, best.noise, best.trained.alpha)
    head = Head(best.trained, layer, c, head.encoding)
    return NLMBelief(head, best.noise * c, jnp.sum(mask))


def checked(belief: Any, data: Transitions) -> Any:
    """The belief, or `NotFinite` where any of its numbers is not finite."""
    leaves = jax.tree.leaves(eqx.filter(belief, eqx.is_inexact_array))
    if not all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in leaves):
        where = f"{data.count} transitions"
        raise error("no_finite_checkpoint", NotFinite, where=where)
    return belief


def lifted(s: State, a: Action, change: Gaussian) -> Gaussian:
    """A Gaussian change of the physical states as one of ``s'``; history is certain."""
    past = s.size - change.mean.size
    nothing = jnp.zeros((past, change.scale.shape[1]), change.scale.dtype)
    return Gaussian(
        stepped(s, a, change.mean), jnp.concatenate([change.scale, nothing])
    )


def with_noise(latent: Gaussian, noise: Float[Array, " d"]) -> Gaussian:
    """Add one step's noise on the physical states."""
    n, d = latent.mean.size, noise.size
    return latent.plus(jnp.concatenate([jnp.diag(noise), jnp.zeros((n - d, d))]))
