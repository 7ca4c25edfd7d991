"""What is known of the parameters before the data, as rows of the least squares.

With ``tt = mu0 + L0 z`` the Gaussian prior is the rows ``[I z]``. A measured sum of
parameters is one more row, exact in the bounded parameters. A posterior is compared
with what was known before the logs; that is the prior and the sums, linearised where
the posterior is:

    [ K  r - K z ]   rows of the sums at z,
    [ I     0    ]   the prior's own.
"""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from equinox import AbstractVar
from jaxtyping import Array, Float

from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.least_squares import (
    gauss_newton_step,
    posterior,
    prior_rows,
    stack,
)
from sim2gp.inference.linalg import library
from sim2gp.inference.parameters import Parameters
from sim2gp.types import AnyArray, in_float64


class AbstractPrior(eqx.Module):
    """What an estimate asks of a prior. ``gaussian`` whitens: ``tt = mu0 + L0 z``."""

    gaussian: AbstractVar[Gaussian]

    @property
    @abstractmethod
    def linear(self) -> tuple[int, ...]:
        """Places of the parameters that the model is linear in, as far as is known."""

    @abstractmethod
    def moved(self, z: Float[AnyArray, " p"], dz: Float[AnyArray, " p"]) -> AnyArray:
        """Where a step leads that begins as ``dz``: along a curve that suits them."""

    @abstractmethod
    def rows(self, z: Float[AnyArray, " p"]) -> Float[AnyArray, "q p1"]:
        """Rows ``[K r]`` whose squares are the prior: ``[I z]``, and others."""

    @abstractmethod
    def curvature(
        self, z: Float[AnyArray, " p"], gradient: Float[AnyArray, " p"]
    ) -> Float[AnyArray, "p p"]:
        """The Hessian that the parameters' maps add, given the data's gradient.

        It shapes steps only, never the posterior: where a bound saturates it is several
        times Gauss-Newton's, and steps without it zigzag or crawl.
        """


class ParameterPrior(AbstractPrior):
    """The prior of a table of parameters, with what was measured of their sums.

    ``scales`` multiply the sd of each group of parameters: the data choose them
    (`sim2gp.inference.relevance`). The whitening stays that of ``gaussian``.
    """

    gaussian: Gaussian
    table: Parameters
    scales: Float[AnyArray, " g"]

    def __init__(
        self,
        gaussian: Gaussian,
        table: Parameters,
        scales: Float[AnyArray, " g"] | None = None,
    ) -> None:
        self.gaussian, self.table = gaussian, table
        self.scales = np.ones(len(table.groups)) if scales is None else scales

    def rows(self, z: Float[AnyArray, " p"]) -> Float[AnyArray, "q p1"]:
        xp, rows = library(z), prior_rows(z)
        if self.table.groups:
            rows = rows / self.each()[:, None]
        if not self.table.measurements:
            return rows
        # Of NumPy's, compiled: a fit of the host asks again and again.
        f = eqx.filter_jit(_measured) if xp is np else _measured
        measured = xp.asarray(f(self.table, self.gaussian, z))
        return xp.concatenate([rows, measured])

    @property
    def linear(self) -> tuple[int, ...]:
        return tuple(np.flatnonzero(self.members.sum(axis=0)).tolist())

    def moved(self, z: Float[AnyArray, " p"], dz: Float[AnyArray, " p"]) -> AnyArray:
        about = self.gaussian
        return about.whitened(self.table.moved(about.at(z), about.scale @ dz))

    @property
    def members(self) -> Float[np.ndarray, "g p"]:
        """1 where a parameter is in a group."""
        out = np.zeros((len(self.table.groups), len(self.table)))
        for row, places in zip(out, self.table.groups.values(), strict=True):
            row[places] = 1.0
        return out

    def each(self, scales: Float[AnyArray, " g"] | None = None) -> AnyArray:
        """The scale of each parameter: 1 outside groups."""
        members, scales = self.members, self.scales if scales is None else scales
        return scales @ members + (1.0 - members.sum(axis=0))

    def as_gaussian(self) -> Gaussian:
        """The Gaussian with its scales, without measured sums."""
        about, each = self.gaussian, library(self.scales).asarray(self.each())
        return Gaussian(about.mean, about.scale * each[None])

    def scales_in(self, scaled: Gaussian) -> Float[AnyArray, " g"]:
        """The scales of a Gaussian that `as_gaussian` gave."""
        first = np.asarray([at[0] for at in self.table.groups.values()], int)
        xp = library(scaled.scale)
        return (xp.diagonal(scaled.scale) / xp.diagonal(self.gaussian.scale))[first]

    def scaled(self, scales: Float[AnyArray, " g"]) -> "ParameterPrior":
        """The same with other scales."""
        return ParameterPrior(self.gaussian, self.table, scales)

    def curvature(
        self, z: Float[AnyArray, " p"], gradient: Float[AnyArray, " p"]
    ) -> Float[AnyArray, "p p"]:
        return self.table.curvature(self.gaussian, z, gradient)

    @in_float64
    def linearised(self, tt: Float[Array, " p"]) -> Gaussian:
        """As a Gaussian, the measured sums linearised at the virtual ``tt``."""
        z = self.gaussian.whitened(jnp.asarray(tt, float))
        rows = self.table.measurement_rows(self.gaussian, z)
        about = rows.at[:, -1].add(-rows[:, :-1] @ z)
        full = stack(about, jnp.eye(z.size, z.size + 1, dtype=z.dtype))
        return posterior(full, gauss_newton_step(full), self.gaussian)

    @in_float64
    def at_mode(self) -> Gaussian:
        """As a Gaussian, linearised at its own mode."""
        import scipy.optimize  # a third of a second: a refused project does not wait

        if not self.table.measurements:
            return self.gaussian
        rows = jax.jit(lambda z: self.rows(z))
        found = scipy.optimize.least_squares(
            lambda z: np.asarray(rows(z))[:, -1],
            np.zeros(len(self.table)),
            lambda z: np.asarray(rows(z))[:, :-1],
            xtol=1e-15,
            ftol=1e-15,
            gtol=1e-12,
        )
        return self.linearised(self.gaussian.at(jnp.asarray(found.x)))


def _measured(table: Parameters, gaussian: Gaussian, z: Array) -> Array:
    return table.measurement_rows(gaussian, z)
