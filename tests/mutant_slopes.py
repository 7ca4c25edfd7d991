"""Mutants of the derivatives of MuJoCo's steps, and of descents on the host."""

from mutant_list import Mutant

SLOPES = "systems/mujoco/slopes/"
BODY, STEP = SLOPES + "rigid_body.py", SLOPES + "step.py"
ACTS, NUMBERS = SLOPES + "actuation.py", SLOPES + "numbers.py"
DIFFERENCES = ("test_slopes.py", "as_its_differences")
ON_HOST = ("test_host_descent.py", "")

SLOPES_OF_STEPS = (
    Mutant(
        "slopes: a joint's force does not turn with it",
        BODY,
        " + cross_force(S, of.F[b])",
        "",
        DIFFERENCES,
    ),
    Mutant(
        "slopes: velocities before a joint are those after it",
        BODY,
        "v_before[j], a_before[j] = now_v, now_a",
        "v_before[j], a_before[j] = now_v + S[j], now_a",
        DIFFERENCES,
    ),
    Mutant(
        "slopes: servos do not saturate",
        ACTS,
        "free[i, held] = 0.0",
        "free[i, held] = 1.0",
        DIFFERENCES,
    ),
    Mutant(
        "slopes: dry friction never sticks",
        STEP,
        "if some.size:",
        "if False:",
        DIFFERENCES,
    ),
    Mutant(
        "slopes: a sticking joint does not feel a servo's rate gain",
        ACTS,
        "out[j] -= at.free[i] * (has.gear[i] ** 2 * change + twice)",
        "out[j] -= at.free[i] * twice",
        DIFFERENCES,
    ),
    Mutant(
        "slopes: what cancels in free fall is no size",
        BODY,
        "size += np.einsum",
        "size += 0.0 * np.einsum",
        ("test_slopes.py", "free_fall"),
    ),
    Mutant(
        "slopes: gravity that is switched off acts",
        NUMBERS,
        "np.zeros(3) if weightless else ",
        "",
        ("test_slopes.py", "free_fall"),
    ),
    Mutant(
        "slopes: whatever acts is taken for known",
        STEP,
        "(np.abs(left) <= LEFT_OVER * found.size).all(0)",
        "np.ones(q.shape[1], bool)",
        ("test_slopes.py", "does_not_know or left_to_differences"),
    ),
    Mutant(
        "slopes: rows of a window do not follow each other",
        "systems/plants/external.py",
        "@ S + C[:, k - first]",
        "@ (0.0 * S) + C[:, k - first]",
        ("test_window_slopes.py", "window_is_differentiated"),
    ),
    Mutant(
        "slopes: dry friction has no regularisation of its own",
        NUMBERS,
        "return 1.0 / np.maximum(softness, 1e-15), rate",
        "return 2.0 / np.maximum(softness, 1e-15), rate",
        # Where it does not hold, differences are taken: slower, as right.
        ("test_slopes.py", "as_its_differences"),
    ),
)
