"""Data with a likelihood that any version of a machine can be fitted to.

A search for missing physics fits many machines to the same rows: the bare one, and each
with one more parameter. `OneStepData` are exact states of a simulated task,
`WindowData` the windows of real logs. Both give the evidence of a machine, and its
linearisation.
"""

import abc
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sim2gp.data.one_step import OneStepLikelihood
from sim2gp.data.transitions import Transitions, with_history
from sim2gp.data.windows import Windows
from sim2gp.data.windows_likelihood import WindowsLikelihood
from sim2gp.identification import fit
from sim2gp.identification.misfit.residuals import (
    misfit_of_transitions,
    misfit_of_windows,
)
from sim2gp.identification.misfit.tests import Misfit
from sim2gp.inference.estimate import Estimate, drawn_starts, estimate
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.likelihood import AbstractLikelihood
from sim2gp.inference.prior import ParameterPrior
from sim2gp.systems.base import AbstractSystem
from sim2gp.types import in_float64

FREE = 0.1  # of a prior that leaves a size free, relative to 1 / sd
DRAWN = 2  # random starts of a one-step fit, next to the prior's mean


class AbstractData(abc.ABC):
    """Rows that every candidate machine must explain.

    ``freedom`` is the Student-t's, ``cluster`` the windows whose errors may be
    correlated, ``period`` the time between actions in s, 0 where it varies.
    """

    system: AbstractSystem
    period: float
    freedom: float
    cluster: Int[np.ndarray, " W"]

    @abc.abstractmethod
    def fit(self) -> Estimate:
        """The machine as it is, by the library's own fit."""

    @abc.abstractmethod
    def likelihood(self, system: AbstractSystem) -> AbstractLikelihood:
        """The likelihood of a machine's parameters and of the nuisances."""

    @abc.abstractmethod
    def misfit(self, system: AbstractSystem, fitted: Estimate) -> Misfit:
        """Four tests of what a machine's fit leaves over."""

    @in_float64
    def refit(
        self,
        system: AbstractSystem,
        starts: Float[np.ndarray, "S p"],
        warm_start: Estimate,
        prior: Gaussian | None = None,
    ) -> Estimate:
        """A changed machine, from several starts (whitened) at another fit's noise.

        The same descent, EM and evidence as `fit`, which would start from a noise so
        large that a start says nothing: nothing keeps a delay from the wrong side of a
        sample then. ``prior`` replaces that of the machine's table. Raises
        `NotConverged` or `NotFinite`.
        """
        likelihood, table = self.likelihood(system), system.parameters
        found = estimate(
            likelihood,
            ParameterPrior(table.prior() if prior is None else prior, table),
            starts=jnp.asarray(starts, float),
            nuisances=warm_start.nuisances,
            noise=warm_start.noise,
            freedom=jnp.asarray(self.freedom),
        )
        rows = int(np.asarray(likelihood.counts).max(axis=1).sum())
        found.convergence.check(table.names, f"{rows} rows")
        return found

    def blocks(
        self,
        system: AbstractSystem,
        z: Float[np.ndarray, "G p"],
        nuisances: Float[Array, "W n"],
    ) -> Float[Array, "G W c b k"]:
        """`Blocks` at points of the parameters, whitened by the prior."""
        prior, likelihood = system.parameters.prior(), self.likelihood(system)
        if likelihood.on_host:
            each = [
                likelihood.blocks(prior.at(one), nuisances, prior.scale) for one in z
            ]
            return jnp.stack(each)
        return _blocks(likelihood, prior, jnp.asarray(z, float), nuisances)


@eqx.filter_jit
def _blocks(
    likelihood: AbstractLikelihood, prior: Gaussian, z: Array, e: Array
) -> Array:
    scale = prior.scale
    return jax.lax.map(lambda one: likelihood.blocks(prior.at(one), e, scale), z)


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
        self.freedom = np.inf
        self.cluster = np.zeros(1, int)

    def transitions(self, history: int = 0) -> Transitions:
        """All rows, with so many past actions in the states."""
        parts = [with_history(S, A, history) for S, A in self.episodes]
        joined = [np.concatenate(columns) for columns in zip(*parts, strict=True)]
        return Transitions.of(*joined)

    @in_float64
    def fit(self) -> Estimate:
        table, key = self.system.parameters, jax.random.key(self.seed)
        likelihood = self.likelihood(self.system)
        found = estimate(
            likelihood,
            ParameterPrior(table.prior(), table),
            starts=drawn_starts(jnp.zeros((1, len(table))), 1 + DRAWN, key),
        )
        rows = int(likelihood.counts[0, 0])
        found.convergence.check(table.names, f"{rows} transitions")
        return found

    def likelihood(self, system: AbstractSystem) -> OneStepLikelihood:
        return OneStepLikelihood(system, self.transitions(system.history), self.period)

    @in_float64
    def misfit(self, system: AbstractSystem, fitted: Estimate) -> Misfit:
        return misfit_of_transitions(
            self.likelihood(system), fitted.prior, fitted.posterior, fitted.noise.sd
        )


class WindowData(AbstractData):
    """Windows of real logs; ``cut`` makes them for a machine (delays reach back).

    ``cluster`` says which windows may share an error, such as those of one second,
    ``recording`` which are of one recording.
    """

    def __init__(
        self,
        system: AbstractSystem,
        cut: Callable[[AbstractSystem], Windows],
        cluster: Int[np.ndarray, " W"],
        recording: Int[np.ndarray, " W"],
        *,
        robust: bool = False,
        seed: int = 0,
    ) -> None:
        self.system, self.period, self.seed = system, 0.0, seed
        self.cut, self.robust, self.cluster = cut, robust, cluster
        self.recording = recording
        self.windows = cut(system)
        self.freedom = fit.FREEDOM if robust else np.inf

    @in_float64
    def fit(self) -> Estimate:
        key = jax.random.key(self.seed)
        return fit.fit_windows(self.system, self.windows, key=key, robust=self.robust)

    def likelihood(self, system: AbstractSystem) -> WindowsLikelihood:
        # The same rows, with inputs as far back as the machine's delays.
        same = system.longest_delay <= self.system.longest_delay
        return WindowsLikelihood(system, self.windows if same else self.cut(system))

    def misfit(self, system: AbstractSystem, fitted: Estimate) -> Misfit:
        return misfit_of_windows(self.likelihood(system), fitted)
