"""Arms with position servos, as a vendor's MJCF has them, and their recordings.

Masses, lengths and gains are those of a common arm of six axes and 0.9 m reach. Damping
and kv are both open in no project: a rate gain and a damping of the joint act alike.
"""

from collections.abc import Mapping, Sequence
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
     1.5, 0.1, 0.4, 1.8, 2000, 400, 150),
    (1.2, (0, 0.127, 0), (0.1112, 0.1112, 0.2194), (0, 0, 0.392), "0 1 0",
     0.8, 0.05, 0.2, 2.4, 500, 100, 28),
    (1.2, (0, 0, 0.1), (0.1112, 0.1112, 0.2194), (0, 0.127, 0), "0 0 1",
     0.6, 0.05, 0.2, 3.0, 500, 100, 28),
    (0.2, (0, 0.08, 0), (0.0171, 0.0171, 0.0338), (0, 0, 0.1), "0 1 0",
     0.4, 0.05, 0.1, 3.0, 500, 100, 28),
)  # fmt: skip
#: Turns the upper arm about its own axis: the third of seven.
ROLL = (1.5, (0, 0, 0.08), (0.012, 0.012, 0.004), (0, 0, 0.2), "0 0 1",
        1.5, 0.1, 0.4, 3.0, 2000, 400, 150)  # fmt: skip
NAMES = tuple(f"joint{k + 1}" for k in range(6))


def model_text(
    timestep: float = 0.005,
    *,
    links: Sequence[tuple[Any, ...]] = LINKS,
    arms: int = 1,
    limited: bool = True,
    down: tuple[float, float, float] = (0, 0, -9.81),
) -> str:
    """These links one after the other as MJCF; more arms stand side by side.

    Upright on a floor its mirror image moves as it does; with ``down`` along x, on a
    wall, it does not.
    """
    chains, servos = "", ""
    for arm in range(arms):
        first, inside = arm * len(links) + 1, ""
        for k, link in reversed(list(enumerate(links, first))):
            place = np.add(link[3], (0.0, 0.6 * arm, 0.0) if k == first else 0.0)
            inside = _body(k, link, place, limited) + f"{inside}</body>"
        chains += inside
        for k, (*_, reach, kp, kv, force) in enumerate(links, first):
            servos += (
                f'<position name="servo{k}" joint="joint{k}" kp="{kp}" kv="{kv}" '
                f'ctrlrange="{-reach} {reach}" forcerange="{-force} {force}"/>'
            )
    return (
        '<mujoco model="arm"><compiler angle="radian" autolimits="true"/>'
        f'<option timestep="{timestep}" gravity="{_row(down)}" '
        'integrator="implicitfast"/>'
        f"<worldbody>{chains}</worldbody><actuator>{servos}</actuator></mujoco>"
    )


def _body(k: int, link: tuple[Any, ...], place: np.ndarray, limited: bool) -> str:
    mass, centre, inertia, _, axis, damping, armature, dry, reach, *_ = link
    stops = f'range="{-reach} {reach}"' if limited else ""
    return (
        f'<body name="link{k}" pos="{_row(place)}">'
        f'<inertial mass="{mass}" pos="{_row(centre)}" diaginertia="{_row(inertia)}"/>'
        f'<joint name="joint{k}" axis="{axis}" {stops} damping="{damping}" '
        f'armature="{armature}" frictionloss="{dry}"/>'
    )


def project_text(
    logs: Sequence[str],
    *,
    constants: Sequence[str],
    delay: bool = True,
    window: float = 1.0,
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
        f'system = "arm.xml"\n{opened}[likelihood]\nwindow = {window}\n{late}[[logs]]\n'
        f'files = {list(logs)}\ntime = "time"\n[logs.columns]\n{names}\n{drives}\n'
    )


def record(
    out: Path,
    model: Any = None,
    *,
    seconds: float = 5.0,
    seed: int = 0,
    delay: float = 0.0,
    values: dict[str, float] | None = None,
    read: Mapping[str, tuple[int, float, float]] | None = None,
) -> Float[np.ndarray, "N columns"]:
    """A log of slow targets on all joints, by C MuJoCo, of the six-axis arm or a model.

    ``values`` are other constants by path; a delay is a whole number of periods.
    ``read``: by column the sign, the zero in rad, and the unit in rad of the numbers in
    the file: ``value = sign * unit * number + zero``.
    """
    import mujoco

    model = model or mujoco.MjModel.from_xml_string(model_text())
    steps = int(np.ceil(PERIOD / model.opt.timestep - 1e-9))
    model.opt.timestep = PERIOD / steps
    _set(model, values or {})
    data, rng, n = mujoco.MjData(model), np.random.default_rng(seed), model.nu
    count, late = round(seconds / PERIOD), round(delay / PERIOD)
    t = PERIOD * np.arange(count)
    centre, target = _targets(model, t, rng)
    data.qpos[:] = centre
    table = np.empty((count, 1 + 2 * n))
    for k in range(count):
        noise = ENCODER * rng.normal(size=n)
        table[k] = [t[k], *(data.qpos + noise), *target[k]]
        data.ctrl[:] = target[max(k - late, 0)]
        mujoco.mj_step(model, data, nstep=steps)
    joints = [model.joint(j).name for j in range(n)]
    names = ["time", *joints, *(f"u{k}" for k in range(1, n + 1))]
    for name, (sign, zero, unit) in (read or {}).items():
        i = names.index(name)
        table[:, i] = (table[:, i] - zero) / (sign * unit)
    header = ",".join(names)
    np.savetxt(out, table, delimiter=",", header=header, comments="", fmt="%.9g")
    return table


def _targets(model: Any, t: np.ndarray, rng: Any) -> tuple[np.ndarray, np.ndarray]:
    """Middles of the joints' ranges, and sums of four sines about them, from rest."""
    low, high = np.where(model.jnt_limited[:, None], model.jnt_range, (-3.0, 3.0)).T
    size, target = np.minimum((high - low) / 6.0, 0.8), np.zeros((len(t), model.nu))
    for j in range(model.nu):
        for hertz in rng.uniform(0.1, 1.2, 4):
            phase = rng.uniform(0.0, 2.0 * np.pi)
            target[:, j] += 0.4 * size[j] * np.sin(2.0 * np.pi * hertz * t + phase)
    target *= np.minimum(t / 0.5, 1.0)[:, None] ** 2
    return (low + high) / 2.0, (low + high) / 2.0 + target


def _set(model: Any, values: dict[str, float]) -> None:
    import mujoco

    from sim2gp.systems.mujoco.constants import constants_of, set_constants

    known = constants_of(model)
    set_constants(model, [(known[path], value) for path, value in values.items()])
    mujoco.mj_setConst(model, mujoco.MjData(model))


def _row(numbers: Any) -> str:
    return " ".join(f"{x:g}" for x in numbers)
