"""The corrected intervals of a fit: of its windows, and of what its simulator may lack.

Every effect of the machine's library becomes one more unknown, unless a parameter of
the machine acts alike. It is zero at the fit. The windows are linearised there,
`sim2gp.identification.intervals.scatter` gives the posterior of all unknowns, and they
are linearised there again, until the centre stays: physics that is missing may have
taken the fit far from it. The noise stays the fit's, which has the misfit in it: that
makes intervals rather too wide than too narrow.
"""

from collections.abc import Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from sim2gp.data.windows import Windows
from sim2gp.data.windows_likelihood import WindowsLikelihood, compile_linearise
from sim2gp.identification.intervals.pulls import (
    Pulls,
    cost_of_rows,
    pulls_of_rows,
    rows_of,
)
from sim2gp.identification.intervals.scatter import (
    CorrectedFit,
    correct_posterior,
)
from sim2gp.identification.missing_physics.score import sine_to
from sim2gp.inference.estimate import Estimate
from sim2gp.inference.gaussian import Gaussian
from sim2gp.systems.assemble import free_parts
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.effects.registry import smooth_effects
from sim2gp.systems.parts import AbstractPart
from sim2gp.types import in_float64

#: Sine of the angle to the parameters' span below which an effect is one of them in
#: another shape, such as dry friction with another width.
DISGUISE = 0.02
TRUSTED = 1.0  # nats that a centre may cost beyond what the linear misfit says
GAIN = 0.5  # of a gain that the linear misfit predicts: what may fail to come
HALVINGS = 6
ROUNDS = 6  # linearisations
SETTLED = 0.1  # of its sd: no parameter's centre moves by more than this


def compile_corrected(system: AbstractSystem, cut: Windows) -> None:
    """Start to compile what `corrected_windows` will ask, while a fit goes on.

    The machine's own linearisation, which others ask, too, comes first.
    """
    compile_linearise(system, cut)
    effects = smooth_effects(system)
    if effects:
        compile_linearise(free_parts(system, effects), cut)


@in_float64
def corrected_windows(
    likelihood: WindowsLikelihood,
    fitted: Estimate,
    group: Int[np.ndarray, " W"],
    effects: Sequence[AbstractPart] | None = None,
) -> CorrectedFit:
    """The corrected posterior of a fit's parameters, checked with the simulator itself.

    ``effects`` are what it may lack, with their prior sd: None is its library, which a
    model of the user's own does not have. Raises `NotFinite` E203.
    """
    p, cut = fitted.prior.mean.size, likelihood.windows
    system = likelihood.system
    given = smooth_effects(system) if effects is None else tuple(effects)
    system, whole, own = _with_effects_at_zero(system, fitted, given)
    wider = WindowsLikelihood(system, cut)
    at = np.asarray(whole.posterior.mean)
    rows = rows_of(wider, whole, whole.posterior.mean)
    pulls = pulls_of_rows(rows, cut, group)
    order = np.concatenate([own, _identifiable_effects(pulls, own)])
    lacking = np.arange(len(order)) >= p
    mean, scale = np.asarray(whole.prior.mean), np.asarray(whole.prior.scale)
    prior = Gaussian(*map(jnp.asarray, (mean[order], scale[np.ix_(order, order)])))
    for _ in range(ROUNDS):
        here = Gaussian(jnp.asarray(at[order]), prior.scale)
        found = correct_posterior(prior, here, pulls.of(order), lacking)
        if not found.enough:
            return replace(found, posterior=fitted.posterior)
        to = at.copy()
        to[order] = np.asarray(found.posterior.mean)
        to, rows = _trusted(wider, whole, rows, pulls, at, to, found.inflation)
        moved = np.abs(to - at)[order] / np.asarray(found.posterior.sd())
        at = to
        if len(order) == p or np.max(moved) <= SETTLED:
            break
        pulls = pulls_of_rows(rows, cut, group)
    both = Gaussian(jnp.asarray(at[order]), found.posterior.scale)
    if len(order) == p:
        return replace(found, posterior=both)
    mine = Gaussian(both.mean[:p], both.scale[:p]).triangular()
    names = system.parameters.names
    return replace(
        found,
        posterior=Gaussian(both.mean[:p], mine),
        effects=tuple(names[j] for j in order[p:]),
        lacking=Gaussian(both.mean[p:], both.scale[p:]),
    )


def _with_effects_at_zero(
    machine: AbstractSystem, fitted: Estimate, effects: Sequence[AbstractPart]
) -> tuple[AbstractSystem, Estimate, Int[np.ndarray, " p"]]:
    """The machine with effects, its estimate with all at nothing; its own columns."""
    if not effects:
        return machine, fitted, np.arange(fitted.prior.mean.size)
    system = free_parts(machine, effects)
    names, prior = system.parameters.names, system.parameters.prior()
    own = np.asarray([names.index(name) for name in machine.parameters.names])
    scale = prior.scale.at[np.ix_(own, own)].set(fitted.prior.scale)
    whole = replace(
        fitted,
        prior=Gaussian(prior.mean.at[own].set(fitted.prior.mean), scale),
        posterior=Gaussian(prior.mean.at[own].set(fitted.posterior.mean), scale),
        information=jnp.zeros_like(scale),  # of another machine
        scores=jnp.zeros((len(fitted.scores), len(scale))),
    )
    return system, whole, own


def _identifiable_effects(
    pulls: Pulls, own: Int[np.ndarray, " p"]
) -> Int[np.ndarray, " k"]:
    """The other columns with an effect that no parameters of the machine mimic."""
    A = np.asarray(np.linalg.qr(np.concatenate(list(pulls.factors)), mode="r"))
    others = np.setdiff1d(np.arange(A.shape[1]), own)
    kept = [j for j in others if sine_to(A[:, own], A[:, j])[0] > DISGUISE]
    return np.asarray(kept, int)


def _trusted(
    likelihood: WindowsLikelihood,
    fitted: Estimate,
    rows: Float[np.ndarray, "W k npr"],
    pulls: Pulls,
    at: Float[np.ndarray, " p"],
    to: Float[np.ndarray, " p"],
    inflation: float,
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "W k npr"]]:
    """As far towards ``to`` as the linear misfit may be believed, and the rows there.

    Near a bound the machine is not linear in ``z``, and a centre far from the MAP is
    one that no data suggest. So halfway back, and again, until the misfit there is no
    more than the linear one, to `TRUSTED` nats of data that count as often as they
    should, or half of what is gained.
    """
    cut = likelihood.windows
    dz = np.linalg.solve(np.asarray(fitted.prior.scale), to - at)
    score, F = pulls.scores.sum(axis=0), pulls.fisher.sum(axis=0)
    before = cost_of_rows(rows, cut)
    for share in 0.5 ** np.arange(HALVINGS):
        there = at + share * (to - at)
        found = rows_of(likelihood, fitted, jnp.asarray(there))
        linear = share * dz @ (score + 0.5 * share * F @ dz)
        slack = TRUSTED * max(inflation, 1.0) + GAIN * max(-linear, 0.0)
        if cost_of_rows(found, cut) - before - linear <= slack:
            return there, found
    return at, rows
