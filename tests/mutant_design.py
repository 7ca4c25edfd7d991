"""Mutants of experiment design: what it would tell, its limits, what is asked of it."""

from mutant_list import Mutant

EXPERIMENT, GOALS = "experiment_design/experiment.py", "experiment_design/goals.py"
LIMITS, SIGNALS, SEARCH = (
    "experiment_design/limits.py",
    "experiment_design/signals.py",
    "experiment_design/search.py",
)
CLIMB, SAMPLES = "experiment_design/by_gradients.py", "experiment_design/by_samples.py"
RUN, VERDICT = "commands/design.py", "experiment_design/verdict.py"
TOLD = ("test_design.py", "tells_what_the_log")
GOAL = ("test_design.py", "dense_covariances")
KEPT = ("test_design.py", "exactly or followed")
SEARCHED = ("test_design_search.py", "beats_random or nothing_can")

DESIGN = (
    Mutant(
        "design: starts are known",
        EXPERIMENT,
        "P = P - Q @ (Q.T @ P)",
        "P = P",
        TOLD,
    ),
    Mutant(
        "design: starts without a prior",
        EXPERIMENT,
        "jnp.concatenate([J[:, :n], jnp.eye(n, dtype=J.dtype)])",
        "jnp.concatenate([J[:, :n], 1e-3 * jnp.eye(n, dtype=J.dtype)])",
        TOLD,
    ),
    Mutant(
        "design: what was believed before is forgotten",
        EXPERIMENT,
        "jnp.concatenate([A, eye])",
        "jnp.concatenate([A, 1e-3 * eye])",
        TOLD,
    ),
    Mutant(
        "design: commands come a period early",
        EXPERIMENT,
        "(jnp.arange(rows, dtype=U.dtype) - before)",
        "(jnp.arange(rows, dtype=U.dtype) - before - 1)",
        ("test_design.py", "as_the_system_steps"),
    ),
    Mutant(
        "goal: the rest is taken for known",
        GOALS,
        "rows = scale[jnp.asarray(self.index)]",
        "rows = scale[jnp.asarray(self.index)][:, jnp.asarray(self.index)]",
        GOAL,
    ),
    Mutant(
        "goal: sd in place of variance",
        GOALS,
        "return jnp.sqrt(jnp.mean(jnp.sum(",
        "return (jnp.mean(jnp.sum(",
        GOAL,
    ),
    Mutant(
        "limits: rates are twice as fast",
        LIMITS,
        "step = limits.rate * period",
        "step = 2.0 * limits.rate * period",
        KEPT,
    ),
    Mutant(
        "limits: the machine was not at rest",
        LIMITS,
        "jax.lax.scan(follow, jnp.zeros_like(U[0]), U)",
        "jax.lax.scan(follow, U[0], U)",
        KEPT,
    ),
    Mutant(
        "limits: the lower side is open",
        LIMITS,
        "limits.state_low[None] - states",
        "0.0 * states",
        ("test_design.py", "share_of_the_half"),
    ),
    Mutant(
        "limits: what is stated widens a channel",
        LIMITS,
        "max(low, box[name][0]), min(high, box[name][1])",
        "low, high",
        ("test_design.py", "narrow"),
    ),
    Mutant(
        "limits: a start on the edge",
        LIMITS,
        "if not low < x < high:",
        "if not low - 9.0 < x < high + 9.0:",
        ("test_design.py", "admit_no_motion"),
    ),
    Mutant(
        "multisine: cut, not scaled",
        SIGNALS,
        "U / jnp.maximum(share, 1.0)[None]",
        "U",
        ("test_design.py", "scaled_not_cut"),
    ),
    Mutant(
        "search: whatever leaves the limits",
        SEARCH,
        "if bad <= ALLOWED:",
        "if bad <= 1.0:",
        ("test_design_search.py", "no_smaller"),
    ),
    Mutant(
        "search: the worst plan",
        CLIMB,
        "return cost * beyond(states[1:]) - worth",
        "return cost * beyond(states[1:]) + worth",
        SEARCHED,
    ),
    Mutant(
        "search: what is lost is kept",
        CLIMB,
        "if jnp.mean(then < LOST) > 1.0 - LEAVING:",
        "if True:",
        ("test_design_search.py", "given_up"),
    ),
    Mutant(
        "search: a turn at most",
        CLIMB,
        "return jnp.sum(jnp.maximum(worst, 0.0))",
        "return jnp.max(jnp.maximum(worst, 0.0))",
        ("test_design.py", "every_turn"),
    ),
    Mutant(
        "search by samples: the worst ones are kept",
        SAMPLES,
        "np.argsort(-values, kind",
        "np.argsort(values, kind",
        ("test_design_mujoco.py", "beats_random"),
    ),
    Mutant(
        "search by samples: windows begin one late",
        SAMPLES,
        "asked, U, first, count - 1)",
        "asked, U, first + 1, count - 1)",
        ("test_design_mujoco.py", "of_the_definition"),
    ),
    Mutant(
        "search: longer periods with the noise of short ones",
        CLIMB,
        "noise=experiment.noise / math.sqrt(k)",
        "noise=experiment.noise",
        ("test_design_search.py", "longer_periods"),
    ),
    Mutant(
        "goal: some constants count as one",
        GOALS,
        "return len(self.index)",
        "return 1",
        ("test_design.py", "directions"),
    ),
    Mutant(
        "verdict: what cannot be narrowed is a reason to run",
        VERDICT,
        'expected[n]["of_before"] <= 1.0 - NARROWER]',
        'expected[n]["of_before"] <= 1.0]',
        ("test_design_run.py", None),
    ),
    Mutant(
        "verdict: what is known well enough is a reason to run",
        VERDICT,
        "if share[n] > asked.within",
        "if share[n] > 0.0",
        ("test_design_run.py", None),
    ),
    Mutant(
        "verdict: the model's errors are not said",
        VERDICT,
        "if wide[n] > max(asked.within, share[n])",
        "if wide[n] < 0.0",
        ("test_design_run.py", None),
    ),
    Mutant(
        "search: limits hold for machines of the plain posterior",
        CLIMB,
        "jax.vmap(experiment.plausible.at)(draws)",
        "jax.vmap(experiment.belief.at)(draws)",
        ("test_design_search.py", "corrected_posterior"),
    ),
    Mutant(
        "export: the plain posterior leaves without being asked for",
        "commands/export.py",
        'if posterior == "corrected" else found.plain',
        'if posterior == "plain" else found.plain',
        ("test_project_model.py", "as_wide_as_its_report"),
    ),
    Mutant(
        "csv: rounded",
        RUN,
        "repr(float(x))",
        'f"{float(x):.6g}"',
        ("test_design_run.py", None),
    ),
)
