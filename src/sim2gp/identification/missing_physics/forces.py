"""Forces that the simulator of a run lacks: of one-step data, and of windows of logs.

Windows have the corrected intervals (`sim2gp.identification.intervals`), with functions
that have details. One step of exact states has white noise, and masses and motor may
both be unknown, so that data say how large a force is next to the motor. Where forces
are on, the slopes by masses and motor then look like forces. So the average over which
forces are on is taken where they are off, and mean and covariance where they are on.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sim2gp.identification.intervals.averaging import (
    NOTHING,
    Groups,
    Moments,
    Scales,
    averaged,
)
from sim2gp.identification.intervals.discrepancy import (
    corrected_windows,
    identifiable,
)
from sim2gp.identification.missing_physics.curves import Curve, curves_of
from sim2gp.identification.missing_physics.data import (
    AbstractData,
    OneStepData,
    WindowData,
)
from sim2gp.identification.missing_physics.reach import box_of
from sim2gp.identification.missing_physics.shapes import is_nothing
from sim2gp.inference.estimate import Estimate
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.prior import ParameterPrior
from sim2gp.inference.relevance import Linear, relevant
from sim2gp.systems.assemble import free_parts
from sim2gp.systems.effects.missing import missing_forces
from sim2gp.systems.machine import plant_of
from sim2gp.systems.mechanism import AbstractMechanism
from sim2gp.types import in_float64

STEPS = 40  # of a descent
CHOICES = 3  # of forces, each from the last one's best fit
DAMPING = 1.0, 1e6  # first and last, of parameters in prior sd
FREE = 1e-2  # of a prior that leaves weights free, relative to 1 / sd
SETTLED = 0.1  # nats
FARTHEST = 0.3  # prior sd that a step may take a parameter: bounds saturate far away

#: Factors ``[J r]`` of each channel's rows, at any unknowns.
Rows = Callable[[Float[np.ndarray, " k"]], Float[np.ndarray, "c q k1"]]


@dataclass(frozen=True)
class FoundForces:
    """The probability of each kind of force, and of nothing (`NONE`); all curves."""

    each: Mapping[str, float] = field(default_factory=dict)
    curves: tuple[Curve, ...] = ()

    @property
    def found(self) -> tuple[Curve, ...]:
        """Forces that are rather there than not, and whose band leaves zero."""
        likely = {kind for kind, p in self.each.items() if kind and p > NOTHING}
        some = (c for c in self.curves if likely & set(c.kinds))
        return tuple(c for c in some if not is_nothing(c))


def find_forces(data: AbstractData, bare: Estimate) -> FoundForces:
    """Which forces the machine of ``data`` lacks, given the fit without any.

    None of a plant without a mass matrix. Raises `NotFinite` E203.
    """
    if not isinstance(plant_of(data.system), AbstractMechanism):
        return FoundForces()
    if isinstance(data, OneStepData):
        return _of_transitions(data, bare)
    assert isinstance(data, WindowData)
    box = box_of(data.system, data.windows)
    forces = missing_forces(data.system, box, fine=True, closely=True)
    likelihood = data.likelihood(data.system)
    found = corrected_windows(likelihood, bare, data.recording, tuple(forces))
    return FoundForces(found.each, found.curves)


@in_float64
def _of_transitions(data: OneStepData, bare: Estimate) -> FoundForces:
    """The parameters come first among the unknowns, then weights in all directions
    that no parameter does as well."""
    machine, box = data.system, _visited(data)
    forces = missing_forces(machine, box, fine=True, closely=True)
    system = free_parts(machine, forces, period=data.period)
    table, likelihood = system.parameters, data.likelihood(system)
    own = np.asarray([table.names.index(name) for name in machine.parameters.names])
    prior, counts = ParameterPrior(table.prior(), table), likelihood.counts[0]

    def rows_onto(onto: Float[np.ndarray, "p k"]) -> Rows:
        def rows(y: Float[np.ndarray, " k"]) -> Float[np.ndarray, "c q k1"]:
            z, none = onto @ y, jnp.zeros((1, 0))
            found = np.asarray(data.blocks(system, z[None], none)[0, 0])
            return np.concatenate([found[..., :-1] @ onto, found[..., -1:]], axis=2)

        return rows

    start = np.zeros(len(table))
    start[own] = np.asarray(bare.z())
    # With forces off, whatever the parameters' order in the table.
    first = _joined(rows_onto(np.eye(len(table)))(start), np.asarray(bare.noise.sd))
    T, groups = identifiable(first[:, :-1], own, table.groups)
    of_all, whole, o = rows_onto(T), rows_onto(np.eye(len(table))), len(own)
    y, noise = np.append(start[own], np.zeros(T.shape[1] - o)), bare.noise
    last: Scales | None = None
    for _ in range(CHOICES):
        off = np.append(y[:o], np.zeros(len(y) - o))
        rows = whole(T @ off)
        grams = jnp.asarray(np.swapaxes(rows, 1, 2) @ rows)
        linear = Linear(grams, 0.0 * likelihood.floor, counts, likelihood.floor)
        noise, _ = _relevant(linear, jnp.asarray(T @ off), noise, prior)
        sd = np.asarray(noise.sd)
        about = _whitened(of_all(off), sd, off)
        top = _best_choice(about, groups)
        if last is not None and top.keys() == last.keys():
            break
        starts = [start[own]] if last is None else [y[:o], start[own]]
        last = top
        some = [np.arange(o), *(groups[name] for name in sorted(top))]
        y = _best_fit(T, np.concatenate(some), rows_onto, starts, counts)
    on = _AtBest(*_whitened(of_all(y), sd, y), y[:o], groups)
    mean, scale, each = averaged(*about, groups, on.moments)
    onto = np.asarray(prior.gaussian.scale) @ T
    virtual = Gaussian(
        prior.gaussian.at(jnp.asarray(T @ mean)), jnp.asarray(onto @ scale)
    )
    return FoundForces(each, curves_of(system, forces, box, virtual))


def _best_fit(
    T: Float[np.ndarray, "p k"],
    some: Int[np.ndarray, " s"],
    rows_onto: Callable[[Float[np.ndarray, "p s"]], Rows],
    starts: Sequence[Float[np.ndarray, " o"]],
    counts: Array,
) -> Float[np.ndarray, " k"]:
    """All unknowns, those in ``some`` at the best of descents from these parameters."""
    best, o = np.zeros(T.shape[1]), len(starts[0])
    rows, none = rows_onto(T[:, some]), np.zeros(len(some) - o)
    tried = [_descend(rows, np.append(x, none), o, float(counts[0])) for x in starts]
    best[some] = min(tried, key=lambda at: at.nats).y
    return best


def _best_choice(
    about: tuple[Float[np.ndarray, "q k"], Float[np.ndarray, " q"]], groups: Groups
) -> Scales:
    """The groups that are on in the most probable choice, and their scales."""
    tried: list[Scales] = []

    def note(scales: Scales) -> Moments:
        tried.append(scales)
        k = about[0].shape[1]
        return Moments(np.zeros(k), np.zeros((k, k)))

    averaged(*about, groups, note)
    return tried[0]


@dataclass(frozen=True)
class _AtBest:
    """The linear model where forces are on; parameters come first.

    A prior whose scale is the data's says nothing of a force's size. So parameters
    follow from their own prior and the data, all weights free, and weights follow.
    """

    root: Float[np.ndarray, "q k"]
    data: Float[np.ndarray, " q"]
    own: Float[np.ndarray, " o"]
    groups: Groups

    def moments(self, scales: Scales) -> Moments:
        """Mean and scale with so strong forces."""
        o, k = len(self.own), self.root.shape[1]
        D = np.zeros(k)
        for name, share in scales.items():
            D[self.groups[name]] = share
        on = np.flatnonzero(D)
        O, B = self.root[:, :o], self.root[:, on] * D[on]
        free = np.linalg.qr(np.concatenate([B, FREE * np.eye(len(on))]))[0][: len(B)]
        rest = np.concatenate([O - free @ (free.T @ O), np.eye(o)])
        of_own = np.linalg.solve(np.linalg.qr(rest, mode="r"), np.eye(o))
        Q, R = np.linalg.qr(np.concatenate([B, np.eye(len(on))]))
        onto = D[on, None] * np.linalg.solve(R, Q[: len(B)].T)
        mean, scale = np.zeros(k), np.zeros((k, k))
        mean[:o], mean[on] = self.own, onto @ (self.data - O @ self.own)
        scale[:o, :o], scale[on, :o] = of_own, -onto @ O @ of_own
        scale[np.ix_(on, o + np.arange(len(on)))] = D[on, None] * np.linalg.solve(
            R, np.eye(len(on))
        )
        return Moments(mean, scale)


class _Point(NamedTuple):
    """Unknowns, rows there, and nats of misfit and prior."""

    y: Float[np.ndarray, " k"]
    rows: Float[np.ndarray, "c q k1"]
    nats: float


def _descend(rows: Rows, y: Float[np.ndarray, " k"], o: int, count: float) -> _Point:
    """Where the machine with its forces fits best.

    Variable projection (Golub and Pereyra 1973; Kaufman 1975): at any parameters, the
    first ``o`` unknowns, the weights are solved for, as they are linear, and
    Levenberg-Marquardt descends in the parameters alone. In both together its way would
    be a narrow curve, along which masses and forces have one ratio. Each channel's
    noise is what is left.
    """
    at, damping = _solved(rows, y, o, count), DAMPING[0]
    for _ in range(STEPS):
        R = _joined(at.rows, np.sqrt(_squares(at.rows) / count))
        O, B = R[:, :o], R[:, o:-1] / FREE
        Q, T = np.linalg.qr(np.concatenate([B, np.eye(B.shape[1])]))
        onto = Q[: len(B)].T @ O
        H = O.T @ O - onto.T @ onto + (1.0 + damping) * np.eye(o)
        step = -np.linalg.solve(H, O.T @ R[:, -1] + at.y[:o])
        step *= min(1.0, FARTHEST / np.max(np.abs(step)))
        follow = -np.linalg.solve(T, onto @ step) / FREE
        there = _solved(rows, at.y + np.concatenate([step, follow]), o, count)
        gain = at.nats - there.nats
        if not gain > 0.0:
            damping = 10.0 * damping
            if damping > DAMPING[1]:
                break
            continue
        at = there
        if gain < SETTLED:
            break
        damping = 0.1 * damping
    return at


def _solved(rows: Rows, y: Float[np.ndarray, " k"], o: int, count: float) -> _Point:
    """With the weights that are best for these parameters."""
    found = rows(y)
    R = _joined(found, np.sqrt(_squares(found) / count))
    slack = FREE * np.eye(len(y) - o)
    whole = np.concatenate([R[:, o:-1], slack])
    change = np.linalg.lstsq(whole, -np.append(R[:, -1], FREE * y[o:]))[0]
    y = np.append(y[:o], y[o:] + change)
    found = rows(y)
    prior = y[:o] @ y[:o] + FREE**2 * y[o:] @ y[o:]
    nats = 0.5 * (count * np.sum(np.log(_squares(found))) + prior)
    return _Point(y, found, float(nats))


def _squares(rows: Float[np.ndarray, "c q k1"]) -> Float[np.ndarray, " c"]:
    """Of each channel's residuals."""
    return np.asarray(np.sum(rows[:, :, -1] ** 2, axis=1))


