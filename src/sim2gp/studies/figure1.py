"""Figure 1: a horizontal two-link arm, learned from two data sets in turn.

What the first data set cannot know (link 1) it must leave at the prior, and the second
must find. Beside the figure stand other recordings of the same arm, and many arms drawn
from the prior: they tell whether the intervals are right.
"""

import time
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sim2gp.identification import diagnose
from sim2gp.models import Sim2GPBelief
from sim2gp.runs import Progress, new_run
from sim2gp.runs.provenance import provenance
from sim2gp.studies.two_link_study import (
    DT,
    LEVELS,
    LOCKED,
    NOISE,
    STEPS,
    Study,
    band,
    coverage_study,
    covered,
    learn,
    nominal_truth,
)
from sim2gp.types import Action, Dynamics, Key, State, in_float64

DRAWS = 32
SEEDS, QUICK_SEEDS = 200, 20  # arms drawn from the prior
REPEATS, QUICK_REPEATS = 40, 5  # other recordings of the nominal arm


@in_float64
def repeat_study(
    repeats: int, *, key: Key, progress: Progress
) -> list[dict[str, dict[str, Any]]]:
    """The claims about one arm, over other recordings of the nominal arm."""
    truth = nominal_truth()
    keys = jax.random.split(key, repeats)
    return [
        arm_claims(learn(truth, key=k))
        for k in progress.track(keys, "other recordings")
    ]


def run(*, out: Path, seed: int, quick: bool, progress: Progress) -> dict[str, Any]:
    """Reproduce figure 1 and check its claims; returns the summary of the run."""
    started = time.perf_counter()
    key = jax.random.key(seed)
    seeds = QUICK_SEEDS if quick else SEEDS
    repeats = QUICK_REPEATS if quick else REPEATS
    with new_run(out, "reproduce fig1") as writer:
        progress.say("figure 1: two data sets of one arm")
        study = learn(nominal_truth(), key=jax.random.fold_in(key, 0))
        arrays = figure_arrays(study, key=jax.random.fold_in(key, 1))
        over, failed = coverage_study(
            seeds, key=jax.random.fold_in(key, 2), progress=progress
        )
        arrays |= {f"coverage/{name}": value for name, value in over.items()}
        others = repeat_study(
            repeats, key=jax.random.fold_in(key, 4), progress=progress
        )
        claims = arm_claims(study, others) | {
            "intervals_cover": coverage_claim(over["z"], failed)
        }
        summary = _summary(study, claims, over["z"], seed, quick)
        summary["fits_not_converged"] = failed
        table, posterior = study.prior.system.parameters, study.posterior2.posterior
        prior = study.prior.posterior
        arrays |= diagnose.arrays(
            table, prior, posterior, key=jax.random.fold_in(key, 3), count=500
        )
        line = f"sim2gp reproduce fig1 --seed {seed}{' --quick' * quick}"
        summary |= provenance(started, line)
        from sim2gp.reports import figure1, figure_bytes, write_report

        writer.write_summary(summary)
        writer.write_arrays("arrays.npz", arrays)
        writer.write_bytes("figure1.png", figure_bytes(figure1(arrays, summary), "png"))
        writer.write_text("report.html", write_report(summary, arrays))
    return summary


def figure_arrays(study: Study, *, key: Key) -> dict[str, np.ndarray]:
    """Everything that `sim2gp.reports.figure1` draws."""
    arrays = {"figure1/truth": np.asarray(study.truth)}
    for name in ("prior", "posterior1", "posterior2"):
        belief = getattr(study, name).posterior
        arrays[f"figure1/{name}/mean"] = np.asarray(belief.mean)
        arrays[f"figure1/{name}/scale"] = np.asarray(belief.scale)
    pairs = {
        "data1": (study.first, {"prior": study.prior, "posterior1": study.posterior1}),
        "data2": (
            study.second,
            {"posterior1": study.middle, "posterior2": study.posterior2},
        ),
    }
    for data, (recording, beliefs) in pairs.items():
        arrays[f"figure1/{data}/state"] = np.asarray(recording.state)
        arrays[f"figure1/{data}/action"] = np.asarray(recording.action)
        for name, belief in beliefs.items():
            # The same draws of the standard normal for both beliefs of a panel.
            draws = _draws(belief, jax.random.split(key, DRAWS))
            arrays[f"figure1/{data}/draws/{name}"] = _rollouts(draws, recording.action)
    return arrays


