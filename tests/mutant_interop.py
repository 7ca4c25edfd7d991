"""Mutants of what connects to others: each must fail the test that is about it."""

from mutant_list import Mutant

GYM, VECTOR = "robot/gymnasium.py", "robot/gymnasium_vector.py"
BOX = "systems/plants/black_box.py"
SINKS, SYSID = "runs/sinks.py", "systems/mujoco/sysid.py"

INTEROP = (
    Mutant(
        "gymnasium: one noise for all steps",
        GYM,
        "jax.random.fold_in(jax.random.fold_in(key, Purpose.NOISE), t)",
        "jax.random.fold_in(key, Purpose.NOISE)",
        ("test_gymnasium.py", "last_bit"),
    ),
    Mutant(
        "gymnasium: every episode is the first",
        GYM,
        "self.episode, self.steps = self.episode + 1, 0",
        "self.episode, self.steps = 1, 0",
        ("test_gymnasium.py", "last_bit"),
    ),
    Mutant(
        "gymnasium: a seed keeps the old machine",
        GYM,
        "self.task = self.made.task(self.key)",
        "self.task = self.task",
        ("test_gymnasium.py", "last_bit"),
    ),
    Mutant(
        "gymnasium: no limits",
        GYM,
        "jnp.any(jnp.abs(seen) > bound)",
        "jnp.any(jnp.abs(seen) > 2.0 * bound)",
        ("test_gymnasium.py", "states_end"),
    ),
    Mutant(
        "gymnasium: a vector begins the same episode again",
        VECTOR,
        "self.episode = self.episode + again.astype(np.int32)",
        "pass",
        ("test_gymnasium.py", "vector"),
    ),
    Mutant(
        "gymnasium: a vector rewards what began anew",
        VECTOR,
        "np.where(again, np.float32(0.0), met.reward)",
        "met.reward",
        ("test_gymnasium.py", "vector"),
    ),
    Mutant(
        "gymnasium: a vector's machines are the first",
        VECTOR,
        "[eqx.filter(task, eqx.is_array) for task in tasks]",
        "[eqx.filter(tasks[0], eqx.is_array) for task in tasks]",
        ("test_gymnasium.py", "vector"),
    ),
    Mutant(
        "gymnasium: a vector clocks what began anew",
        VECTOR,
        "np.where(again, 0, np.asarray(now.step) + 1)",
        "(np.asarray(now.step) + 1)",
        ("test_gymnasium.py", "vector"),
    ),
    Mutant(
        "black box: its writes are kept",
        BOX,
        "theta[i].copy(), s[i].copy(), a[i].copy()",
        "theta[i], s[i], a[i]",
        ("test_black_box.py", "slopes_are"),
    ),
    Mutant(
        "black box: NaN is asked about",
        BOX,
        "good & (h > 0.0)",
        "(h > 0.0)",
        ("test_black_box.py", "nan_is"),
    ),
    Mutant(
        "black box: single precision is differenced finely",
        BOX,
        "in (np.float16, np.float32)",
        "in (np.float16,)",
        ("test_black_box.py", "single_precision"),
    ),
    Mutant(
        "black box: noise is not found",
        BOX,
        "np.array_equal(one, two, equal_nan=True)",
        "np.array_equal(one, one, equal_nan=True)",
        ("test_black_box.py", "when_the_system"),
    ),
    Mutant(
        "black box: a fault amid an episode is JAX's",
        "planning/episode.py",
        "@of_callbacks()\ndef episode(",
        "def episode(",
        ("test_black_box.py", "amid_an_episode"),
    ),
    Mutant(
        "black box: a fault amid training is JAX's",
        "planning/loop.py",
        "@of_callbacks()\ndef posterior_sampling(",
        "def posterior_sampling(",
        ("test_black_box.py", "amid_an_episode"),
    ),
    Mutant(
        "black box: a fault amid a fit is JAX's",
        "types.py",
        "with jax.enable_x64(True), of_callbacks():",
        "with jax.enable_x64(True):",
        ("test_black_box.py", "later_fault"),
    ),
    Mutant(
        "sinks: NaN is left out without a word",
        SINKS,
        "if lost:",
        "if not line:",
        ("test_sinks.py", "not_finite"),
    ),
    Mutant(
        "sinks: a line waits",
        SINKS,
        "        self.file.flush()\n",
        "",
        ("test_sinks.py", "before_the_next"),
    ),
    Mutant(
        "sysid: floats without a point",
        SYSID,
        "{'' if '.' in mantissa else '.0'}",
        "",
        ("test_sysid.py", "read_the_same"),
    ),
    Mutant(
        "sysid: all elements are the first",
        SYSID,
        "entry.numbers[each][i]",
        "entry.numbers[each][0]",
        ("test_sysid.py", "boxes_are"),
    ),
)
