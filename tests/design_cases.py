"""A pendulum to design experiments for, its commands and limits."""

import jax.numpy as jnp
import numpy as np

import sim2gp.experiment_design as d
from rail_mass import DT, rail_mass
from sim2gp.inference.gaussian import Gaussian
from sim2gp.systems import Delay, free_parts
from simulated_logs import pendulum

PERIOD, STEPS, WINDOW = 0.01, 200, 20
LIMITS = {"theta": (-1.5, 1.5), "theta.velocity": (-15.0, 15.0)}


def experiment(system=None, *, width=0.5) -> d.Experiment:
    """Two seconds of a pendulum with three unknown constants, angles measured."""
    system = pendulum() if system is None else system
    prior = system.parameters.prior()
    return d.Experiment(
        system,
        Gaussian(prior.mean + 0.1, width * prior.scale),
        jnp.asarray([2e-3, 3e-3]),
        jnp.asarray([0.1, 0.4, 0.0, 0.0]),
        jnp.asarray([0.05, 0.05, 1.0, 1.0]),
        (0, 1),
        PERIOD,
        STEPS,
        WINDOW,
    )


def commands(seed=0, size=4.0):
    rng = np.random.default_rng(seed)
    held = np.repeat(rng.uniform(-size, size, (STEPS // 4, 1)), 4, axis=0)
    held[:4] = 0.0  # as before the log, whose first input is taken to have held
    return jnp.asarray(held)


def limits(system, stated=LIMITS, rates=None, start=(0.1, 0.4, 0.0, 0.0)):
    return d.LimitBox.of(system, stated, rates or {}, start=np.asarray(start))


def delayed():
    """The same pendulum behind an input with an unknown delay."""
    system = pendulum()
    return free_parts(system, [Delay("voltage")])


def rail_experiment() -> d.Experiment:
    """Two seconds of a mass on a rail; corrected, its belief is wider and elsewhere."""
    system = rail_mass()
    prior = system.parameters.prior()
    return d.Experiment(
        system,
        prior,
        jnp.asarray([1e-2]),
        jnp.zeros(2),
        jnp.asarray([0.05, 1.0]),
        (0,),
        DT,
        20,
        10,
        corrected=Gaussian(prior.mean + 0.3, 1.5 * prior.scale[:, ::-1]),
    )
