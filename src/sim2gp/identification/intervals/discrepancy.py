"""The corrected intervals of a fit: of its windows, and of what its simulator may lack.

Forces that the machine may lack (`sim2gp.systems.effects.forces`) are more unknowns, as
far as no parameter of the machine acts alike. They are zero at the fit. The windows are
linearised there, `sim2gp.identification.intervals.scatter` gives the posterior of all
unknowns, and they are linearised there again, until the centre stays: physics that is
missing may have taken the fit far from it. The noise stays the fit's, which has the
misfit in it: that makes intervals rather too wide than too narrow.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import eigh

from sim2gp.data.cuts import Cuts
from sim2gp.data.windows import Windows
from sim2gp.data.windows_likelihood import compile_linearise
from sim2gp.identification.intervals.averaging import Groups
from sim2gp.identification.intervals.pulls import (
    Pulls,
    WindowRows,
    pulls_of_rows,
    rows_of,
)
from sim2gp.identification.intervals.scatter import (
    CorrectedFit,
    correct_posterior,
)
from sim2gp.identification.missing_physics.at_zero import (
    AtZero,
    forces_of,
    kinds_of,
)
from sim2gp.identification.missing_physics.curves import curves_of
from sim2gp.identification.missing_physics.reach import box_of
from sim2gp.inference.gaussian import Gaussian
from sim2gp.systems.assemble import free_parts
from sim2gp.systems.base import AbstractSystem
from sim2gp.types import in_float64

#: Sine of the angle to the parameters' span below which a force is one of them in
#: another shape; and of what has no effect at all, next to the largest of its group.
DISGUISE, NO_EFFECT = 0.05, 1e-6
TRUSTED = 1.0  # nats that a centre may cost beyond what the linear misfit says
GAIN = 0.5  # of a gain that the linear misfit predicts: what may fail to come
HALVINGS = 6
ROUNDS = 6  # linearisations
SETTLED = 0.1  # of its sd: no parameter's centre moves by more than this
#: The same where it goes back: halfway is then as near. Delays and dry friction bend a
#: simulation where a linearisation cannot see it: smaller steps may never come.
SETTLED_BACK = 0.5


def compile_corrected(system: AbstractSystem, cut: Windows | Cuts) -> None:
    """Start to compile what `corrected_windows` will ask, while a fit goes on.

    The machine's own linearisation, which others ask, too, comes first.
    """
    forces = forces_of(system, box_of(system, cut))
    machines = (system, free_parts(system, forces)) if forces else (system,)
    for machine in machines:
        compile_linearise(machine, cut)


@in_float64
def corrected_windows(start: AtZero) -> CorrectedFit:
    """The corrected posterior of a fit's parameters, checked with the simulator itself.

    ``start`` is the fit, with the forces that its machine may lack. Raises `NotFinite`
    E203.
    """
    whole, own, wider = start.fitted, start.own, start.likelihood
    system, p = wider.system, len(own)
    mean, scale = (np.asarray(x) for x in (whole.prior.mean, whole.prior.scale))
    rows = start.rows
    pulls = pulls_of_rows(rows, start.group)
    T, groups = _identifiable(pulls, own, system.parameters.groups)
    k = T.shape[1]
    prior = Gaussian(np.zeros(k), np.eye(k))
    at = np.zeros(k)
    at[:p] = np.asarray(whole.z())[own]
    onto, before = _Onto(mean, scale @ T), at
    for _ in range(ROUNDS):
        here = pulls.onto(T)
        found = correct_posterior(prior, Gaussian(at, prior.scale), here, groups)
        if not found.enough:
            return replace(found, posterior=start.alone.posterior)
        posterior = found.posterior.on_host()
        to, settled = _next(posterior, before, at)
        before = at
        if groups and settled:  # a linearisation of all forces is saved
            at = to
            break
        at, rows = _trusted(start, rows, here, onto, at, to, found.inflation)
        moved = np.abs(at - before) / posterior.sd()
        if not groups or np.max(moved) <= SETTLED:
            break
        pulls = pulls_of_rows(rows, start.group)
    both = Gaussian(onto(at), onto.scale @ posterior.scale)
    return replace(
        found,
        posterior=jax.device_put(both.marginal(own)),
        curves=curves_of(system, start.forces, start.box, both),
    )


def _next(
    posterior: Gaussian, before: Float[np.ndarray, " k"], at: Float[np.ndarray, " k"]
) -> tuple[Float[np.ndarray, " k"], bool]:
    """The next centre, and whether it is as good as ``at``, which followed ``before``.

    Halfway to the posterior's where that is back: the last step was too long.
    """
    to, sd = posterior.mean, posterior.sd()
    last, here, there = (posterior.whitened(x) for x in (before, at, to))
    back = (there - here) @ (here - last) < 0.0
    settled = np.max(np.abs(to - at) / sd) <= (SETTLED_BACK if back else SETTLED)
    return 0.5 * (at + to) if back else to, bool(settled)


class _Onto(NamedTuple):
    """Virtual values of reduced coordinates."""

    mean: Float[np.ndarray, " p"]
    scale: Float[np.ndarray, "p k"]

    def __call__(self, c: Float[np.ndarray, " k"]) -> Float[np.ndarray, " p"]:
        return self.mean + self.scale @ c


def _identifiable(
    pulls: Pulls, own: Int[np.ndarray, " o"], groups: Groups
) -> tuple[Float[np.ndarray, "p k"], Groups]:
    """Coordinates of parameters and forces, without what parameters do as well.

    A smooth force of the velocity may be a damping: what acts so is called damping. Of
    each group the directions remain that no parameters mimic, with the prior that it
    has given that there are no others. Groups of a kind are on together: a joint alone
    may show too little of its friction to tell it from damping, and of all inputs the
    gains may be the masses' scale.
    """
    A = np.asarray(np.linalg.qr(pulls.rows, mode="r"))
    Q, R = np.linalg.qr(A[:, own])
    Q = Q[:, np.abs(np.diag(R)) > 1e-12 * np.abs(R).max(initial=0.0)]
    parts, found, start = [np.eye(A.shape[1])[:, own]], {}, len(own)
    for kind, all_places in kinds_of(groups).items():
        kept = _apart(A[:, all_places], Q)
        W = np.zeros((A.shape[1], kept.shape[1]))
        W[all_places] = kept
        parts.append(W)
        found[kind] = np.arange(start, start + kept.shape[1])
        start += kept.shape[1]
    return np.concatenate(parts, axis=1), found


def _apart(
    G: Float[np.ndarray, "k g"], Q: Float[np.ndarray, "k p"]
) -> Float[np.ndarray, "g d"]:
    """Orthonormal directions of a group whose effect is not in the span of ``Q``.

    They solve ``rest^T rest w = sine^2 G^T G w``. What does nothing at all has no angle
    and stays; a group that does nothing is left out.
    """
    size = np.linalg.norm(G)
    if size == 0.0:
        return np.zeros((G.shape[1], 0))
    slack = (NO_EFFECT * size) ** 2 * np.eye(G.shape[1])
    rest = G - Q @ (Q.T @ G)
    sine2, kept = eigh(rest.T @ rest + slack, G.T @ G + slack)
    return np.asarray(np.linalg.qr(kept[:, sine2 > DISGUISE**2])[0])


def _trusted(
    start: AtZero,
    rows: WindowRows,
    pulls: Pulls,
    onto: _Onto,
    at: Float[np.ndarray, " k"],
    to: Float[np.ndarray, " k"],
    inflation: float,
) -> tuple[Float[np.ndarray, " k"], WindowRows]:
    """As far towards ``to`` as the linear misfit may be believed, and the rows there.

    Near a bound the machine is not linear in ``z``, and a centre far from the MAP is
    one that no data suggest. So halfway back, and again, until the misfit there is no
    more than the linear one, to `TRUSTED` nats of data that count as often as they
    should, or half of what is gained.
    """
    dz = to - at
    score, F = pulls.scores.sum(axis=0), pulls.fisher
    for share in 0.5 ** np.arange(HALVINGS):
        there = at + share * (to - at)
        tt = jnp.asarray(onto(there))
        found = rows_of(start.likelihood, start.fitted, tt, start.group)
        linear = share * dz @ (score + 0.5 * share * F @ dz)
        slack = TRUSTED * max(inflation, 1.0) + GAIN * max(-linear, 0.0)
        if found.cost - rows.cost - linear <= slack:
            return there, found
    return at, rows
