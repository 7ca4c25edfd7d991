"""Arms with position servos, and recordings of them with odd signs, zeros and units."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

#: Of each link: kg, m, N m s/rad, kg m^2, N m, N m/rad, N m s/rad, N m, and its axis.
LINKS = (
    (4.0, 0.15, 1.0, 0.10, 0.50, 2000.0, 400.0, 300.0, "0 0 1"),
    (4.0, 0.40, 1.0, 0.10, 0.50, 2000.0, 400.0, 300.0, "0 1 0"),
    (2.0, 0.35, 0.6, 0.06, 0.40, 2000.0, 300.0, 200.0, "0 1 0"),
    (1.5, 0.10, 0.3, 0.03, 0.20, 500.0, 60.0, 60.0, "0 1 0"),
    (1.0, 0.10, 0.2, 0.02, 0.10, 500.0, 40.0, 60.0, "1 0 0"),
    (0.5, 0.10, 0.1, 0.01, 0.05, 200.0, 20.0, 30.0, "0 1 0"),
)


def arm_xml(links: slice = slice(None), *, limited: bool = True) -> str:
    """An MJCF of some of the links, one after the other, each with a servo."""
    bodies, servos, place = "", "", "0 0 0.1"
    some = list(enumerate(LINKS[links], 1))
    for k, (mass, length, damping, armature, dry, kp, kv, force, axis) in some:
        reach = 'range="-2.8 2.8" limited="true"' if limited else 'limited="false"'
        bodies += (
            f'<body name="link{k}" pos="{place}">'
            f'<joint name="joint{k}" axis="{axis}" damping="{damping}" '
            f'armature="{armature}" frictionloss="{dry}" {reach}/>'
            f'<geom type="capsule" size=".03" fromto="0 0 0 {length} 0 .02" '
            f'mass="{mass}" contype="0" conaffinity="0"/>'
        )
        servos += (
            f'<position name="servo{k}" joint="joint{k}" kp="{kp}" kv="{kv}" '
            f'ctrlrange="-2.8 2.8" forcerange="-{force} {force}"/>'
        )
        place = f"{length} 0 .02"
    return (
        '<mujoco><compiler angle="radian"/>'
        '<option timestep="0.002" integrator="implicitfast"/><worldbody>'
        f"{bodies}{'</body>' * len(some)}</worldbody>"
        f"<actuator>{servos}</actuator></mujoco>"
    )


def write_arm_log(
    xml: str,
    path: Path,
    *,
    seconds: float,
    seed: int = 0,
    read: Mapping[str, tuple[int, float, float]] | None = None,
) -> None:
    """Slow sines of all targets at 200 Hz, encoders with 1e-3 rad of noise.

    ``read``: by column (q1, u1, ...) the sign, the zero in rad, and the unit in rad of
    the numbers in the file: ``value = sign * unit * number + zero``.
    """
    import mujoco

    model = mujoco.MjModel.from_xml_string(xml)
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    n, model.opt.timestep = model.nu, 0.0025
    t = 0.005 * np.arange(round(seconds / 0.005))
    target = np.zeros((len(t), n))
    for _ in range(4):
        f, phase = rng.uniform(0.1, 0.8, n), rng.uniform(0, 2 * np.pi, n)
        target += rng.uniform(0.1, 0.25, n) * np.sin(2 * np.pi * f * t[:, None] + phase)
    target *= np.minimum(1.0, t / 1.0)[:, None]
    rows = []
    for u in target:
        rows.append([*data.qpos + 1e-3 * rng.standard_normal(n), *u])
        data.ctrl[:] = u
        mujoco.mj_step(model, data, nstep=2)
    numbers = [*(k + 1 for k in range(n))]
    names = [*(f"q{k}" for k in numbers), *(f"u{k}" for k in numbers)]
    table = np.asarray(rows)
    for i, name in enumerate(names):
        sign, zero, unit = (read or {}).get(name, (1, 0.0, 1.0))
        table[:, i] = (table[:, i] - zero) / (sign * unit)
    whole = np.column_stack([t, table])
    header = ",".join(["time", *names])
    np.savetxt(path, whole, delimiter=",", header=header, comments="", fmt="%.9g")
