"""A search over commands: what both kinds give, in JAX and on the host."""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

from jaxtyping import Array, Float

from sim2gp.experiment_design.experiment import Experiment
from sim2gp.experiment_design.goals import AbstractGoal
from sim2gp.experiment_design.limits import LimitBox
from sim2gp.experiment_design.signals import AbstractCommandSignal
from sim2gp.types import AnyArray, Key


class SearchProblem(NamedTuple):
    """What is searched for, and draws of the parameters in units of the belief.

    informed: the information is their mean; trials: they must keep the limits while
        searching; held_out: what is found is held against them.
    """

    experiment: Experiment
    signal: AbstractCommandSignal
    goal: AbstractGoal
    limits: LimitBox
    informed: Float[Array, "D p"]
    trials: Float[Array, "N p"]
    held_out: Float[Array, "K p"]


class SearchPrograms(NamedTuple):
    """Better coefficients, draws' states and excess over limits, and the information.

    The last of commands: nats, the belief's scale after them, and the mean's states.
    """

    improve: Callable[[Key], AnyArray]
    check: Callable[[Array], tuple[AnyArray, AnyArray]]
    information: Callable[[Array], tuple[Any, AnyArray, AnyArray]]


@runtime_checkable
class SearchMethod(Protocol):
    """A module that searches: `by_gradients` and `by_samples`.

    TRIALS, CHECKED: draws that must keep the limits while searching, and at the end.
    """

    TRIALS: int
    CHECKED: int

    def search_programs(self, problem: SearchProblem) -> SearchPrograms:
        """The programs that search and judge."""

    def sensitivity_at(
        self, experiment: Experiment, U: Float[Array, "T m"], periods: int
    ) -> Float[AnyArray, "k p"]:
        """How predictions of so many periods move with the virtual parameters."""

    def scale_after(
        self, experiment: Experiment, U: Float[Array, "T m"]
    ) -> Float[AnyArray, "p p"]:
        """Square root of the covariance that commands leave, at the belief's mean."""
