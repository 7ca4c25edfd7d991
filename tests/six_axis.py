"""A six-axis arm with position servos, as a vendor's MJCF has it, and its recordings.

Masses, lengths and gains are those of a common arm of 0.9 m reach. Damping and kv are
both open in no project: a servo's rate gain and its joint's damping act alike.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

PERIOD = 5e-3  # s, of the log
ENCODER = 1e-3  # rad
#: mass kg, centre m, inertia kg m^2, place m, axis, damping, armature, dry friction,
#: range rad, kp, kv, largest torque
LINKS = (
    (3.7, (0, 0, 0.03), (0.0103, 0.0103, 0.0067), (0, 0, 0.163), "0 0 1",
     2.0, 0.1, 0.6, 3.1, 2000, 400, 150),
    (8.4, (0, 0, 0.28), (0.2269, 0.2269, 0.0151), (0, 0.138, 0), "0 1 0",
     2.0, 0.1, 0.6, 1.5, 2000, 400, 150),
    (2.3, (0, 0, 0.25), (0.0494, 0.0494, 0.0041), (0, -0.131, 0.425), "0 1 0",
     1.5, 0.1, 0.4, 2.0, 2000, 400, 150),
    (1.2, (0, 0.127, 0), (0.1112, 0.1112, 0.2194), (0, 0, 0.392), "0 1 0",
     0.8, 0.05, 0.2, 2.0, 500, 100, 28),
    (1.2, (0, 0, 0.1), (0.1112, 0.1112, 0.2194), (0, 0.127, 0), "0 0 1",
     0.6, 0.05, 0.2, 3.0, 500, 100, 28),
    (0.2, (0, 0.08, 0), (0.0171, 0.0171, 0.0338), (0, 0, 0.1), "0 1 0",
     0.4, 0.05, 0.1, 3.0, 500, 100, 28),
)  # fmt: skip
NAMES = tuple(f"joint{k + 1}" for k in range(6))


def model_text(timestep: float = 0.005) -> str:
    """The arm as MJCF."""
    inside = ""
    for k, link in reversed(list(enumerate(LINKS, start=1))):
        mass, centre, inertia, place, axis, damping, armature, dry, reach = link[:9]
        inside = (
            f'<body name="link{k}" pos="{_row(place)}">'
            f'<inertial mass="{mass}" pos="{_row(centre)}" '
            f'diaginertia="{_row(inertia)}"/>'
            f'<joint name="joint{k}" axis="{axis}" range="{-reach} {reach}" '
            f'damping="{damping}" armature="{armature}" frictionloss="{dry}"/>'
            f"{inside}</body>"
        )
    servos = "".join(
        f'<position name="servo{k}" joint="joint{k}" kp="{link[9]}" kv="{link[10]}" '
        f'ctrlrange="{-link[8]} {link[8]}" forcerange="{-link[11]} {link[11]}"/>'
        for k, link in enumerate(LINKS, start=1)
    )
    return (
        '<mujoco model="six_axis"><compiler angle="radian" autolimits="true"/>'
        f'<option timestep="{timestep}" integrator="implicitfast"/>'
        f"<worldbody>{inside}</worldbody><actuator>{servos}</actuator></mujoco>"
    )


def project_text(
    logs: Sequence[str], *, constants: Sequence[str], delay: bool = True
) -> str:
    """A project of the arm for these logs; one delay of all drives is open."""
    names = "\n".join(f'{n} = "{n}"' for n in NAMES)
    drives = "\n".join(f'servo{k} = "u{k}"' for k in range(1, 7))
    late = (
        '[actuators."servo*"]\ndelay = {low = 0.0, high = 0.03}\ntie = true\n'
        if delay
        else ""
    )
    opened = "".join(f'[parameters."{path}"]\n' for path in constants)
    return (
        f'system = "arm.xml"\n{opened}[likelihood]\nwindow = 1.0\n{late}[[logs]]\n'
        f'files = {list(logs)}\ntime = "time"\n[logs.columns]\n{names}\n{drives}\n'
    )


def record(
    out: Path,
    *,
    seconds: float = 5.0,
    seed: int = 0,
    delay: float = 0.0,
    values: dict[str, float] | None = None,
) -> Float[np.ndarray, "N 13"]:
    """A log of slow targets on all joints, by C MuJoCo at the model's own step.

    ``values`` are other constants by path; a delay is a whole number of periods.
    """
    import mujoco

    model = mujoco.MjModel.from_xml_string(model_text())
    _set(model, values or {})
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    count, late = round(seconds / PERIOD), round(delay / PERIOD)
    t = PERIOD * np.arange(count)
    size = np.asarray([0.8, 0.5, 0.6, 0.8, 0.8, 0.8])
    target = np.zeros((count, 6))
    for j in range(6):
        for hertz in rng.uniform(0.1, 1.2, 4):
            phase = rng.uniform(0.0, 2.0 * np.pi)
            target[:, j] += 0.4 * size[j] * np.sin(2.0 * np.pi * hertz * t + phase)
    target *= np.minimum(t / 0.5, 1.0)[:, None] ** 2  # from rest
    data.qpos[:] = target[0]
    table = np.empty((count, 13))
    for k in range(count):
        noise = ENCODER * rng.normal(size=6)
        table[k] = [t[k], *(data.qpos + noise), *target[k]]
        data.ctrl[:] = target[max(k - late, 0)]
        mujoco.mj_step(model, data)
    header = ",".join(["time", *NAMES, *(f"u{k}" for k in range(1, 7))])
    np.savetxt(out, table, delimiter=",", header=header, comments="", fmt="%.9g")
    return table


def _set(model: Any, values: dict[str, float]) -> None:
    import mujoco

    from sim2gp.systems.mujoco.constants import constants_of, set_constants

    known = constants_of(model)
    set_constants(model, [(known[path], value) for path, value in values.items()])
    mujoco.mj_setConst(model, mujoco.MjData(model))


def _row(numbers: tuple[float, ...]) -> str:
    return " ".join(f"{x:g}" for x in numbers)
