"""Where the library's parts stand today: the one file here that follows a rewrite."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import machines
import payload_arm
import sim2gp as sg
import simulated_logs
from sim2gp import systems as sy
from sim2gp.data import windows
from sim2gp.data.split_log import cut
from sim2gp.data.transitions import Transitions
from sim2gp.data.windows import WindowsBelief, fit_windows, linearise
from sim2gp.identification.intervals.discrepancy import corrected_windows
from sim2gp.identification.missing_physics.data import WindowData
from sim2gp.identification.missing_physics.score import score
from sim2gp.inference.linear_measurements import Weighed
from sim2gp.models import sim2gp
from sim2gp.systems.assemble import with_weighed
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
    known = with_weighed(arm, [Weighed(("weight", "payload"), (1.0, 9.81), 2.0, 0.05)])
    pair = [payload_arm.log(0, seed=1), payload_arm.log(1, seed=2)]
    return {
        "actuated": (actuated, [late], {"window": 0.2}),
        "robust": (bare, [late], {"window": 0.2, "robust": True}),
        "one_step": (bare, [exact], {"window": 0.0}),
        "groups": (both, pair, {"window": 0.2}),
        "measured_sum": (known, pair[:1], {"window": 0.2}),
    }


def stacked(machine: sg.AbstractSystem, data: Transitions) -> tuple[Any, Any]:
    """The one-step likelihood of a machine, and its empty nuisances."""
    exact = jax.tree.map(jnp.asarray, data)
    return sim2gp.likelihood(sg.Sim2GP(machine), exact), jnp.zeros((1, 0))


def of_windows(machine: sg.AbstractSystem, found: Any) -> tuple[Any, Any]:
    """The windows' likelihood, with its nuisances at nothing."""
    exact = jax.tree.map(jnp.asarray, found)
    likelihood = windows.likelihood(machine, machine.parameters.prior(), exact)
    return likelihood, jnp.zeros(found.start.shape)


def cut_and_fit(
    machine: sg.AbstractSystem, logs: Sequence[Any], *, window: float, robust: bool
) -> tuple[Any, np.ndarray, Any]:
    """Windows, the log of each, and what was fitted."""
    found, places = cut(logs, machine, window=window)
    belief = fit_windows(machine, found, key=jax.random.key(5), robust=robust)
    return found, np.asarray([k for k, _ in places]), belief


def intervals(belief: WindowsBelief, found: Any, of: np.ndarray) -> Any:
    """The corrected posterior."""
    return corrected_windows(belief.informed(), found, of).posterior


def slopes(belief: WindowsBelief, found: Any) -> tuple[np.ndarray, np.ndarray]:
    """Residuals and Jacobians of all rows at the prior's mean, from recorded starts."""
    at = linearise(belief, found, belief.prior.mean)
    return np.asarray(at.residual), np.asarray(at.jacobian)


@in_float64
def gains(machine: Any, logs: Sequence[Any]) -> dict[str, float]:
    """What each effect of a library is worth, by one linearisation, nats."""
    _, places = cut(logs, machine, window=0.2)
    of = np.asarray([k for k, _ in places])
    data = WindowData(machine, lambda m: cut(logs, m, window=0.2)[0], of)
    scored = score(data, data.fit(), sy.candidates(machine, windows=True))
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