def _joined(
    rows: Float[np.ndarray, "c q k1"], sd: Float[np.ndarray, " c"]
) -> Float[np.ndarray, "r k1"]:
    """All rows, in sd of the noise."""
    return np.concatenate(list(rows / np.asarray(sd)[:, None, None]))


def _whitened(
    rows: Float[np.ndarray, "c q k1"],
    sd: Float[np.ndarray, " c"],
    y: Float[np.ndarray, " k"],
) -> tuple[Float[np.ndarray, "k k"], Float[np.ndarray, " k"]]:
    """The linear model about ``y``: its slopes, and data as if it went through zero."""
    R = np.asarray(np.linalg.qr(_joined(rows, sd), mode="r"))
    return R[:, :-1], R[:, :-1] @ y - R[:, -1]


_relevant = jax.jit(relevant)


def _visited(data: OneStepData) -> dict[str, tuple[float, float]]:
    """The range of each channel in the episodes."""
    d = len(data.system.physical_states)
    S = np.concatenate([S[:, :d] for S, _ in data.episodes])
    A = np.concatenate([A for _, A in data.episodes])
    channels = (*data.system.physical_states, *data.system.actions)
    ends = [(float(x.min()), float(x.max())) for x in (*S.T, *A.T)]
    return dict(zip((c.name for c in channels), ends, strict=True))
