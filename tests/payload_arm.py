"""A pendulum with a motor that may carry a payload; logs of it in both states."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import scipy.integrate

from sim2gp.data.logs import Log
from sim2gp.inference.parameters import Parameter
from sim2gp.systems import ODE, Channel

ARM, GRAVITY = 0.3, 9.81  # m, m/s^2
TRUTH = {"inertia": 0.02, "weight": 1.2, "damping": 0.05, "payload": 0.15}
TABLE = (
    Parameter("inertia", "kg m^2", "about the joint", "log_bounded", 0.005, 0.08),
    Parameter("weight", "N m", "moment of the arm's weight", "log_bounded", 0.3, 5.0),
    Parameter("damping", "N m s/rad", "viscous friction", "log_bounded", 0.005, 0.5),
    Parameter("payload", "kg", "mass at the tip", "bounded", 0.0, 0.5),
)
STATES = Channel("q", "rad"), Channel("q.velocity", "rad/s")
ACTIONS = (Channel("torque", "N m", low=-2.0, high=2.0),)


def slope(xp: Any, k: Any, s: Any, a: Any) -> Any:
    """Of one point or of rows; ``s`` and ``a`` have their channels last."""
    q, v = s[..., 0], s[..., 1]
    inertia = k["inertia"] + k["payload"] * ARM**2
    weight = k["weight"] + k["payload"] * GRAVITY * ARM
    turn = a[..., 0] - weight * xp.sin(q) - k["damping"] * v
    return xp.stack([v, turn / inertia], -1)


def ode(k: Any, s: Any, a: Any) -> Any:
    return slope(jnp, k, s, a)


def arm() -> ODE:
    return ODE(ode, TABLE, STATES, ACTIONS)


def log(group: int, seed: int, *, seconds: float = 1.2, **changes: float) -> Log:
    """By scipy's integrator; the payload is there in group 1."""
    rng = np.random.default_rng(seed)
    period, count = 0.01, round(100 * seconds)
    time = period * np.arange(count)
    held = np.repeat(rng.uniform(-1.5, 1.5, count // 10 + 1), 10)[:count]
    known = TRUTH | {"payload": TRUTH["payload"] if group else 0.0} | changes

    def rate(t: float, s: np.ndarray) -> np.ndarray:
        k = min(int(t / period + 1e-9), count - 1)
        return np.asarray(slope(np, known, s, held[k : k + 1]))

    solved = scipy.integrate.solve_ivp(
        rate, (0.0, time[-1]), [0.3, 0.0], t_eval=time, rtol=1e-8, max_step=period
    )
    q = solved.y[0] + 1e-3 * rng.standard_normal(count)
    return Log(
        name=f"log{seed}",
        source=f"log{seed}.csv",
        time=time,
        channels={"q": q},
        inputs={"torque": held},
        mask={"q": np.ones(count, bool)},
        group=group,
    )
