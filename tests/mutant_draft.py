"""Mutants of `sim2gp init`: each must fail the test that is about it."""

from mutant_list import Mutant

COLUMNS, READINGS = "project/columns.py", "project/readings.py"
DRAFT, ZEROS = "project/draft.py", "systems/machine.py"
ODD = ("test_draft.py", "odd_log")

FIRST_DRAFT = (
    Mutant(
        "draft: no sign is turned",
        READINGS,
        "for s in (1, -1)]",
        "for s in (1, 1)]",
        ODD,
    ),
    Mutant(
        "draft: no zero is moved",
        READINGS,
        "[: 1 + turns]",
        "[:1]",
        ODD,
    ),
    Mutant(
        "draft: starts keep the old zero",
        READINGS,
        "windows.start * sign + zero,",
        "windows.start * sign,",
        ODD,
    ),
    Mutant(
        "draft: nothing is in degrees",
        DRAFT,
        "for columns in (stated, _in_other_units(system, stated)):",
        "for columns in (stated, stated):",
        ODD,
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
        "max(LONGEST_MEAN, float(self.engine.model.opt.timestep))",
        "LONGEST_MEAN",
        ("test_draft.py", "coarse"),
    ),
    Mutant(
        "whatever stalls is near its MAP",
        "inference/convergence.py",
        "NEAR = 0.03",
        "NEAR = 30.0",
        ("test_laplace.py", "no_arrival"),
    ),
)
