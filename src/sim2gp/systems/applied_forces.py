"""Missing forces on the joints of an engine, in N and N m.

At each step of the engine they are those of the state where the step begins, and are
held for as long as it lasts, as its inputs are:

    s' = step(theta, s, [a, f(w, s)], h)

In NumPy: the engine's threads and JAX's callbacks ask for them.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from sim2gp.systems.base import Channel, index_of
from sim2gp.systems.effects.forces import ForceField
from sim2gp.systems.plants.external import AbstractSimulator


class WithForces(AbstractSimulator):
    """An engine under missing forces; their weights are its last parameters.

    ``engine`` takes a force on each joint behind its inputs; ``states`` are its own,
    positions first.
    """

    def __init__(
        self, engine: AbstractSimulator, states: Sequence[Channel], field: ForceField
    ) -> None:
        self.engine, self.differences = engine, engine.differences
        self.names = (*engine.names, *field.values)
        self._joints = sum(c.unit in ("rad", "m") for c in states)
        self._of, first = [], 0
        for force in field.forces:
            joint, last = index_of(force.where, states), first + len(force.basis.sds)
            z = joint + self._joints * force.of_velocity
            self._of.append((force.basis, joint, z, slice(first, last)))
            first = last
        self._count = first

    def substeps(self, span: Float[np.ndarray, "*r"]) -> np.ndarray:
        return self.engine.substeps(span)

    def flow(
        self,
        theta: Float[np.ndarray, "B p"],
        s: Float[np.ndarray, "B n"],
        a: Float[np.ndarray, "B m"],
        h: Float[np.ndarray, " B"],
    ) -> Float[np.ndarray, "B n"]:
        of_engine, w = np.split(theta, [-self._count], axis=1)
        counts = self.substeps(h)
        for k in range(int(counts.max(initial=1))):
            span = np.where(k < counts, h / counts, 0.0)
            s = self.engine.flow(of_engine, s, self._inputs(w, s, a), span)
        return s

    def slopes(
        self,
        theta: Float[np.ndarray, "B p"],
        s: Float[np.ndarray, "B n"],
        a: Float[np.ndarray, "B m"],
        h: Float[np.ndarray, " B"],
    ) -> tuple[Float[np.ndarray, "B n"], Float[np.ndarray, "B n pnm"]]:
        return self.slopes_of_steps(theta, s, a, h)

    def jacobian(
        self,
        theta: Float[np.ndarray, "B p"],
        s: Float[np.ndarray, "B n"],
        a: Float[np.ndarray, "B m"],
        h: Float[np.ndarray, " B"],
        after: Float[np.ndarray, "B n"],
    ) -> Float[np.ndarray, "B n pnm"]:
        of_engine, w = np.split(theta, [-self._count], axis=1)
        p, n, m = of_engine.shape[1], s.shape[1], a.shape[1]
        whole = self.engine.jacobian(of_engine, s, self._inputs(w, s, a), h, after)
        by_theta, by_s, by_a, by_f = np.split(whole, np.cumsum([p, n, m]), axis=2)
        by_w, by_s = np.zeros((len(s), n, self._count)), by_s.copy()
        for basis, joint, z, own in self._of:
            push, at = by_f[..., joint], s[:, z]
            by_w[..., own] = push[..., None] * basis.features(at)[:, None]
            by_s[..., z] += push * basis.slope(w[:, own].T, at)[:, None]
        return np.concatenate([by_theta, by_w, by_s, by_a], axis=2)

    def _inputs(
        self,
        w: Float[np.ndarray, "B k"],
        s: Float[np.ndarray, "B n"],
        a: Float[np.ndarray, "B m"],
    ) -> Float[np.ndarray, "B mj"]:
        """Inputs, and the forces on all joints behind them.

        Intervals and forecasts begin where most weights are zero, for each of a
        thousand steps: what is zero need not be computed.
        """
        f = np.zeros((len(s), self._joints))
        for basis, joint, z, own in self._of:
            if w[:, own].any():
                f[:, joint] += basis.value(w[:, own].T, s[:, z])
        return np.concatenate([a, f], axis=1)
