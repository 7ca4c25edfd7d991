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

from collections.abc import Callable, Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sim2gp.compilation import compile_async, give_back_freed
from sim2gp.data.cuts import Cuts
from sim2gp.data.window_slopes import HostRun, about
from sim2gp.data.windows import AT_A_TIME, Windows, evenly_spread
from sim2gp.inference.arrowhead import Blocks, Noise, eliminate
from sim2gp.inference.estimate import Estimate
from sim2gp.inference.least_squares import factor
from sim2gp.inference.likelihood import AbstractLikelihood, Trial
from sim2gp.inference.linalg import library, triangular
from sim2gp.inference.linearized import value_and_jacobian
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.host import simulator_of
from sim2gp.systems.simulate import inputs_of, simulate
from sim2gp.types import AnyArray, in_float64

#: Derivatives of windows that are in memory at once (64 MiB).
TOGETHER = 2**23


class WindowsLikelihood(AbstractLikelihood):
    """Windows of a machine's logs: per-window functions, vmapped at the edge."""

    system: AbstractSystem
    windows: Windows
    counts: Float[AnyArray, "W c"]
    floor: Float[AnyArray, " c"]
    most: int = eqx.field(static=True)  # samples of a channel in a window

    @in_float64
    def __init__(
        self, system: AbstractSystem, windows: Windows, most: int | None = None
    ) -> None:
        keep = jax.device_put if simulator_of(system) is None else np.asarray
        self.system, self.windows = system, jax.tree.map(keep, windows)
        counts = windows.counts
        self.counts, self.floor = keep(counts), self.windows.floor
        self.most = int(counts.max(initial=0.0)) if most is None else most

    @property
    def n_nuisances(self) -> int:
        return int(self.windows.start.shape[1])

    @property
    def on_host(self) -> bool:
        return simulator_of(self.system) is not None

    def some(self, which: Int[np.ndarray, " w"]) -> "WindowsLikelihood":
        """The likelihood of some of the windows, by number."""
        return WindowsLikelihood(self.system, self.windows.some(which))

    def parts(
        self, size: int
    ) -> Iterator[tuple[Int[np.ndarray, " w"], "WindowsLikelihood"]]:
        """So many windows at a time, and their numbers (`parts_of`)."""
        if size >= len(self.windows):
            yield np.arange(len(self.windows)), self
            return
        for own, windows in self.windows.in_parts(size):
            yield own, WindowsLikelihood(self.system, windows, self.most)

    def thinned(self, count: int) -> "WindowsLikelihood":
        """Of a quarter as many windows, evenly spread: each has several rows."""
        which = evenly_spread(count // 4, len(self.windows))
        some = self.windows.some(which), self.counts[which]
        thin: WindowsLikelihood = eqx.tree_at(
            lambda one: (one.windows, one.counts), self, some
        )
        return thin

    def simulated(
        self, window: Windows, tt: Float[Array, " p"], e: Float[Array, " n"]
    ) -> tuple[Float[Array, "L c"], Float[Array, "L n"], Float[Array, " m"]]:
        """One window: ``prediction - y``, zero where masked; states; input delays."""
        values = self.system.values(tt, window.configuration)
        params = self.system.record(values)
        x0 = window.start + window.start_sd * e
        states = simulate(self.system, params, window, x0)
        return _residual(window, states), states, self.system.delays(params)

    def blocks(
        self,
        tt: Float[Array, " p"],
        e: Float[Array, "W n"],
        scale: Float[Array, "p q"],
    ) -> Blocks:
        n, p = e.shape[1], scale.shape[1]
        if self.on_host and not isinstance(tt, jax.core.Tracer):
            # Within compiled code the simulator's steps are called from there.
            trial = self.trial(*map(np.asarray, (tt, e, scale)))
            return jnp.asarray(trial.blocks())

        def one(window: Windows, e: Array) -> Array:
            def residual(x: Array) -> Array:
                return self.simulated(window, tt + scale @ x[n:], e + x[:n])[0]

            r, J = value_and_jacobian(residual, jnp.zeros(n + p))
            # What was measured, before rows of zeros.
            order = jnp.argsort(~window.mask, axis=0, stable=True)[: self.most]
            r = jnp.take_along_axis(r, order, axis=0)
            J = jnp.take_along_axis(J, order[..., None], axis=0)
            return jax.vmap(factor, in_axes=1)(J, r)

        found: Array = self.windows.each(one, e)
        return found

    def trial(
        self,
        tt: Float[np.ndarray, " p"],
        e: Float[np.ndarray, "W n"],
        scale: Float[np.ndarray, "p p"],
    ) -> Trial:
        if not self.on_host:
            return super().trial(tt, e, scale)
        W, size = len(self.windows), together(self.system, self.windows)
        parts = [np.arange(i, min(i + size, W)) for i in range(0, W, size)]
        some = [self.some(i) for i in parts] if len(parts) > 1 else [self]
        pairs = zip(some, parts, strict=True)
        runs = [one.run(tt, e[i], scale) for one, i in pairs]
        squares = [
            np.sum(_residual(one.windows, run.states) ** 2, axis=1)
            for one, run in zip(some, runs, strict=True)
        ]

        def blocks() -> Float[np.ndarray, "W c b k"]:
            pairs = zip(some, runs, strict=True)
            return np.concatenate([one._factors(run, self.most) for one, run in pairs])

        return Trial(np.concatenate(squares), blocks)

    def _factors(self, run: HostRun, most: int) -> Float[np.ndarray, "W c b k"]:
        """`blocks` of a run, of no more than ``most`` samples of a channel."""
        windows, outputs = self.windows, list(self.windows.outputs)
        r, J = _residual(windows, run.states), run.slopes()[:, :, outputs]

        def one(w: int, c: int) -> Float[np.ndarray, "b k"]:
            i = windows.mask[w, :, c]
            more = most - int(i.sum())
            rows = np.pad(J[w, i, c], ((0, more), (0, 0)))
            return factor(rows, np.pad(r[w, i, c], (0, more)))

        channels = range(len(outputs))
        return np.stack([[one(w, c) for c in channels] for w in range(len(r))])

    def run(
        self,
        tt: Float[np.ndarray, " p"],
        e: Float[np.ndarray, "W n"],
        scale: Float[np.ndarray, "p p"],
    ) -> HostRun:
        """All windows on the host, with slopes in starts and parameters, whitened."""
        simulator, windows = simulator_of(self.system), self.windows
        assert simulator is not None
        start = windows.start + windows.start_sd * e
        asked = about(tt, start, scale, windows.start_sd)
        return HostRun(simulator, self.system, windows, asked)

    def first_noise(self) -> Noise:
        """The measurements' sd about each window's mean."""
        # Numbers that are known ask for no program.
        xp = jnp if isinstance(self.counts, jax.core.Tracer) else np
        windows = self.windows.y, self.windows.mask, self.counts, self.floor
        y, mask, counts, floor = map(xp.asarray, windows)
        mean = xp.where(mask, y, 0.0).sum(axis=1) / xp.maximum(counts, 1)
        squares = xp.where(mask, (y - mean[:, None]) ** 2, 0.0).sum(axis=(0, 1))
        sd = xp.sqrt(squares / xp.maximum(counts.sum(axis=0), 1)) + floor
        return Noise(*jax.device_put((sd, xp.ones(len(y)))))


class CutsLikelihood:
    """The same of windows that are made when they are asked for."""

    def __init__(self, system: AbstractSystem, windows: Cuts) -> None:
        self.system, self.windows = system, windows
        self.counts, self.floor = windows.counts, windows.floor

    def some(self, which: Int[np.ndarray, " w"]) -> WindowsLikelihood:
        """The likelihood of some of the windows, by number."""
        return WindowsLikelihood(self.system, self.windows.some(which))

    def parts(
        self, size: int | None = None
    ) -> Iterator[tuple[Int[np.ndarray, " w"], WindowsLikelihood]]:
        """So many windows at a time, and their numbers (`parts_of`).

        All parts share a program.
        """
        give_back_freed()
        size = size or max(1, AT_A_TIME // self.windows.length)
        most = int(self.counts.max(initial=0.0))
        for own, windows in self.windows.in_parts(size):
            yield own, WindowsLikelihood(self.system, windows, most)


AnyWindows = WindowsLikelihood | CutsLikelihood


def likelihood_of(system: AbstractSystem, windows: Windows | Cuts) -> AnyWindows:
    """That of windows as they are."""
    if isinstance(windows, Cuts):
        return CutsLikelihood(system, windows)
    return WindowsLikelihood(system, windows)


def _residual(
    windows: Windows, states: Float[AnyArray, "*W L n"]
) -> Float[AnyArray, "*W L c"]:
    """Of one window, or of all."""
    r = states[..., np.asarray(windows.outputs)] - windows.y
    return library(r).where(windows.mask, r, 0.0)


def start_states(windows: Windows, fitted: Estimate) -> Float[np.ndarray, "W n"]:
    """The smoothed start state of each window."""
    e = np.asarray(fitted.nuisances)
    return np.asarray(windows.start) + np.asarray(windows.start_sd) * e


class Linearised(NamedTuple):
    """Every row of every window at one vector of parameters, windows from their starts.

    ``jacobian`` is that of the residuals in the parameters and in the window's own
    start state, per prior sd of each. Masked entries of both are zero.
    """

    residual: Float[Array, "W L c"]
    jacobian: Float[Array, "W L c pn"]
    state: Float[Array, "W L n"]
    input: Float[Array, "W L m"]


def together(system: AbstractSystem, windows: Windows | Cuts) -> int:
    """How many of the windows to linearise at a time: all, if they are not many."""
    n = windows.start.shape[1]
    each = windows.length * n * (n + len(system.parameters))
    return max(1, min(len(windows), TOGETHER // max(each, 1)))


@in_float64
def linearise(
    likelihood: WindowsLikelihood, fitted: Estimate, tt: Float[Array, " p"]
) -> Linearised:
    """The windows' simulation at virtual values ``tt``, and its derivatives."""
    e, tt = jnp.asarray(fitted.nuisances), jnp.asarray(tt, float)
    if likelihood.on_host:
        run = likelihood.run(*map(np.asarray, (tt, e, fitted.prior.scale)))
        return _host_rows(likelihood.windows, run)
    return _linearise(likelihood, e, tt, fitted.prior.scale)


def linearise_some(
    likelihood: AnyWindows, fitted: Estimate
) -> tuple[Windows, Estimate, Linearised]:
    """At the MAP; of very many windows, of some that are evenly spread."""
    system, W = likelihood.system, len(likelihood.windows)
    size = together(system, likelihood.windows)
    if size < W or not isinstance(likelihood, WindowsLikelihood):
        which = evenly_spread(size, W)
        likelihood, fitted = likelihood.some(which), fitted.some(which)
    found = linearise(likelihood, fitted, fitted.posterior.mean)
    return likelihood.windows, fitted, found


@in_float64
def compile_linearise(system: AbstractSystem, windows: Windows | Cuts) -> None:
    """Start to compile `linearise` for windows like these and a fit to come.

    For as many as are linearised at a time.
    """
    if simulator_of(system) is not None:
        return  # nothing to compile: its programs are small
    size, prior = together(system, windows), system.parameters.prior()
    _, likelihood = next(likelihood_of(system, windows).parts(size))
    e = jnp.zeros(likelihood.windows.start.shape)
    _linearise.compile_for(likelihood, e, prior.mean, prior.scale)


def _host_rows(windows: Windows, run: HostRun) -> Linearised:
    """Rows of windows that were simulated on the host; the start's columns go last."""
    J = run.slopes()[:, :, list(windows.outputs)]
    J = np.roll(np.where(windows.mask[..., None], J, 0.0), -run.states.shape[-1], -1)
    found = _residual(windows, run.states), J, run.states, run.inputs
    return Linearised(*jax.device_put(found))


@compile_async
def _linearise(
    likelihood: WindowsLikelihood,
    e: Float[Array, "W n"],
    tt: Float[Array, " p"],
    scale: Float[Array, "p p"],
) -> Linearised:
    n, p = e.shape[1], scale.shape[1]

    def one(window: Windows, e: Array) -> Linearised:
        def rows(x: Array) -> tuple[Array, ...]:
            at = tt + scale @ x[:p], e + x[p:]
            r, states, delays = likelihood.simulated(window, *at)
            return r, states, inputs_of(window, delays)

        (r, states, inputs), J = value_and_jacobian(rows, jnp.zeros(p + n))
        return Linearised(r, J[0], states, inputs)

    found: Linearised = likelihood.windows.each(one, e)
    return found


def information_at(
    likelihood: AnyWindows, fitted: Estimate
) -> Callable[[Float[Array, " p"]], Float[Array, "p p"]]:
    """The factor of the data's Fisher, whitened by the prior, at any virtual vector.

    The start states stay where their windows put them, the noise as it was learned.
    """
    n, size = fitted.nuisances.shape[1], together(likelihood.system, likelihood.windows)

    def information(tt: Float[Array, " p"]) -> Float[Array, "p p"]:
        factors = []
        for own, part in likelihood.parts(size):
            known = fitted.some(np.resize(own, len(part.counts)))
            found = linearise(part, known, tt)
            factors.append(_information(found.jacobian, found.residual, known.noise, n))
        return factors[0] if len(factors) == 1 else triangular(jnp.concatenate(factors))

    return in_float64(information)


@eqx.filter_jit
def _information(J: Array, r: Array, noise: Noise, n: int) -> Float[Array, "p p"]:
    """Start states eliminated."""
    J = jnp.roll(J, n, axis=-1)  # the start's columns first
    blocks = jax.vmap(jax.vmap(factor, in_axes=1))(J, r)
    return eliminate(blocks, jnp.zeros((len(J), n)), noise).data[:-1, :-1]
