"""A machine with another table of constants: of several configurations, or of one.

What was weighed is part of a table as well (`with_weighed`).

``configured(system, [Configuration("bare", fixed=...), Configuration("payload", own=...
)])`` is one machine for a joint fit: windows and transitions say which configuration
each row is of. `alone` is the machine as it stands in one of them, for whoever acts on
it, and what a joint posterior says of it.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sim2gp.errors import InputError
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.linear_measurements import LinearMeasurement
from sim2gp.inference.parameters import Parameter, Parameters, unknown_parameter
from sim2gp.inference.variants import AT, Configuration, index_of
from sim2gp.systems.base import AbstractSystem, Channel
from sim2gp.systems.function_checks import names_of
from sim2gp.types import Action, Scalar, State, in_float64


class Configured(AbstractSystem):
    """A machine that is ``system`` in all but its table of constants."""

    system: AbstractSystem
    parameters: Parameters = eqx.field(static=True)

    def __init__(self, system: AbstractSystem, parameters: Parameters) -> None:
        self.system, self.parameters = system, parameters

    def check_functions(self) -> None:
        """The machine inside has checked its own."""

    @property
    def states(self) -> tuple[Channel, ...]:
        return self.system.states

    @property
    def actions(self) -> tuple[Channel, ...]:
        return self.system.actions

    @property
    def max_substep(self) -> float:
        return self.system.max_substep

    @property
    def window_substep(self) -> float:
        return self.system.window_substep

    @property
    def history(self) -> int:
        return self.system.history

    @property
    def longest_delay(self) -> float:
        return self.system.longest_delay

    def record(self, values: Mapping[str, Scalar]) -> Any:
        return self.system.record(values)

    def flow(self, params: Any, s: State, a: Action, h: float | Scalar) -> State:
        return self.system.flow(params, s, a, h)

    def delays(self, params: Any) -> Float[Array, " m"]:
        return self.system.delays(params)

    def mean_inputs(
        self, params: Any, held: Float[Array, "past m"], dt: float, count: int
    ) -> Float[Array, "count m"]:
        return self.system.mean_inputs(params, held, dt, count)

    def around(self, system: AbstractSystem) -> "Configured":
        """Another version of the machine inside: its new free constants are shared."""
        known, had = names_of(self.parameters), self.system.parameters.names
        new = [p for p in system.parameters.free if p.name not in had]
        freed = {p.name: p for p in new if p.name in known}  # a fixed one until now
        more = Parameters(tuple(p for p in new if p.name not in known))
        return Configured(system, self.parameters.merge(more).replace(**freed))


def configured(
    system: AbstractSystem,
    configurations: Sequence[Configuration],
    priors: Mapping[str, Parameter] | None = None,
) -> Configured:
    """The machine in all of its configurations at once.

    ``priors`` are those of columns, by ``<constant> @ <configuration>``; a column
    without one has the prior of its constant, independently. Raises `InputError` E145
    for an unknown constant or column, and for one that is stated twice or is not free.
    """
    table, given = system.parameters, dict(priors or {})
    for c in configurations:
        _check(table, c)
    names = [c.name for c in configurations]
    if len(set(names)) < len(names):
        raise InputError("E145", "two configurations of one name", got=", ".join(names))
    free = []
    for p in table.free:
        columns = dict.fromkeys(c.column(p.name) for c in configurations)
        own = {c.column(p.name) for c in configurations if p.name in c.own}
        for column in columns:
            if column == p.name or column in own:
                prior = given.pop(column, p)
                named = {"name": column, "unit": p.unit, "meaning": p.meaning}
                free.append(dataclasses.replace(prior, **named))  # type: ignore[arg-type]
    for column in given:
        raise unknown_parameter(column, [p.name for p in free])
    both = Parameters(tuple(free), table.fixed, tuple(configurations))
    for c in configurations:
        _check_delays(system, both, c)
    return Configured(system, both)


def with_weighed(
    system: AbstractSystem, sums: Sequence[LinearMeasurement]
) -> Configured:
    """The machine, of which some sums of constants were measured.

    Of a machine in several configurations a sum names columns. Raises `InputError` E142
    for a sum that the bounds rule out, E144 for its sd, E145 for an unknown constant,
    one that stands twice, or a sum of fixed ones alone.
    """
    table = system.parameters
    ranges = {p.name: (p.low, p.high) for p in table.free}
    ranges |= {name: (value, value) for name, value in table.fixed}
    for x in sums:
        for name in x.of:
            if name not in ranges:
                raise unknown_parameter(name, ranges)
        doubled = len(set(x.of)) < len(x.of)
        if doubled or not set(x.of) & set(table.names):
            raise InputError(
                "E145",
                "a constant twice in a sum" if doubled else "a sum without unknowns",
                got=" + ".join(x.of),
                expected="each constant once, one of them free",
                fix="state its weight" if doubled else "give one of them a prior",
            )
        x.check(ranges)
    more = dataclasses.replace(table, measurements=(*table.measurements, *sums))
    inner = system.system if isinstance(system, Configured) else system
    return Configured(inner, more)


def _check(table: Parameters, configuration: Configuration) -> None:
    """Constants that the table has, each stated once, own ones free (E145)."""
    fixed, own = dict(configuration.fixed), configuration.own
    for name in (*fixed, *own):
        if name not in names_of(table):
            raise unknown_parameter(name, names_of(table))
    for name in own:
        if name in fixed or own.count(name) > 1:
            raise InputError(
                "E145",
                "a constant stated twice in one configuration",
                where=configuration.name,
                got=name,
                expected="a known value, or a column of its own",
                fix=f"leave one of the two out for {name}",
            )
        if name not in table.names:
            raise InputError(
                "E145",
                "a fixed constant cannot be free in one configuration",
                where=configuration.name,
                got=f"{name} = {dict(table.fixed)[name]:g}",
                expected="a constant with a prior",
                fix=f"give {name} a prior, and fix it in the other configurations",
            )


def _check_delays(
    system: AbstractSystem, table: Parameters, configuration: Configuration
) -> None:
    """No delay is longer than what inputs are kept for (E141)."""
    fixed = dict(configuration.fixed)
    for name in (f"{channel.name}.delay" for channel in system.actions):
        low = high = fixed.get(name, 0.0)
        if name in configuration.own:
            prior = table[configuration.column(name)]
            low, high = prior.low, prior.high
        if not 0.0 <= low <= high <= system.longest_delay:
            raise InputError(
                "E141",
                f"{name} of one configuration",
                where=configuration.name,
                got=f"{low:g} s" if low == high else f"from {low:g} to {high:g} s",
                expected=f"from 0 to {system.longest_delay:g} s, as the machine has it",
                fix=f"widen the machine's own {name}",
            )


def own_table(
    table: Parameters, name: str | None
) -> tuple[Parameters, tuple[int, ...]]:
    """One configuration's constants, and where the free ones stand in the joint table.

    Raises `InputError` E152 for an unknown configuration, or none where there are some.
    """
    if not table.configurations:
        index_of(name, ())
        return table, tuple(range(len(table)))
    chosen = table.configurations[index_of(name, table.configurations)]
    known = dict(table.fixed) | dict(chosen.fixed)
    free, places = [], []
    for i, p in enumerate(table.free):
        constant = p.name.split(AT)[0]
        if p.name == chosen.column(constant):
            free.append(dataclasses.replace(p, name=constant))
            places.append(i)
            known.pop(constant, None)
    # A posterior knows what was weighed already.
    return Parameters(tuple(free), tuple(known.items())), tuple(places)


@in_float64
def alone(
    system: AbstractSystem, belief: Gaussian, name: str | None
) -> tuple[AbstractSystem, Gaussian]:
    """The machine as it stands in one configuration, and what is believed of it.

    ``belief`` is one over the joint table's virtual values. A machine that has one
    configuration alone has no names: it comes back as it is. Raises `InputError` E152.
    """
    if not system.parameters.configurations:
        index_of(name, ())
        return system, belief
    assert isinstance(system, Configured)  # no other table has configurations
    table, places = own_table(system.parameters, name)
    at = np.asarray(places, int)
    own = Gaussian(jnp.asarray(belief.mean)[at], jnp.asarray(belief.scale)[at])
    square = Gaussian(own.mean, own.triangular())
    return Configured(system.system, table), square
