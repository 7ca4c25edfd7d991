"""Groups of logs as variants of one machine, and sums that were measured.

    [[logs]]                                  [[logs]]
    name = "bare"                             name = "payload"
    fixed = {"body/hand/mass" = 0.4}          free = ["body/hand/mass"]

Parameters that a group does not name are shared with all others. A column of its own
has the prior of its parameter, or of ``[parameters."body/hand/mass @ payload"]``.
"""

from collections.abc import Mapping

from sim2gp.errors import InputError, error
from sim2gp.inference.linear_measurements import LinearMeasurement
from sim2gp.inference.parameters import Parameter, unknown_parameter
from sim2gp.project.priors import prior, with_location
from sim2gp.project.schema import ParameterSpec, ProjectSpec
from sim2gp.project.source import ProjectSource
from sim2gp.systems import AbstractSystem, Variant, with_variants
from sim2gp.systems.assemble import with_measurements
from sim2gp.systems.function_checks import names_of
from sim2gp.systems.variants import AT


def with_configurations(
    spec: ProjectSpec, source: ProjectSource, system: AbstractSystem
) -> AbstractSystem:
    """The machine in all configurations of the file; as it is, where there is one.

    Raises `InputError` E141, E145 and E160.
    """
    places: dict[str, int] = {}
    for i, group in enumerate(spec.logs):
        first = spec.logs[places.setdefault(spec.configuration(i), i)]
        if (group.fixed, sorted(group.free)) != (first.fixed, sorted(first.free)):
            where, got = source.where("logs", i, "name"), spec.configuration(i)
            raise error("configuration_in_two_ways", where=where, got=got)
    if not any(group.fixed or group.free for group in spec.logs):
        for column in own_columns(spec.parameters):
            known = names_of(system.parameters)
            where = source.where("parameters", column)
            raise with_location(unknown_parameter(column, known), where)
        return system
    found = []
    for name, i in places.items():
        group = spec.logs[i]
        fixed = tuple(group.fixed.items())
        found.append(Variant(name, fixed, tuple(group.free)))
        try:  # alone, so that an error has its group's place
            with_variants(system, found[-1:])
        except InputError as caught:
            wrong = str(caught.got).split(" ")[0]
            if wrong in group.free or not group.fixed:
                where = source.where("logs", i, "free")
            else:
                where = source.where("logs", i, "fixed", wrong)
            raise with_location(caught, where) from caught
    priors = _priors(spec, source, system, found)
    return with_variants(system, found, priors)


def with_linear_measurements(
    spec: ProjectSpec, source: ProjectSource, system: AbstractSystem
) -> AbstractSystem:
    """The machine with the sums that the file says were measured (E142 to E160)."""
    for i, stated in enumerate(spec.weighed):
        where = source.where("weighed", i, "of")
        given = stated.weights
        weights = tuple([1.0] * len(stated.of) if given is None else given)
        if len(weights) != len(stated.of):
            where = source.where("weighed", i, "weights")
            got = f"{len(weights)} weights"
            raise error("weights_of_sum", where=where, got=got, count=len(stated.of))
        found = LinearMeasurement(tuple(stated.of), weights, stated.value, stated.sd)
        try:
            system = with_measurements(system, [found])
        except InputError as caught:
            raise with_location(caught, where) from caught
    return system


def own_columns(parameters: Mapping[str, object]) -> list[str]:
    """The names of ``[parameters]`` that speak of one configuration alone."""
    return [name for name in parameters if AT in name]


def _priors(
    spec: ProjectSpec,
    source: ProjectSource,
    system: AbstractSystem,
    variants: list[Variant],
) -> dict[str, Parameter]:
    """What the file says of columns of one configuration."""
    table = system.parameters
    columns = {c.column(name): name for c in variants for name in c.own}
    priors = {}
    for column in own_columns(spec.parameters):
        where = source.where("parameters", column)
        if column not in columns:
            raise with_location(
                unknown_parameter(column, [*columns, *table.names]), where
            )
        stated = spec.parameters[column]
        base = table[columns[column]]
        found = prior(stated, base, where)
        tied = isinstance(stated, ParameterSpec) and stated.tie
        if tied or not isinstance(found, Parameter):
            got = "tie" if tied else f"{found:g}"
            raise error("no_prior_of_column", where=where, got=got, column=column)
        priors[column] = found
    return priors
