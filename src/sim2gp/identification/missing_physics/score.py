"""Score tests: what would each effect of a library be worth, by one linearisation?

With the bare machine at its MAP, each candidate's magnitude ``x`` is one more unknown.
Linearised there (at ``x = 0``, or at a few magnitudes where nothing is not smooth), the
likelihood of parameters, nuisances and ``x`` is linear least squares, whose evidence,
EM for the noise included, costs a QR of small factors: at fixed noise its gain is that
of the efficient score test with the prior,

    log B = 1/2 c_x^2 - log R_xx,      [R c] the factor of data and prior, x last,

half the squared score over its information, what the other parameters can explain
projected out, minus Occam's price of one more parameter.

Errors of real logs are not independent from sample to sample. With several clusters of
windows the data's part of a gain is divided by the inflation of the magnitude's
variance (a sandwich over clusters): the likelihood is tempered to what rows are worth.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sim2gp.identification.missing_physics.data import AbstractData
from sim2gp.inference.arrowhead import eliminate
from sim2gp.inference.estimate import Estimate, estimate
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.least_squares import prior_rows
from sim2gp.inference.likelihood import AbstractLikelihood
from sim2gp.inference.linalg import sine_to, triangular
from sim2gp.inference.linear_likelihood import LinearLikelihood
from sim2gp.inference.prior import AbstractPrior
from sim2gp.systems.assemble import free_parts
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.effects.registry import Candidate
from sim2gp.types import AnyArray, in_float64

ALIAS = 1e-5  # sine of the angle to the others' span; less cannot be separated
SHARED = 0.3  # of a column: a parameter that explains so much of it is named
FARTHEST = 3.0  # prior sd, of a refit's start


@dataclass(frozen=True)
class ScoredCandidate:
    """A candidate compared with the bare machine, by one linearisation.

    ``gain`` is the evidence that it is worth, nats; ``sine`` the part of its effect
    that no parameter of the machine can mimic, ``partners`` those that mimic the rest.
    ``starts`` are where a fit of ``system`` should start, whitened by its prior, the
    best first.
    """

    candidate: Candidate
    system: AbstractSystem
    gain: float
    sine: float
    partners: tuple[str, ...]
    starts: Float[np.ndarray, "S p"]

    @property
    def alias(self) -> bool:
        """Whether one of the machine's own parameters has the same effect."""
        return self.sine < ALIAS


@in_float64
def score_candidates(
    data: AbstractData, bare: Estimate, candidates: Sequence[Candidate]
) -> list[ScoredCandidate]:
    """Every candidate by its linearisation at the bare machine's MAP."""
    machine, n = data.system, bare.nuisances.shape[1]
    names, likelihood = machine.parameters.names, data.likelihood(machine)
    smooth = [c.effect for c in candidates if c.smooth]
    # One machine with all of these: one compilation, one simulation.
    whole = free_parts(machine, smooth)
    mode = dict(zip(names, np.asarray(bare.z()).tolist(), strict=True))
    z = _extended(mode, whole, {e.name: 0.0 for e in smooth})
    every = np.asarray(data.blocks(whole, z[None], bare.nuisances)[0])

    def linear(blocks: np.ndarray, z: np.ndarray) -> _Linear:
        return _linear(data, likelihood, bare, blocks, z)

    plain = _select_columns(every, whole, [*names, None], n)
    without = linear(plain, np.asarray([*mode.values(), 0.0]))
    out = []
    for candidate in candidates:
        period = data.period or None
        system = free_parts(machine, [candidate.effect], period=period)
        order = [*names, candidate.name]
        z = np.stack(
            [_extended(mode, system, {candidate.name: x}) for x in candidate.grid]
        )
        if candidate.smooth:
            found = _select_columns(every, whole, order, n)[None]
        else:
            each = np.asarray(data.blocks(system, z, bare.nuisances))
            found = np.stack([_select_columns(b, system, order, n) for b in each])
        own = [system.parameters.names.index(name) for name in order]
        fits = [linear(b, x) for b, x in zip(found, z[:, own], strict=True)]
        gains = [
            tempered_gain(f.evidence - without.evidence, f.inflation, f.sd)
            for f in fits
        ]
        ranked = np.argsort(-np.asarray(gains), kind="stable")
        steps = np.stack([fit.z for fit in fits])[ranked]
        steps[:, -1] = np.clip(steps[:, -1], -FARTHEST, FARTHEST)
        # Where the linearisation is poor, its points are better starts than its MAPs.
        starts = np.zeros((2 * len(z), len(own)))
        starts[:, own] = np.concatenate([steps, z[ranked][:, own]])
        best = int(ranked[0])
        sine, shared = _alias(found[best], bare)
        partners = tuple(names[j] for j in shared)
        out.append(
            ScoredCandidate(candidate, system, gains[best], sine, partners, starts)
        )
    return out


@dataclass(frozen=True)
class _Linear:
    """A linearised fit: log evidence, MAP, the last unknown's sd and inflation."""

    evidence: float
    z: Float[np.ndarray, " p"]
    sd: float
    inflation: float


