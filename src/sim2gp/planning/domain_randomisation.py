"""Domain randomisation: a world whose parameters are drawn again in every episode.

The state of such a world ends in the virtual parameters. They do not change within an
episode, and a policy does not see them. Other tools train robust policies with draws
from the prior; a posterior is what the data leave of it.
"""

import equinox as eqx
import jax.numpy as jnp

from sim2gp.inference.gaussian import Gaussian
from sim2gp.planning.episode import world_of
from sim2gp.planning.tasks import Task
from sim2gp.planning.world import MarkovObjective, World
from sim2gp.systems import AbstractSystem
from sim2gp.types import Action, State, single


class Carried(eqx.Module):
    """``(s, tt), a -> (f(s, a; tt), tt)``."""

    system: AbstractSystem
    dt: float = eqx.field(static=True)

    def __call__(self, x: State, a: Action) -> State:
        n = len(self.system.states)
        s2 = self.system.transition(x[n:], x[:n], a, self.dt)
        return jnp.concatenate([s2, x[n:]])


def randomised_world(task: Task, system: AbstractSystem, constants: Gaussian) -> World:
    """``task`` on a simulator whose virtual parameters are drawn again at every reset.

    It is for policies that are trained, and look at the machine's own state alone.
    """
    constants = single(constants)
    dynamics, objective = Carried(system, task.dt), MarkovObjective(task.reward)
    return world_of(
        task, dynamics, objective, history=system.history, constants=constants
    )
