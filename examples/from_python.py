# %% [markdown]
# # Every command from Python
#
# A pendulum whose MJCF is wrong about its friction (`pip install 'sim2gp[mujoco]'`).

# %%
from pathlib import Path

import mujoco
import numpy as np

import sim2gp as sg

MODEL = """<mujoco model="pendulum">
<option timestep="0.005" integrator="implicitfast"/>
<worldbody><body name="arm"><joint name="hinge" axis="0 1 0" damping="0.01"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="0.5"/></body></worldbody>
<actuator><motor name="motor" joint="hinge" ctrlrange="-2 2"/></actuator></mujoco>
"""
PROJECT = """system = "pendulum.xml"
[parameters."joint/hinge/damping"]
[[logs]]
files = ["a.csv", "b.csv"]
[logs.columns]
hinge = "hinge"
motor = "motor"
[limits]
hinge = [-3.0, 3.0]
"""


def recorded(seed: int) -> dict[str, np.ndarray]:
    """Three seconds of a machine with twice the friction of its file."""
    truth = mujoco.MjModel.from_xml_string(MODEL)
    truth.dof_damping[:] = 0.02
    rng, data, rows = np.random.default_rng(seed), mujoco.MjData(truth), []
    for torque in np.repeat(rng.uniform(-1.0, 1.0, 30), 10):
        rows.append((data.time, data.qpos[0] + 1e-3 * rng.normal(), torque))
        data.ctrl[:] = torque
        mujoco.mj_step(truth, data, 2)
    time, hinge, motor = np.asarray(rows).T
    return {"time": time, "hinge": hinge, "motor": motor}


Path("pendulum.xml").write_text(MODEL)
Path("pendulum.toml").write_text(PROJECT)
for seed, name in enumerate("abc"):
    log = recorded(seed)
    table = np.column_stack(list(log.values()))
    np.savetxt(f"{name}.csv", table, "%.17g", ",", header=",".join(log), comments="")

# %% [markdown]
# ## Which constants do the logs determine?
# `sim2gp identify pendulum.toml`

# %%
robot = sg.load_project("pendulum.toml")
found = sg.identify(robot)
found

# %%
damping = found.parameters["joint/hinge/damping"]
print(f"{damping.mean:.4f} {damping.unit}, 95 % in {damping.interval}")
found.save("runs/pendulum")  # what the command line writes; sg.load_run reads it

# %% [markdown]
# Logs may be arrays or columns of a data frame, by the names of the channels.

# %%
log = sg.Log.of(recorded(0), name="a")
alone = sg.identify(robot, log, held_out=False)

# %% [markdown]
# ## Does it predict what it was not shown?
# `sim2gp evaluate runs/pendulum --logs c.csv`, and `sim2gp evaluate pendulum.toml`

# %%
unseen = found.forecast(sg.read_logs("c.csv", robot))
print(unseen.rmse, "where holding still has", unseen.hold_rmse)
folds = sg.evaluate(robot)

# %% [markdown]
# ## What physics is missing? Which model do the logs support?
# `sim2gp explain runs/pendulum`, `sim2gp compare pendulum.toml`

# %%
missing = sg.explain(found)
print(missing.answer)
comparison = sg.compare(robot, horizons=[0.2])
print(comparison.best)

# %% [markdown]
# ## What should be run next?
# `sim2gp design runs/pendulum --limit motor=-1:1 --seconds 2`

# %%
experiment = sg.design(found, limits=sg.Limits(motor=1.0), seconds=2.0)
print(experiment.expected_sd)
experiment.save("next.csv")

# %% [markdown]
# ## The constants back in the model, and draws for training
# `sim2gp apply runs/pendulum`, `sim2gp export runs/pendulum --draws 4`

# %%
print(sg.apply(found).diff)
draws = sg.export(found, "runs/draws", draws=4)

# %% [markdown]
# ## A machine that is learned while it runs, and the paper's figures
# `sim2gp demo --episodes 1`, `sim2gp reproduce fig1 --quick`

# %%
demonstration = sg.demo(episodes=1)
figure = sg.reproduce("fig1", "runs/fig1", quick=True)
