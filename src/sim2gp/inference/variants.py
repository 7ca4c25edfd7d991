"""One machine in several configurations: what they share, and what each has alone.

Logs of one robot with and without its payload share nearly all constants. A joint fit
has one vector of free columns: those of shared constants, and for a constant that some
configuration has alone a column of its own, named ``<constant> @ <configuration>``. The
machine in configuration ``g`` has the constants

    theta_g = G_g (theta, known),    G_g a selection of columns and of known values,

so what the fit sees is one function of one vector, and ``g`` is data like the inputs.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Int

from sim2gp.errors import InputError, nearest
from sim2gp.types import AnyArray, Scalar

#: Between a constant and the one configuration whose column it is.
AT = " @ "
#: The index of a configuration; a machine that has one alone needs none.
Which = Int[AnyArray, ""] | int | None


@dataclass(frozen=True)
class Configuration:
    """What one configuration has alone; all other constants are shared.

    ``fixed`` are constants whose value is known in it, ``own`` those that are learned
    for it by themselves.
    """

    name: str
    fixed: tuple[tuple[str, float], ...] = ()
    own: tuple[str, ...] = ()

    def column(self, constant: str) -> str:
        """The free column, or the name of the known value, that a constant has in it.

        Of a value that is fixed in this configuration it is ``<constant> @ <name>``
        too: no column of the table.
        """
        alone = constant in self.own or constant in dict(self.fixed)
        return f"{constant}{AT}{self.name}" if alone else constant


def valued(
    values: Mapping[str, Scalar],
    configurations: Sequence[Configuration],
    index: Which,
) -> dict[str, Scalar]:
    """The constants of one configuration out of all columns and known ``values``.

    ``index`` may be traced: constants that differ are gathered, the others stay as they
    are. Raises `InputError` E152 where there are several and none is chosen.
    """
    if not configurations:
        return dict(values)
    if index is None:
        raise which(None, [c.name for c in configurations])
    like = next(iter(values.values()))
    known = dict(values)
    for c in configurations:
        known |= {c.column(x): jnp.asarray(v, like.dtype) for x, v in c.fixed}
    differing = {x: None for c in configurations for x in (*dict(c.fixed), *c.own)}
    alone = {c.column(x) for c in configurations for x in differing if x != c.column(x)}
    found = {name: x for name, x in values.items() if name not in alone}
    for x in differing:
        found[x] = jnp.stack([known[c.column(x)] for c in configurations])[index]
    return found


def index_of(name: str | None, configurations: Sequence[Configuration]) -> int:
    """Position of a configuration; the first where there are none (E152)."""
    names = [c.name for c in configurations]
    if not names and name is None:
        return 0
    if name not in names:
        raise which(name, names)
    return names.index(name)


def which(name: str | None, known: Sequence[str]) -> InputError:
    """E152: a configuration must be named, by one of the known names."""
    close = nearest(name, known) if name else None
    said = f"one of {', '.join(known)}" if known else "no name: there is one alone"
    return InputError(
        "E152",
        "unknown configuration" if name else "which configuration of the machine",
        got=name or "none named",
        expected=said,
        fix=f"did you mean {close}" if close else "name one with --configuration",
    )
