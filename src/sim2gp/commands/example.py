"""Example: a complete small project to begin with, from nothing but this package.

A horizontal arm of two rods swings for ten seconds, twice. Its masses, its friction and
its motors' delay are not those that its project file assumes: what the first `identify`
finds can be compared with `TRUTH`.
"""

import csv
import io
import shutil
from collections.abc import Mapping
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sim2gp import cleanup
from sim2gp.runs import Progress
from sim2gp.runs.store import check_absent, disk_error
from sim2gp.systems import UniformRodArm
from sim2gp.types import in_float64

#: Masses in kg and viscous friction in N m s/rad of the arm that was recorded.
MECHANICS = {"m1": 1.15, "b1": 0.13, "m2": 0.65, "b2": 0.06}
LATE = 2  # rows from a command to its torque
PERIOD, SECONDS = 0.005, 10.0  # s: between rows, of a log
ENCODER = 5e-4  # rad, sd of an encoder's noise
TORQUE = (0.6, 0.2)  # N m, amplitude of each sine
FREQUENCIES = (0.4, 0.9, 1.7)  # Hz

TRUTH = MECHANICS | {"torque1.delay": LATE * PERIOD}

MODEL = """\
<!-- A horizontal arm of two uniform rods, as its drawing has it. -->
<mujoco model="arm">
  <option timestep="0.005" integrator="RK4" gravity="0 0 0"/>
  <worldbody>
    <body name="upper">
      <joint name="q1" axis="0 0 1" damping="0.1"/>
      <inertial pos="0.25 0 0" mass="1" diaginertia="1e-4 0.0208333 0.0208333"/>
      <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.01"/>
      <body name="lower" pos="0.5 0 0">
        <joint name="q2" axis="0 0 1" damping="0.1"/>
        <inertial pos="0.2 0 0" mass="0.8" diaginertia="1e-4 0.0106667 0.0106667"/>
        <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.01"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="torque1" joint="q1" ctrlrange="-1 1"/>
    <motor name="torque2" joint="q2" ctrlrange="-1 1"/>
  </actuator>
</mujoco>
"""
PROJECT = """\
# What is known of the arm before the logs, and where its logs are.
system = "uniform_rod_arm"        # bundled; arm.xml is the same arm for MuJoCo

[parameters]                      # masses and friction of both joints are learned
m1 = {mean = 1.0, sd = 0.3}       # kg: from the drawing, known to about 0.3 kg
m2 = {mean = 0.8, sd = 0.3}
b1 = {low = 0.01, high = 0.5}     # N m s/rad: anywhere between
b2 = {low = 0.01, high = 0.5}

[actuators."*"]                   # both motors answer a little late
delay = {low = 0.0, high = 0.03}  # s
tie = true                        # with the same delay

[[logs]]
files = ["first.csv", "second.csv"]
[logs.columns]                    # channel of the arm = column of the file
q1 = "q1"
q2 = "q2"
torque1 = "torque1"
torque2 = "torque2"

[limits]                          # rad: of the arm; samples beyond them are not used
q1 = [-3.0, 3.0]
q2 = [-2.5, 2.5]
"""
README = """\
# An arm and two recordings of it

    sim2gp identify arm.toml           # masses, friction and delay, with intervals
    sim2gp evaluate arm.toml           # each log predicted by a fit of the other
    sim2gp explain runs/arm            # is physics missing?
    sim2gp design runs/arm             # which experiment would tell more?

`arm.toml` says what is known of the arm. `first.csv` and `second.csv` have time in s,
encoder angles in rad and commanded torques in N m, 200 rows a second. The recorded arm
has

{truth}

so the drawing is wrong about both masses. `identify` does not know these numbers. Its
results are in `runs/arm/`: open `report.html`.

`arm.xml` is the same arm as a MuJoCo model. With the extra `mujoco` installed,

    sim2gp init arm.xml first.csv second.csv --out mujoco.toml

drafts a project file for it, as for a robot of your own, and
`sim2gp identify mujoco.toml` fits that.
"""


def example(folder: Path | str, *, progress: Progress | None = None) -> Path:
    """Write a project file, a model, two logs and a readme into a new folder.

    Returns the project file's path. Raises `InputError` E132 where something is there
    already, E130 and E190 where the folder cannot be written.
    """
    folder = Path(folder)
    check_absent(folder)
    table = UniformRodArm().parameters
    truth = "\n".join(
        f"    {name} = {value:g} {table[name].unit if name in MECHANICS else 's'}"
        for name, value in TRUTH.items()
    )
    texts = {
        "arm.toml": PROJECT,
        "arm.xml": MODEL,
        "README.md": README.format(truth=truth),
    }
    for number, name in enumerate(("first.csv", "second.csv")):
        texts[name] = _csv_text(_recorded(number))
    try:
        folder.mkdir()  # ours alone from here on: if anything fails, nothing is left
        with cleanup.registered(lambda: shutil.rmtree(folder, ignore_errors=True)):
            _write_texts(folder, texts)
    except OSError as caught:
        raise disk_error(folder, caught) from caught
    (progress or Progress()).say(f"next: sim2gp identify {folder / 'arm.toml'}")
    return folder / "arm.toml"


def _write_texts(folder: Path, texts: Mapping[str, str]) -> None:
    try:
        for name, text in texts.items():
            (folder / name).write_text(text, encoding="utf-8")
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise


@in_float64
def _recorded(seed: int) -> Float[np.ndarray, "T 5"]:
    """Time, angles as the encoders have them, and torques."""
    rng = np.random.default_rng(seed)
    time = PERIOD * np.arange(round(SECONDS / PERIOD))
    phase = rng.uniform(0.0, 2.0 * np.pi, (2, len(FREQUENCIES)))
    turns = 2.0 * np.pi * np.multiply.outer(time, np.asarray(FREQUENCIES))
    torque = np.asarray(TORQUE) * np.sin(turns[:, None] + phase).mean(axis=-1)
    late = np.concatenate([np.zeros((LATE, 2)), torque[:-LATE]])
    angle = np.asarray(_swung(jnp.asarray(late)))
    noise = ENCODER * rng.standard_normal(angle.shape)
    return np.column_stack([time, angle + noise, torque])


@eqx.filter_jit
def _swung(torque: Float[Array, "T 2"]) -> Float[Array, "T 2"]:
    """Both angles at each row, from rest."""
    arm = UniformRodArm()
    known = {name: arm.parameters.nominal()[name] for name in ("l1", "l2")}
    params = arm.record({k: jnp.asarray(v) for k, v in (known | MECHANICS).items()})

    def step(s: Array, u: Array) -> tuple[Array, Array]:
        return arm.flow(params, s, u, PERIOD), s[:2]

    return jax.lax.scan(step, jnp.zeros(4), torque)[1]


def _csv_text(rows: Float[np.ndarray, "T 5"]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["time", "q1", "q2", "torque1", "torque2"])
    writer.writerows([[f"{x:.6g}" for x in row] for row in rows])
    return text.getvalue()