def _linear(
    data: AbstractData,
    likelihood: AbstractLikelihood,
    bare: Estimate,
    blocks: np.ndarray,
    z: np.ndarray,
) -> _Linear:
    """The fit of a likelihood that is linear around ``z``."""
    rows = data.system.parameters.measurement_rows(bare.prior, bare.z())
    rows = jnp.insert(rows, -1, 0.0, axis=1)  # no sum has the candidate in it
    counts, floor = likelihood.counts, likelihood.floor
    z0 = jnp.asarray(z)
    standard = Gaussian(jnp.zeros_like(z0), jnp.eye(z0.size))
    found = estimate(
        LinearLikelihood(
            counts, floor, jnp.asarray(blocks), z0, bare.nuisances, bare.noise
        ),
        _LinearPrior(standard, rows, z0),
        starts=z0[None],
        nuisances=bare.nuisances,
        freedom=jnp.asarray(data.freedom),
    )
    root = np.asarray(found.posterior.scale)
    row = root @ root[-1]
    inflation = sandwich_inflation(np.asarray(found.scores), data.cluster, row, -1)
    z = np.array(found.posterior.mean)
    return _Linear(float(found.log_evidence), z, math.sqrt(row[-1]), inflation)


class _LinearPrior(AbstractPrior):
    """Whitened already; the rows of measured sums are linear around ``z0``."""

    gaussian: Gaussian
    measured: Float[Array, "q p1"]
    z0: Float[Array, " p"]

    @property
    def linear(self) -> tuple[int, ...]:
        return ()

    def moved(self, z: Float[AnyArray, " p"], dz: Float[AnyArray, " p"]) -> AnyArray:
        return z + dz

    def rows(self, z: Float[Array, " p"]) -> Float[Array, "q p1"]:
        change = self.measured[:, :-1] @ (z - self.z0)
        return jnp.concatenate([prior_rows(z), self.measured.at[:, -1].add(change)])

    def curvature(
        self, z: Float[Array, " p"], gradient: Float[Array, " p"]
    ) -> Float[Array, "p p"]:
        return jnp.zeros((z.size, z.size))


def _alias(blocks: np.ndarray, bare: Estimate) -> tuple[float, list[int]]:
    """Sine between the last column and the others' span, and who lies closest."""
    noise, e = bare.noise, bare.nuisances
    R = np.asarray(eliminate(jnp.asarray(blocks), e, noise).data)[:, :-1]
    sine, share = sine_to(R[:, :-1], R[:, -1])
    order = np.argsort(-np.abs(share))
    return sine, [int(j) for j in order[:3] if abs(share[j]) > SHARED]


def sandwich_inflation(
    scores: Float[np.ndarray, "W p"],
    cluster: Int[np.ndarray, " W"],
    row: Float[np.ndarray, " p"],
    j: int,
) -> float:
    """Variance of unknown ``j`` with errors correlated in clusters, over the model's.

    The sandwich ``H^-1 G H^-1`` with ``G`` the outer products of the clusters' scores
    and ``row`` that of ``H^-1``; 1 for one cluster (its rows are independent), and
    never less than 1.
    """
    clusters = np.unique(cluster)
    if len(clusters) < 2:
        return 1.0
    each = np.stack([scores[cluster == k].sum(axis=0) for k in clusters])
    each = each - each.mean(axis=0)
    lost = len(clusters) / (len(clusters) - 1.0)  # to their own mean
    return max(1.0, lost * float(np.sum((each @ row) ** 2) / row[j]))


def tempered_gain(gain: float, inflation: float, sd: float) -> float:
    """The gain in evidence when the data count for less by ``inflation`` (k).

    With the magnitude's ``sd`` in prior sd, the data's information is
    ``I = 1 / sd^2 - 1``, Occam's price ``1/2 log(1 + I)``, and the rest of a gain
    ``1/2 m^2 I^2 / (1 + I)``; ``I / k`` takes the place of ``I`` in both. A gain that
    is not a number is none at all.
    """
    if not math.isfinite(gain):
        return -math.inf
    information = max(1.0 / sd**2 - 1.0, 0.0)
    less = information / inflation
    fit = gain + 0.5 * math.log1p(information)
    share = (1.0 + information) / (inflation**2 * (1.0 + less))
    return fit * share - 0.5 * math.log1p(less)


def sd_widening(inflation: float, sd: float) -> float:
    """How many times ``sd`` (in prior sd) the magnitude is uncertain by then."""
    information = max(1.0 / sd**2 - 1.0, 0.0)
    return math.sqrt((1.0 + information) / (1.0 + information / inflation))


def _extended(
    mode: Mapping[str, float], system: AbstractSystem, added: Mapping[str, float]
) -> Float[np.ndarray, " p"]:
    """The bare MAP and physical values of what is added, whitened by the prior."""
    known, table = dict(mode), system.parameters
    for name, x in added.items():
        known[name] = (table[name].unconstrain(x) - table[name].mean) / table[name].sd
    return np.asarray([known[name] for name in table.names])


def _select_columns(
    blocks: np.ndarray, system: AbstractSystem, names: Sequence[str | None], n: int
) -> np.ndarray:
    """The factors of some parameters' columns, in this order; None is an empty one.

    The ``n`` nuisances stay before them, the residuals behind.
    """
    known = system.parameters.names
    parts = [blocks[..., :n]]
    for name in names:
        at = None if name is None else n + known.index(name)
        parts.append(np.zeros_like(blocks[..., :1]) if at is None else
                     blocks[..., at : at + 1])  # fmt: skip
    kept = np.concatenate([*parts, blocks[..., -1:]], axis=-1)
    flat = jnp.asarray(kept.reshape(-1, *kept.shape[-2:]))
    k = kept.shape[-1]
    return np.asarray(jax.vmap(triangular)(flat)[:, :k]).reshape(*kept.shape[:-2], k, k)
