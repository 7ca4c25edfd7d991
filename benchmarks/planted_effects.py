"""Does the search find planted physics? Machines with known missing physics.

For each machine and effect, hidden constants are drawn from the prior and two episodes
of 5 s are run on the task, process noise as there: one with pink noise as input, one
that pumps the pole up and over. Neither knows any constant. `find_missing_physics` then
sees states and inputs alone.
"""

import dataclasses
import math
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from sim2gp.identification.missing_physics.data import OneStepData
from sim2gp.identification.missing_physics.explain import find_missing_physics
from sim2gp.planning.coloured_noise import coloured_noise
from sim2gp.planning.tasks import MACHINES, Task, draw_truth
from sim2gp.runs.cell_work import AbstractCell, Values
from sim2gp.systems import (
    AbstractPlant,
    BaseTilt,
    EncoderOffset,
    Lag,
    effect,
    with_parts,
)
from sim2gp.systems.effects.base import (
    AbstractForce,
    AbstractInputEffect,
)
from sim2gp.systems.effects.units import force_unit
from sim2gp.systems.mechanism import AbstractMechanism, Pair
from sim2gp.systems.parts import AbstractPart
from sim2gp.types import Key, Scalar

EPISODES = 2
#: Pull back to the middle, V per rad or m; pole speed from which pumping turns round.
CENTRE = {"furuta": 1.0, "cartpole": 12.0}
FASTEST = {"furuta": 20.0, "cartpole": 12.0}
NOTHING = "nothing"
#: Machines with nothing missing, for each of those with something.
SOUND = 2


class Cogging(AbstractForce):
    """A motor that snaps into place, ``-magnitude sin(turns q)``."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    turns: float = eqx.field(static=True)
    what: ClassVar[str] = "cogging"
    meaning: ClassVar[str] = "cogging of the motor"
    max_substep: ClassVar[float] = 0.005

    def unit(self, plant: AbstractPlant) -> str:
        return force_unit(plant, self.where)

    def force(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair, v: Pair
    ) -> Pair:
        i = system.joint(self.where)
        return jnp.zeros_like(q).at[i].set(-x * jnp.sin(self.turns * q[i]))


class Saturation(AbstractInputEffect):
    """An amplifier that yields no more than ``magnitude``, smoothly."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    what: ClassVar[str] = "saturation"
    meaning: ClassVar[str] = "saturation of the amplifier"
    max_substep: ClassVar[float] = 0.005

    def through(self, x: Scalar, u: Scalar) -> Scalar:
        return x * jnp.tanh(u / x)


class Coupling(AbstractForce):
    """Friction of the first joint that grows with the second one's speed."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    what: ClassVar[str] = "coupling"
    meaning: ClassVar[str] = "friction that grows with the pole's speed"
    max_substep: ClassVar[float] = 0.005

    def unit(self, plant: AbstractPlant) -> str:
        return "N m s^2/rad^2"

    def force(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair, v: Pair
    ) -> Pair:
        i = system.joint(self.where)
        return jnp.zeros_like(q).at[i].set(-x * v[i] * jnp.abs(v[1 - i]))


def _middle(machine: str, *names: str) -> dict[str, AbstractPart]:
    return {name: effect(machine, name, "middle") for name in names}


_SHARED = ("coulomb", "dead_zone", "spring", "delay", "drag")
#: What is planted, at the catalogue's middle strength where it has the effect.
PLANTED: dict[str, dict[str, AbstractPart]] = {
    "furuta": {
        **_middle("furuta", *_SHARED),
        "lag": Lag("voltage", 0.015),
        "tilt": BaseTilt(magnitude=math.radians(2.0)),
        "encoder": EncoderOffset("alpha", math.radians(2.0)),
    },
    "cartpole": {
        **_middle("cartpole", *_SHARED),
        "lag": Lag("voltage", 0.015),
        **_middle("cartpole", "tilt"),
        "encoder": EncoderOffset("theta", math.radians(2.0)),
    },
}
#: What no library holds.
OUTSIDE: dict[str, dict[str, AbstractPart]] = {
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


def planted_task(machine: str, planted: AbstractPart | None, key: Key) -> Task:
    """The machine's task with hidden constants and one more effect, float32."""
    make, preset = MACHINES[machine]
    bare = make()
    truth = draw_truth(bare, key)
    task = preset(truth)
    if planted is None:
        return task
    system = with_parts(bare, [planted], period=task.dt)
    fixed = {k: jnp.asarray(v, jnp.float32) for k, v in system.parameters.fixed}
    record = system.record(task.truth | fixed)
    dynamics = system.bind(record, task.dt)
    return dataclasses.replace(task, dynamics=dynamics, history=system.history)


