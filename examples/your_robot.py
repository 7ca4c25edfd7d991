# %% [markdown]
# # Your robot: from a model and a log to a report
#
# You need a model (MJCF or URDF), a log, and MuJoCo (`pip install 'sim2gp[mujoco]'`).
# Here both files are those of `sg.example`. Put your own in their place.

# %%
from pathlib import Path

import sim2gp as sg

if not Path("robot/arm.xml").exists():
    sg.example("robot")
model = "robot/arm.xml"
logs = [Path("robot/first.csv"), Path("robot/second.csv")]
print(Path(model).read_text())

# %% [markdown]
# ## A draft of the project file
#
# `sg.init` matches the columns of the logs to the joints and inputs of the model by
# their names. It tries signs, units and zeros on the model itself, and gives a reason
# for each guess. Read the file before you go on.

# %%
draft = Path("robot/mine.toml")
if not draft.exists():
    sg.init(model, logs, out=draft)
print(draft.read_text())

# %% [markdown]
# ## What do the logs determine?

# %%
robot = sg.load_project(draft)
found = sg.identify(robot)
found

# %% [markdown]
# A verdict of `traded_off` means that the logs determine a combination of parameters
# only; `prior_dominated` means that they say nothing new. The next experiment can
# change that. Limits are in the units of the channels.

# %%
experiment = sg.design(
    found, limits=sg.Limits(q1=(-2.0, 2.0), q2=(-2.0, 2.0)), seconds=3.0
)
print(experiment.summary["headline"])
experiment.save("robot/next.csv")

# %% [markdown]
# ## Back to the model, and on to training
#
# `sg.apply` shows what changes in the MJCF; all other bytes stay. `sg.export` writes
# samples of the posterior for domain randomisation.

# %%
print(sg.apply(found).diff)
samples = sg.export(found, "runs/samples", draws=8)
print(sorted(file.name for file in Path("runs/samples").iterdir()))

# %%
found.save("runs/mine")
sg.show("runs/mine")
