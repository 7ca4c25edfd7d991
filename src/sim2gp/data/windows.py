"""The likelihood of real logs: open-loop windows whose start states are unknown.

A log is cut into windows that do not overlap. Within one, the machine is simulated from
an unknown start state under the recorded inputs, and every measured sample is compared
once with the simulation at its own time stamp:

    y_j = x_out(t_j; theta, x0) + eps_j,    eps ~ N(0, diag(sig^2) / w)
    x0  = m0 + S0 e,                        e ~ N(0, I)

Velocities need not be measured, rates need not be known, rows may be missing. The start
states are the nuisances that `sim2gp.inference.arrowhead` eliminates window by window,
so memory and time are linear in the data. ``w`` is one Student-t weight per window (1
if off). ``window = 0`` is the paper's one-step likelihood: two rows, and ``S0 = 0``.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sim2gp import checks
from sim2gp.compilation import ahead
from sim2gp.inference.arrowhead import Blocks, Noise, eliminate
from sim2gp.inference.expectation_maximisation import expectation
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.informed_prior import informed
from sim2gp.inference.least_squares import factor
from sim2gp.inference.levenberg_marquardt import AbstractLikelihood, Fit, multi_start
from sim2gp.inference.linearized import jacobian_by_columns, value_and_jacobian
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.plants.external import on_host
from sim2gp.systems.simulate import Stretch, inputs_of, simulate
from sim2gp.types import AnyArray, Key, Scalar, in_float64

NOISE_ROUNDS = 8  # fewer leave noise and starts of real logs short of a fixed point
NEAR_ROUNDS = 3  # of a fit that begins with the noise of another one
FREEDOM = 4.0  # degrees of freedom of the Student-t weight


class Windows(Stretch):
    """Padded windows, a row for each end of an integration step.

    Row 0 is the start, padding rows have zero length, and a row without a sample (where
    the clock left a gap too long for one step) has a false mask. ``outputs`` are the
    indices of the measured states, ``floor`` the sensors' resolution. ``configuration``
    is the machine's, an index into its table's.
    """

    span: Float[AnyArray, "W L"]
    knots: Float[AnyArray, "W H"]
    area: Float[AnyArray, "W H m"]
    y: Float[AnyArray, "W L c"]
    mask: Bool[AnyArray, "W L c"]
    start: Float[AnyArray, "W n"]
    start_sd: Float[AnyArray, "W n"]
    floor: Float[AnyArray, " c"]
    configuration: Int[AnyArray, " W"]
    outputs: tuple[int, ...] = eqx.field(static=True)

    def __len__(self) -> int:
        return len(self.y)

    def some(self, which: Bool[np.ndarray, " W"] | Int[np.ndarray, " w"]) -> "Windows":
        """The windows chosen by a mask or by number; the floor belongs to all."""
        bare = eqx.tree_at(lambda w: w.floor, self, None)
        chosen: Windows = eqx.tree_at(
            lambda w: w.floor,
            jax.tree.map(lambda x: np.asarray(x)[which], bare),
            self.floor,
            is_leaf=lambda x: x is None,
        )
        return chosen

    def each(self, f: Callable[..., Any], *per_window: Any) -> Any:
        """``f`` of one window (and of one row of each argument), for all windows."""
        axes = eqx.tree_at(lambda w: w.floor, jax.tree.map(lambda _: 0, self), None)
        return jax.vmap(f, in_axes=(axes, *[0] * len(per_window)))(self, *per_window)


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

    @property
    def known(self) -> Noise:
        """What a descent holds fixed."""
        return Noise(jnp.asarray(self.noise), jnp.asarray(self.weights))

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
        values = self.system.values(tt, window.configuration)
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
    e: Float[Array, "W n"],
    noise: Noise,
    rounds: Int[Array, ""],
    freedom: Scalar,
) -> tuple[Fit, WindowsBelief]:
    count = jnp.sum(windows.mask.astype(windows.y.dtype), axis=1)  # (W, c)
    fit, noise, _ = multi_start(
        likelihood(system, prior, windows),
        starts,
        e,
        noise,
        expectation(count, windows.floor, freedom),
        rounds=NOISE_ROUNDS,
        needed=rounds,
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


@eqx.filter_jit
def _large(windows: Windows) -> Noise:
    """The measurements' own sd about each window's mean: it traps no first MAP."""
    mask = windows.mask.astype(windows.y.dtype)
    y = jnp.where(windows.mask, windows.y, 0.0)
    mean = jnp.sum(y, axis=1) / jnp.maximum(jnp.sum(mask, axis=1), 1)
    squares = jnp.sum(mask * (y - mean[:, None]) ** 2, axis=(0, 1))
    sd = jnp.sqrt(squares / jnp.maximum(jnp.sum(mask, axis=(0, 1)), 1)) + windows.floor
    return Noise(sd, jnp.ones(len(windows)))


def at_map(
    belief: WindowsBelief, windows: Windows
) -> tuple[AbstractLikelihood, Float[Array, " p"], Float[Array, "W n"], Noise]:
    """The likelihood of a fit; constants, starts and noise where the fit stands."""
    exact = jax.tree.map(jnp.asarray, windows)
    z = jnp.linalg.solve(belief.prior.scale, belief.posterior.mean - belief.prior.mean)
    e = _whitened(exact, jnp.asarray(belief.starts))
    return likelihood(belief.system, belief.prior, exact), z, e, belief.known


def _whitened(windows: Windows, starts: Float[Array, "W n"]) -> Float[Array, "W n"]:
    """Start states as nuisances; one that is known has none."""
    sd = windows.start_sd
    return jnp.where(sd > 0.0, (starts - windows.start) / jnp.where(sd > 0.0, sd, 1), 0)


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
            values = system.values(own, window.configuration)
            params = system.record(values)
            states = simulate(system, params, window, start + window.start_sd * x[-n:])
            r = states[:, np.asarray(window.outputs)] - window.y
            u = inputs_of(window, system.delays(params))
            return jnp.where(window.mask, r, 0.0), states, u

        found: tuple[Array, ...] = windows.each(one, starts)
        return found

    nowhere = jnp.zeros(prior.mean.size + n)
    J, (r, states, inputs) = jacobian_by_columns(rows, nowhere, at_once=on_host(system))
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
        return _information(found.jacobian, found.residual, belief.known, n)

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
    near: WindowsBelief | None = None,
) -> WindowsBelief:
    """Posterior of the constants given windows of logs.

    Noise by EM, one Student-t weight per window where ``robust``. A ``prior`` is what
    is believed but for what was weighed. The descent begins at the prior's mean and
    elsewhere, or where another fit of windows like these stands, ``near`` this one's:
    that is quick, and with as many ``starts`` compiles nothing. Raises `NotConverged`,
    `NotFinite` or `DeadParameters`, and `InputError` E148 for no starts, E140 for a
    prior of another number of constants.
    """
    checks.count("fit_windows", starts=starts)
    prior = system.parameters.prior() if prior is None else prior
    p = len(system.parameters)
    checks.same_shape("fit_windows", (p,), prior=prior.mean)
    exact = jax.tree.map(jnp.asarray, windows)
    if near is None:
        first = jnp.zeros((starts, p))
        if starts > 1:
            first = first.at[1:].set(0.7 * jax.random.normal(key, (starts - 1, p)))
        e, noise, rounds = jnp.zeros(windows.start.shape), _large(exact), NOISE_ROUNDS
    else:
        z = jnp.linalg.solve(prior.scale, near.posterior.mean - prior.mean)
        first = jnp.full((starts, p), jnp.nan).at[0].set(z)
        e, noise, rounds = _whitened(exact, near.starts), near.known, NEAR_ROUNDS
    begin = first, e, noise, rounds, FREEDOM if robust else np.inf
    # By way of NumPy: JAX compiles anew for numbers whose type it calls weak.
    begin = jax.tree.map(lambda x: jnp.asarray(np.asarray(x)), begin)
    fit, belief = _fit(system, prior, exact, *begin)
    names = system.parameters.names
    fit.raise_unless_converged(names, f"{len(windows)} windows")
    return belief
