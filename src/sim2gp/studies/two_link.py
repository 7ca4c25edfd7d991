"""Two data sets of the horizontal arm, and what is learned from them in turn.

Data set 1 has joint 1 locked and excites joint 2; data set 2 moves both. The posterior
after the first is the prior of the second,

    N(mu0, S0) --D1--> N(mu1, S1) --D2--> N(mu2, S2)     over tt = (m1, b1, m2, b2).

Torques are autocorrelated noise within the motors' limits; process noise acts on the
increments of the joints that move.
"""

import time
from collections.abc import Hashable
from dataclasses import asdict, dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
from jaxtyping import Array, Float

from sim2gp.data.transitions import Transitions
from sim2gp.errors import NotConverged, NotFinite
from sim2gp.models import Sim2GP, Sim2GPBelief
from sim2gp.runs.cell_work import AbstractCell, Values
from sim2gp.systems import UniformRodArm
from sim2gp.types import Action, Key, State, in_float64

DT = 0.02  # s
STEPS = 150
NOISE = (1e-3, 1e-3, 2e-2, 2e-2)  # sd of one step's increment, rad and rad/s
TORQUE_SD, TORQUE_LIMIT = 1.0, 1.0  # N m; the excitation uses the whole range
LOCKED = (True, False)  # of data set 1
RHO = 0.9  # autocorrelation of the excitation over one step
LEVELS = (50, 90, 95)
BAND = 0.999  # acceptance of each coverage count, if the intervals are right


class ArmRecording(eqx.Module):
    """One data set: the arm from rest, and the torques that moved it."""

    state: Float[Array, "T1 4"]
    action: Float[Array, "T 2"]

    def transitions(self) -> Transitions:
        """The same as ``(s, a, s')``."""
        s = np.asarray(self.state)
        return Transitions.of(s[:-1], np.asarray(self.action), s[1:])


class LearnedArm(eqx.Module):
    """Both data sets of one arm, and the belief that each stage starts and ends with.

    ``middle`` is posterior 1 as the prior of the free arm.
    """

    truth: Float[Array, " p"]
    first: ArmRecording
    second: ArmRecording
    prior: Sim2GPBelief
    posterior1: Sim2GPBelief
    middle: Sim2GPBelief
    posterior2: Sim2GPBelief

    @property
    def sd(self) -> Float[np.ndarray, "stages p"]:
        """Posterior sd before any data, after the first data set, and after both."""
        stages = self.prior, self.posterior1, self.posterior2
        return np.stack([np.asarray(belief.parameters()[1]) for belief in stages])

    @property
    def z(self) -> Float[np.ndarray, " p"]:
        """Errors after both data sets, in posterior sd."""
        mean, sd = (np.asarray(x) for x in self.posterior2.parameters())
        return (mean - np.asarray(self.truth)) / sd


@in_float64
def nominal_truth() -> Float[Array, " p"]:
    """Virtual values of the nominal arm; no prior mean is its truth."""
    table = UniformRodArm().parameters
    nominal = table.nominal()
    return table.unconstrain(jnp.asarray([nominal[n] for n in table.names], float))


@eqx.filter_jit
def record(arm: UniformRodArm, truth: Float[Array, " p"], *, key: Key) -> ArmRecording:
    """Excite the free joints of an arm; a locked joint gets no torque and no noise."""
    free = jnp.asarray([0.0 if locked else 1.0 for locked in arm.locked], truth.dtype)
    noise = jnp.asarray(NOISE, truth.dtype) * jnp.concatenate([free, free])
    torque_key, noise_key = jax.random.split(key)
    eps = jax.random.normal(torque_key, (STEPS, 2), truth.dtype)

    def colour(t: Action, eps: Array) -> tuple[Action, Action]:
        t = RHO * t + np.sqrt(1.0 - RHO**2) * TORQUE_SD * eps
        return t, t

    _, torque = jax.lax.scan(colour, TORQUE_SD * eps[0], eps)
    action = jnp.clip(torque, -TORQUE_LIMIT, TORQUE_LIMIT) * free[None]
    disturbance = noise[None] * jax.random.normal(noise_key, (STEPS, 4), truth.dtype)

    def step(s: State, x: tuple[Action, State]) -> tuple[State, State]:
        s = arm.transition(truth, s, x[0], DT) + x[1]
        return s, s

    rest = jnp.zeros(4, truth.dtype)
    _, path = jax.lax.scan(step, rest, (action, disturbance))
    return ArmRecording(jnp.concatenate([rest[None], path]), action)


@in_float64
def learn(truth: Float[Array, " p"], *, key: Key) -> LearnedArm:
    """Record and learn both data sets in turn; raises what `Sim2GP.fit` raises."""
    one, two, fit1, fit2 = jax.random.split(key, 4)
    locked, free = UniformRodArm(locked=LOCKED), UniformRodArm()
    first, second = record(locked, truth, key=one), record(free, truth, key=two)
    model = Sim2GP(locked, dt=DT)
    prior = model.init(fit1)
    posterior1 = model.fit(prior, first.transitions(), key=fit1)
    model = Sim2GP(free, dt=DT).with_prior(posterior1.posterior)
    middle = model.init(fit2)
    posterior2 = model.fit(middle, second.transitions(), key=fit2)
    return LearnedArm(truth, first, second, prior, posterior1, middle, posterior2)


@dataclass(frozen=True)
class ArmCell(AbstractCell):
    """One arm, recorded and learned; ``index`` counts the arms of a seed.

    method: ``prior``, an arm drawn from the prior, or ``nominal``, another recording of
        the nominal arm.
    """

    method: str
    seed: int
    index: int

    @property
    def name(self) -> str:
        """The name of its file."""
        return f"{self.method}_{self.seed}_{self.index}"

    @property
    def arguments(self) -> Values:
        """All of them."""
        return asdict(self)

    @property
    def program(self) -> tuple[Hashable, ...]:
        """All arms are one program; both kinds have a process of their own."""
        return (self.method,)

    @in_float64
    def compute(self, needed: Values | None) -> Values:
        """Errors and spreads of the two data sets; none for a fit that failed."""
        del needed
        kind = ("prior", "nominal").index(self.method)
        key = jax.random.fold_in(jax.random.key(self.seed), 2 + 2 * kind)
        draw, run = jax.random.split(jax.random.fold_in(key, self.index))
        truth = nominal_truth()
        if self.method == "prior":
            truth = UniformRodArm().parameters.prior().sample(draw)
        given = {
            "truth": np.asarray(truth).tolist(),
            "z": [],
            "sd": [],
            "failure": None,
        }
        started = time.perf_counter()
        try:
            learned = learn(jnp.asarray(truth), key=run)
        except (NotConverged, NotFinite) as error:
            return given | {"failure": str(error)}
        found = {"z": learned.z.tolist(), "sd": learned.sd.tolist()}
        return given | found | {"seconds": time.perf_counter() - started}


def coverage_band(level: int, count: int) -> tuple[float, float]:
    """Shares of ``count`` arms that right intervals of ``level`` per cent hold.

    Binomial, central 99.9 %: what lies outside is no accident.
    """
    low, high = scipy.stats.binom.interval(BAND, count, level / 100.0)
    return float(low) / count, float(high) / count


def coverage(z: Float[np.ndarray, "seeds p"], level: int) -> Float[np.ndarray, " p"]:
    """Share of arms whose truth lies in the central interval of each parameter."""
    limit = scipy.stats.norm.ppf(0.5 + level / 200.0)
    return np.asarray(np.mean(np.abs(z) <= limit, axis=0))
