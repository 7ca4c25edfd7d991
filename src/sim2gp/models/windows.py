"""The likelihood of real logs: open-loop windows whose start states are unknown.

A log is cut into windows that do not overlap. Within one, the machine is simulated from
an unknown start state under the recorded inputs, and every measured sample is compared
once with the simulation at its own time stamp:

    y_j = x_out(t_j; theta, x0) + eps_j,    eps ~ N(0, diag(sig^2) / w)
    x0  = m0 + S0 e,                        e ~ N(0, I)

Velocities need not be measured, rates need not be known, rows may be missing. The start
states are the nuisances that `sim2gp.arrowhead` eliminates window by window, so memory
and time are linear in the data. ``w`` is one Student-t weight per window (1 if off).
``window = 0`` is the paper's one-step likelihood: two rows, and ``S0 = 0``.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sim2gp.ahead import ahead
from sim2gp.arrowhead import Blocks, Noise, eliminate
from sim2gp.em import expectation
from sim2gp.gaussian import Gaussian
from sim2gp.laplace import AbstractLikelihood, Fit, multi_start
from sim2gp.least_squares import factor
from sim2gp.models.informed import informed
from sim2gp.models.linearized import jacobian_by_columns, value_and_jacobian
from sim2gp.systems.base import AbstractSystem
from sim2gp.types import AnyArray, Key, Scalar, in_float64

NOISE_ROUNDS = 8  # fewer leave noise and starts of real logs short of a fixed point
FREEDOM = 4.0  # degrees of freedom of the Student-t weight
DELAY_BLUR = 4e-3  # s, of inputs that may be delayed


class Windows(eqx.Module):
    """Padded windows, a row for each end of an integration step.

    Row 0 is the start, padding rows have zero length, and a row without a sample (where
    the clock left a gap too long for one step) has a false mask. ``span`` is the time
    since the previous row, s. ``knots`` and ``area`` are the times and values at which
    the integral of the held input bends; between them it is straight, so its mean over
    any delayed interval is exact. ``outputs`` are the indices of the measured states,
    ``floor`` the sensors' resolution. ``configuration`` is the machine's, an index into
    its table's.
    """

    y: Float[AnyArray, "W L c"]
    mask: Bool[AnyArray, "W L c"]
    span: Float[AnyArray, "W L"]
    knots: Float[AnyArray, "W H"]
    area: Float[AnyArray, "W H m"]
    start: Float[AnyArray, "W n"]
    start_sd: Float[AnyArray, "W n"]
    floor: Float[AnyArray, " c"]
    configuration: Int[AnyArray, " W"]
    outputs: tuple[int, ...] = eqx.field(static=True)

    def __len__(self) -> int:
        return len(self.y)

    def each(self, f: Callable[..., Any], *per_window: Any) -> Any:
        """``f`` of one window (and of one row of each argument), for all windows."""
        axes = eqx.tree_at(lambda w: w.floor, jax.tree.map(lambda _: 0, self), None)
        return jax.vmap(f, in_axes=(axes, *[0] * len(per_window)))(self, *per_window)


class Stretch(eqx.Module):
    """What a simulation needs of a window: its steps, and the inputs that reach it."""

    span: Float[AnyArray, " L"]
    knots: Float[AnyArray, " H"]
    area: Float[AnyArray, "H m"]


def inputs_of(
    window: Windows | Stretch, delays: Float[Array, " m"], blur: float = 0.0
) -> Float[Array, "L m"]:
    """Mean delayed input over the step that ends at each row of one window.

    Where every step is as long as the input is held, all of these means bend at the
    same delays, and a fit is caught in the kink. ``blur`` (s) averages the held input
    over that width around each time first, which makes them smooth in the delay.
    """
    end = jnp.cumsum(window.span)
    # A row without length has no mean; its input does not matter but must be finite.
    h = jnp.where(window.span > 0.0, window.span, 1.0)

    def channel(area: Array, delay: Array) -> Array:
        def integral(t: Array) -> Array:
            if not blur:
                return jnp.interp(t, window.knots, area)
            twice = _second_integral(window.knots, area)
            return (twice(t + 0.5 * blur) - twice(t - 0.5 * blur)) / blur

        before = integral(-delay[None])
        return jnp.diff(jnp.concatenate([before, integral(end - delay)])) / h

    return jax.vmap(channel, in_axes=(1, 0), out_axes=1)(window.area, delays)


def _second_integral(
    knots: Float[Array, " H"], area: Float[Array, " H"]
) -> Callable[[Array], Array]:
    """The integral of a piecewise straight function, as a function of its end."""
    length = jnp.diff(knots)
    slope = jnp.diff(area) / length
    whole = jnp.cumsum(length * 0.5 * (area[1:] + area[:-1]))
    whole = jnp.concatenate([jnp.zeros_like(whole[:1]), whole])

    def at(t: Array) -> Array:
        k = jnp.clip(jnp.searchsorted(knots, t, side="right") - 1, 0, slope.size - 1)
        x = t - knots[k]
        return whole[k] + x * (area[k] + 0.5 * x * slope[k])

    return at


def simulate(
    system: AbstractSystem,
    params: Any,
    window: Windows | Stretch,
    x0: Float[Array, " n"],
) -> Float[Array, "L n"]:
    """States at the rows of one window, from ``x0`` at its first."""

    def step(x: Array, row: tuple[Array, Array]) -> tuple[Array, Array]:
        h, u = row
        x = system.flow(params, x, u, h)
        return x, x

    blur = DELAY_BLUR if system.longest_delay else 0.0
    inputs = inputs_of(window, system.delays(params), blur)
    # A gradient's way back takes each step again: a third of the time that it takes to
    # keep and fetch what every step has seen. What runs forward alone is not touched.
    again = jax.checkpoint(step, prevent_cse=False)
    return jax.lax.scan(again, x0, (window.span, inputs))[1]


class WindowsBelief(eqx.Module):
    """What logs say: a Gaussian over virtual parameters, and the noise of each sensor.

    ``starts`` are the smoothed start states of the training windows.
    """

    system: AbstractSystem
    prior: Gaussian
    posterior: Gaussian
    noise: Float[Array, " c"]
    information: Float[Array, "p p"]  # factor of the data's Fisher, whitened by prior
    weights: Float[Array, " W"]
    starts: Float[Array, "W n"]
    log_evidence: Scalar

    @in_float64
    def informed(self) -> "WindowsBelief":
        """The same belief, with what was weighed counted as prior."""
        table, L0 = self.system.parameters, self.prior.scale
        if not table.weighed:
            return self
        prior = informed(table, self.prior, self.posterior.mean)
        factor = self.information @ jnp.linalg.solve(L0, prior.scale)
        return eqx.tree_at(lambda b: (b.prior, b.information), self, (prior, factor))


class _Windowed(AbstractLikelihood):
    """The likelihood as least squares: per-window functions, vmapped at the edge."""

    system: AbstractSystem
    prior: Gaussian
    windows: Windows

    def residual(self, window: Windows, x: Float[Array, " pn"]) -> Float[Array, "L c"]:
        """``prediction - y`` of one window at ``x = (z, e)``, zero where masked."""
        p = self.prior.mean.size
        tt = self.prior.mean + self.prior.scale @ x[:p]
        values = self.system.parameters.values(tt, window.configuration)
        params = self.system.record(values)
        x0 = window.start + window.start_sd * x[p:]
        states = simulate(self.system, params, window, x0)
        r = states[:, np.asarray(window.outputs)] - window.y
        return jnp.where(window.mask, r, 0.0)

    def blocks(self, z: Float[Array, " p"], e: Float[Array, "W n"]) -> Blocks:
        """Factors of every window's and output's ``[J_e J_z r]``."""

        def one(window: Windows, e: Array) -> Array:
            x = jnp.concatenate([z, e])
            r, J = value_and_jacobian(lambda x: self.residual(window, x), x)
            J = jnp.roll(J, e.size, axis=-1)  # the start's columns first
            return jax.vmap(factor, in_axes=1)(J, r)

        found: Array = self.windows.each(one, e)
        return found

    def known(self, z: Float[Array, " p"]) -> Float[Array, "q p1"]:
        """Of sums that were weighed."""
        return self.system.parameters.known(self.prior, z)

    def curvature(
        self, z: Float[Array, " p"], gradient: Float[Array, " p"]
    ) -> Float[Array, "p p"]:
        """Of the table's maps."""
        return self.system.parameters.curvature(self.prior, z, gradient)


