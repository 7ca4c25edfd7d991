"""The simulator on the host that moves a machine, with the forces on its joints.

JAX asks a simulator on the host for single steps; whole windows of logs it moves by
itself (`sim2gp.data.window_slopes`). Effects on the joints of such a machine are kicks
around each of its steps (`sim2gp.systems.effects.kicks`); missing forces act within the
steps of an engine that takes forces (`sim2gp.systems.applied_forces`).
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sim2gp.inference.linearized import value_and_jacobian
from sim2gp.systems.applied_forces import WithForces
from sim2gp.systems.base import AbstractPlant, AbstractSystem
from sim2gp.systems.effects.forces import ForceField, Forcing
from sim2gp.systems.effects.kicks import is_applied, kick
from sim2gp.systems.machine import Machine, plant_of
from sim2gp.systems.plants.external import AbstractSimulator
from sim2gp.types import AnyArray


def simulator_of(system: AbstractSystem) -> AbstractSimulator | None:
    """The simulator that moves whole windows of a machine; None where JAX does.

    Its parameters are those of the plant, then the weights of missing forces that it
    takes as forces, then the magnitudes of the machine's other effects on the joints.
    """
    plant = plant_of(system)
    engine = getattr(plant, "engine", None)
    if not isinstance(engine, AbstractSimulator) or getattr(plant, "mjx", None):
        return None
    forcing = system.forcing if isinstance(system, Machine) else ()
    kicks = tuple(x for x in forcing if not is_applied(plant, x))
    for field in forcing[len(kicks) :]:
        assert isinstance(field, ForceField)  # `is_applied`
        engine = WithForces(engine, plant.states, field)
    return WithKicks(engine, plant, kicks) if kicks else engine


class OnHost(NamedTuple):
    """What a simulator on the host needs of a machine's parameters: names, or numbers.

    theta: of the simulator.
    offset: the plant's states minus the system's.
    delays: of the inputs, s.
    altering: of what alters the inputs that arrive, for `Machine.altered`.
    """

    theta: Any
    offset: Any
    delays: Any
    altering: Any


def names_on_host(simulator: AbstractSimulator, system: AbstractSystem) -> OnHost:
    """Names of parameters, empty for zero (E145 for a lag)."""
    plant = plant_of(system)
    altering: tuple[str, ...] = ()
    offset: dict[str, str] = {}
    delays: dict[str, str] = {}
    if isinstance(system, Machine):
        offset = {sensor.where: sensor.name for sensor in system.sensors}
        delays, altering = system.delaying, system.altering
    return OnHost(
        simulator.names,
        tuple(offset.get(channel.name, "") for channel in plant.states),
        tuple(delays.get(channel.name, "") for channel in plant.actions),
        altering,
    )


def numbers_on_host(
    names: OnHost, system: AbstractSystem, tt: Float[np.ndarray, " p"], variant: int
) -> tuple[OnHost, OnHost]:
    """The parameters at virtual values, (q,) of each kind, and their slopes, (q, p)."""
    table, known = system.parameters, {"": 0.0} | dict(system.parameters.fixed)
    column: Callable[[str], str] = str
    if system.variants:
        column = system.variants[variant].column
        known |= {column(x): value for x, value in system.variants[variant].fixed}
    theta, (slope, _) = table.constrain(tt), table.slopes(tt)
    places = {name: i for i, name in enumerate(table.names)}

    def numbers(names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        x, J = np.zeros(len(names)), np.zeros((len(names), tt.size))
        for k, name in enumerate(map(column, names)):
            if name in places:
                i = places[name]
                x[k], J[k, i] = theta[i], slope[i]
            else:
                x[k] = known[name]
        return x, J

    found = [numbers(of_kind) for of_kind in names]
    return OnHost(*(x for x, _ in found)), OnHost(*(J for _, J in found))


class WithKicks(AbstractSimulator):
    """A simulator whose steps lie between half kicks of its joints' velocities."""

    def __init__(
        self,
        engine: AbstractSimulator,
        plant: AbstractPlant,
        forcing: tuple[Forcing, ...],
    ) -> None:
        self.engine, self.differences = engine, engine.differences
        self._kicks = tuple(_Kicks(plant, forcing, back) for back in (False, True))
        own = self._kicks[0].names
        self.names, self._count = (*engine.names, *own), len(own)

    def flow(
        self,
        theta: Float[np.ndarray, "B p"],
        s: Float[np.ndarray, "B n"],
        a: Float[np.ndarray, "B m"],
        h: Float[np.ndarray, " B"],
    ) -> Float[np.ndarray, "B n"]:
        of_plant, size = np.split(theta, [-self._count], axis=1)
        before, after = self._kicks
        s = before(size, s, 0.5 * h)
        return after(size, self.engine.flow(of_plant, s, a, h), 0.5 * h)

    def slopes(
        self,
        theta: Float[np.ndarray, "B p"],
        s: Float[np.ndarray, "B n"],
        a: Float[np.ndarray, "B m"],
        h: Float[np.ndarray, " B"],
    ) -> tuple[Float[np.ndarray, "B n"], Float[np.ndarray, "B n pnm"]]:
        of_plant, size = np.split(theta, [-self._count], axis=1)
        p, n = of_plant.shape[1], s.shape[1]
        before, after = self._kicks
        s, first = before.slopes(size, s, 0.5 * h)
        s, middle = self.engine.slopes(of_plant, s, a, h)
        s, last = after.slopes(size, s, 0.5 * h)
        by_plant, by_s, by_a = np.split(middle, [p, p + n], axis=2)
        by_size = by_s @ first[..., :-n]
        whole = np.concatenate([by_plant, by_size, by_s @ first[..., -n:], by_a], 2)
        whole = last[..., -n:] @ whole
        whole[..., p : p + self._count] += last[..., : self._count]
        return s, whole


