"""SIM2GP: a simulator with bounded parameters, linearised at its MAP, is a GP.

    y_n = s'_n - s_n = f(x_n, tt) + eps_n,   eps ~ N(0, diag(sig^2)),   tt ~ N(mu0, S0)
    tt*     = argmin 1/2 sum ||y_n - f(x_n, tt)||^2_Se + 1/2 ||tt - mu0||^2_S0
    Sq^-1   = S0^-1 + sum J_n^T Se^-1 J_n                (Gauss-Newton; paper, eq. 2)
    sig_k^2 = (2 floor_k^2 + sum r_nk^2 + (J Sq J^T)_kk) / (2 + N)          (EM)

The paper prints the MAP with the prior counted twice and Sq with the full Hessian; the
linearised model's own Hessian is the Gauss-Newton one, which is also always positive.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sim2gp import checks
from sim2gp.belief import AbstractBelief, AbstractModel
from sim2gp.data.transitions import Transitions
from sim2gp.inference import linearized
from sim2gp.inference.arrowhead import Blocks, Noise
from sim2gp.inference.expectation_maximisation import expectation
from sim2gp.inference.gaussian import LOG_2PI, Gaussian
from sim2gp.inference.information import Sensitivity
from sim2gp.inference.least_squares import factor, gauss_newton_step, over, stack
from sim2gp.inference.levenberg_marquardt import AbstractLikelihood, Fit, multi_start
from sim2gp.inference.linalg import triangular
from sim2gp.models import draws
from sim2gp.models.features import Encoding
from sim2gp.systems.base import AbstractSystem
from sim2gp.types import Action, Dynamics, Key, Scalar, State, double, in_float64

NOISE_ROUNDS = 5  # EM; the last change of sig is below 1e-3 relative from here on
STARTS = 4
FLOOR = 1e-3  # prior guess of the noise, relative to each channel's rms change
PRIOR_NOISE = 1e-3  # before any data, of half of a channel's box


class Sim2GPBelief(AbstractBelief):
    """A Gaussian over virtual parameters, seen through the linearised simulator."""

    system: AbstractSystem
    prior: Gaussian
    posterior: Gaussian
    noise: Float[Array, " d"]  # sd of one step, state units
    information: Float[Array, "p p"]  # factor of the data's Fisher, whitened by prior
    log_evidence: Scalar
    count: Int[Array, ""]
    dt: float = eqx.field(static=True)

    @in_float64
    def latent(self, s: State, a: Action) -> Gaussian:
        return _latent(self, *double(s, a))

    @in_float64
    def predict(self, s: State, a: Action) -> Gaussian:
        return _predict(self, *double(s, a))

    @in_float64
    def sample(self, key: Key) -> Dynamics:
        mean = self.posterior.mean
        delta = self.posterior.sample(key) - mean
        return draws.linearized(self.system, mean, delta, self.dt)

    @in_float64
    def point(self) -> Dynamics:
        return draws.physics_at(self.system, self.posterior.mean, self.dt)

    def sensitivity(self, s: State, a: Action) -> Sensitivity:
        d = self.noise.size
        shared = _latent(self, s, a).scale[:d] / self.noise[:, None]
        return shared, jnp.zeros((d, 0), shared.dtype)

    @property
    def coordinates(self) -> tuple[int, int, int]:
        return self.noise.size, self.posterior.scale.shape[1], 0

    @in_float64
    def parameters(self) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
        """Virtual mean and sd; push them through the table for physical units."""
        return self.posterior.mean, self.posterior.sd()


class Sim2GP(AbstractModel):
    """The simulator as a prior over dynamics.

    ``dt`` is the control period (s). ``prior`` replaces the table's own, in virtual
    space: with a posterior here, data sets are learned one after another. A ``frozen``
    simulator takes ``prior`` as the last word on its constants, because other data or
    the same ones in another form have made it: a fit then learns the noise alone.
    Raises `InputError` E148 for a period that is not positive, E140 for a prior of
    another number of constants.
    """

    system: AbstractSystem
    prior: Gaussian
    dt: float = eqx.field(static=True)
    frozen: bool = eqx.field(static=True)

    @in_float64
    def __init__(
        self,
        system: AbstractSystem,
        *,
        dt: float = 0.02,
        prior: Gaussian | None = None,
        frozen: bool = False,
    ) -> None:
        checks.positive("Sim2GP", dt=dt)
        self.system = system
        self.prior = system.parameters.prior() if prior is None else prior
        p = len(system.parameters)
        checks.same_shape("Sim2GP", (p,), prior=self.prior.mean)
        self.dt = dt
        self.frozen = frozen

    def with_prior(self, prior: Gaussian) -> "Sim2GP":
        """The same recipe, starting from another belief about the constants."""
        return eqx.tree_at(lambda m: m.prior, self, prior)

    @in_float64
    def init(self, key: Key) -> Sim2GPBelief:
        """The prior itself; needs no key."""
        del key
        p = self.prior.mean.size
        return Sim2GPBelief(
            self.system,
            self.prior,
            self.prior,
            PRIOR_NOISE * Encoding.of(self.system, {}).half_widths(),
            jnp.zeros((p, p)),
            jnp.zeros(()),
            jnp.zeros((), int),
            self.dt,
        )

    @in_float64
    def fit(
        self, belief: AbstractBelief, data: Transitions, *, key: Key
    ) -> Sim2GPBelief:
        """Multi-start MAP, noise by EM, Laplace posterior.

        Raises `NotConverged`, `NotFinite` or `DeadParameters`.
        """
        assert isinstance(belief, Sim2GPBelief)
        if self.frozen:
            return _noise_alone(self, jax.tree.map(jnp.asarray, data))
        p = self.prior.mean.size
        warm = jax.scipy.linalg.solve(
            self.prior.scale, belief.posterior.mean - self.prior.mean
        )
        spread = 0.7 * jax.random.normal(key, (STARTS - 2, p))
        starts = jnp.concatenate([warm[None], jnp.zeros((1, p)), spread])
        fit, fitted = _fit(self, jax.tree.map(jnp.asarray, data), starts)
        names = self.system.parameters.names
        fit.raise_unless_converged(names, f"{data.count} transitions")
        return fitted

    def update(
        self, belief: AbstractBelief, s: State, a: Action, s2: State
    ) -> Sim2GPBelief:
        """Condition on one transition at the current linearisation (a Kalman update).

        Traceable; call it under `in_float64`.
        """
        assert isinstance(belief, Sim2GPBelief)
        return _update(belief, s, a, s2)


def _latent(belief: Sim2GPBelief, s: Array, a: Array) -> Gaussian:
    def f(tt: Array) -> Array:
        return belief.system.transition(tt, s, a, belief.dt)

    return linearized.latent(f, belief.posterior)


def _predict(belief: Sim2GPBelief, s: Array, a: Array) -> Gaussian:
    d, n = belief.noise.size, s.size
    noise = jnp.concatenate([jnp.diag(belief.noise), jnp.zeros((n - d, d))])
    return _latent(belief, s, a).plus(noise)


class _OneStep(AbstractLikelihood):
    """The one-step likelihood: exact states, independent noise on each increment."""

    model: Sim2GP
    data: Transitions

    def rows(
        self, z: Float[Array, " p"]
    ) -> tuple[Float[Array, "N d"], Float[Array, "N d p"]]:
        """Residuals ``f - y`` and their Jacobian in ``z``; masked rows are zero."""
        model, d = self.model, len(self.model.system.physical_states)

        def one(
            s: Array, a: Array, s2: Array, valid: Array, which: Array | None
        ) -> tuple[Array, Array]:
            def f(z: Array) -> Array:
                tt = model.prior.mean + model.prior.scale @ z
                return model.system.transition(tt, s, a, model.dt, which)[:d]

            value, J = linearized.value_and_jacobian(f, z)
            return jnp.where(valid, value - s2[:d], 0.0), jnp.where(valid, J, 0.0)

        data = self.data
        rows = data.state, data.action, data.next_state, data.mask, data.configuration
        return jax.vmap(one)(*rows)

    def blocks(self, z: Float[Array, " p"], e: Float[Array, "1 0"]) -> Blocks:
        """All data as one window; a step of exact states has no nuisances ``e``."""
        del e
        r, J = self.rows(z)
        return jax.vmap(factor, in_axes=1)(J, r)[None]

    def known(self, z: Float[Array, " p"]) -> Float[Array, "q p1"]:
        """Of sums that were weighed."""
        return self.model.system.parameters.known(self.model.prior, z)

    def curvature(
        self, z: Float[Array, " p"], gradient: Float[Array, " p"]
    ) -> Float[Array, "p p"]:
        """Of the table's maps."""
        model = self.model
        return model.system.parameters.curvature(model.prior, z, gradient)


