"""Missing forces on the joints of an engine, in N and N m.

At each step of the engine they are those of the state where the step begins, and are
held for as long as it lasts, as its inputs are:

    s' = step(theta, s, [a, f(w, s)], h)

In NumPy: the engine's threads and JAX's callbacks ask for them.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sim2gp.systems.base import Channel, index_of
from sim2gp.systems.effects.bases import StateBasis, alike
from sim2gp.systems.effects.forces import ForceField
from sim2gp.systems.plants.external import AbstractSimulator


class Alike(NamedTuple):
    """The ``g`` forces whose bases are of one kind, each with ``k`` weights."""

    basis: StateBasis
    of: list[int]  # the state of each
    columns: Int[np.ndarray, "k g"]  # of its weights, among all
    onto_joints: Float[np.ndarray, "g j"]  # one where it acts
    onto_states: Float[np.ndarray, "g n"]  # one where its state is

    def weights(self, w: Float[np.ndarray, "B K"]) -> Float[np.ndarray, "k g B"]:
        """Theirs, of those of all forces."""
        return w.T[self.columns]

    def points(self, s: Float[np.ndarray, "B n"]) -> Float[np.ndarray, "g B"]:
        """Where they are asked for."""
        return s.T[self.of]


def _kinds(
    field: ForceField, states: Sequence[Channel], joints: int
) -> Iterator[Alike]:
    forces = field.forces
    acts = [index_of(force.where, states) for force in forces]
    of = [j + joints * f.of_velocity for j, f in zip(acts, forces, strict=True)]
    sizes = [len(force.basis.sds) for force in forces]
    columns = np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1])
    for basis, each in alike([force.basis for force in forces]):
        own, at = np.stack([columns[i] for i in each], axis=1), [of[i] for i in each]
        onto_joints = np.eye(joints)[[acts[i] for i in each]]
        yield Alike(basis, at, own, onto_joints, np.eye(len(states))[at])


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
        self._count = len(field.values)
        self._kinds = list(_kinds(field, states, self._joints))

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
        for each in self._kinds:
            push, at = by_f @ each.onto_joints.T, each.points(s)
            features = each.basis.features(at).swapaxes(0, 1)[:, None]
            by_w[..., each.columns.T] = push[..., None] * features
            slope = each.basis.slope(each.weights(w), at).T[:, None]
            by_s += (push * slope) @ each.onto_states
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
        f = np.zeros((self._joints, len(s)))
        for each in self._kinds:
            own = each.weights(w)
            if own.any():
                f += each.onto_joints.T @ each.basis.value(own, each.points(s))
        return np.concatenate([a, f.T], axis=1)
