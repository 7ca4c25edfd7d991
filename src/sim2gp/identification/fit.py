"""The posterior of a machine's parameters, from windows of its logs."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from sim2gp import checks
from sim2gp.data.cuts import Cuts
from sim2gp.data.windows import AT_A_TIME, Windows, evenly_spread
from sim2gp.data.windows_likelihood import CutsLikelihood, WindowsLikelihood
from sim2gp.errors import NotConverged
from sim2gp.inference.arrowhead import Noise
from sim2gp.inference.estimate import Estimate, Report, drawn_starts, estimate
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.in_parts import estimate_in_parts
from sim2gp.inference.prior import ParameterPrior
from sim2gp.systems.base import AbstractSystem
from sim2gp.types import Key, in_float64

#: Share of the windows that a fit on the host begins with, how few they may be, and of
#: how many rows: of fewer, all windows are as fast. So near to its MAP, in posterior
#: sd, that part comes: all windows have another one.
SHARE, LEAST, MANY = 0.2, 2, 500
NEAR = 1.0
FREEDOM = 4.0  # degrees of freedom of the Student-t weight


@in_float64
def fit_windows(
    system: AbstractSystem,
    windows: Windows | Cuts,
    *,
    key: Key,
    prior: Gaussian | None = None,
    robust: bool = False,
    starts: int = 2,
    warm_start: Estimate | None = None,
    report: Report | None = None,
) -> Estimate:
    """Posterior of the parameters given windows of logs.

    Noise by EM, one Student-t weight per window where ``robust``. A ``prior`` is what
    is believed but for measured sums. The descent begins at the prior's mean and
    elsewhere, or at the ``warm_start``, another fit of windows like these: that is
    quick, and with as many ``starts`` compiles nothing. Where a simulator on the host
    moves the machine, ``report`` is called after each step, and starts are compared on
    some of the windows. `Cuts` are fitted in parts, after some of their windows.
    Raises `NotConverged`, `NotFinite` or `DeadParameters`, and `InputError` E148 for no
    starts, E140 for a prior of another number of parameters.
    """
    checks.count("fit_windows", starts=starts)
    prior = system.parameters.prior() if prior is None else prior
    p = len(system.parameters)
    checks.same_shape("fit_windows", (p,), prior=prior.mean)
    about = ParameterPrior(prior, system.parameters)
    freedom = FREEDOM if robust else np.inf
    if isinstance(windows, Cuts):
        how: dict[str, Any] = {"key": key, "robust": robust, "starts": starts}
        known = warm_start or _fit_of_some(system, windows, prior=prior, **how)
        data = CutsLikelihood(system, windows)
        found = estimate_in_parts(data, about, known, freedom)
        return _checked(found, system, len(windows))
    likelihood = WindowsLikelihood(system, windows)
    if warm_start is None:
        zeros = np.zeros if likelihood.on_host else jnp.zeros
        first = drawn_starts(zeros((1, p)), starts, key)
        e, noise = np.zeros(windows.start.shape), likelihood.first_noise()
    else:
        first = np.full((starts, p), np.nan)
        first[0] = prior.on_host().whitened(np.asarray(warm_start.posterior.mean))
        e, noise = warm_start.nuisances, warm_start.noise
    begin = first, e, noise, freedom
    # By way of NumPy: JAX compiles again for numbers whose type it calls weak.
    begin = jax.device_put(jax.tree.map(np.asarray, begin))
    first, e, noise, freedom = begin
    same: dict[str, Any] = {"freedom": freedom, "report": report}
    some = _first_windows(likelihood) if warm_start is None else None
    if some is not None:
        part = likelihood.some(some)
        found = estimate(part, about, starts=first, until=NEAR, **same)
        first, e = found.z()[None], e.at[some].set(found.nuisances)
        noise = Noise(found.noise.sd, jnp.ones(len(windows)))
    from_here = {"starts": first, "nuisances": e, "noise": noise}
    found = estimate(likelihood, about, **from_here, **same)
    return _checked(found, system, len(windows))


def _checked(found: Estimate, system: AbstractSystem, count: int) -> Estimate:
    """The estimate, if its descent has ended at a MAP; its error knows it."""
    try:
        found.convergence.check(system.parameters.names, f"{count} windows")
    except NotConverged as error:
        error.known = found
        raise
    return found


def _fit_of_some(system: AbstractSystem, windows: Cuts, **how: Any) -> Estimate:
    """Of windows that are spread over all; the others are at their guessed starts."""
    W, size = len(windows), max(LEAST, AT_A_TIME // windows.length)
    some = evenly_spread(size, W)
    found = fit_windows(system, windows.some(some), **how)
    whole = found.of_windows(W)
    e = np.asarray(whole.nuisances)
    e[some] = found.nuisances
    return replace(whole, nuisances=e)


def _first_windows(likelihood: WindowsLikelihood) -> Int[np.ndarray, " w"] | None:
    """Windows that a fit on the host begins with, spread over all; None for all."""
    W = len(likelihood.counts)
    count = max(LEAST, round(SHARE * W))
    few = likelihood.windows.span.size < MANY
    if not likelihood.on_host or few or 2 * count > W:
        return None
    return evenly_spread(count, W)