def likelihood(model: Sim2GP, data: Transitions) -> AbstractLikelihood:
    """The likelihood that `Sim2GP.fit` descends, for whoever linearises it himself."""
    return _OneStep(model, data)


@eqx.filter_jit
def _fit(
    model: Sim2GP, data: Transitions, starts: Float[Array, "starts p"]
) -> tuple[Fit, Sim2GPBelief]:
    d, N = len(model.system.physical_states), jnp.sum(data.mask, dtype=float)
    change, count = _rms_change(data, d), jnp.full((1, d), N)

    # Start from a large noise, so that the first MAP is not trapped.
    fit, noise, _ = multi_start(
        likelihood(model, data),
        starts,
        jnp.zeros((1, 0)),
        Noise(change, jnp.ones(1)),
        expectation(count, FLOOR * change),
        rounds=NOISE_ROUNDS,
    )
    belief = Sim2GPBelief(
        model.system,
        model.prior,
        fit.posterior(model.prior),
        noise.sd,
        fit.data[:-1, :-1],
        fit.log_evidence(noise, count),
        jnp.sum(data.mask),
        model.dt,
    )
    return fit, belief


def _rms_change(data: Transitions, d: int) -> Float[Array, " d"]:
    """Of each physical state in one step; 1 where nothing moves."""
    N = jnp.sum(data.mask, dtype=float)
    y = jnp.where(data.mask[:, None], data.delta()[:, :d], 0.0)
    change = jnp.sqrt(jnp.sum(y**2, axis=0) / jnp.maximum(N, 1.0))
    return jnp.where(change > 0.0, change, 1.0)


