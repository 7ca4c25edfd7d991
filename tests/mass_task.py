"""A mass to be moved to 1: a task and a conjugate model, known in closed form."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from sim2gp.belief import AbstractBelief, AbstractModel
from sim2gp.data.transitions import Transitions
from sim2gp.inference.gaussian import Gaussian
from sim2gp.planning import ICEM, MPC, AbstractPlanner, World
from sim2gp.planning.episode import Trajectory, episode, oracle_world
from sim2gp.planning.tasks import Task
from sim2gp.types import Box, Dynamics, Key, State

KEY = jax.random.key(0)
DT = 0.1
NOISE = 1e-3, 1e-2
#: What was traced, drawn and fitted in the present test.
traces: list[str] = []
draws: list[str] = []
fits: list[tuple[int, int]] = []


@pytest.fixture(autouse=True)
def fresh_counters() -> None:
    """Count anew in each test of a file that imports this."""
    traces.clear()
    draws.clear()
    fits.clear()


class Mass(eqx.Module):
    """A double integrator of unknown gain; counts how often it is traced."""

    gain: Array

    def __call__(self, s: State, a: Array) -> State:
        traces.append("Mass")
        return jnp.stack([s[0] + DT * s[1], s[1] + DT * self.gain * a[0]])


class Reach(eqx.Module):
    def __call__(self, s: State, a: Array, s2: State) -> Array:
        return -((s2[0] - 1.0) ** 2) - 0.1 * s2[1] ** 2 - 1e-3 * a[0] ** 2


def single(*values: float) -> Array:
    return jnp.asarray(values, jnp.float32)


def mass_task(gain: float = 2.0, dynamics: Dynamics | None = None) -> Task:
    return Task(
        dynamics=Mass(jnp.asarray(gain, jnp.float32)) if dynamics is None else dynamics,
        reward=Reach(),
        noise=single(*NOISE),
        start=single(0.0, 0.0),
        start_sd=single(0.01, 0.01),
        state_bound=single(10.0, 10.0),
        actions=Box(single(-1.0), single(1.0)),
        truth={"gain": jnp.asarray(gain, jnp.float32)},
        name="mass",
        horizon=20,
        dt=DT,
        planning_horizon=8,
        planning_iterations=2,
    )


SMALL = MPC(ICEM(samples=32, elites=6))


class GainBelief(AbstractBelief):
    """``gain ~ N(mean, sd^2)``: conjugate, so the whole loop has a closed form."""

    mean: Array
    sd: Array

    @property
    def noise(self) -> Array:
        return single(*NOISE)

    def latent(self, s: State, a: Array) -> Gaussian:
        raise NotImplementedError

    def predict(self, s: State, a: Array) -> Gaussian:
        raise NotImplementedError

    def sample(self, key: Key) -> Mass:
        draws.append("draw")
        gain = self.mean + self.sd * jax.random.normal(key)
        return Mass(gain.astype(jnp.float32))

    def point(self) -> Mass:
        return Mass(self.mean)

    def sensitivity(self, s: State, a: Array) -> tuple[Array, Array]:
        velocity = DT * a[0] * self.sd / NOISE[1]
        shared = jnp.stack([jnp.zeros_like(velocity), velocity])[:, None]
        return shared, jnp.zeros((2, 0), shared.dtype)

    @property
    def coordinates(self) -> tuple[int, int, int]:
        return 2, 1, 0

    def parameters(self) -> tuple[Array, Array]:
        return self.mean[None], self.sd[None]


class GainModel(AbstractModel):
    def init(self, key: Key) -> GainBelief:
        return GainBelief(single(1.0)[0], single(1.0)[0])

    def fit(
        self, belief: AbstractBelief, data: Transitions, *, key: Key
    ) -> AbstractBelief:
        fits.append((data.count, len(data.mask)))
        x = DT * np.asarray(data.action)[:, 0] * np.asarray(data.mask)
        y = (np.asarray(data.next_state) - np.asarray(data.state))[:, 1]
        precision = 1.0 + x @ x / 1e-4
        mean = (1.0 + x @ y / 1e-4) / precision
        return GainBelief(*single(mean, 1.0 / np.sqrt(precision)))

    def update(
        self, belief: AbstractBelief, s: State, a: Array, s2: State
    ) -> AbstractBelief:
        """Conjugate; float64 in, the belief's own dtype out."""
        assert isinstance(belief, GainBelief)
        x = (DT * a[0]).astype(belief.mean.dtype)
        y = (s2 - s)[1].astype(belief.mean.dtype)
        precision = 1.0 / belief.sd**2 + x**2 / 1e-4
        mean = (belief.mean / belief.sd**2 + x * y / 1e-4) / precision
        return GainBelief(mean, precision**-0.5)


def start(task: Task, planner: AbstractPlanner, world: World) -> Any:
    return planner.init(world, key=KEY)


def fly_mass(gain: float = 2.0, key: Key = KEY) -> Trajectory:
    task = mass_task(gain)
    world = oracle_world(task)
    return episode(task, SMALL, start(task, SMALL, world), world, key=key)[0]


def same(one: Any, two: Any) -> bool:
    return bool(eqx.tree_equal(one, two))