def _draws(belief: Sim2GPBelief, keys: Array) -> Dynamics:
    return eqx.filter_vmap(belief.sample)(keys)


def _rollouts(draws: Dynamics, action: Float[Array, "T 2"]) -> np.ndarray:
    """Paths (draws, T + 1, 4) of the draws from rest under the recorded torques."""
    rest = jnp.zeros(4, jnp.float32)

    def one(draw: Dynamics, action: Array) -> Array:
        def step(s: State, a: Action) -> tuple[State, State]:
            s = draw(s, a)
            return s, s

        _, path = jax.lax.scan(step, rest, action)
        return jnp.concatenate([rest[None], path])

    every = eqx.filter_vmap(one, in_axes=(eqx.if_array(0), None))
    paths = eqx.filter_jit(every)(draws, jnp.asarray(action, jnp.float32))
    # A drawing needs no more than a milliradian, and the file is half as large.
    return np.round(np.asarray(paths), 3)


def _summary(
    study: Study,
    claims: dict[str, dict[str, Any]],
    z: np.ndarray,
    seed: int,
    quick: bool,
) -> dict[str, Any]:
    table = study.prior.system.parameters
    names = list(table.names)
    stages = [study.prior, study.posterior1, study.posterior2]
    sd = np.stack([np.asarray(belief.parameters()[1]) for belief in stages])
    held = sum(claim["holds"] for claim in claims.values())
    found = diagnose.summary(
        table, study.prior.prior, study.posterior2.posterior, _information(study)
    )
    values = np.asarray(study_values(study))
    for name, value in zip(names, values, strict=True):
        found["parameters"][name]["truth"] = float(value)
    return {
        "command": "reproduce",
        "title": "Figure 1: a two-link arm learned from two data sets",
        "figure": "fig1",
        "seed": seed,
        "quick": quick,
        "headline": f"{held} of {len(claims)} claims hold. {_sentence(sd)}",
        "claims": claims,
        "curves": {
            "transitions": [0, STEPS, 2 * STEPS],
            **{f"sd_{name}": sd[:, i].tolist() for i, name in enumerate(names)},
        },
        "coverage": {
            name: {f"{level} %": float(covered(z, level)[i]) for level in LEVELS}
            for i, name in enumerate(names)
        },
        "coverage_arms": len(z),
        "n_transitions": 2 * STEPS,
        "noise": _noise(study),
        "tables": [_table(names, sd, stages, study), _coverage_table(names, z)],
        "figure1": {
            "names": names,
            "lengths": [dict(table.fixed)["l1"], dict(table.fixed)["l2"]],
            "dt": DT,
            "vertical": False,
            "titles": [
                "(a) data set 1: joint 1 locked",
                "data set 2: both joints free",
            ],
        },
        **found,
    }


@in_float64
def study_values(study: Study) -> Float[Array, " p"]:
    """The true constants in physical units."""
    return study.prior.system.parameters.constrain(study.truth)


@in_float64
def _information(study: Study) -> Float[Array, "r p"]:
    """Both data sets' square-root information, whitened by the first prior."""
    middle = study.middle.prior
    onto = jnp.linalg.solve(middle.scale, study.prior.prior.scale)
    rows = [study.posterior1.information, study.posterior2.information @ onto]
    return jnp.concatenate(rows)


