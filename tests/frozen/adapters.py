"""Where the library's parts stand today: the one file here that follows a rewrite."""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import machines
import payload_arm
import sim2gp as sg
import simulated_logs
from sim2gp import systems as sy
from sim2gp.data.one_step import OneStepLikelihood
from sim2gp.data.split_log import cut
from sim2gp.data.transitions import Transitions
from sim2gp.data.windows_likelihood import (
    WindowsLikelihood,
    linearise,
    start_states,
)
from sim2gp.identification.fit import fit_windows
from sim2gp.identification.intervals.discrepancy import corrected_windows
from sim2gp.identification.missing_physics.at_zero import at_zero
from sim2gp.identification.missing_physics.data import WindowData
from sim2gp.identification.missing_physics.score import score_candidates
from sim2gp.inference.estimate import Estimate
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.likelihood import AbstractLikelihood
from sim2gp.inference.linear_measurements import LinearMeasurement
from sim2gp.systems.assemble import with_measurements
from sim2gp.types import in_float64


def stepped() -> dict[str, sg.AbstractSystem]:
    """Every kind of machine: bare, with effects, with actuators, with offset zeros."""
    furuta = sy.Furuta()
    lagged = sy.Machine(furuta, actuators=[sy.Lag("voltage", 0.01)], period=0.02)
    zeroed = sy.Machine(furuta, sensors=[sy.EncoderOffset("alpha", 0.03)])
    return machines.every() | {"lagged": lagged, "zeroed": zeroed}


def one_step() -> dict[str, sg.AbstractSystem]:
    """Machines that are fitted to exact states."""
    furuta = sy.Furuta()
    freed = sy.free_parts(furuta, [sy.Coulomb("theta", 2e-3)])
    delayed = sy.free_parts(furuta, [sy.Delay("voltage", 0.03)], period=0.02)
    arm = sy.UniformRodArm()
    return {
        "furuta": furuta,
        "cartpole": sy.CartPole(),
        "arm": arm,
        "friction": freed,
        "delay": delayed,
    }


#: The machines of `windowed`, by name: to make them is to simulate their logs.
WINDOWED = ("actuated", "robust", "one_step", "groups", "measured_sum")


@functools.cache
def windowed() -> dict[str, tuple[sg.AbstractSystem, list[Any], dict[str, Any]]]:
    """Machines that are fitted to logs, with the logs, and options of the fit."""
    bare = simulated_logs.pendulum()
    actuated = sy.free_parts(bare, sy.neutral_actuators(bare.actions))
    late = simulated_logs.simulated(seconds=2.0, seed=2, delay=0.006, noise=1e-3)
    exact = simulated_logs.simulated(
        seconds=0.6, seed=3, noise=1e-3, velocities=True, jitter=0.1
    )
    arm = payload_arm.arm()
    both = sy.with_variants(
        arm,
        [
            sy.Variant("bare", fixed=(("payload", 0.0),)),
            sy.Variant("loaded", own=("payload",)),
        ],
    )
    both_weigh = LinearMeasurement(("weight", "payload"), (1.0, 9.81), 2.0, 0.05)
    known = with_measurements(arm, [both_weigh])
    pair = [payload_arm.log(0, seed=1), payload_arm.log(1, seed=2)]
    made: list[tuple[sg.AbstractSystem, list[Any], dict[str, Any]]] = [
        (actuated, [late], {"window": 0.2}),
        (bare, [late], {"window": 0.2, "robust": True}),
        (bare, [exact], {"window": 0.0}),
        (both, pair, {"window": 0.2}),
        (known, pair[:1], {"window": 0.2}),
    ]
    return dict(zip(WINDOWED, made, strict=True))


class Whitened(NamedTuple):
    """A likelihood in units of the prior."""

    likelihood: AbstractLikelihood
    prior: Gaussian

    def blocks(self, z: Array, e: Array) -> Array:
        """The factors at a point."""
        return self.likelihood.blocks(self.prior.at(z), e, self.prior.scale)


def stacked(machine: sg.AbstractSystem, data: Transitions) -> tuple[Any, Any]:
    """The one-step likelihood of a machine, and its empty nuisances."""
    likelihood = OneStepLikelihood(machine, data, 0.02)
    return Whitened(likelihood, machine.parameters.prior()), jnp.zeros((1, 0))


def of_windows(machine: sg.AbstractSystem, found: Any) -> tuple[Any, Any]:
    """The windows' likelihood, with its nuisances at nothing."""
    likelihood = WindowsLikelihood(machine, found)
    prior = machine.parameters.prior()
    return Whitened(likelihood, prior), jnp.zeros(found.start.shape)


class Fitted(NamedTuple):
    """A fit of windows."""

    likelihood: WindowsLikelihood
    estimate: Estimate
    posterior: Gaussian
    noise: Array
    weights: Array
    starts: np.ndarray
    log_evidence: Array


def cut_and_fit(
    machine: sg.AbstractSystem, logs: Sequence[Any], *, window: float, robust: bool
) -> tuple[Any, np.ndarray, Any]:
    """Windows, the log of each, and what was fitted."""
    windows, places = cut(logs, machine, window=window)
    found = fit_windows(machine, windows, key=jax.random.key(5), robust=robust)
    fitted = Fitted(
        WindowsLikelihood(machine, windows),
        found,
        found.posterior,
        found.noise.sd,
        found.noise.weights,
        start_states(windows, found),
        found.log_evidence,
    )
    return windows, places[:, 0], fitted


def intervals(fitted: Fitted, windows: Any, of: np.ndarray) -> Any:
    """The corrected posterior."""
    table = fitted.likelihood.system.parameters
    known = fitted.estimate.with_measurements(table)
    return corrected_windows(at_zero(fitted.likelihood, known, of)).posterior


def slopes(fitted: Fitted, windows: Any) -> tuple[np.ndarray, np.ndarray]:
    """Residuals and Jacobians of all rows at the prior's mean, from recorded starts."""
    found = fitted.estimate
    at = linearise(fitted.likelihood, found, found.prior.mean)
    return np.asarray(at.residual), np.asarray(at.jacobian)


@in_float64
def gains(machine: Any, logs: Sequence[Any]) -> dict[str, float]:
    """What each effect of a library is worth, by one linearisation, nats."""
    _, places = cut(logs, machine, window=0.2)
    of = places[:, 0]
    data = WindowData(machine, lambda m: cut(logs, m, window=0.2)[0], of, of)
    scored = score_candidates(data, data.fit(), sy.candidates(machine, windows=True))
    names = {one.candidate.name: one.gain for one in scored}
    return {n.replace("viscous", "back_emf"): gain for n, gain in names.items()}


def learners(machine: Any) -> dict[str, sg.AbstractModel]:
    """Every model, trained for a moment."""
    brief = {"hidden": (16, 16), "steps": 200, "refit_steps": 100}
    sim = sg.Sim2GP(machine)
    return {
        "nlm": sg.NLM(machine, **brief),
        "residual": sg.Residual(sim, **brief),
        "joint": sg.Residual(sim, mode="joint", **brief),
        "function_space": sg.FunctionSpace(sim, **brief),
        "literal": sg.FunctionSpace(sim, objective="literal", **brief),
        "residual_function_space": sg.ResidualFunctionSpace(sim, **brief),
        "auto": sg.Auto([sim, sg.Residual(sim, **brief)]),
    }
