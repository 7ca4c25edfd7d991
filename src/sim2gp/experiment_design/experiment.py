"""The expected information of an experiment: the likelihood of logs not yet recorded.

The commands are held over each period, the outputs are sampled at its ends, and what is
learned is exactly what `data.windows` would learn from that log: windows that do not
overlap, each with an unknown start, noise of the sensors on every sample. Only the
derivatives of that likelihood are needed, and they do not depend on what comes out.
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sim2gp import checks
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.least_squares import over
from sim2gp.inference.linalg import triangular
from sim2gp.inference.linearized import value_and_jacobian
from sim2gp.systems.base import (
    DELAY_BLUR,
    WINDOW_SUBSTEP,
    AbstractSystem,
    steps_in,
)
from sim2gp.systems.simulate import HeldInputs, simulate

#: Commands over each period, in the units of the inputs.
Commands = Float[Array, "T m"]


class Experiment(eqx.Module):
    """Everything about an experiment but its commands.

    belief: over virtual parameters, before it; information is counted from it.
    corrected: the same as wide as the model's errors make it, or None: the limits of
        the states must hold for machines that are drawn from it.
    noise: sd of each measured output; ``outputs`` are their indices among the states.
    start: the state that the machine is in when it begins.
    start_sd: how uncertain the start of every window is, before its samples.
    period: of commands and samples, s; ``window`` periods make a window.
    substep: of the integration at most, s.

    Raises `InputError` E144 for a sd that cannot be, E148 for another number, E140 for
    arrays of another shape.
    """

    system: AbstractSystem
    belief: Gaussian
    noise: Float[Array, " c"]
    start: Float[Array, " n"]
    start_sd: Float[Array, " n"]
    outputs: tuple[int, ...] = eqx.field(static=True)
    period: float = eqx.field(static=True)
    steps: int = eqx.field(static=True)
    window: int = eqx.field(static=True)
    substep: float = eqx.field(static=True, default=WINDOW_SUBSTEP)
    corrected: Gaussian | None = None

    def __check_init__(self) -> None:
        checks.deviation("Experiment", noise=self.noise)
        checks.deviation_or_zero("Experiment", start_sd=self.start_sd)
        checks.finite("Experiment", start=self.start)
        checks.positive("Experiment", period=self.period, substep=self.substep)
        checks.count("Experiment", steps=self.steps, window=self.window)
        n = len(self.system.physical_states)
        checks.index("Experiment", n, outputs=self.outputs)
        checks.same_shape("Experiment", (n,), start=self.start, start_sd=self.start_sd)
        checks.same_shape("Experiment", (len(self.outputs),), noise=self.noise)

    @property
    def substeps(self) -> int:
        """Of the integration, in a period."""
        return int(steps_in(self.period, self.substep))

    @property
    def plausible(self) -> Gaussian:
        """What the machine may be, with the errors of the model allowed for."""
        return self.belief if self.corrected is None else self.corrected

    def record(self, tt: Float[Array, " p"]) -> Any:
        """The parameters at virtual values."""
        return self.system.record(self.system.parameters.values(tt))


def trajectory(
    experiment: Experiment, tt: Float[Array, " p"], U: Commands
) -> Float[Array, "times n"]:
    """States at the beginning and after each period, for one machine."""
    whole = piece(experiment, U, 0, experiment.steps)
    params = experiment.record(tt)
    states = simulate(experiment.system, params, whole, experiment.start)
    return states[:: experiment.substeps]


def information(
    experiment: Experiment,
    z: Float[Array, " p"],
    U: Commands,
    states: Float[Array, "times n"],
) -> Float[Array, "rows p"]:
    """Rows that square to the Fisher information about the belief's ``z``.

    At one machine of the belief, whose `trajectory` is ``states``. In its units:
    ``I + A^T A`` is the precision after the experiment. Starts are eliminated window by
    window, by orthogonal projection.
    """
    p, n, belief = z.size, states.shape[1], experiment.belief
    count = experiment.window
    first = jnp.arange(0, experiment.steps - count + 2, count)
    outputs = np.asarray(experiment.outputs)

    def one(i: Array) -> Array:
        window, x0 = piece(experiment, U, i, count - 1), states[i]

        def seen(x: Array) -> Array:
            params = experiment.record(belief.at(z + x[n:]))
            start = x0 + experiment.start_sd * x[:n]
            found = simulate(experiment.system, params, window, start)
            rows = found[:: experiment.substeps, outputs] / experiment.noise[None]
            return rows.ravel()

        _, J = value_and_jacobian(seen, jnp.zeros(n + p, z.dtype))
        return about_constants(J, n)

    return jax.vmap(one)(first).reshape(-1, p)


def about_constants(J: Float[Array, "N q"], n: int) -> Float[Array, "rows p"]:
    """Rows in all of a window's unknowns as rows in its parameters alone.

    What an unknown start, of unit prior, explains as well is projected out: twice, as
    the second time takes what rounding left. Every factor here has full rank, so that
    plans can be improved along its gradient.
    """
    S = jnp.concatenate([J[:, :n], jnp.eye(n, dtype=J.dtype)])
    P = jnp.concatenate([J[:, n:], jnp.zeros((n, J.shape[1] - n), J.dtype)])
    Q = over(S, triangular(S))
    for _ in range(2):
        P = P - Q @ (Q.T @ P)
    return P


def sensitivity_at(
    experiment: Experiment, U: Commands, periods: int
) -> Float[Array, "k p"]:
    """How predictions of so many periods move with the virtual parameters.

    From states along the way, which are known: a row for each output of each
    prediction, in noise sd.
    """
    system, tt = experiment.system, experiment.belief.mean
    states = trajectory(experiment, tt, U)
    first = jnp.arange(0, experiment.steps - periods + 1, periods)
    outputs = np.asarray(experiment.outputs)

    def one(i: Array) -> Array:
        window = piece(experiment, U, i, periods)

        def ahead(tt: Array) -> Array:
            found = simulate(system, experiment.record(tt), window, states[i])
            return found[-1, outputs] / experiment.noise

        return value_and_jacobian(ahead, tt)[1]

    return jax.vmap(one)(first).reshape(-1, tt.size)


def posterior_scale(belief: Gaussian, A: Float[Array, "rows p"]) -> Float[Array, "p p"]:
    """Square root of the covariance once the experiment was made."""
    eye = jnp.eye(A.shape[1], dtype=A.dtype)
    return over(belief.scale, triangular(jnp.concatenate([A, eye])))


def piece(experiment: Experiment, U: Commands, first: Any, periods: int) -> HeldInputs:
    """Some periods, and the inputs that reach them; at rest before the experiment."""
    period, count = experiment.period, experiment.substeps
    reach = experiment.system.longest_delay + DELAY_BLUR
    before, later = math.ceil(reach / period) + 1, math.ceil(DELAY_BLUR / period) + 1
    held = jnp.concatenate(
        [jnp.zeros((before, U.shape[1]), U.dtype), U, jnp.repeat(U[-1:], later, axis=0)]
    )
    area = jnp.concatenate([jnp.zeros_like(U[:1]), jnp.cumsum(held * period, axis=0)])
    rows = before + periods + later + 1
    area = jax.lax.dynamic_slice_in_dim(area, first, rows)
    knots = period * (jnp.arange(rows, dtype=U.dtype) - before)
    span = jnp.full(periods * count + 1, period / count, U.dtype).at[0].set(0.0)
    return HeldInputs(span, knots, area - area[:1])
