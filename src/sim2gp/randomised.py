"""Domain randomisation: a world whose constants are drawn anew in every episode.

The state of such a world ends in the virtual constants, which nothing changes and which
a policy does not see. Drawn from the prior they are what robust policies are trained
with elsewhere; drawn from a posterior, what data have left of that.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp

from sim2gp.flight import world_of
from sim2gp.gaussian import Gaussian
from sim2gp.planning import MarkovObjective, World
from sim2gp.systems import AbstractSystem
from sim2gp.tasks import Task
from sim2gp.types import Action, Key, State, single


class Carried(eqx.Module):
    """``(s, tt), a -> (f(s, a; tt), tt)``."""

    system: AbstractSystem
    dt: float = eqx.field(static=True)

    def __call__(self, x: State, a: Action) -> State:
        n = len(self.system.states)
        s2 = self.system.transition(x[n:], x[:n], a, self.dt)
        return jnp.concatenate([s2, x[n:]])


class DrawnReset(eqx.Module):
    """A start, and constants drawn for it."""

    start: Callable[[Key], State]
    constants: Gaussian

    def __call__(self, key: Key) -> State:
        where, which = jax.random.split(key)
        return jnp.concatenate([self.start(where), self.constants.sample(which)])


def randomised_world(task: Task, system: AbstractSystem, constants: Gaussian) -> World:
    """``task`` on a simulator whose virtual constants every reset draws anew.

    It is for policies that are trained, and look at the machine's own state alone.
    """
    constants = single(constants)
    dynamics, objective = Carried(system, task.dt), MarkovObjective(task.reward)
    world = world_of(task, dynamics, objective, history=system.history)
    assert world.state_bound is not None
    free = jnp.full_like(constants.mean, jnp.inf)
    bound = jnp.concatenate([world.state_bound, free])
    reset = DrawnReset(world.reset, constants)
    return eqx.tree_at(lambda w: (w.reset, w.state_bound), world, (reset, bound))
