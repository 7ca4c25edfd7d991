"""A machine: physics, and what is around it, as one record.

``Machine(plant, effects, sensors, actuators, variants)`` is a system. The plant is
physics: a bundled machine, a MuJoCo model, or the user's function. Each part around it
is a small record with one parameter. Parameters of the machine are the plant's and
those of its parts, fixed at their magnitudes: ``parameters`` gives them priors, or
other values, and `free_parts` (`sim2gp.systems.assemble`) gives each part its own
prior.

    machine = Machine(Furuta(), effects=[Coulomb("theta", 2e-3)])
    machine = free_parts(machine, [Delay("voltage", 0.02)])
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sim2gp import checks
from sim2gp.errors import error
from sim2gp.inference.parameters import Parameter, Parameters, unknown_parameter
from sim2gp.systems.actuators import (
    AbstractActuator,
    Delay,
    Gain,
    Lag,
    Offset,
    delayed_means,
)
from sim2gp.systems.base import (
    LONGEST_MEAN,
    AbstractPlant,
    AbstractSystem,
    Channel,
    index_of,
)
from sim2gp.systems.effects.base import (
    AbstractEffect,
    AbstractInputEffect,
    AbstractJointEffect,
    check_effect,
)
from sim2gp.systems.effects.forces import ForceField, Forcing, MissingForce
from sim2gp.systems.effects.kicks import kicked
from sim2gp.systems.function_checks import names_of
from sim2gp.systems.mechanism import AbstractMechanism, Effects
from sim2gp.systems.parts import AbstractPart
from sim2gp.systems.sensors import EncoderOffset
from sim2gp.systems.variants import AT, Variant, joint_table
from sim2gp.types import Action, Scalar, State


class MachineParams(eqx.Module):
    """Parameters of the plant, and of each part by name."""

    plant: Any
    parts: dict[str, Scalar]


class Machine(AbstractSystem):
    """A plant with effects, sensors and actuators, in one or several variants.

    ``parameters`` is a whole table, or maps names to a `Parameter` (free) or a number
    (fixed). With a ``period`` (s) of the control the state carries the past actions
    that delays and lags need, newest first, as channels ``voltage[-1]``,
    ``voltage[-2]``, ...; without one a delay is left to the caller of `flow` (the
    likelihood over windows).

    Raises `InputError` E103 for an unknown channel, E145 for an unknown name, for two
    parts of one name, for a tie to a part that is not there and for a part that the
    plant cannot have, E141 for a delay or a
    lag out of its range, E148 for a period that is not positive, E140, E123 or E173 for
    an effect whose functions have another shape, are no real numbers, or raise.
    """

    plant: AbstractPlant
    effects: tuple[AbstractEffect, ...]
    sensors: tuple[EncoderOffset, ...]
    actuators: tuple[AbstractActuator, ...]
    parameters: Parameters = eqx.field(static=True)
    period: float | None = eqx.field(static=True)
    variants: tuple[Variant, ...] = eqx.field(static=True, default=())

    def __init__(
        self,
        plant: AbstractPlant,
        effects: Sequence[AbstractEffect] = (),
        sensors: Sequence[EncoderOffset] = (),
        actuators: Sequence[AbstractActuator] = (),
        variants: Sequence[Variant] = (),
        parameters: Parameters | Mapping[str, Parameter | float] | None = None,
        *,
        period: float | None = None,
    ) -> None:
        self.plant, self.variants, self.period = plant, tuple(variants), period
        self.effects, self.sensors = tuple(effects), tuple(sensors)
        self.actuators = tuple(actuators)
        if period is not None:
            checks.positive("Machine", period=period)
        for part in self.parts:
            part.unit(plant)  # raises for a channel that is not there
        own = plant.parameters.merge(self._magnitudes())
        if isinstance(parameters, Parameters):
            self.parameters = _completed(own, parameters, self.variants)
        else:
            table = own.replace(**dict(parameters or {}))
            self.parameters = joint_table(table, variants) if variants else table
        self._check_inputs()

    def check_functions(self) -> None:
        """Each effect's: a force on the wrong joints would pass for one on both."""
        for effect in self.effects:
            check_effect(self.plant, effect)

    def _magnitudes(self) -> Parameters:
        """The parameters of the parts, fixed; a shared one is that of its own input."""
        names = [*names_of(self.plant.parameters), *(p.place for p in self.parts)]
        for part in self.parts:
            if names.count(part.place) > 1:
                raise error("two_parts_of_one_name", got=part.place)
        own: dict[str, float] = {}
        for part in self.parts:
            own |= part.values if part.name == part.place else {}
        for part in self.parts:
            if not own.keys() & part.values.keys():
                raise error(
                    "constant_to_share_missing",
                    got=part.name,
                    expected=", ".join(own),
                    part=part.place,
                )
        return Parameters((), tuple(own.items()))

    def _check_inputs(self) -> None:
        """Delays and lags that can be followed (E141, E145, E148)."""
        late = {p.where: p.name for p in self.actuators if isinstance(p, Delay)}
        for part in self.actuators:
            low, high = self._range(part.name)
            if isinstance(part, Delay) and (low < 0.0 or high == math.inf):
                got = f"from {low:g} to {high:g} s"
                raise error("delay_without_end", got=got, name=part.name)
            if not isinstance(part, Lag):
                continue
            checks.positive("Machine with a lag", period=self.period or 0.0)
            if part.where in late and self._range(late[part.where])[1] > 0.0:
                raise error("lag_of_delayed_input", where=part.where)
            if not (low > 0.0 and math.isfinite(high)):
                got = f"from {low:g} to {high:g} s"
                raise error("lag_out_of_range", got=got, name=part.name)

    @property
    def parts(self) -> tuple[AbstractPart, ...]:
        """Effects, sensors and actuators."""
        return *self.effects, *self.sensors, *self.actuators

    @property
    def joint_effects(self) -> tuple[AbstractJointEffect, ...]:
        """Those that act on the joints, in their order."""
        return tuple(e for e in self.effects if isinstance(e, AbstractJointEffect))

    @property
    def states(self) -> tuple[Channel, ...]:
        past = tuple(
            replace(channel, name=f"{channel.name}[-{k}]")
            for k in range(1, self.history + 1)
            for channel in self.actions
        )
        return self.plant.states + past

    @property
    def actions(self) -> tuple[Channel, ...]:
        return self.plant.actions

    @property
    def max_substep(self) -> float:
        # A plant without equations is stepped as its author steps it.
        inside = isinstance(self.plant, AbstractMechanism)
        own = [e.max_substep if inside else LONGEST_MEAN for e in self.effects]
        mean = [LONGEST_MEAN] if self.actuators else []
        return min([self.plant.max_substep, *own, *mean])

    @property
    def window_substep(self) -> float:
        return self.plant.window_substep

    @property
    def own_step(self) -> float | None:
        return self.plant.own_step

    @property
    def longest_delay(self) -> float:
        delays = [p for p in self.actuators if isinstance(p, Delay)]
        return max((self._range(p.name)[1] for p in delays), default=0.0)

    @property
    def history(self) -> int:
        if self.period is None:
            return 0
        lags = (p for p in self.actuators if isinstance(p, Lag))
        past = [part.memory(self._range(part.name)[1]) for part in lags]
        longest = max([self.longest_delay, *past])
        return math.ceil(longest / self.period - 1e-9)

    def record(self, values: Mapping[str, Scalar]) -> MachineParams:
        parts = {name: values[name] for part in self.parts for name in part.values}
        return MachineParams(self.plant.record(values), parts)

    def flow(
        self, params: MachineParams, s: State, a: Action, h: float | Scalar
    ) -> State:
        """The plant's own with effects, at the true position, under the input that
        arrives; ``s`` is the physical state, ``a`` the delayed or filtered input."""
        a = self._through(params, a)
        if not self.sensors:
            return self._moved(params, s, a, h)
        offset = self._offset(params).astype(s.dtype)
        return self._moved(params, s + offset, a, h) - offset

    def altered(self, constants: Float[Array, " r"], a: Action) -> Action:
        """The plant's input where ``a`` arrives, by the parameters named `altering`.

        Each entry depends on the same one of ``a`` alone.
        """
        parts = dict(zip(self.altering, constants, strict=True))
        return self._through(MachineParams(None, parts), a)

    @property
    def altering(self) -> tuple[str, ...]:
        """Names of the parameters that alter inputs."""
        effects = (e for e in self.effects if isinstance(e, AbstractInputEffect))
        parts = (*self._of(Gain), *self._of(Offset), *effects)
        return tuple(dict.fromkeys(name for part in parts for name in part.values))

    def _through(self, params: MachineParams, a: Action) -> Action:
        """The input behind the actuators' gains, offsets and effects."""
        if self._of(Gain):
            a = self._each(params, Gain) * a
        if self._of(Offset):
            a = a + self._each(params, Offset)
        on_inputs = [e for e in self.effects if isinstance(e, AbstractInputEffect)]
        if not on_inputs:
            return a
        each = list(a)  # an array that is set again and again compiles for long
        for effect in on_inputs:
            i = index_of(effect.where, self.actions)
            each[i] = effect.through(effect.own(params.parts), each[i])
        return jnp.stack(each)

    def _offset(self, params: MachineParams) -> Float[Array, " n"]:
        """What the encoders leave out of each state."""
        zero = jnp.zeros_like(params.parts[self.sensors[0].name])
        known = {p.where: params.parts[p.name] for p in self.sensors}
        return jnp.stack([known.get(c.name, zero) for c in self.plant.states])

    def delays(self, params: MachineParams) -> Float[Array, " m"]:
        """Delay of each input; a lag is none (E145 over windows of logs)."""
        if not self.delaying:
            return self.plant.delays(params.plant)
        return self._each(params, Delay)

    @property
    def delaying(self) -> dict[str, str]:
        """Names of the parameters that delay inputs, by input (E145 for a lag)."""
        for part in self.actuators:
            if isinstance(part, Lag):
                raise error("lag_over_windows", name=part.name, channel=part.where)
        return {part.where: part.name for part in self._of(Delay)}

    def mean_inputs(
        self, params: MachineParams, held: Float[Array, "past m"], dt: float, count: int
    ) -> Float[Array, "count m"]:
        if self._of(Delay):
            means = delayed_means(held, dt, self._each(params, Delay), count)
        else:
            means = jnp.broadcast_to(held[:1], (count, held.shape[1]))
        for part in self.actuators:
            if isinstance(part, Lag):
                i = index_of(part.where, self.actions)
                filtered = part.means(held[:, i], dt, params.parts[part.name], count)
                means = means.at[:, i].set(filtered)
        return means

    @property
    def forcing(self) -> tuple[Forcing, ...]:
        """What acts on the joints: effects, and all missing forces as one."""
        forces = tuple(e for e in self.effects if isinstance(e, MissingForce))
        return *self.joint_effects, *((ForceField(forces),) if forces else ())

    def acting(self, params: MachineParams) -> Effects:
        """The same with their magnitudes, or weights."""
        return [(effect, effect.own(params.parts)) for effect in self.forcing]

    def _moved(
        self, params: MachineParams, s: State, a: Action, h: float | Scalar
    ) -> State:
        """The plant's flow, with the effects on its joints."""
        acting = self.acting(params)
        if not acting:
            return self.plant.flow(params.plant, s, a, h)
        if isinstance(self.plant, AbstractMechanism):
            return self.plant.flow_with(params.plant, acting, s, a, h)
        return kicked(self.plant, params.plant, acting, s, a, h)

    def _of(self, kind: type[Gain | Offset | Delay]) -> list[AbstractActuator]:
        """The actuators of one kind that do something, or may."""
        nothing = (kind.neutral, kind.neutral)
        of_kind = (part for part in self.actuators if isinstance(part, kind))
        return [part for part in of_kind if self._range(part.name) != nothing]

    def _each(
        self, params: MachineParams, kind: type[Gain | Offset | Delay]
    ) -> Float[Array, " m"]:
        """The parameters of one kind of actuator, of each input."""
        found = {part.where: params.parts[part.name] for part in self._of(kind)}
        none = jnp.full_like(next(iter(found.values())), kind.neutral)
        return jnp.stack([found.get(channel.name, none) for channel in self.actions])

    def _range(self, name: str) -> tuple[float, float]:
        """Least and largest value of a parameter, in any variant."""
        fixed = [*self.parameters.fixed, *(x for c in self.variants for x in c.fixed)]
        low = high = [value for known, value in fixed if known == name]
        free = [p for p in self.parameters.free if p.name.split(AT)[0] == name]
        low, high = low + [p.low for p in free], high + [p.high for p in free]
        return min(low), max(high)


def plant_of(system: AbstractSystem) -> AbstractPlant:
    """The physics of a system, without what is around it."""
    found = system.plant if isinstance(system, Machine) else system
    assert isinstance(found, AbstractPlant)  # a system is a plant or a machine
    return found


def as_machine(system: AbstractSystem) -> Machine:
    """A plant as a machine without parts."""
    return system if isinstance(system, Machine) else Machine(plant_of(system))


def _completed(
    own: Parameters, given: Parameters, variants: Sequence[Variant]
) -> Parameters:
    """The given table with the parameters that it does not mention (E145)."""
    known = {name.split(AT)[0] for name in names_of(given)}
    for name in sorted(known - set(names_of(own))):
        raise unknown_parameter(name, names_of(own))
    known |= {name for c in variants for name in (*dict(c.fixed), *c.own)}
    free = tuple(p for p in own.free if p.name not in known)
    fixed = tuple((name, value) for name, value in own.fixed if name not in known)
    return given.merge(Parameters(free, fixed))
