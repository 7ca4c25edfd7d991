"""What was measured of the machine itself: "both links together weigh 1.24 kg".

    sum_k w_k theta_k = value + eps,     eps ~ N(0, sd^2)

A sum of parameters is linear in ``theta`` and not in their virtual values, so it is one
more row of the least squares, not a change of the independent prior.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float

from sim2gp import checks
from sim2gp.errors import error
from sim2gp.types import Scalar


@dataclass(frozen=True)
class LinearMeasurement:
    """A measured sum of parameters, each times its weight, and its sd."""

    of: tuple[str, ...]
    weights: tuple[float, ...]
    value: float
    sd: float

    def check(self, ranges: Mapping[str, tuple[float, float]]) -> None:
        """That the parameters can make up the sum, within ``ranges`` (E142, E144)."""
        checks.moments(f"the measured {' + '.join(self.of)}", self.value, self.sd)
        pairs = list(zip(self.of, self.weights, strict=True))
        low, high = (
            sum(pick(w * end for end in ranges[name]) for name, w in pairs if w != 0.0)
            for pick in (min, max)
        )
        if not low < self.value < high:
            raise error(
                "measured_sum_out_of_bounds",
                where=" + ".join(self.of),
                got=f"{self.value:g}",
                low=f"{low:g}",
                high=f"{high:g}",
            )


def residuals(
    measurements: Sequence[LinearMeasurement], values: Mapping[str, Scalar], like: Array
) -> Float[Array, " q"]:
    """How far each sum is from what was measured, in sd."""
    rows = []
    for x in measurements:
        terms = zip(x.weights, x.of, strict=True)
        rows.append((sum(w * values[name] for w, name in terms) - x.value) / x.sd)
    return jnp.stack(rows) if rows else jnp.zeros(0, like.dtype)
