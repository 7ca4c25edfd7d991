"""Does `explain` find what was planted? Machines with known missing physics.

For each machine and effect, hidden constants are drawn from the prior and two episodes
of 5 s are flown on the task, process noise as there: one with pink noise as input, one
that pumps the pole up and over. Neither knows any constant. `explain` then sees states
and inputs alone.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from sim2gp.diagnose.evidence import OneStepData
from sim2gp.planning.noise import coloured_noise
from sim2gp.systems import (
    AbstractSystem,
    BaseTilt,
    CartPole,
    EncoderOffset,
    Furuta,
    InputDelay,
    InputLag,
    Lagged,
    effect,
)
from sim2gp.systems.base import AbstractMechanism, index_of
from sim2gp.systems.effects import AbstractEffect, AbstractForce, Pair
from sim2gp.systems.perturbed import perturb
from sim2gp.tasks import Task, cartpole_swingup, draw_truth, furuta_swingup
from sim2gp.types import Action, Key, Scalar

Planted = AbstractEffect | InputDelay | InputLag
MACHINES: dict[str, tuple[Callable[[], AbstractMechanism], Callable[..., Task]]] = {
    "furuta": (Furuta, furuta_swingup),
    "cartpole": (CartPole, cartpole_swingup),
}
EPISODES = 2
#: Pull back to the middle, V per rad or m; pole speed from which pumping turns round.
CENTRE = {"furuta": 1.0, "cartpole": 12.0}
FASTEST = {"furuta": 20.0, "cartpole": 12.0}
NOTHING = "nothing"


class Cogging(AbstractForce):
    """A motor that snaps into place, ``-magnitude sin(turns q)``."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    turns: float = eqx.field(static=True)
    what: ClassVar[str] = "cogging"
    meaning: ClassVar[str] = "cogging of the motor"
    max_substep: ClassVar[float] = 0.005

    def unit(self, system: AbstractMechanism) -> str:
        return "N m" if system.states[system.joint(self.where)].unit == "rad" else "N"

    def force(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair, v: Pair
    ) -> Pair:
        i = system.joint(self.where)
        return jnp.zeros_like(q).at[i].set(-x * jnp.sin(self.turns * q[i]))


class Saturation(AbstractEffect):
    """An amplifier that yields no more than ``magnitude``, smoothly."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    what: ClassVar[str] = "saturation"
    meaning: ClassVar[str] = "saturation of the amplifier"
    max_substep: ClassVar[float] = 0.005

    def unit(self, system: AbstractMechanism) -> str:
        return system.actions[index_of(self.where, system.actions)].unit

    def input(self, system: AbstractMechanism, x: Scalar, a: Action) -> Action:
        i = index_of(self.where, system.actions)
        return a.at[i].set(x * jnp.tanh(a[i] / x))

    def inertia(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair
    ) -> tuple[Scalar, Scalar, Scalar]:
        none = jnp.zeros_like(x)
        return none, none, none

    def force(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair, v: Pair
    ) -> Pair:
        return jnp.zeros_like(v)


class Coupling(AbstractForce):
    """Friction of the first joint that grows with the second one's speed."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    what: ClassVar[str] = "coupling"
    meaning: ClassVar[str] = "friction that grows with the pole's speed"
    max_substep: ClassVar[float] = 0.005

    def unit(self, system: AbstractMechanism) -> str:
        return "N m s^2/rad^2"

    def force(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair, v: Pair
    ) -> Pair:
        i = system.joint(self.where)
        return jnp.zeros_like(q).at[i].set(-x * v[i] * jnp.abs(v[1 - i]))


def _middle(machine: str, *names: str) -> dict[str, Planted]:
    return {name: effect(machine, name, "middle") for name in names}


