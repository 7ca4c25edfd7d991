"""Variants of one machine: which parameters they share, and which each has alone.

Logs of one robot with and without its payload share nearly all parameters. A joint fit
has one vector of free columns: those of shared parameters, and for a parameter that
some variant has alone a column of its own, named ``<parameter> @ <variant>``. Variant
``g`` of the machine has the parameters

    theta_g = G_g (theta, known),    G_g a selection of columns and of known values,

so the fit sees one function of one vector, and ``g`` is data like the inputs. Project
files and the command line call a variant a configuration.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Int

from sim2gp.errors import InputError, error, nearest
from sim2gp.inference.parameters import Parameter, Parameters, unknown_parameter
from sim2gp.systems.function_checks import names_of
from sim2gp.types import AnyArray, AnyScalar

#: Between a parameter and the one variant whose column it is.
AT = " @ "
#: The index of a variant; a machine without variants needs none.
Which = Int[AnyArray, ""] | int | None


@dataclass(frozen=True)
class Variant:
    """What one variant has alone; all other parameters are shared.

    ``fixed`` are parameters whose value is known in it, ``own`` those that are learned
    for it by themselves.
    """

    name: str
    fixed: tuple[tuple[str, float], ...] = ()
    own: tuple[str, ...] = ()

    def column(self, constant: str) -> str:
        """The free column, or the name of the known value, that a parameter has in it.

        A value that is fixed in this variant is named ``<parameter> @ <name>``, too: it
        is no column of the table.
        """
        alone = constant in self.own or constant in dict(self.fixed)
        return f"{constant}{AT}{self.name}" if alone else constant


def values_of(
    columns: Mapping[str, AnyScalar], variants: Sequence[Variant], index: Which
) -> dict[str, AnyScalar]:
    """The parameters of one variant out of all columns and known values.

    ``index`` may be traced: parameters that differ are gathered, the others stay as
    they are. Raises `InputError` E152 where there are several and none is chosen.
    """
    if not variants:
        return dict(columns)
    if index is None:
        raise which(None, [c.name for c in variants])
    like = next(iter(columns.values()))
    known = dict(columns)
    for c in variants:
        known |= {c.column(x): jnp.asarray(v, like.dtype) for x, v in c.fixed}
    differing = {x: None for c in variants for x in (*dict(c.fixed), *c.own)}
    alone = {c.column(x) for c in variants for x in differing if x != c.column(x)}
    found = {name: x for name, x in columns.items() if name not in alone}
    for x in differing:
        found[x] = jnp.stack([known[c.column(x)] for c in variants])[index]
    return found


def joint_table(
    table: Parameters,
    variants: Sequence[Variant],
    priors: Mapping[str, Parameter] | None = None,
) -> Parameters:
    """The columns of all variants of a machine with this table.

    ``priors`` are those of columns, by ``<parameter> @ <variant>``; a column without
    one has the prior of its parameter, independently. Raises `InputError` E145 for an
    unknown parameter or column, and for one that is stated twice or is not free.
    """
    given = dict(priors or {})
    for c in variants:
        _check(table, c)
    names = [c.name for c in variants]
    if len(set(names)) < len(names):
        raise error("two_configurations_of_one_name", got=", ".join(names))
    free = []
    for p in table.free:
        columns = dict.fromkeys(c.column(p.name) for c in variants)
        own = {c.column(p.name) for c in variants if p.name in c.own}
        for column in columns:
            if column == p.name or column in own:
                prior = given.pop(column, p)
                named = {"name": column, "unit": p.unit, "meaning": p.meaning}
                free.append(dataclasses.replace(prior, **named))  # type: ignore[arg-type]
    for column in given:
        raise unknown_parameter(column, [p.name for p in free])
    return Parameters(tuple(free), table.fixed)


def own_table(
    table: Parameters, variants: Sequence[Variant], name: str | None
) -> tuple[Parameters, tuple[int, ...]]:
    """One variant's parameters, and where the free ones are in the joint table.

    Raises `InputError` E152 for an unknown variant, or none where there are some.
    """
    if not variants:
        index_of(name, ())
        return table, tuple(range(len(table)))
    chosen = variants[index_of(name, variants)]
    known = dict(table.fixed) | dict(chosen.fixed)
    free, places = [], []
    for i, p in enumerate(table.free):
        constant = p.name.split(AT)[0]
        if p.name == chosen.column(constant):
            free.append(dataclasses.replace(p, name=constant))
            places.append(i)
            known.pop(constant, None)
    # A posterior already includes the measured sums.
    return Parameters(tuple(free), tuple(known.items())), tuple(places)


def index_of(name: str | None, variants: Sequence[Variant]) -> int:
    """Position of a variant; the first where there are none (E152)."""
    names = [c.name for c in variants]
    if not names and name is None:
        return 0
    if name not in names:
        raise which(name, names)
    return names.index(name)


def which(name: str | None, known: Sequence[str]) -> InputError:
    """E152: a variant must be named, by one of the known names."""
    close = nearest(name, known) if name else None
    expected = f"one of {', '.join(known)}" if known else "no name: there is one alone"
    if not name:
        return error("which_configuration", got="none named", expected=expected)
    fix = f"did you mean {close}" if close else None
    return error("unknown_configuration", got=name, expected=expected, fix=fix)


def _check(table: Parameters, variant: Variant) -> None:
    """Parameters that the table has, each stated once, own ones free (E145)."""
    fixed, own = dict(variant.fixed), variant.own
    for name in (*fixed, *own):
        if name not in names_of(table):
            raise unknown_parameter(name, names_of(table))
    for name in own:
        if name in fixed or own.count(name) > 1:
            raise error(
                "constant_stated_twice", where=variant.name, got=name, name=name
            )
        if name not in table.names:
            got = f"{name} = {dict(table.fixed)[name]:g}"
            raise error("fixed_constant_freed", where=variant.name, got=got, name=name)
