# %% [markdown]
# # First posterior in five minutes
#
# You need nothing of your own: `sg.example` writes an arm with two recordings. In
# Colab, upload the wheel and run `%pip install sim2gp-*.whl` first.

# %%
from pathlib import Path

import sim2gp as sg

project = Path("first/arm.toml")
if not project.exists():
    sg.example("first")
print(project.read_text())

# %% [markdown]
# The project file says what is known of the arm before any data: a mean and a standard
# deviation for each mass, a range for each friction. This is the prior.

# %%
robot = sg.load_project(project)
found = sg.identify(robot)
found

# %% [markdown]
# The posterior is what the recordings leave of that. Each parameter has a mean, an
# interval that holds its true value with 95 % probability, and a verdict. The arm was
# recorded with `m1 = 1.15 kg`, which the drawing has as 1 kg.

# %%
mass = found.parameters["m1"]
print(f"before: {mass.prior_mean} +- {mass.prior_sd} {mass.unit}")
print(f"after:  {mass.mean:.4f} +- {mass.sd:.4f}, 95 % in {mass.interval}")

# %% [markdown]
# ## Does it predict?
#
# A fit of the first recording predicts the second: from a measured start, with the
# recorded torques, 0.2 s ahead. An error is easier to judge next to that of a trivial
# prediction, here that nothing moves.

# %%
unseen = sg.evaluate(robot, horizon=0.2)
for name, error in unseen.rmse.items():
    print(f"{name}: {error:.4f} rad, holding still {unseen.hold_rmse[name]:.4f} rad")

# %% [markdown]
# ## Is physics missing?

# %%
print(found.summary["misfit"]["verdict"])

# %% [markdown]
# ## The report
#
# `found.save` writes a folder with the numbers and `report.html`, one file that needs
# no network. `sg.show` is the same report in this notebook.

# %%
found.save("runs/first")
sg.show("runs/first")

# %% [markdown]
# Next: [your own robot](../docs/your_robot.md), from an MJCF or URDF file and its logs.
