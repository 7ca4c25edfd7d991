"""What every executor offers: independent jobs in, their results as they get done."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

from sim2gp import errors
from sim2gp.errors import Sim2GPError

Job = TypeVar("Job")
Result = TypeVar("Result")
#: A result, or the kind and arguments of an error of ours.
Outcome = tuple[Any, tuple[str, dict[str, Any]] | None]


class AbstractExecutor(ABC):
    """Does independent jobs, elsewhere or here.

    Jobs and results are pickled; arrays of 64 bits must be NumPy's, since JAX would
    read them with 32.
    """

    @property
    @abstractmethod
    def count(self) -> int:
        """How many jobs are done at once; 1 is this process itself."""

    @property
    @abstractmethod
    def accelerated(self) -> bool:
        """Whether each of its processes has an accelerator."""

    @abstractmethod
    def spread(
        self, work: Callable[[Job], Result], groups: Sequence[Sequence[Job]]
    ) -> Iterator[tuple[Job, Result]]:
        """``work(job)`` of every job as it gets done; ``work`` must be importable.

        Jobs of a group share what they compile. Raises what ``work`` raises of
        `Sim2GPError`, and E208 when a process dies of anything else.
        """

    def in_order(
        self,
        work: Callable[[Job], Result],
        jobs: Sequence[Job],
        done: Callable[[Job], object],
    ) -> list[Result]:
        """``work(job)`` of every job, in their order; ``done(job)`` as each is ready.

        No two jobs may be the same object.
        """
        place = {id(job): k for k, job in enumerate(jobs)}
        found: dict[int, Result] = {}
        for job, result in self.spread(work, [[job] for job in jobs]):
            found[place[id(job)]] = result
            done(job)
        return [found[k] for k in range(len(jobs))]


def outcome_of(work: Callable[[Any], Any], job: Any) -> Outcome:
    """What a process sends back: the job's result, or an error that it raised."""
    try:
        return work(job), None
    except Sim2GPError as caught:
        return None, (type(caught).__name__, caught.arguments)


def result_of(outcome: Outcome) -> Any:
    """The result that was sent; raises the error that was."""
    result, failure = outcome
    if failure is not None:
        kind, arguments = failure
        raise getattr(errors, kind)(**arguments)
    return result
