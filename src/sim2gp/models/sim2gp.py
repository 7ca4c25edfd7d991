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
import numpy as np
from jaxtyping import Array, Float, Int

from sim2gp import checks
from sim2gp.belief import AbstractBelief, AbstractModel
from sim2gp.compilation import compile_async
from sim2gp.data.one_step import OneStepLikelihood
from sim2gp.data.transitions import Transitions
from sim2gp.inference import linearized
from sim2gp.inference.estimate import (
    Estimate,
    drawn_starts,
    estimate,
    estimate_noise,
)
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.information import Sensitivity
from sim2gp.inference.least_squares import gauss_newton_step, over, stack
from sim2gp.inference.linalg import triangular
from sim2gp.inference.prior import ParameterPrior
from sim2gp.models import draws
from sim2gp.models.features import Encoding
from sim2gp.systems.base import AbstractSystem
from sim2gp.types import Action, Dynamics, Key, Scalar, State, double, in_float64

STARTS = 4
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
        """Virtual mean and sd; push them through the table for physical units.

        Weights of functions that may be missing (parameters in groups) are left out.
        """
        own = self._own()
        return self.posterior.mean[own], self.posterior.sd()[own]

    @in_float64
    def without_functions(self) -> "Sim2GPBelief":
        """What it says of the simulator's own parameters, missing functions averaged.

        It predicts nothing: its machine still has them.
        """
        return self.marginal(self._own(), self.system)

    @in_float64
    def marginal(
        self, kept: Int[np.ndarray, " k"], system: AbstractSystem
    ) -> "Sim2GPBelief":
        """What it says of the parameters at these places, the others averaged.

        ``system`` is the machine that has these alone.
        """
        rest = np.setdiff1d(np.arange(self.posterior.mean.size), kept)
        A, r = self.information, len(rest)
        rows = jnp.concatenate([A, jnp.eye(A.shape[1], dtype=A.dtype)[rest]])
        left = triangular(rows[:, np.concatenate([rest, kept])])[r:, r:]
        prior, posterior = self.prior.marginal(kept), self.posterior.marginal(kept)
        new = system, prior, posterior, left
        return eqx.tree_at(
            lambda b: (b.system, b.prior, b.posterior, b.information), self, new
        )

    def _own(self) -> Int[np.ndarray, " p"]:
        """Places of the simulator's own parameters."""
        return np.flatnonzero([not p.group for p in self.system.parameters.free])


class Sim2GP(AbstractModel):
    """The simulator as a prior over dynamics.

    ``dt`` is the control period (s). ``prior`` replaces the table's own, in virtual
    space: with a posterior here, data sets are learned one after another. A ``frozen``
    simulator keeps ``prior`` as the posterior of its parameters, because it comes from
    other data or from the same data in another form: a fit then learns the noise alone.
    Raises `InputError` E148 for a period that is not positive, E140 for a prior of
    another number of parameters.
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

    @property
    def history(self) -> int:
        return self.system.history

    def with_prior(self, prior: Gaussian) -> "Sim2GP":
        """The same recipe, starting from another belief about the parameters."""
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
        rows = jax.tree.map(jnp.asarray, data)
        if self.frozen:
            return belief_of(self, _noise_alone(self, rows), rows)
        warm = self.prior.whitened(belief.posterior.mean)
        first = jnp.stack([warm, jnp.zeros_like(warm)])
        found = _fit(self, rows, drawn_starts(first, STARTS, key))
        names = self.system.parameters.names
        found.convergence.check(names, f"{data.count} transitions")
        return belief_of(self, found, rows)

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


@compile_async
def _fit(
    model: Sim2GP, data: Transitions, starts: Float[Array, "starts p"]
) -> Estimate:
    likelihood = OneStepLikelihood(model.system, data, model.dt)
    return estimate(
        likelihood,
        ParameterPrior(model.prior, model.system.parameters),
        starts=starts,
    )


@eqx.filter_jit
def _noise_alone(model: Sim2GP, data: Transitions) -> Estimate:
    likelihood = OneStepLikelihood(model.system, data, model.dt)
    prior = ParameterPrior(model.prior, model.system.parameters)
    return estimate_noise(likelihood, prior)


def belief_of(model: Sim2GP, found: Estimate, data: Transitions) -> Sim2GPBelief:
    """What a fit of these data has found, as a belief."""
    return Sim2GPBelief(
        model.system,
        found.prior,
        found.posterior,
        found.noise.sd,
        found.information,
        found.log_evidence,
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
