"""Other models of what a simulator leaves of a step, to compare missing forces with.

An ensemble of networks (Chua et al. 2018, arXiv 1805.12114), and an exact Gaussian
process on each output. Their beliefs are only drawn from.
"""

from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Array, Float

from sim2gp.belief import AbstractBelief, AbstractModel
from sim2gp.data.transitions import Transitions
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.information import Sensitivity
from sim2gp.models import Residual, Sim2GP
from sim2gp.models.features import Encoding, stepped
from sim2gp.models.sim2gp import Sim2GPBelief
from sim2gp.types import Action, Dynamics, Key, Scalar, State, in_float64

MEMBERS = 5  # of an ensemble
WAVES = 200  # random features of a draw of a Gaussian process
OPTIMISED = 60  # evaluations of a Gaussian process' evidence


class DrawnBelief(AbstractBelief):
    """A belief that is only drawn from and never asked for its moments."""

    sim: Sim2GPBelief

    @property
    def noise(self) -> Float[Array, " d"]:
        return self.sim.noise

    @in_float64
    def parameters(self) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
        return self.sim.parameters()

    def latent(self, s: State, a: Action) -> Gaussian:
        raise NotImplementedError

    predict = latent

    def sensitivity(self, s: State, a: Action) -> Sensitivity:
        raise NotImplementedError

    @property
    def coordinates(self) -> tuple[int, int, int]:
        raise NotImplementedError


class Members(DrawnBelief):
    """Networks that were trained from different beginnings; a draw is one of them."""

    members: tuple[AbstractBelief, ...]

    def sample(self, key: Key) -> Dynamics:
        which = int(jax.random.randint(key, (), 0, len(self.members)))
        return self.members[which].point()

    def point(self) -> Dynamics:
        return self.members[0].point()


class Ensemble(AbstractModel):
    """`MEMBERS` networks on what the simulator leaves (Chua et al. 2018)."""

    one: Residual

    def init(self, key: Key) -> Members:
        keys = jax.random.split(key, MEMBERS)
        members = tuple(self.one.init(key) for key in keys)
        return Members(members[0].sim, members)

    def fit(self, belief: AbstractBelief, data: Transitions, *, key: Key) -> Members:
        assert isinstance(belief, Members)
        keys = jax.random.split(key, MEMBERS)
        pairs = zip(belief.members, keys, strict=True)
        members = tuple(self.one.fit(b, data, key=k) for b, k in pairs)
        return Members(members[0].sim, members)

    def update(
        self, belief: AbstractBelief, s: State, a: Action, s2: State
    ) -> AbstractBelief:
        raise NotImplementedError


class Process(NamedTuple):
    """Of each output a Gaussian process: data, and logs of its hyperparameters."""

    X: Float[Array, "N e"]
    y: Float[Array, "N d"]  # in rms of the column
    mask: Array
    size: Float[Array, " d"]
    log: Float[Array, "d k"]  # length of each input, sd, noise


class ProcessDraw(eqx.Module):
    """The simulator plus one draw of each process: prior features and an update.

    Matheron's rule (Wilson et al. 2020, arXiv 2002.09309).
    """

    physics: Dynamics
    encoding: Encoding
    X: Float[Array, "N e"]
    length: Float[Array, "d e"]
    update: Float[Array, "d N"]
    waves: Float[Array, "d R e"]
    phase: Float[Array, "d R"]
    weights: Float[Array, "d R"]

    def __call__(self, s: State, a: Action) -> State:
        x = self.encoding(s, a)
        base = self.physics(s, a)
        d = len(self.length)

        def one(length: Array, v: Array, omega: Array, phase: Array, w: Array) -> Array:
            z = (self.X - x[None]) / length[None]
            k = jnp.exp(-0.5 * jnp.sum(z**2, axis=1))
            return k @ v + w @ jnp.cos(omega @ (x / length) + phase)

        more = jax.vmap(one)(
            self.length, self.update, self.waves, self.phase, self.weights
        )
        return stepped(s, a, (base - s)[:d] + more)


class ProcessBelief(DrawnBelief):
    """The simulator at its MAP, and what it leaves of each output."""

    process: Process | None
    encoding: Encoding

    @in_float64
    def sample(self, key: Key) -> Dynamics:
        first, second = jax.random.split(key)
        if self.process is None:
            return self.sim.sample(first)
        return single_draw(self.sim.point(), self.encoding, self.process, second)

    def point(self) -> Dynamics:
        return self.sim.point()


def kernel(
    X: Float[Array, "N e"], Z: Float[Array, "M e"], log: Float[Array, " k"]
) -> Float[Array, "N M"]:
    apart = (X[:, None] - Z[None]) / jnp.exp(log[:-2])
    return jnp.exp(2.0 * log[-2] - 0.5 * jnp.sum(apart**2, axis=2))