def arm_claims(
    study: Study, others: list[dict[str, dict[str, Any]]] | None = None
) -> dict[str, dict[str, Any]]:
    """The paper's claims about one arm, in the numbers this project set for them.

    With ``others``, each claim also says in how many other recordings it holds.
    """
    stages = [study.prior, study.posterior1, study.posterior2]
    sd = np.stack([np.asarray(belief.parameters()[1]) for belief in stages])
    ratio = sd[1, :2] / sd[0, :2]
    furthest = ratio[np.argmax(np.abs(ratio - 1.0))]
    first, last = np.max(sd[1, 2:]), np.max(sd[2])
    distance = np.max(np.abs(study.z))
    claims: dict[str, tuple[bool, float, str]] = {
        "link_1_stays_at_the_prior": (
            abs(furthest - 1.0) <= 0.10,
            furthest,
            "sd of m1 and b1 after data set 1 over the prior's; within 10 %",
        ),
        "link_2_is_learned_first": (
            first < 0.05,
            first,
            "largest sd of m2 and b2 after data set 1; below 0.05",
        ),
        "both_links_are_learned": (
            last < 0.15,
            last,
            "largest sd of the four after data set 2; below 0.15",
        ),
        "truth_is_near": (
            distance <= 2.5,
            distance,
            "largest distance of the truth after data set 2, in sd; at most 2.5",
        ),
    }
    found: dict[str, dict[str, Any]] = {}
    for name, (holds, figure, text) in claims.items():
        found[name] = {"holds": bool(holds), "figure": float(figure), "text": text}
        if others:
            count = sum(other[name]["holds"] for other in others)
            found[name]["other_recordings"] = f"{count} of {len(others)}"
            found[name]["text"] += f". Other recordings: {count} of {len(others)} hold."
    return found


def coverage_claim(z: Float[np.ndarray, "seeds p"], failed: int) -> dict[str, Any]:
    """Whether the shares of all parameters lie in the bands, at all levels."""
    holds, shares = True, []
    for level in LEVELS:
        inside, (low, high) = covered(z, level), band(level, len(z))
        holds = holds and bool(np.all((low <= inside) & (inside <= high)))
        shares.append(
            f"{level} %: {inside.min():.3f} to {inside.max():.3f} "
            f"(band {low:.3f} to {high:.3f})"
        )
    return {
        "holds": holds,
        "figure": "; ".join(shares),
        "text": f"share of {len(z)} arms drawn from the prior whose truth lies inside; "
        f"least and greatest of four parameters; {failed} fits not converged",
    }


def _sentence(sd: np.ndarray) -> str:
    return (
        f"The first data set teaches link 2 (sd {sd[1, 2:].max():.3f}) and leaves "
        f"link 1 at the prior (sd {sd[1, :2].min():.2f} of {sd[0, 0]:.2f}); "
        f"the second teaches both (sd at most {sd[2].max():.3f})."
    )


def _noise(study: Study) -> dict[str, dict[str, float]]:
    """What EM found on each data set; a locked joint has no noise to find."""
    channels = [channel.name for channel in study.prior.system.physical_states]
    first, second = study.posterior1.noise.tolist(), study.posterior2.noise.tolist()
    locked = [*LOCKED, *LOCKED]
    rows = {}
    for name, sd, one, two, still in zip(
        channels, NOISE, first, second, locked, strict=True
    ):
        rows[name] = {"true": sd} | ({} if still else {"data set 1": one})
        rows[name]["data set 2"] = two
    return rows


def _table(
    names: list[str], sd: np.ndarray, stages: list[Sim2GPBelief], study: Study
) -> dict[str, Any]:
    """The beliefs in virtual space, one row for each parameter."""
    mean = [np.asarray(belief.parameters()[0]) for belief in stages]
    rows = []
    for i, name in enumerate(names):
        beliefs = [f"{m[i]:.3f} ± {s[i]:.3f}" for m, s in zip(mean, sd, strict=True)]
        rows.append([name, f"{float(study.truth[i]):.3f}", *beliefs])
    return {
        "title": "Virtual parameters, mean ± sd",
        "columns": ["parameter", "truth", "prior", "after data set 1", "after both"],
        "rows": rows,
    }


def _coverage_table(names: list[str], z: np.ndarray) -> dict[str, Any]:
    shares = {level: covered(z, level) for level in LEVELS}
    rows: list[list[Any]] = [
        [name, *(f"{shares[level][i]:.3f}" for level in LEVELS)]
        for i, name in enumerate(names)
    ]
    bands = [band(level, len(z)) for level in LEVELS]
    rows.append(["band", *(f"{low:.3f} to {high:.3f}" for low, high in bands)])
    return {
        "title": f"Share of {len(z)} arms inside the interval, after both data sets",
        "columns": ["parameter", *(f"{level} % interval" for level in LEVELS)],
        "rows": rows,
        "note": "Truths are drawn from the prior; the band holds 99.9 % of the counts "
        "of right intervals.",
    }
