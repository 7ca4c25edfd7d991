"""Mutants of information gain, of what explorers maximise, and of their studies."""

from mutant_list import Mutant

INF, EXP = "inference/information.py", "planning/exploration.py"
JOINT = ("test_information.py", "log_determinant")
STEPS = ("test_information.py", "left or leaves")

EXPLORING = (
    Mutant(
        "gain doubled",
        INF,
        "log_det_factor(qr(rows))",
        "2.0 * log_det_factor(qr(rows))",
        JOINT,
    ),
    Mutant(
        "gain without the noise",
        "models/sim2gp.py",
        ".scale[:d] / self.noise[:, None]",
        ".scale[:d]",
        ("test_sim2gp.py", "information_gain"),
    ),
    Mutant(
        "gain: an output's own part is forgotten",
        INF,
        "gain = jnp.sum(logs)\n",
        "gain = 0.0 * jnp.sum(logs)\n",
        JOINT,
    ),
    Mutant(
        "gain: innovations without their sd",
        INF,
        "row[T:] / jnp.sqrt(variance)",
        "row[T:]",
        STEPS,
    ),
    Mutant(
        "gain: nothing is ever learned",
        INF,
        "h @ h)\n        return M - ",
        "h @ h)\n        return M + 0.0 * ",
        STEPS,
    ),
    Mutant(
        "seen: what outputs share is forgotten",
        INF,
        "shared @ self.z.scale + common",
        "shared @ self.z.scale",
        STEPS,
    ),
    Mutant(
        "explorer: what was done counts again",
        EXP,
        "carry.after(shared, own) if self.together else carry",
        "carry",
        ("test_exploration.py", "done"),
    ),
    Mutant(
        "explorer: sensitivities of the whole belief",
        EXP,
        "left = carry.left(*jax.vmap(self.belief.sensitivity)(S, A))",
        "left = jax.vmap(self.belief.sensitivity)(S, A)",
        ("test_exploration.py", "done"),
    ),
    Mutant(
        "episode: the objective's memory is not kept",
        "planning/episode.py",
        "Resumed(world.objective, now.memory)",
        "Resumed(world.objective, world.objective.init())",
        ("test_exploration.py", "episode"),
    ),
)
