"""What a search over commands is made of, for a simulator in JAX or on the host."""

from collections.abc import Callable
from typing import Any, NamedTuple

from jaxtyping import Array

from sim2gp.types import AnyArray, Key


class SearchPrograms(NamedTuple):
    """Better coefficients, draws' states and excess over limits, and the information.

    The last of commands: nats, the belief's scale after them, and the mean's states.
    """

    improve: Callable[[Key], AnyArray]
    check: Callable[[Array], tuple[AnyArray, AnyArray]]
    told: Callable[[Array], tuple[Any, AnyArray, AnyArray]]