def likelihood(
    system: AbstractSystem, prior: Gaussian, windows: Windows
) -> AbstractLikelihood:
    """The likelihood that `fit_windows` descends, for whoever linearises it himself."""
    return _Windowed(system, prior, windows)


@eqx.filter_jit
def _fit(
    system: AbstractSystem,
    prior: Gaussian,
    windows: Windows,
    starts: Float[Array, "starts p"],
    freedom: Scalar,
) -> tuple[Fit, WindowsBelief]:
    count = jnp.sum(windows.mask.astype(windows.y.dtype), axis=1)  # (W, c)
    N = jnp.sum(count, axis=0)
    # Start from a large noise, so that the first MAP is not trapped.
    mean = jnp.sum(jnp.where(windows.mask, windows.y, 0.0), axis=1)
    mean = mean / jnp.maximum(count, 1)
    away = jnp.where(windows.mask, windows.y - mean[:, None], 0.0)
    sd = jnp.sqrt(jnp.sum(away**2, axis=(0, 1)) / jnp.maximum(N, 1)) + windows.floor
    W, n = windows.start.shape
    fit, noise, _ = multi_start(
        likelihood(system, prior, windows),
        starts,
        jnp.zeros((W, n)),
        Noise(sd, jnp.ones(W)),
        expectation(count, windows.floor, freedom),
        rounds=NOISE_ROUNDS,
    )
    belief = WindowsBelief(
        system,
        prior,
        fit.posterior(prior),
        noise.sd,
        fit.data[:-1, :-1],
        noise.weights,
        windows.start + windows.start_sd * fit.e,
        fit.log_evidence(noise, count),
    )
    return fit, belief


