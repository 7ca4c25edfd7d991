"""How far from its MAP a fit may end, and what is reported."""

import jax.numpy as jnp
import pytest

from sim2gp.errors import DeadParameters, NotConverged, NotFinite, Sim2GPError
from sim2gp.inference.convergence import (
    CONVERGED,
    DEAD,
    NOT_FINITE,
    STALLED,
    Convergence,
)


@pytest.mark.parametrize(
    ("status", "step_sd", "near", "raised"),
    [
        (CONVERGED, 0.5, None, None),  # its gradient is flat
        (STALLED, 0.1, None, NotConverged),
        (STALLED, 0.1, 1.0, None),
        (STALLED, 1.1, 1.0, NotConverged),
        (STALLED, float("nan"), 1.0, NotConverged),
        (NOT_FINITE, 0.1, 1.0, NotFinite),
        (DEAD, 0.1, 1.0, DeadParameters),
    ],
)
def test_a_fit_is_refused_farther_from_its_map_than_is_asked(
    status: int, step_sd: float, near: float | None, raised: type[Sim2GPError] | None
) -> None:
    each = jnp.asarray([step_sd, 0.0])
    ended = Convergence(jnp.asarray(status), each[1], each[0], 7, each)
    asked = {} if near is None else {"near": near}
    if raised is None:
        ended.check(("mass", "damping"), "the data", **asked)
        return
    with pytest.raises(raised) as caught:
        ended.check(("mass", "damping"), "the data", **asked)
    if raised is NotConverged:
        assert "mass" in str(caught.value)
