"""Mutants of `sim2gp init`: each must fail the test that is about it."""

from mutant_list import Mutant

COLUMNS, READINGS = "project/columns.py", "project/readings.py"
DRAFT, ZEROS = "project/draft.py", "systems/machine.py"
TEXT, EXPERIMENT = "project/draft_text.py", "experiment_design/safe_excitation.py"
ODD = ("test_draft.py", "odd_log")
SERVOS = ("test_first_draft.py", "servo_arm")

FIRST_DRAFT = (
    Mutant(
        "draft: no sign is turned",
        DRAFT,
        "for s in (1, -1)]",
        "for s in (1, 1)]",
        ODD,
    ),
    Mutant(
        "draft: no zero is moved",
        DRAFT,
        "zeros = (0.0, np.pi) if turns else (0.0,)",
        "zeros = (0.0,)",
        ODD,
    ),
    Mutant(
        "draft: starts keep the old zero",
        READINGS,
        "w.start * scale[:, None] + zero[:, None]",
        "w.start * scale[:, None]",
        ODD,
    ),
    Mutant(
        "draft: nothing is in degrees",
        DRAFT,
        "if smaller is None or travel <= min(LARGE, reach):",
        "if True:",
        ODD,
    ),
    Mutant(
        "draft: the last reading is as good as the best",
        READINGS,
        "_surer(scores, best) <= SURE",
        "_surer(scores, best) <= np.inf",
        SERVOS,
    ),
    Mutant(
        "draft: a target is no angle",
        "systems/mujoco/system.py",
        'unit = ("m" if model.jnt_type[j] == 2 else "rad") if servo else "1"',
        'unit = "1"',
        SERVOS,
    ),
    Mutant(
        "draft: the gains of servos are open",
        TEXT,
        '_GAINS = ("kp", "kv")',
        "_GAINS = ()",
        SERVOS,
    ),
    Mutant(
        "draft: a servo has short windows",
        TEXT,
        "WINDOWS = 1.0, 5.0",
        "WINDOWS = 0.2, 5.0",
        ("test_first_draft.py", "windows_of_servos"),
    ),
    Mutant(
        "draft: a window longer than the log",
        TEXT,
        "high, longest)",
        "high)",
        ("test_first_draft.py", "short_log"),
    ),
    Mutant(
        "draft: readings have no deadline",
        READINGS,
        "if time.monotonic() > self.until:",
        "if False:",
        ("test_first_draft.py", "not_tried"),
    ),
    Mutant(
        "first experiment: at the limits of joints",
        EXPERIMENT,
        "if states[..., i].min() < low or states[..., i].max() > high:",
        "if False:",
        ("test_first_draft.py", "none_is_safe"),
    ),
    Mutant(
        "first experiment: targets jump",
        "experiment_design/limits.py",
        "((high - low) / SLOW).tolist()",
        "(100.0 * (high - low)).tolist()",
        ("test_design_mujoco.py", "move_slowly"),
    ),
    Mutant(
        "a missing column of an input cannot be a number",
        "data/logs/read.py",
        "raise _or_constant(error, plan) from error",
        "raise",
        ("test_first_draft.py", "without_a_column"),
    ),
    Mutant(
        "root: a draft forgets it",
        TEXT,
        "if c.root is not None:",
        "if False:",
        ("test_first_draft.py", "root"),
    ),
    Mutant(
        "draft: a rate has no sign",
        COLUMNS,
        "-1 if slope < 0 else 1",
        "1",
        ("test_draft.py", "rate_tells"),
    ),
    Mutant(
        "draft: what should be is as good as what is",
        COLUMNS,
        "- 1.0 * bool(words & _AIMED)",
        "- 0.0 * bool(words & _AIMED)",
        ("test_draft.py", "names_and_rates"),
    ),
    Mutant(
        "draft: theta is the first of two hinges",
        COLUMNS,
        "if units.count(u) == 1",
        "if units.count(u) >= 1",
        ("test_draft.py", "only_joint"),
    ),
    Mutant(
        "draft: time in s whatever its step",
        COLUMNS,
        "next(u for u, least in marks if period >= least)",
        '"s"',
        ("test_draft.py", "name_and_step"),
    ),
    Mutant(
        "zeros: the way back is forgotten",
        ZEROS,
        "s + offset, a, h) - offset",
        "s + offset, a, h)",
        ("test_placement.py", "moves_the_machine"),
    ),
    Mutant(
        "mujoco: a coarse model is stepped finely",
        "systems/mujoco/system.py",
        "return self.own_step",
        "return 0.01",
        ("test_draft.py", "coarse"),
    ),
    Mutant(
        "whatever stalls is near its MAP",
        "inference/convergence.py",
        "NEAR = 0.03",
        "NEAR = 30.0",
        ("test_laplace.py", "no_arrival"),
    ),
    Mutant(
        "jitter of the stamps is one of the steps",
        "data/clock.py",
        "if away > EVEN:\n        part",
        "if True:\n        part",
        ("test_clock.py", "jitter"),
    ),
    Mutant(
        "a step a little too long is two",
        "systems/base.py",
        "/ longest - STEP_TOLERANCE)",
        "/ longest - 1e-9)",
        ("test_clock.py", "little_longer"),
    ),
    Mutant(
        "forecasts of a model with its own step take another",
        "data/grid.py",
        "(round(away(k), 9), -k)",
        "-k",
        ("test_clock.py", "forecasts"),
    ),
    Mutant(
        "windows of two periods are stepped as one",
        "systems/mujoco/engine.py",
        "if lengths.size == 1:",
        "if lengths.size >= 1:",
        ("test_clock.py", "two_periods"),
    ),
)