class Linearised(NamedTuple):
    """Every row of every window at one vector of constants, windows from their starts.

    ``jacobian`` is that of the residuals in the constants and in the window's own start
    state, per prior sd of each. Masked entries of both are zero.
    """

    residual: Float[Array, "W L c"]
    jacobian: Float[Array, "W L c pn"]
    state: Float[Array, "W L n"]
    input: Float[Array, "W L m"]


@in_float64
def linearise(
    belief: WindowsBelief, windows: Windows, tt: Float[Array, " p"]
) -> Linearised:
    """The windows' simulation at virtual values ``tt``, and its derivatives."""
    exact = jax.tree.map(jnp.asarray, windows)
    start = jnp.asarray(belief.starts)
    return _linearise(belief.system, belief.prior, exact, start, jnp.asarray(tt, float))


@in_float64
def compile_linearise(system: AbstractSystem, windows: Windows) -> None:
    """Start to compile `linearise` for windows like these and a belief to come."""
    prior = system.parameters.prior()
    exact = jax.tree.map(jnp.asarray, windows)
    _linearise.compile_for(system, prior, exact, exact.start, prior.mean)


@ahead
def _linearise(
    system: AbstractSystem,
    prior: Gaussian,
    windows: Windows,
    starts: Float[Array, "W n"],
    tt: Float[Array, " p"],
) -> Linearised:
    n = windows.start.shape[1]

    def rows(x: Array) -> tuple[Array, ...]:
        own = tt + prior.scale @ x[:-n]

        def one(window: Windows, start: Array) -> tuple[Array, ...]:
            values = system.parameters.values(own, window.configuration)
            params = system.record(values)
            states = simulate(system, params, window, start + window.start_sd * x[-n:])
            r = states[:, np.asarray(window.outputs)] - window.y
            u = inputs_of(window, system.delays(params))
            return jnp.where(window.mask, r, 0.0), states, u

        found: tuple[Array, ...] = windows.each(one, starts)
        return found

    nowhere = jnp.zeros(prior.mean.size + n)
    J, (r, states, inputs) = jacobian_by_columns(rows, nowhere)
    return Linearised(r, J, states, inputs)


def information_at(
    belief: WindowsBelief, windows: Windows
) -> Callable[[Float[Array, " p"]], Float[Array, "p p"]]:
    """The factor of the data's Fisher, whitened by the prior, at any virtual vector.

    The start states stay where their windows put them, the noise as it was learned.
    """
    n = windows.start.shape[1]

    def information(tt: Float[Array, " p"]) -> Float[Array, "p p"]:
        found = linearise(belief, windows, tt)
        noise = Noise(belief.noise, belief.weights)
        return _information(found.jacobian, found.residual, noise, n)

    return in_float64(information)


@eqx.filter_jit
def _information(J: Array, r: Array, noise: Noise, n: int) -> Float[Array, "p p"]:
    """Start states eliminated."""
    J = jnp.roll(J, n, axis=-1)  # the start's columns first
    blocks = jax.vmap(jax.vmap(factor, in_axes=1))(J, r)
    return eliminate(blocks, jnp.zeros((len(J), n)), noise).data[:-1, :-1]


@in_float64
def fit_windows(
    system: AbstractSystem,
    windows: Windows,
    *,
    key: Key,
    prior: Gaussian | None = None,
    robust: bool = False,
    starts: int = 2,
    near: Float[Array, " p"] | None = None,
) -> WindowsBelief:
    """Posterior of the constants given windows of logs.

    Noise by EM, one Student-t weight per window where ``robust``. A ``prior`` is what
    is believed but for what was weighed. The descent begins at the prior's mean and
    elsewhere, or at virtual values ``near`` the MAP alone. Raises `NotConverged`,
    `NotFinite` or `DeadParameters`.
    """
    prior = system.parameters.prior() if prior is None else prior
    p = prior.mean.size
    first = jnp.zeros((starts, p))
    if near is not None:
        z = jnp.linalg.solve(prior.scale, jnp.asarray(near, float) - prior.mean)
        first = first + z[None]
    elif starts > 1:
        first = first.at[1:].set(0.7 * jax.random.normal(key, (starts - 1, p)))
    fit, belief = _fit(
        system,
        prior,
        jax.tree.map(jnp.asarray, windows),
        first,
        jnp.asarray(FREEDOM if robust else jnp.inf),
    )
    names = system.parameters.names
    fit.raise_unless_converged(names, f"{len(windows)} windows")
    return belief