@eqx.filter_jit
def _noise_alone(model: Sim2GP, data: Transitions) -> Sim2GPBelief:
    """The noise by one step of EM, exact where the constants' posterior is given.

    The log evidence is that of the data at the constants' mean.
    """
    d, N = len(model.system.physical_states), jnp.sum(data.mask, dtype=float)
    p = model.prior.mean.size
    r, J = _OneStep(model, data).rows(jnp.zeros(p))
    floor = FLOOR * _rms_change(data, d)
    squares = jnp.sum(r**2, axis=0)
    total = 2.0 * floor**2 + squares + jnp.sum(J**2, axis=(0, 2))
    noise = jnp.sqrt(total / (2.0 + N))
    normaliser = N * jnp.sum(jnp.log(noise) + 0.5 * LOG_2PI)
    return Sim2GPBelief(
        model.system,
        model.prior,
        model.prior,
        noise,
        jnp.zeros((p, p)),
        -0.5 * jnp.sum(squares / noise**2) - normaliser,
        jnp.sum(data.mask),
        model.dt,
    )


def _update(belief: Sim2GPBelief, s: Array, a: Array, s2: Array) -> Sim2GPBelief:
    d = belief.noise.size
    latent = _latent(belief, s, a)
    r = (latent.mean - s2)[:d] / belief.noise
    A = latent.scale[:d] / belief.noise[:, None]
    # Coordinates whitened by the current posterior: its own rows are [I 0].
    identity = jnp.eye(A.shape[1], A.shape[1] + 1, dtype=A.dtype)
    full = stack(jnp.concatenate([A, r[:, None]], axis=1), identity)
    scale = belief.posterior.scale
    mean = belief.posterior.mean + scale @ gauss_newton_step(full)
    scale = over(scale, full[:-1, :-1])
    # The same rows, whitened by the prior instead.
    J0 = jnp.linalg.solve(belief.posterior.scale.T, A.T).T @ belief.prior.scale
    predictive = Gaussian(latent.mean[:d], latent.scale[:d])
    predictive = predictive.plus(jnp.diag(belief.noise))
    new = (
        Gaussian(mean, scale),
        triangular(jnp.concatenate([belief.information, J0])),
        belief.log_evidence + predictive.log_prob(s2[:d]),
        belief.count + 1,
    )
    return eqx.tree_at(
        lambda b: (b.posterior, b.information, b.log_evidence, b.count), belief, new
    )


@eqx.filter_jit
def _hessian(belief: Sim2GPBelief, data: Transitions) -> Float[Array, "p p"]:
    model = Sim2GP(belief.system, dt=belief.dt, prior=belief.prior)
    likelihood = _OneStep(model, data)

    def loss(z: Array) -> Scalar:
        r = likelihood.rows(z)[0] / belief.noise[None]
        apart = likelihood.known(z)[:, -1]
        return 0.5 * (jnp.sum(r**2) + z @ z + apart @ apart)

    offset = belief.posterior.mean - belief.prior.mean
    return jax.hessian(loss)(jnp.linalg.solve(belief.prior.scale, offset))


@in_float64
def full_hessian(belief: Sim2GPBelief, data: Transitions) -> Float[Array, "p p"]:
    """Hessian of the negative log posterior in whitened coordinates: a diagnostic.

    It equals the Gauss-Newton precision up to residuals times curvature, and may be
    indefinite away from a good fit; it is never used as a posterior.
    """
    return _hessian(belief, jax.tree.map(jnp.asarray, data))
