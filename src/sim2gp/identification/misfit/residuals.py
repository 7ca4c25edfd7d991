"""The misfit tests of a fit: its residuals at the MAP, and what they might depend on.

One-step fits leave one row for each transition. Windows of real logs leave one row for
each sample, and each window its own start state, whose part is projected out; within a
window rows are tested for correlation, between windows they are not. An open-loop
simulation whose model errs at all drifts, so that on real machines these tests
raise the alarm as a rule: that is right, the posterior counts every sample as new.
"""

import numpy as np
from jaxtyping import Array, Float, Int

from sim2gp.data.one_step import OneStepLikelihood, compiled_rows
from sim2gp.data.transitions import earlier_inputs, episode_numbers
from sim2gp.data.windows import Windows
from sim2gp.data.windows_likelihood import AnyWindows, linearise_some
from sim2gp.identification.misfit.tests import Misfit, misfit
from sim2gp.inference.estimate import Estimate
from sim2gp.inference.gaussian import Gaussian
from sim2gp.systems.base import Channel
from sim2gp.types import in_float64


@in_float64
def misfit_of_transitions(
    likelihood: OneStepLikelihood,
    prior: Gaussian,
    posterior: Gaussian,
    noise: Float[Array, " d"],
) -> Misfit:
    """Of a one-step fit and the transitions it was fitted to.

    An episode goes on where a row starts in the state in which the last one ended.
    """
    system, data = likelihood.system, likelihood.data
    N = data.count
    found = compiled_rows(likelihood, posterior.mean, prior.scale)
    r, J = (np.asarray(x)[:N] for x in found)
    sd = np.asarray(noise)
    s, a, s2 = data.held
    episode = episode_numbers(s, s2)
    states = system.physical_states
    return misfit(
        r / sd,
        np.concatenate([encode_angles(s[:, : len(states)], states), a], axis=1),
        jacobian=J / sd[:, None],
        past=earlier_inputs(a, episode),
        group=episode,
        channels=[channel.name for channel in states],
    )


@in_float64
def misfit_of_windows(likelihood: AnyWindows, fitted: Estimate) -> Misfit:
    """Of a fit and its windows; of very many, of some that are evenly spread.

    One-step windows have no start state of their own, and are tested as transitions.
    """
    system = likelihood.system
    cut, fitted, found = linearise_some(likelihood, fitted)
    r, J, s, a = (np.concatenate(np.asarray(x)) for x in found)
    weight = np.sqrt(np.repeat(np.asarray(fitted.noise.weights), cut.mask.shape[1]))
    scale = weight[:, None] / np.asarray(fitted.noise.sd)
    mask = np.asarray(cut.mask).reshape(r.shape)
    kept = mask.any(axis=1)
    p = fitted.prior.mean.size
    free = bool(np.any(np.asarray(cut.start_sd) > 0.0))
    number = np.arange(len(cut)) if free else _successive(cut)
    group = np.repeat(number, cut.mask.shape[1])[kept]
    J = (J * scale[..., None])[kept]
    states = system.physical_states
    return misfit(
        (r * scale)[kept],
        np.concatenate([encode_angles(s, states), a], axis=1)[kept],
        jacobian=J[..., :p],
        nuisance=J[..., p:] if free else None,
        group=group,
        mask=mask[kept],
        channels=[states[i].name for i in cut.outputs],
        rows="samples",
    )


def encode_angles(
    x: Float[np.ndarray, "N n"], channels: tuple[Channel, ...]
) -> Float[np.ndarray, "N k"]:
    """The columns, angles as sine and cosine."""
    columns = [
        f(x[:, i])
        for i, channel in enumerate(channels)
        for f in ((np.sin, np.cos) if channel.angle else (np.asarray,))
    ]
    return np.stack(columns, axis=1)


def _successive(cut: Windows) -> Int[np.ndarray, " W"]:
    """One number for one-step windows each of which starts where the last one ended."""
    end = np.sum(np.asarray(cut.y), axis=1, where=np.asarray(cut.mask))
    start = np.asarray(cut.start)[:, list(cut.outputs)]
    return episode_numbers(start, end)
