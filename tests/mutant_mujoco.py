"""Mutants of simulators on the host: each must fail the test that is about it."""

from mutant_list import Mutant

EXTERNAL, ENGINE = "systems/external.py", "systems/mujoco_engine.py"
MJCF, FILE = "systems/mjcf.py", "systems/mjcf_file.py"

ON_THE_HOST = (
    Mutant(
        "external: a one-sided difference",
        EXTERNAL,
        "points = np.concatenate([x[None], x + sides, x - sides])",
        "points = np.concatenate([x[None], x + sides, x + 0.0 * sides])",
        ("test_external.py", "right_forward"),
    ),
    Mutant(
        "external: differences cross bounds",
        EXTERNAL,
        "np.clip(points[..., :p], self.low, self.high)",
        "points[..., :p]",
        ("test_external.py", "cross_a_bound"),
    ),
    Mutant(
        "external: a bound is forgotten when dividing",
        EXTERNAL,
        'np.einsum("kbk->kb", points[1 : K + 1] - points[K + 1 :])',
        "2.0 * step.T",
        ("test_external.py", "cross_a_bound"),
    ),
    Mutant(
        "external: numbers cross as they are",
        EXTERNAL,
        "x.astype(dtype).reshape(*lead, *x.shape[1:])",
        "x.astype(np.float32).astype(dtype).reshape(*lead, *x.shape[1:])",
        ("test_external.py", "last_bit"),
    ),
    Mutant(
        "mujoco: derived constants are those of the file",
        ENGINE,
        "if self._derive:",
        "if False:",
        ("test_mujoco_system.py", "step_is or batch"),
    ),
    Mutant(
        "mujoco: constants of another row",
        ENGINE,
        "chosen = [models[k] for k in which.reshape(-1)[mine]]",
        "chosen = [models[0] for k in which.reshape(-1)[mine]]",
        ("test_mujoco_system.py", "batch"),
    ),
    Mutant(
        "mujoco: a copy keeps its first values",
        ENGINE,
        "if self._held[k] == theta.tobytes():",
        "if self._held[k]:",
        ("test_mujoco_system.py", "step_is"),
    ),
    Mutant(
        "mujoco: what stopped early counts",
        ENGINE,
        "np.where(stopped[:, None], np.nan, state)",
        "np.where(stopped[:, None], state, state)",
        ("test_mujoco_system.py", "ran_away"),
    ),
    Mutant(
        "mujoco: every substep is the file's",
        ENGINE,
        "model.opt.timestep = span / count",
        "pass",
        ("test_mujoco_system.py", "uneven"),
    ),
    Mutant(
        "mjcf: a mass without its inertia",
        MJCF,
        "model.body_inertia[b] = inertia * (value / mass)",
        "pass",
        ("test_mujoco_system.py", "step_is or batch"),
    ),
    Mutant(
        "mjcf: a servo's gain without its bias",
        MJCF,
        "model.actuator_biasprm[i, column] = -value",
        "pass",
        ("test_mujoco_system.py", "step_is or batch"),
    ),
    Mutant(
        "mjcf file: a body keeps its inertia",
        FILE,
        '    "inertia": "body_inertia",\n',
        "",
        ("test_mujoco_file.py", "makes_that_model"),
    ),
    Mutant(
        "mjcf file: what cannot be said is not checked",
        FILE,
        "not np.isclose(found, wanted, rtol=1e-9, atol=1e-12)",
        "not np.isclose(found, wanted, rtol=1e9, atol=1e-12)",
        ("test_mujoco_file.py", "cannot_say"),
    ),
    Mutant(
        "mjcf load: parts may lie anywhere",
        "systems/mjcf_load.py",
        "if not place.is_relative_to(inside):",
        "if False:",
        ("test_mujoco_file.py", "stays_in_its_folder"),
    ),
    Mutant(
        "mjcf load: parts of parts are not looked at",
        "systems/mjcf_load.py",
        "                todo.append(place)",
        "                pass",
        ("test_mujoco_file.py", "stays_in_its_folder"),
    ),
)
