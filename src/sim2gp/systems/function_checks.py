"""What the author of a system wrote, checked by one trace when it is constructed.

Inside a step numbers broadcast: a derivative of one number would move every state.
"""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from sim2gp import checks
from sim2gp.errors import error
from sim2gp.inference.parameters import Parameters
from sim2gp.types import Action, State

if TYPE_CHECKING:
    from sim2gp.systems.base import AbstractSystem, Channel
    from sim2gp.systems.mechanism import AbstractMechanism


def names_of(table: Parameters) -> tuple[str, ...]:
    """Names of all parameters, those that are learned and then those that are fixed."""
    return *table.names, *(name for name, _ in table.fixed)


def named_once(table: Parameters, *channels: Sequence["Channel"]) -> None:
    """Every parameter, state and input has a name of its own (E145)."""
    names = [*names_of(table), *(c.name for group in channels for c in group)]
    for name in names:
        if names.count(name) > 1:
            raise error("name_given_twice", got=name)


def check_returns(
    system: "AbstractSystem",
    what: str,
    function: Callable[..., Any],
    *more: Any,
    name: str,
    size: int | None = None,
) -> None:
    """That ``function(params, s, a, *more)`` has a number for each state, or ``size``.

    ``what`` it returns and its ``name`` are for the message. Raises `InputError` E140,
    E123 and E173 otherwise.
    """
    n, m, table = len(system.physical_states), len(system.actions), system.parameters
    given = jnp.result_type(float)
    s, a, scalar = (jax.ShapeDtypeStruct(x, given) for x in ((n,), (m,), ()))
    values = dict.fromkeys(names_of(table), scalar)
    record = f"{type(system).__name__}.record"
    params = checks.shapes(system.record, values, name=record)
    meaning = "a number for each state" if size is None else ""
    shape = (n if size is None else size,)
    arguments = params, s, a, *more
    checks.returns(what, function, arguments, shape, name=name, meaning=meaning)


def check_mechanism(system: "AbstractMechanism") -> None:
    """That inertia and forces are those of two joints (E140, E123, E173)."""
    for what, f, size in (("inertia", _inertia, 3), ("forces", _forces, 2)):
        name = f"{type(system).__name__}.{what}"
        function = jax.tree_util.Partial(f, system)
        check_returns(system, what, function, name=name, size=size)


def _inertia(system: "AbstractMechanism", params: Any, s: State, a: Action) -> Any:
    """`AbstractMechanism.inertia` as one array."""
    return jnp.stack(system.inertia(params, s[:2]))


def _forces(system: "AbstractMechanism", params: Any, s: State, a: Action) -> Any:
    """`AbstractMechanism.forces` of a whole state."""
    return system.forces(params, s[:2], s[2:4], a)
