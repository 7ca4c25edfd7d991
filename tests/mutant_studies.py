"""Mutants of plans and of studies' verdicts: worse plans, claims that hold easily."""

from mutant_list import Mutant

PLANS = "planning/mpc.py"
CLAIMS, MAP = "studies/claims.py", "studies/mismatch.py"

STUDIES = (
    Mutant(
        "plans: the longest promises most",
        PLANS,
        "jnp.argmax(best / jnp.asarray(steps, best.dtype))",
        "jnp.argmax(best)",
        ("test_planning.py", "promises_most"),
    ),
    Mutant(
        "plans: an invalid one may promise",
        PLANS,
        "jnp.max(masked(r, valid))",
        "jnp.max(r)",
        ("test_planning.py", "promises_most"),
    ),
    Mutant(
        "claims: many places count once",
        CLAIMS,
        "level = 1.0 - (1.0 - LEVEL) / len(pairs)",
        "level = LEVEL",
        ("test_claims.py", "many_places"),
    ),
    Mutant(
        "claims: the best is asked of one other",
        CLAIMS,
        "if high < worst:",
        "if worst == np.inf:",
        ("test_claims.py", "of_all_others"),
    ),
    Mutant(
        "map: regrets resampled apart",
        MAP,
        "weights @ each[best]",
        "weights[::-1] @ each[best]",
        ("test_mismatch.py", "knows_its_seeds"),
    ),
    Mutant(
        "map: an episode not flown costs nothing",
        MAP,
        "each = 1.0 - np.minimum(np.where(np.isfinite(score), score, 0.0), 1.0)",
        "each = 1.0 - np.minimum(np.where(np.isfinite(score), score, 1.0), 1.0)",
        ("test_mismatch.py", "regret_by_hand"),
    ),
    Mutant(
        "cells: a checksum is written and not compared",
        "runs/sealed.py",
        'if digest.encode("ascii") != content[len(HEAD) : _START]:',
        "if False:",
        ("test_cells.py", "flipped_bit or layout_and_checksum"),
    ),
    Mutant(
        "cells: those of another source are used",
        "runs/cells.py",
        'reason = "" if source == self.source.digest else _SOURCE',
        'reason = ""',
        ("test_cells.py", "modules_and_versions"),
    ),
    Mutant(
        "cells: those kept are not counted",
        "runs/cells.py",
        "older = count[_SOURCE] + count[_UNMARKED]",
        "older = count[_SOURCE]",
        ("test_cells.py", "older_cells"),
    ),
    Mutant(
        "cells: the source is one file",
        "runs/sources.py",
        'pending += [*imported, name.rpartition(".")[0]]',
        "pending += []",
        ("test_cells.py", "all_that_is_imported"),
    ),
    Mutant(
        "runs: a manifest may do without its checksum",
        "runs/manifest.py",
        'if sealed != (manifest["format"] >= SEALED):',
        "if False:",
        ("test_manifest.py", "malformed"),
    ),
    Mutant(
        "policy: shapes are believed",
        "robot/format.py",
        "if found[name].shape != expected[name] or 0 in expected[name]:",
        "if False:",
        ("test_export.py", "malformed"),
    ),
    Mutant(
        "past actions of the bare plant",
        "studies/swingup.py",
        "return task, model, model.history",
        "return task, model, system.history",
        ("test_mismatch.py", "wraps"),
    ),
)