@eqx.filter_jit
def _run_episodes(
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


def episodes_in(
    machine: str, planted: AbstractPart | None, key: Key
) -> list[tuple[np.ndarray, np.ndarray]]:
    """States (T + 1, n) and inputs (T, m) of two episodes on one hidden machine."""
    hidden, run = jax.random.split(key)
    task = planted_task(machine, planted, hidden)
    return [
        jax.tree.map(
            np.asarray,
            _run_episodes(
                task,
                CENTRE[machine],
                FASTEST[machine],
                jnp.asarray(float(e), jnp.float32),
                jax.random.fold_in(run, e),
            ),
        )
        for e in range(EPISODES)
    ]


def data_of(machine: str, planted: AbstractPart | None, key: Key) -> OneStepData:
    """What `find_missing_physics` sees of them."""
    make, _ = MACHINES[machine]
    return OneStepData(make(), episodes_in(machine, planted, key))


def scaled(planted: AbstractPart, strength: float) -> AbstractPart:
    """The same effect, so many times as strong."""
    return dataclasses.replace(planted, magnitude=strength * planted.magnitude)


def settings(machine: str) -> dict[str, AbstractPart | None]:
    """Everything that is planted on a machine, by name: nothing, effects, others."""
    return {NOTHING: None, **PLANTED[machine], **OUTSIDE[machine]}


@dataclass(frozen=True)
class SearchCell(AbstractCell):
    """One hidden machine, and what is planted on it."""

    machine: str
    planted: str
    index: int
    seed: int = 0
    strength: float = 1.0

    @property
    def name(self) -> str:
        return f"{self.machine}-{self.planted}-{self.index}"

    @property
    def arguments(self) -> Values:
        return {"seed": self.seed, "strength": self.strength}

    @property
    def program(self) -> tuple[Hashable, ...]:
        return self.machine, self.planted

    def compute(self, needed: Values | None) -> Values:
        """The search's answer, and the right one."""
        del needed
        machine, name, every = self.machine, self.planted, settings(self.machine)
        planted = every[name]
        if planted is not None:
            planted = scaled(planted, self.strength)
        key = jax.random.key(self.seed)
        for part in ([*MACHINES].index(machine), [*every].index(name), self.index):
            key = jax.random.fold_in(key, part)
        found = find_missing_physics(data_of(machine, planted, key))
        refitted = found.search.refitted
        ranked = [r.scored.candidate.name for r in refitted]
        scored = sorted((s for s in found.search.scored if not s.alias), key=_falling)
        inside = name in PLANTED[machine] and planted is not None
        alarms = found.best.tests.items() if found.best else ()
        return {
            "machine": machine,
            "planted": name,
            "index": self.index,
            "truth": planted.name if inside and planted is not None else "",
            "answer": found.answer,
            "effect": found.effect or "",
            "ranked": ranked,
            "gains": [r.gain for r in refitted],
            "tied": [r.scored.candidate.name for r in found.search.tied],
            "value": refitted[0].value if refitted else None,
            "magnitude": 0.0 if planted is None else planted.magnitude,
            "scored_first": scored[0].candidate.name,
            "alarms": [k for k, t in alarms if t.alarm],
        }


def cells(
    machine: str, truths: int, seed: int = 0, strength: float = 1.0
) -> Iterator[SearchCell]:
    """``truths`` hidden machines for all that is planted, more with nothing."""
    for name in settings(machine):
        count = SOUND * truths if name == NOTHING else truths
        for k in range(count):
            yield SearchCell(machine, name, k, seed, strength)


def _falling(scored: Any) -> float:
    return -float(scored.gain)


def verdict(machine: str, found: Mapping[str, Any]) -> str:
    """right, or what was answered instead."""
    name, answer = found["planted"], found["answer"]
    if name == NOTHING:
        return "right" if answer == "nothing missing" else _told(found)
    if name in OUTSIDE[machine]:
        return "right" if answer == "none of these" else _told(found)
    return "right" if found["effect"] == found["truth"] else _told(found)


def _told(found: Mapping[str, Any]) -> str:
    return str(found["effect"] or found["answer"])


def claims(found: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """The three shares of right answers, their bars, and how often the right effect
    was ranked first whatever the answer."""
    kinds: dict[str, list[bool]] = {"effect": [], "nothing": [], "none of these": []}
    first = []
    for one in found:
        right = verdict(one["machine"], one) == "right"
        if one["planted"] == NOTHING:
            kinds["nothing"].append(right)
        elif one["truth"]:
            kinds["effect"].append(right)
            first.append(bool(one["ranked"]) and one["ranked"][0] == one["truth"])
        else:
            kinds["none of these"].append(right)
    kinds["effect ranked first"] = first
    bars = {
        "effect": 0.85,
        "effect ranked first": 0.85,
        "nothing": 0.95,
        "none of these": 0.80,
    }
    out = {}
    for name, bar in bars.items():
        share = float(np.mean(kinds[name])) if kinds[name] else math.nan
        figures = {"share": share, "of": len(kinds[name]), "bar": bar}
        out[name] = {"holds": share >= bar, **figures}
    return out