def covariance(process: Process, log: Float[Array, " k"]) -> Float[Array, "N N"]:
    """With noise; rows that are masked are far and alone."""
    both = process.mask[:, None] & process.mask[None]
    K = jnp.where(both, kernel(process.X, process.X, log), 0.0)
    own = jnp.where(process.mask, jnp.exp(2.0 * log[-1]) + 1e-8, 1.0)
    return K + jnp.diag(own)


@eqx.filter_jit
def evidence_slope(process: Process, y: Array, log: Array) -> tuple[Scalar, Array]:
    """Minus the log evidence of one output, with broad priors on the logs."""

    def cost(log: Array) -> Array:
        L = jnp.linalg.cholesky(covariance(process, log))
        r = jax.scipy.linalg.solve_triangular(L, y, lower=True)
        prior = jnp.asarray([*[1.0] * (log.size - 2), 0.0, -2.0])
        far = 0.5 * jnp.sum(((log - prior) / 1.5) ** 2)
        return 0.5 * r @ r + jnp.sum(jnp.log(jnp.diag(L))) + far

    return jax.value_and_grad(cost)(log)


def trained(process: Process) -> Process:
    """Hyperparameters of highest evidence, of each output."""
    found = []
    for y, log in zip(process.y.T, process.log, strict=True):
        best = scipy.optimize.minimize(
            lambda x, y=y: [np.asarray(v) for v in evidence_slope(process, y, x)],
            np.asarray(log),
            jac=True,
            method="L-BFGS-B",
            options={"maxfun": OPTIMISED},
        )
        found.append(best.x)
    return process._replace(log=jnp.asarray(np.stack(found)))


@eqx.filter_jit
def single_draw(
    physics: Dynamics, encoding: Encoding, process: Process, key: Key
) -> ProcessDraw:
    def one(y: Array, log: Array, size: Array, key: Key) -> tuple[Array, ...]:
        a, b, c, e = jax.random.split(key, 4)
        omega = jax.random.normal(a, (WAVES, log.size - 2))
        phase = jax.random.uniform(b, (WAVES,), maxval=2.0 * jnp.pi)
        w = jnp.exp(log[-2]) * jnp.sqrt(2.0 / WAVES) * jax.random.normal(c, (WAVES,))
        length = jnp.exp(log[:-2])
        prior = jnp.cos(process.X / length @ omega.T + phase) @ w
        noisy = prior + jnp.exp(log[-1]) * jax.random.normal(e, y.shape)
        r = jnp.where(process.mask, y - noisy, 0.0)
        v = jnp.linalg.solve(covariance(process, log), r)
        v = jnp.where(process.mask, v, 0.0) * jnp.exp(2.0 * log[-2])
        return length, size * v, omega, phase, size * w

    keys = jax.random.split(key, len(process.size))
    length, v, omega, phase, w = jax.vmap(one)(
        process.y.T, process.log, process.size, keys
    )
    small = jax.tree.map(
        lambda x: x.astype(jnp.float32), (process.X, length, v, omega, phase, w)
    )
    return ProcessDraw(physics, encoding, *small)


class ProcessResidual(AbstractModel):
    """The simulator's fit, then an exact Gaussian process on each output of a step."""

    sim: Sim2GP
    encoding: Encoding

    def __init__(self, sim: Sim2GP, *, reach: Mapping[str, float]) -> None:
        self.sim, self.encoding = sim, Encoding.of(sim.system, reach)

    def init(self, key: Key) -> ProcessBelief:
        return ProcessBelief(self.sim.init(key), None, self.encoding)

    @in_float64
    def fit(
        self, belief: AbstractBelief, data: Transitions, *, key: Key
    ) -> ProcessBelief:
        assert isinstance(belief, ProcessBelief)
        sim = self.sim.fit(belief.sim, data, key=key)
        X, y = self._left(sim, data)
        mask = jnp.asarray(data.mask)
        size = jnp.sqrt(jnp.sum(y**2, axis=0) / jnp.sum(mask))
        e, d = X.shape[1], y.shape[1]
        first = jnp.tile(jnp.asarray([*[1.0] * e, 0.0, -1.0]), (d, 1))
        log = first if belief.process is None else belief.process.log
        process = Process(X, y / size[None], mask, size, log)
        return ProcessBelief(sim, trained(process), self.encoding)

    def _left(
        self, sim: Sim2GPBelief, data: Transitions
    ) -> tuple[Float[Array, "N e"], Float[Array, "N d"]]:
        """Encoded rows, and what the simulator at its MAP leaves of each step."""
        d, tt = len(self.sim.system.physical_states), sim.posterior.mean

        @eqx.filter_jit
        def one(s: Array, a: Array, s2: Array, valid: Array) -> tuple[Array, Array]:
            f = self.sim.system.transition(tt, s, a, self.sim.dt, None)[:d]
            return self.encoding(s, a), jnp.where(valid, (s2[:d] - f), 0.0)

        rows = data.state, data.action, data.next_state, data.mask
        return jax.vmap(one)(*(jnp.asarray(x, None) for x in rows))

    def update(
        self, belief: AbstractBelief, s: State, a: Action, s2: State
    ) -> AbstractBelief:
        raise NotImplementedError
