"""Logs of a simulated Furuta pendulum, by scipy's integrator."""

import jax
import jax.numpy as jnp
import numpy as np
import scipy.integrate

import machines
from sim2gp.data.logs import Log
from sim2gp.systems import AbstractEffect, Furuta, Machine

NAMES = ("theta", "alpha", "theta.velocity", "alpha.velocity")
FREE = ("arm_damping", "motor_constant", "pendulum_length")


def pendulum() -> Furuta:
    """A Furuta pendulum with three unknown constants."""
    table = Furuta().parameters
    known = {n: v for n, v in table.nominal().items() if n not in FREE}
    return Furuta(table.replace(**known))


def simulated(
    *,
    seconds: float,
    seed: int,
    delay: float = 0.0,
    jitter: float = 0.0,
    noise: float = 0.0,
    velocities: bool = False,
    changes: dict[str, float] | None = None,
    effects: tuple[AbstractEffect, ...] = (),
) -> Log:
    """A log by scipy's integrator: held inputs, stamps of their own, sensor noise."""
    rng = np.random.default_rng(seed)
    count = int(seconds / 0.002)
    time = 0.002 * np.arange(count) + jitter * rng.uniform(0.0, 0.002, count)
    held = np.repeat(rng.uniform(-4.0, 4.0, count // 20 + 1), 20)[:count]
    system = Machine(Furuta(), effects)
    with jax.enable_x64(True):
        values = system.parameters.nominal() | (changes or {})
        params = system.record({k: jnp.asarray(v) for k, v in values.items()})
        ode = jax.jit(lambda s, a: machines.ode(system, params, s, a))

        def rate(t: float, s: np.ndarray) -> np.ndarray:
            k = max(int(np.searchsorted(time, t - delay, side="right")) - 1, 0)
            return np.asarray(ode(jnp.asarray(s), jnp.asarray(held[k : k + 1])))

        s0 = np.array([0.1, 0.4, 0.0, 0.0])
        solved = scipy.integrate.solve_ivp(
            rate, (0.0, time[-1]), s0, t_eval=time, rtol=1e-7, atol=1e-9, max_step=2e-3
        )
    y = solved.y + noise * rng.standard_normal(solved.y.shape)
    kept = NAMES if velocities else NAMES[:2]
    return Log(
        name=f"log{seed}",
        source=f"log{seed}.csv",
        time=time,
        channels={n: y[i] for i, n in enumerate(kept)},
        inputs={"voltage": held},
        mask={n: np.ones(count, bool) for n in kept},
    )
