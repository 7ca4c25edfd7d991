# %% [markdown]
# # A swing-up with a wrong simulator
#
# A Furuta pendulum whose cable pulls its arm back like a spring. The simulator has no
# such spring. Three models learn from one run of 5 s after the other: the simulator
# alone, the simulator with a learned correction, and the simulator with the right term.

# %%
import jax

import sim2gp as sg

EPISODES = 3
spring = sg.systems.Spring("theta", 0.02)  # N m/rad, on the real machine alone
task = sg.tasks.furuta_swingup(effects=(spring,))
furuta = sg.systems.Furuta()
models = {
    "simulator alone": sg.Sim2GP(furuta),
    "with a correction": sg.Residual(sg.Sim2GP(furuta)),
    "with a spring": sg.Sim2GP(sg.systems.free_parts(furuta, [spring])),
}

# %% [markdown]
# `sg.psrl` samples a simulator from the posterior, plans in it, runs the plan on the
# machine, and learns from what happened (posterior sampling). A return of about 200 is
# a pendulum that swings up at once and stays up; hanging still scores about 30.

# %%
histories = {}
for name, model in models.items():
    history = sg.psrl(task, model, sg.MPC(), episodes=EPISODES, key=jax.random.key(0))
    histories[name] = history
    print(f"{name:18}", [round(float(x)) for x in history.returns])

# %% [markdown]
# The right term needs the fewest runs. Which term is missing, `sg.explain` finds in the
# data, as on [this page](../docs/explain.md).
