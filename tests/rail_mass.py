"""A mass on a rail that brakes it: a small system of one's own, with two parameters."""

import jax.numpy as jnp

import sim2gp as sg

DT = 0.1


def pushed(params, s, a):
    """``x'' = gain a - drag x'``."""
    return jnp.stack([s[1], params["gain"] * a[0] - params["drag"] * s[1]])


def rail_mass() -> sg.AbstractSystem:
    """Of a period of 0.1 s."""
    return sg.systems.ODE(
        pushed,
        [
            sg.Parameter("gain", "1/kg", "of the input", "log_bounded", 0.5, 8.0),
            sg.Parameter("drag", "1/s", "of the rail", "log_bounded", 0.05, 2.0),
        ],
        [sg.Channel("x", "m"), sg.Channel("x.velocity", "m/s")],
        [sg.Channel("force", "N", low=-1.0, high=1.0)],
        max_substep=DT,
    )
