"""The intervals of mujoco.sysid on the recordings of `interval_arms.py`.

Its own fit as its documentation shows it: the whole recording in one open loop from the
known rest, least squares in bounded physical constants, normalised residuals, and its
own `calculate_intervals`. The arm is written as MJCF, stepped by RK4 at 2 ms (the
errors of which are a thousandth of the noise's). Intervals have no prior; their ends
are cut at the prior's bounds, and compared in virtual units as all others are.
"""

import contextlib
from typing import Any

import numpy as np

from interval_arms import LENGTHS, NAMES, PERIOD, Recordings
from sim2gp.inference.parameters import Parameters

STEP = 2e-3  # s
EDGE = 1e-6  # of the box: where an interval's end beyond a bound is cut

MJCF = f"""
<mujoco>
  <option timestep="{STEP}" integrator="RK4" gravity="0 0 0">
    <flag contact="disable"/>
  </option>
  <worldbody>
    <body name="link1">
      <inertial pos="{LENGTHS[0] / 2} 0 0" mass="1" diaginertia="1 1 1"/>
      <joint name="q1" axis="0 0 1" damping="1"/>
      <body name="link2" pos="{LENGTHS[0]} 0 0">
        <inertial pos="{LENGTHS[1] / 2} 0 0" mass="1" diaginertia="1 1 1"/>
        <joint name="q2" axis="0 0 1" damping="1"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="q1"/><motor joint="q2"/></actuator>
</mujoco>
"""


def intervals(
    data: Recordings, s: int, table: Parameters
) -> tuple[np.ndarray, np.ndarray]:
    """Centre and sd (half a 95 % interval over 1.96) in prior sd, of one set."""
    import mujoco
    from mujoco import sysid

    spec = mujoco.MjSpec.from_string(MJCF)
    model = spec.compile()
    count = len(data.torque)
    fine = STEP * np.arange(count * round(PERIOD / STEP))
    torque = np.repeat(data.torque[:, s], round(PERIOD / STEP), axis=0)
    joints = [(name, sysid.SignalType.MjStateQPos) for name in ("q1", "q2")]
    time = PERIOD * np.arange(count)
    measured = sysid.TimeSeries.from_names(time, data.measured[:, s], model, joints)
    rest = sysid.create_initial_state(model, np.zeros(2), np.zeros(2))
    sequences = sysid.ModelSequences(
        "arm", spec, "set", rest, sysid.TimeSeries(fine, torque), measured, True
    )
    residual = sysid.build_residual_fn(models_sequences=[sequences])
    with contextlib.redirect_stdout(None):  # its optimiser prints every iteration
        found, best = sysid.optimize(
            _constants(table), residual, optimizer="scipy", verbose=False
        )
    misfit, _, _ = residual(best.x, found)
    _, half = sysid.calculate_intervals(misfit, np.asarray(best.jac))
    low = np.array([table[name].low for name in NAMES])
    high = np.array([table[name].high for name in NAMES])
    ends = (np.stack([best.x - half, best.x + half]) - low) / (high - low)
    ends = np.clip(ends, EDGE, 1.0 - EDGE)
    below, above = np.log(ends / (1.0 - ends)) / np.asarray(table.prior().sd())
    return 0.5 * (below + above), 0.5 * (above - below) / 1.959963984540054


def _constants(table: Parameters) -> Any:
    """Masses of uniform rods with their inertia, and dampings, from their mid-box."""
    from mujoco import sysid

    def mass(spec: Any, parameter: Any, link: int) -> None:
        m, length = float(parameter.value[0]), LENGTHS[link]
        body = spec.body(f"link{link + 1}")
        body.mass, body.inertia = m, [1e-9, *2 * [m * length**2 / 12.0]]

    def damping(spec: Any, parameter: Any, link: int) -> None:
        joint = spec.joint(f"q{link + 1}")
        joint.damping = [float(parameter.value[0]), 0.0, 0.0]

    constants = sysid.ParameterDict()
    for name in NAMES:
        entry, link = table[name], int(name[1]) - 1
        change = mass if name[0] == "m" else damping

        def modifier(spec: Any, p: Any, change: Any = change, link: int = link) -> None:
            change(spec, p, link)

        middle = 0.5 * (entry.low + entry.high)
        constants.add(
            sysid.Parameter(name, middle, entry.low, entry.high, modifier=modifier)
        )
    return constants