_SHARED = ("coulomb", "dead_zone", "spring", "delay", "drag")
#: What is planted, at the catalogue's middle strength where it has the effect.
PLANTED: dict[str, dict[str, Planted]] = {
    "furuta": {
        **_middle("furuta", *_SHARED),
        "lag": InputLag("voltage", 0.015),
        "tilt": BaseTilt(magnitude=math.radians(2.0)),
        "encoder": EncoderOffset("alpha", math.radians(2.0)),
    },
    "cartpole": {
        **_middle("cartpole", *_SHARED),
        "lag": InputLag("voltage", 0.015),
        **_middle("cartpole", "tilt"),
        "encoder": EncoderOffset("theta", math.radians(2.0)),
    },
}
#: What no library holds.
OUTSIDE: dict[str, dict[str, Planted]] = {
    "furuta": {
        "cogging": Cogging("theta", 5e-3, 2.0),
        "saturation": Saturation("voltage", 3.0),
        "coupling": Coupling("theta", 1e-4),
    },
    "cartpole": {
        "cogging": Cogging("x", 3.0, 20.0),
        "saturation": Saturation("voltage", 6.0),
        "coupling": Coupling("x", 1.5),
    },
}


def name_of(planted: Planted) -> str:
    """Name that `explain` should answer."""
    if isinstance(planted, AbstractEffect):
        return planted.name
    return f"{planted.where}.{'lag' if isinstance(planted, InputLag) else 'delay'}"


def planted_task(machine: str, planted: Planted | None, key: Key) -> Task:
    """The machine's task with hidden constants and one more effect, float32."""
    make, preset = MACHINES[machine]
    bare = make()
    truth = draw_truth(bare, key)
    task = preset(truth)
    if planted is None:
        return task
    system: AbstractSystem
    if isinstance(planted, InputLag):
        system = Lagged(bare, planted.where, planted.magnitude, period=task.dt)
    else:
        system = perturb(bare, [planted], period=task.dt)
    fixed = {k: jnp.asarray(v, jnp.float32) for k, v in system.parameters.fixed}
    record = system.record(task.truth | fixed)
    dynamics = system.bind(record, task.dt)
    return dataclasses.replace(task, dynamics=dynamics, history=system.history)


@eqx.filter_jit
def _fly(
    task: Task, centre: float, fastest: float, pump: Array, key: Key
) -> tuple[Array, Array]:
    reset, process, drive = jax.random.split(key, 3)
    high = task.actions.high
    like = jnp.zeros((task.horizon, high.size), high.dtype)
    noise = coloured_noise(drive, 1, like, 1.0)[0]

    def step(s: Array, x: tuple[Array, Array]) -> tuple[Array, tuple[Array, Array]]:
        eps, t = x
        way = jnp.sign(s[3] * jnp.cos(s[1])) * jnp.sign(fastest - jnp.abs(s[3]))
        a = high * (0.4 * eps + pump * (0.1 * eps - 0.6 * way)) - centre * s[0]
        a = task.limit(a)
        s2 = task.step(s, a, key=jax.random.fold_in(process, t))
        return s2, (s2[: task.size], a)

    s0 = task.reset(reset)
    _, (S, A) = jax.lax.scan(step, s0, (noise, jnp.arange(task.horizon)))
    return jnp.concatenate([s0[None, : task.size], S]), A


def flights(
    machine: str, planted: Planted | None, key: Key
) -> list[tuple[np.ndarray, np.ndarray]]:
    """States (T + 1, n) and inputs (T, m) of two episodes on one hidden machine."""
    hidden, flown = jax.random.split(key)
    task = planted_task(machine, planted, hidden)
    return [
        jax.tree.map(
            np.asarray,
            _fly(
                task,
                CENTRE[machine],
                FASTEST[machine],
                jnp.asarray(float(e), jnp.float32),
                jax.random.fold_in(flown, e),
            ),
        )
        for e in range(EPISODES)
    ]


def data_of(machine: str, planted: Planted | None, key: Key) -> OneStepData:
    """What `explain` sees of them."""
    make, _ = MACHINES[machine]
    return OneStepData(make(), flights(machine, planted, key))
