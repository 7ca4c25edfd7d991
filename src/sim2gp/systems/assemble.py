"""A machine with more: parts, free parameters, variants, and measured sums."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from sim2gp.errors import error
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.linear_measurements import LinearMeasurement
from sim2gp.inference.parameters import Parameter, Parameters, unknown_parameter
from sim2gp.systems.actuators import AbstractActuator
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.effects.base import AbstractEffect
from sim2gp.systems.function_checks import names_of
from sim2gp.systems.machine import Machine, as_machine, plant_of
from sim2gp.systems.parts import AbstractPart
from sim2gp.systems.sensors import EncoderOffset
from sim2gp.systems.variants import Variant, index_of, joint_table, own_table
from sim2gp.types import in_float64


def with_parts(
    system: AbstractSystem,
    parts: Sequence[AbstractPart],
    parameters: Mapping[str, Parameter | float] | None = None,
    *,
    period: float | None = None,
) -> AbstractSystem:
    """The machine with these parts as well; one of the same name is replaced.

    The parameters of the new parts are fixed at their magnitudes, except those in
    ``parameters``. Without parts it is the system as it is.
    """
    if not parts:
        return system
    machine, given = as_machine(system), dict(parameters or {})
    table, places = machine.parameters, {part.place for part in parts}
    own = (part.values for part in parts if part.name == part.place)
    values = {name: value for each in own for name, value in each.items()}
    new = {k: v for k, v in values.items() if k not in names_of(table)}
    table = table.merge(Parameters((), tuple(new.items())))
    table = table.replace(**{name: given.get(name, x) for name, x in values.items()})
    every = [*(p for p in machine.parts if p.place not in places), *parts]
    return Machine(
        machine.plant,
        [p for p in every if isinstance(p, AbstractEffect)],
        [p for p in every if isinstance(p, EncoderOffset)],
        [p for p in every if isinstance(p, AbstractActuator)],
        machine.variants,
        table,
        period=period or machine.period,
    )


def free_parts(
    system: AbstractSystem,
    parts: Sequence[AbstractPart],
    *,
    period: float | None = None,
) -> AbstractSystem:
    """The machine with these parts as well, each with its own prior."""
    plant = plant_of(system)
    priors = {p.name: p for part in parts for p in part.priors(plant)}
    return with_parts(system, parts, priors, period=period)


def carrying_inputs(system: AbstractSystem, period: float) -> AbstractSystem:
    """The machine as its one-step map needs it: its state has the delayed inputs.

    Its parameters are the same, in the same order.
    """
    if not (isinstance(system, Machine) and system.longest_delay > 0.0):
        return system
    return replace(system, period=period)


def with_variants(
    system: AbstractSystem,
    variants: Sequence[Variant],
    priors: Mapping[str, Parameter] | None = None,
) -> Machine:
    """The machine in all of its variants at once, for a joint fit.

    ``priors`` as in `joint_table`, whose errors it raises; E141 for a delay that is
    longer than the machine's own.
    """
    machine = as_machine(system)
    table = joint_table(machine.parameters, variants, priors)
    for variant in variants:
        _check_delays(machine, table, variant)
    return replace(machine, variants=tuple(variants), parameters=table)


def with_measurements(
    system: AbstractSystem, sums: Sequence[LinearMeasurement]
) -> Machine:
    """The machine, of which some sums of parameters were measured.

    Of a machine in several variants a sum names columns. Raises `InputError` E142 for a
    sum that the bounds rule out, E144 for its sd, E145 for an unknown parameter, one
    that is named twice, or a sum of fixed ones alone.
    """
    table = system.parameters
    ranges = {p.name: (p.low, p.high) for p in table.free}
    ranges |= {name: (value, value) for name, value in table.fixed}
    for x in sums:
        for name in x.of:
            if name not in ranges:
                raise unknown_parameter(name, ranges)
        got = " + ".join(x.of)
        if len(set(x.of)) < len(x.of):
            raise error("constant_twice_in_sum", got=got)
        if not set(x.of) & set(table.names):
            raise error("sum_without_unknowns", got=got)
        x.check(ranges)
    more = replace(table, measurements=(*table.measurements, *sums))
    return replace(as_machine(system), parameters=more)


@in_float64
def one_variant(
    system: AbstractSystem, belief: Gaussian, name: str | None
) -> tuple[AbstractSystem, Gaussian]:
    """One variant as a machine of its own, and the belief over its parameters.

    ``belief`` is one over the joint table's virtual values. A machine without variants
    comes back as it is. Raises `InputError` E152.
    """
    if not isinstance(system, Machine) or not system.variants:
        index_of(name, ())
        return system, belief
    table, places = own_table(system.parameters, system.variants, name)
    whole = Gaussian(jnp.asarray(belief.mean), jnp.asarray(belief.scale))
    own = whole.marginal(np.asarray(places, int))
    return replace(system, variants=(), parameters=table), own


def _check_delays(machine: Machine, table: Parameters, variant: Variant) -> None:
    """No delay is longer than what inputs are kept for (E141)."""
    fixed, longest = dict(variant.fixed), machine.longest_delay
    for name in (f"{channel.name}.delay" for channel in machine.actions):
        low = high = fixed.get(name, 0.0)
        if name in variant.own:
            prior = table[variant.column(name)]
            low, high = prior.low, prior.high
        if not 0.0 <= low <= high <= longest:
            raise error(
                "delay_of_configuration_too_long",
                where=variant.name,
                got=f"{low:g} s" if low == high else f"from {low:g} to {high:g} s",
                name=name,
                longest=f"{longest:g}",
            )
