"""A draft's parameters: one linearisation of the logs says which are worth opening.

Windows of the logs are simulated and differentiated once, at the file's numbers, with
all candidates open. The linear fit of that learns the noise, and what the data know of
each parameter once start states and delays are eliminated; `select_parameters` chooses.
"""

import time
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from sim2gp.data.logs import Log
from sim2gp.data.split_log import cut
from sim2gp.data.windows import Windows, channel_motion
from sim2gp.data.windows_likelihood import WindowsLikelihood
from sim2gp.errors import NotFinite, error
from sim2gp.identification.identifiability.selection import (
    Selection,
    select_parameters,
)
from sim2gp.inference.arrowhead import Noise
from sim2gp.inference.estimate import estimate
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.linear_likelihood import LinearLikelihood
from sim2gp.inference.prior import ParameterPrior
from sim2gp.project.project import Project
from sim2gp.systems import MuJoCo
from sim2gp.systems.machine import as_machine
from sim2gp.types import in_float64

SECONDS = 30.0  # of the logs, that are linearised at most
AT_ONCE = 5  # windows, between two looks at the clock


def try_selection(
    project: Project, logs: Sequence[Log], started: float, seconds: float
) -> tuple[Selection | None, str]:
    """`select_constants` within ``seconds`` of ``started``, or why it is not known."""
    try:
        return select_constants(project, logs, until=started + seconds), ""
    except TimeoutError:
        return None, f"not tried: the {seconds:g} s were over"
    except NotFinite as error:
        return None, f"not known: {error.what}"


@in_float64
def select_constants(
    project: Project, logs: Sequence[Log], *, until: float
) -> Selection:
    """Which of a project's open parameters the logs can separate.

    Only those of a model's file are ever held: another machine's table has priors of
    its own. Raises `TimeoutError` where the logs cannot be linearised ``until`` (of
    `time.monotonic`, s), and `NotFinite` where the model does not follow them.
    """
    system, length = project.system, project.window
    plant, table = as_machine(system).plant, system.parameters
    if not isinstance(plant, MuJoCo):
        return Selection({}, {})
    windows, _ = cut(logs, system, window=length)
    some = _by_motion(windows)[: max(1, round(SECONDS / length))]
    size = min(AT_ONCE, len(some))
    # Of equal size, so that one program serves all of them.
    batches = some[: len(some) // size * size].reshape(-1, size)
    prior, likelihood = table.prior(), WindowsLikelihood(system, windows)
    linear = _linearise_prior(likelihood, prior, batches, until)
    zeros = jnp.zeros((1, len(table)))
    fitted = estimate(linear, ParameterPrior(prior, table), starts=zeros)
    if not np.isfinite(fitted.log_evidence):
        raise _not_finite()
    # Windows that are left out are taken to have as much information as the others.
    factor = fitted.information * np.sqrt(len(windows) / batches.size)
    nuisances = [name for name in table.names if name not in plant.names]
    return select_parameters(table, prior, factor, nuisances=nuisances)


def _linearise_prior(
    likelihood: WindowsLikelihood,
    prior: Gaussian,
    batches: Int[np.ndarray, "B w"],
    until: float,
) -> LinearLikelihood:
    """The likelihood of these windows about the prior's mean."""
    tt = np.asarray(prior.mean)
    parts, seconds = [], 0.0
    for which in batches:
        started = time.monotonic()
        if started + seconds > until:
            raise TimeoutError
        part = likelihood.some(which)
        e = np.zeros((len(which), part.n_nuisances))
        with np.errstate(over="ignore", invalid="ignore"):
            parts.append(part.trial(tt, e, np.eye(tt.size)).blocks())
        seconds = time.monotonic() - started
    blocks, which = np.concatenate(parts), batches.ravel()
    if not np.isfinite(blocks).all():
        raise _not_finite()
    # The first noise of a fit is that of all windows: a large one.
    noise = Noise(likelihood.first_noise().sd, jnp.ones(len(which)))
    counts, e = likelihood.counts[which], np.zeros((len(which), likelihood.n_nuisances))
    return LinearLikelihood(counts, likelihood.floor, blocks, tt, e, noise)


def _not_finite() -> NotFinite:
    return error("model_leaves_logs", NotFinite)


def _by_motion(windows: Windows) -> Int[np.ndarray, " W"]:
    """Windows in order: those in which some channel moves most, channel by channel."""
    place = np.argsort(np.argsort(-channel_motion(windows), axis=0), axis=0)
    return np.argsort(place.min(axis=1), kind="stable")