class _Kicks(eqx.Module):
    """Kicks of a batch of states, in order or in reverse, as one compiled program."""

    plant: AbstractPlant
    forcing: tuple[Forcing, ...]
    backwards: bool

    @property
    def names(self) -> tuple[str, ...]:
        """Of the magnitudes and weights."""
        return tuple(name for effect in self.forcing for name in effect.values)

    def __call__(
        self,
        size: Float[np.ndarray, "B e"],
        s: Float[np.ndarray, "B n"],
        t: Float[np.ndarray, " B"],
    ) -> Float[np.ndarray, "B n"]:
        """States after kicks of ``t`` seconds, for magnitudes ``size``."""
        with jax.enable_x64(True):  # also where JAX calls back, in a thread of its own
            return np.asarray(_kicked(self, size, s, t))

    def slopes(
        self,
        size: Float[np.ndarray, "B e"],
        s: Float[np.ndarray, "B n"],
        t: Float[np.ndarray, " B"],
    ) -> tuple[Float[np.ndarray, "B n"], Float[np.ndarray, "B n en"]]:
        """The same, and their Jacobian in magnitudes and state."""
        with jax.enable_x64(True):
            state, J = _kicked_slopes(self, size, s, t)
            return np.asarray(state), np.asarray(J)


@eqx.filter_jit
def _kicked(kicks: _Kicks, size: AnyArray, s: AnyArray, t: AnyArray) -> Array:
    return jax.vmap(_kick, (None, 0, 0))(kicks, jnp.concatenate([size, s], 1), t)


@eqx.filter_jit
def _kicked_slopes(kicks: _Kicks, size: AnyArray, s: AnyArray, t: AnyArray) -> Any:
    def one(x: Array, t: Array) -> Any:
        return value_and_jacobian(lambda x: _kick(kicks, x, t), x)

    return jax.vmap(one)(jnp.concatenate([size, s], axis=1), t)


def _kick(kicks: _Kicks, x: Float[Array, " en"], t: Array) -> Float[Array, " n"]:
    size, s = jnp.split(x, [len(kicks.names)])
    values = dict(zip(kicks.names, size, strict=True))
    acting = [(effect, effect.own(values)) for effect in kicks.forcing]
    return kick(kicks.plant, acting[::-1] if kicks.backwards else acting, s, t)
