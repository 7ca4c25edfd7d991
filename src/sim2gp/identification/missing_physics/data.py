"""Data with a likelihood that any version of a machine can be fitted to.

A search for missing physics fits many machines to the same rows: the bare one, and each
with one more constant. `OneStepData` are exact states of a simulated task, `WindowData`
the windows of real logs. Both give the evidence of a machine, and its linearisation.
"""

import abc
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sim2gp.data import windows
from sim2gp.data.transitions import Transitions, with_history
from sim2gp.data.windows import FREEDOM, Windows, WindowsBelief, fit_windows
from sim2gp.identification.misfit.residuals import (
    misfit_of_transitions,
    misfit_of_windows,
)
from sim2gp.identification.misfit.tests import Misfit
from sim2gp.inference.arrowhead import Noise
from sim2gp.inference.expectation_maximisation import expectation
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.levenberg_marquardt import AbstractLikelihood, Fit, multi_start
from sim2gp.models import sim2gp
from sim2gp.models.sim2gp import FLOOR, Sim2GP
from sim2gp.systems.base import AbstractSystem
from sim2gp.types import Scalar, in_float64


@dataclass(frozen=True)
class Fitted:
    """A machine fitted to data: posterior, noise, nuisances, log evidence in nats.

    ``scores`` are what each window's data add to the gradient at the MAP, whitened by
    the prior; they sum to minus the prior's part.
    """

    system: AbstractSystem
    prior: Gaussian
    posterior: Gaussian
    noise: Noise
    nuisances: Float[Array, "W n"]
    log_evidence: float
    scores: Float[np.ndarray, "W p"] | None = None

    def whitened(self) -> Float[Array, " p"]:
        """The MAP in units of the prior."""
        away = self.posterior.mean - self.prior.mean
        return jnp.linalg.solve(self.prior.scale, away)


class AbstractData(abc.ABC):
    """Rows that every candidate machine must explain.

    ``count`` are the rows of each window and channel, ``floor`` the least noise sd,
    ``freedom`` the Student-t's, ``rounds`` those of EM, ``cluster`` the windows whose
    errors may be correlated, ``period`` the time between actions in s, 0 where it
    varies.
    """

    system: AbstractSystem
    period: float
    count: Float[np.ndarray, "W c"]
    floor: Float[np.ndarray, " c"]
    freedom: float
    rounds: int
    cluster: Int[np.ndarray, " W"]

    @abc.abstractmethod
    def fit(self) -> Fitted:
        """The machine as it is, by the library's own fit."""

    @abc.abstractmethod
    def likelihood(self, system: AbstractSystem, prior: Gaussian) -> AbstractLikelihood:
        """The likelihood of a machine's constants and of the nuisances."""

    @abc.abstractmethod
    def misfit(self, fitted: Fitted) -> Misfit:
        """Four tests of what a fit leaves over."""

    @in_float64
    def refit(
        self, system: AbstractSystem, starts: Float[np.ndarray, "S p"], near: Fitted
    ) -> Fitted:
        """A changed machine, from several starts (whitened) at a near fit's noise.

        The same descent, EM and evidence as `fit`, which would start from a noise so
        large that a start says nothing: nothing keeps a delay from the wrong side of a
        sample then. Raises `NotConverged` or `NotFinite`.
        """
        prior = system.parameters.prior()
        fit, noise, log_evidence = _refit(
            self.likelihood(system, prior),
            jnp.asarray(starts, float),
            near.nuisances,
            near.noise,
            jnp.asarray(self.count),
            jnp.asarray(self.floor),
            jnp.asarray(self.freedom),
            self.rounds,
        )
        where = f"{int(self.count.max(axis=1).sum())} rows"
        fit.raise_unless_converged(system.parameters.names, where)
        return Fitted(
            system,
            prior,
            fit.posterior(prior),
            noise,
            fit.e,
            float(log_evidence),
            scores_of(fit, noise),
        )

    def blocks(
        self,
        system: AbstractSystem,
        z: Float[np.ndarray, "G p"],
        nuisances: Float[Array, "W n"],
    ) -> Float[Array, "G W c k k"]:
        """`Blocks` at points of the constants, whitened by the prior."""
        prior = system.parameters.prior()
        likelihood = self.likelihood(system, prior)
        return _blocks(likelihood, jnp.asarray(z, float), nuisances)


@eqx.filter_jit
def _refit(
    likelihood: AbstractLikelihood,
    starts: Float[Array, "S p"],
    e: Float[Array, "W n"],
    noise: Noise,
    count: Float[Array, "W c"],
    floor: Float[Array, " c"],
    freedom: Scalar,
    rounds: int,
) -> tuple[Fit, Noise, Scalar]:
    """Fit, noise and log evidence, as `Sim2GP.fit` and `fit_windows` define it."""
    update = expectation(count, floor, freedom)
    fit, noise, _ = multi_start(likelihood, starts, e, noise, update, rounds=rounds)
    return fit, noise, fit.log_evidence(noise, count)


def scores_of(fit: Fit, noise: Noise) -> Float[np.ndarray, "W p"]:
    """What each window adds to the gradient of the cost in the constants."""
    white, n = np.asarray(noise.scale(fit.at.blocks)), fit.e.shape[1]
    return np.einsum("wckj,wck->wj", white[..., n:-1], white[..., -1])


