"""How a descent ended: at a MAP, near enough to one, or not."""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from sim2gp.errors import DeadParameters, NotConverged, NotFinite, error
from sim2gp.types import AnyArray, AnyScalar

CONVERGED, STALLED, NOT_FINITE, DEAD = 0, 1, 2, 3
#: A MAP that is no farther than this, in posterior sd, is an answer.
NEAR = 0.03


class Convergence(eqx.Module):
    """How a descent ended; ``newton_step_sd`` is the undamped step that remains."""

    status: Int[AnyArray, ""]
    gradient: AnyScalar  # ``||g||_inf / (1 + cost)``
    newton_step_sd: AnyScalar  # its largest entry, in posterior sd
    steps: int | Int[AnyArray, ""]
    away: Float[AnyArray, " p"]  # that step, of each parameter in its posterior sd

    def as_dict(self) -> dict[str, float | int]:
        """For summary.json: steps, and how far the MAP may be in posterior sd."""
        step_sd, gradient = float(self.newton_step_sd), float(self.gradient)
        finite = {"newton_step_sd": step_sd, "gradient": gradient}
        known = {name: x for name, x in finite.items() if math.isfinite(x)}
        return {"steps": int(self.steps), **known}

    def check(self, names: tuple[str, ...], where: str, near: float = 0.0) -> None:
        """Raise a typed error on the host, naming what to look at.

        A fit that has stalled is an answer as well where its MAP is no farther than
        ``near``, in posterior sd.
        """
        status = int(self.status)
        if status == NOT_FINITE:
            raise error("fit_not_finite", NotFinite, where=where)
        if status == DEAD:
            got = f"zero sensitivity to {', '.join(names)}"
            raise error(
                "no_parameter_reaches_data", DeadParameters, where=where, got=got
            )
        if status == STALLED and not float(self.newton_step_sd) <= near:
            step = f"{float(self.newton_step_sd):.1e} posterior sd"
            got = (
                f"scaled gradient {float(self.gradient):.1e} "
                f"({step}) after {int(self.steps)} steps; farthest off: "
                f"{self._farthest(names)}"
            )
            limit = f"{max(near, NEAR):g}"
            raise error(
                "map_not_reached", NotConverged, where=where, got=got, near=limit
            )

    def _farthest(self, names: tuple[str, ...]) -> str:
        """The three parameters that the last step would move most."""
        away = np.asarray(self.away)
        away = np.where(np.isfinite(away), away, np.inf)
        order = np.argsort(-away)[:3]
        return ", ".join(f"{names[i]} ({away[i]:.2g} sd)" for i in order)


def converged(p: int) -> Convergence:
    """Of ``p`` parameters that needed no descent."""
    zero, none = jnp.zeros(()), jnp.zeros((), int)
    return Convergence(jnp.asarray(CONVERGED), zero, zero, none, jnp.zeros(p))
