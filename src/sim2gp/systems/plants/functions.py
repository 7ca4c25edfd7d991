"""Your own differential equation as a system: a function, its parameters, its channels.

    ds/dt = ode(params, s, a),      integrated by RK4, the input held

`AbstractODE` is the same as a class, with a record of parameters.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx

from sim2gp import checks
from sim2gp.inference.parameters import Parameter, Parameters
from sim2gp.systems.base import AbstractODE, Channel, table_of
from sim2gp.systems.function_checks import check_returns, named_once, names_of
from sim2gp.types import Action, Scalar, State

Constants = dict[str, Scalar]


class ODE(AbstractODE):
    """A machine whose equation is a function ``ode(params, s, a)`` of JAX arrays.

    It is written for one point: ``params`` are the parameters by name, ``s`` the
    states, ``a`` the inputs, and what comes back is the time derivative of ``s``, per
    second. ``max_substep`` (s) is the longest step of RK4 within a period.

    Raises `InputError` E145 for a name that is there twice, E148 for a substep that is
    not positive, and, from one trace of the function, E140 for a derivative of another
    shape than the state's, E123 for one of no real numbers, E173 where it raises.
    """

    function: Callable[[Constants, State, Action], State] = eqx.field(static=True)
    parameters: Parameters = eqx.field(static=True)
    channels: tuple[Channel, ...] = eqx.field(static=True)
    inputs: tuple[Channel, ...] = eqx.field(static=True)
    longest: float = eqx.field(static=True)

    def __init__(
        self,
        ode: Callable[[Constants, State, Action], State],
        parameters: Sequence[Parameter] | Parameters,
        states: Sequence[Channel],
        actions: Sequence[Channel],
        *,
        max_substep: float = 0.01,
    ) -> None:
        self.function = ode
        self.parameters = table_of(parameters)
        self.channels, self.inputs = tuple(states), tuple(actions)
        self.longest = max_substep
        named_once(self.parameters, self.channels, self.inputs)
        checks.positive_or_infinite("ODE", max_substep=max_substep)

    def check_functions(self) -> None:
        """The user's function itself, under the user's name for it."""
        name = checks.name_of(self.function)
        check_returns(self, "a derivative", self.function, name=name)

    @property
    def states(self) -> tuple[Channel, ...]:
        return self.channels

    @property
    def actions(self) -> tuple[Channel, ...]:
        return self.inputs

    @property
    def max_substep(self) -> float:
        return self.longest

    def record(self, values: Mapping[str, Scalar]) -> Constants:
        """The parameters by name, without those of others."""
        return {name: values[name] for name in names_of(self.parameters)}

    def ode(self, params: Any, s: State, a: Action) -> State:
        return self.function(params, s, a)