@eqx.filter_jit
def _blocks(likelihood: AbstractLikelihood, z: Array, e: Array) -> Array:
    return jax.lax.map(lambda one: likelihood.blocks(one, e), z)


class OneStepData(AbstractData):
    """Episodes of exact states: S of (T + 1, n) and A of (T, m) each, every ``dt`` s.

    Inputs count as zero before an episode, as on the simulated tasks.
    """

    def __init__(
        self,
        system: AbstractSystem,
        episodes: Sequence[tuple[np.ndarray, np.ndarray]],
        *,
        dt: float = 0.02,
        seed: int = 0,
    ) -> None:
        self.system, self.period, self.seed = system, dt, seed
        self.episodes = [
            (np.asarray(S, float), np.asarray(A, float)) for S, A in episodes
        ]
        change = np.concatenate([np.diff(S, axis=0) for S, _ in self.episodes])
        rms = np.sqrt(np.mean(change**2, axis=0))
        self.floor = FLOOR * np.where(rms > 0.0, rms, 1.0)
        self.count = np.full((1, change.shape[1]), float(len(change)))
        self.freedom, self.rounds = np.inf, sim2gp.NOISE_ROUNDS
        self.cluster = np.zeros(1, int)

    def transitions(self, history: int = 0) -> Transitions:
        """All rows, with so many past actions in the states."""
        parts = [with_history(S, A, history) for S, A in self.episodes]
        joined = [np.concatenate(columns) for columns in zip(*parts, strict=True)]
        return Transitions.of(*joined)

    @in_float64
    def fit(self) -> Fitted:
        system, key = self.system, jax.random.key(self.seed)
        model = Sim2GP(system, dt=self.period)
        data = self.transitions(system.history)
        belief = model.fit(model.init(key), data, key=key)
        return Fitted(
            system,
            belief.prior,
            belief.posterior,
            Noise(belief.noise, jnp.ones(1)),
            jnp.zeros((1, 0)),
            float(belief.log_evidence),
        )

    def likelihood(self, system: AbstractSystem, prior: Gaussian) -> AbstractLikelihood:
        model = Sim2GP(system, dt=self.period, prior=prior)
        data = self.transitions(system.history)
        return sim2gp.likelihood(model, jax.tree.map(jnp.asarray, data))

    @in_float64
    def misfit(self, fitted: Fitted) -> Misfit:
        system = fitted.system
        blank = Sim2GP(system, dt=self.period).init(jax.random.key(self.seed))
        belief = eqx.tree_at(
            lambda b: (b.posterior, b.noise), blank, (fitted.posterior, fitted.noise.sd)
        )
        return misfit_of_transitions(belief, self.transitions(system.history))


class WindowData(AbstractData):
    """Windows of real logs; ``cut`` makes them for a machine (delays reach back).

    ``cluster`` says which windows may share an error, such as those of one second.
    """

    def __init__(
        self,
        system: AbstractSystem,
        cut: Callable[[AbstractSystem], Windows],
        cluster: Int[np.ndarray, " W"],
        *,
        robust: bool = False,
        seed: int = 0,
    ) -> None:
        self.system, self.period, self.seed = system, 0.0, seed
        self.cut, self.robust, self.cluster = cut, robust, cluster
        self.windows = cut(system)
        self.count = np.sum(np.asarray(self.windows.mask), axis=1).astype(float)
        self.floor = np.asarray(self.windows.floor)
        self.freedom = FREEDOM if robust else np.inf
        self.rounds = windows.NOISE_ROUNDS

    def windows_for(self, system: AbstractSystem) -> Windows:
        """The same rows, with inputs as far back as the machine's delays."""
        same = system.longest_delay <= self.system.longest_delay
        return self.windows if same else self.cut(system)

    @in_float64
    def fit(self) -> Fitted:
        system, found = self.system, self.windows
        key = jax.random.key(self.seed)
        belief = fit_windows(system, found, key=key, robust=self.robust)
        sd = jnp.asarray(found.start_sd)
        away = belief.starts - jnp.asarray(found.start)
        nuisances = jnp.where(sd > 0.0, away / jnp.where(sd > 0.0, sd, 1.0), 0.0)
        return Fitted(
            system,
            belief.prior,
            belief.posterior,
            Noise(belief.noise, belief.weights),
            nuisances,
            float(belief.log_evidence),
        )

    def likelihood(self, system: AbstractSystem, prior: Gaussian) -> AbstractLikelihood:
        found: Any = jax.tree.map(jnp.asarray, self.windows_for(system))
        return windows.likelihood(system, prior, found)

    @in_float64
    def misfit(self, fitted: Fitted) -> Misfit:
        found = self.windows_for(fitted.system)
        p, sd = fitted.prior.mean.size, jnp.asarray(found.start_sd)
        belief = WindowsBelief(
            fitted.system,
            fitted.prior,
            fitted.posterior,
            fitted.noise.sd,
            jnp.zeros((p, p)),
            fitted.noise.weights,
            jnp.asarray(found.start) + sd * fitted.nuisances,
            jnp.asarray(fitted.log_evidence),
        )
        return misfit_of_windows(belief, found)
