"""Figure 1: a horizontal two-link arm, learned from two data sets in turn.

What the first data set cannot know (link 1) it must leave at the prior, and the second
must find. Next to the figure are other recordings of the same arm, and many arms drawn
from the prior: they show whether the intervals are right.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sim2gp.identification import diagnose
from sim2gp.models import Sim2GPBelief
from sim2gp.runs.cell_work import AbstractCell, Values
from sim2gp.studies.study import Arrays, Key, Study
from sim2gp.studies.two_link import (
    DT,
    LEVELS,
    LOCKED,
    NOISE,
    STEPS,
    ArmCell,
    LearnedArm,
    coverage,
    coverage_band,
    learn,
    nominal_truth,
)
from sim2gp.types import Action, Dynamics, State, in_float64
from sim2gp.types import Key as RandomKey

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DRAWS = 32
#: Arms drawn from the prior, for each other recording of the nominal arm.
ARMS_PER_RECORDING = 5


class TwoLinkArm(Study):
    """One arm that is drawn, and its claims over other arms and recordings.

    ``seeds`` is the number of arms that are drawn from the prior.
    """

    size = (200, None)
    quick_size = (20, None)

    def rows(self) -> dict[Key, list[ArmCell]]:
        """Arms drawn from the prior, and other recordings of the nominal arm."""
        recordings = max(self.count // ARMS_PER_RECORDING, 1)
        return {
            ("prior",): [ArmCell("prior", self.seed, i) for i in range(self.count)],
            ("nominal",): [ArmCell("nominal", self.seed, i) for i in range(recordings)],
        }

    @cached_property
    def learned(self) -> LearnedArm:
        """The arm that is drawn."""
        key = jax.random.fold_in(jax.random.key(self.seed), 0)
        return learn(nominal_truth(), key=key)

    def arrays(self, values: Mapping[AbstractCell, Values]) -> Arrays:
        """What figure 1 draws, errors of all arms, and draws of the posterior."""
        key, rows = jax.random.key(self.seed), self.rows()
        learned = self.learned
        posterior, prior = learned.posterior2.posterior, learned.prior.posterior
        table = learned.prior.system.parameters
        arms = [values[cell] for cell in rows["prior",]]
        others = [values[cell] for cell in rows["nominal",]]
        # A fit that failed is an arm that no interval covers.
        lost = np.full(len(table.names), np.inf).tolist()
        return {
            **figure_arrays(learned, key=jax.random.fold_in(key, 1)),
            "coverage/truth": np.asarray([arm["truth"] for arm in arms]),
            "coverage/z": np.asarray([arm["z"] or lost for arm in arms]),
            "recordings/z": np.asarray([one["z"] for one in others if one["z"]]),
            "recordings/sd": np.asarray([one["sd"] for one in others if one["sd"]]),
            **diagnose.arrays(
                table, prior, posterior, key=jax.random.fold_in(key, 3), count=500
            ),
        }

    def summary(
        self, arrays: Arrays, values: Mapping[AbstractCell, Values]
    ) -> dict[str, Any]:
        """Claims about the drawn arm, over its other recordings, and over all arms."""
        del values
        learned, z = self.learned, arrays["coverage/z"]
        table = learned.prior.system.parameters
        failed = int(np.sum(~np.isfinite(z).all(axis=1)))
        pairs = zip(arrays["recordings/sd"], arrays["recordings/z"], strict=True)
        others = [arm_claims(sd, errors) for sd, errors in pairs]
        claims = with_others(arm_claims(learned.sd, learned.z), others)
        claims["intervals_cover"] = coverage_claim(z, failed)
        held = sum(claim["holds"] for claim in claims.values())
        taught = _arm_sentence(learned.sd)
        return {
            "title": "Figure 1: a two-link arm learned from two data sets",
            "figure": "fig1",
            "quick": self.quick,
            "headline": f"{held} of {len(claims)} claims hold. {taught}",
            "claims": claims,
            "curves": {
                "transitions": [0, STEPS, 2 * STEPS],
                **{
                    f"sd_{n}": learned.sd[:, i].tolist()
                    for i, n in enumerate(table.names)
                },
            },
            "coverage": _coverage(table.names, z),
            "coverage_arms": len(z),
            "n_transitions": 2 * STEPS,
            "noise": _noise(learned),
            "tables": [_belief_table(learned), _coverage_table(table.names, z)],
            "figure1": _figure_entries(learned),
            **_parameter_summary(learned),
        }

    def pictures(
        self, arrays: Mapping[str, np.ndarray], summary: Mapping[str, Any]
    ) -> "dict[str, Figure]":
        """The arm over both data sets, and the beliefs before and after each."""
        from sim2gp.reports import figure1

        return {"figure1": figure1(arrays, summary)}


def figure_arrays(learned: LearnedArm, *, key: RandomKey) -> dict[str, np.ndarray]:
    """Everything that `sim2gp.reports.figure1` draws."""
    arrays = {"figure1/truth": np.asarray(learned.truth)}
    for name in ("prior", "posterior1", "posterior2"):
        belief = getattr(learned, name).posterior
        arrays[f"figure1/{name}/mean"] = np.asarray(belief.mean)
        arrays[f"figure1/{name}/scale"] = np.asarray(belief.scale)
    pairs = {
        "data1": (
            learned.first,
            {"prior": learned.prior, "posterior1": learned.posterior1},
        ),
        "data2": (
            learned.second,
            {"posterior1": learned.middle, "posterior2": learned.posterior2},
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


def _coverage(names: Sequence[str], z: np.ndarray) -> dict[str, dict[str, float]]:
    """Share of arms inside each interval, by parameter."""
    shares = {f"{level} %": coverage(z, level) for level in LEVELS}
    return {
        name: {level: float(share[i]) for level, share in shares.items()}
        for i, name in enumerate(names)
    }


def _figure_entries(learned: LearnedArm) -> dict[str, Any]:
    """What the figure's panels say."""
    table = learned.prior.system.parameters
    return {
        "names": list(table.names),
        "lengths": [dict(table.fixed)["l1"], dict(table.fixed)["l2"]],
        "dt": DT,
        "vertical": False,
        "titles": ["(a) data set 1: joint 1 locked", "data set 2: both joints free"],
    }


@in_float64
def _parameter_summary(learned: LearnedArm) -> dict[str, Any]:
    """Posterior and truth of each parameter, in its unit."""
    table = learned.prior.system.parameters
    found = diagnose.summary(
        table,
        learned.prior.prior,
        learned.posterior2.posterior,
        information_of(learned),
    )
    values = np.asarray(table.constrain(learned.truth))
    for name, value in zip(table.names, values, strict=True):
        found["parameters"][name]["truth"] = float(value)
    return found


@in_float64
def information_of(learned: LearnedArm) -> Float[Array, "r p"]:
    """Both data sets' square-root information, whitened by the first prior."""
    onto = jnp.linalg.solve(learned.middle.prior.scale, learned.prior.prior.scale)
    rows = [learned.posterior1.information, learned.posterior2.information @ onto]
    return jnp.concatenate(rows)


def arm_claims(
    sd: Float[np.ndarray, "stages p"], z: Float[np.ndarray, " p"]
) -> dict[str, dict[str, Any]]:
    """The paper's claims about one arm, in the numbers this project set for them.

    sd: spreads before any data, after the first data set, and after both.
    z: errors after both, in posterior sd.
    """
    ratio = sd[1, :2] / sd[0, :2]
    furthest = ratio[np.argmax(np.abs(ratio - 1.0))]
    first, last = np.max(sd[1, 2:]), np.max(sd[2])
    distance = np.max(np.abs(z))
    found: dict[str, tuple[bool, float, str]] = {
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
    return {
        name: {"holds": bool(holds), "figure": float(figure), "text": text}
        for name, (holds, figure, text) in found.items()
    }


def with_others(
    claims: dict[str, dict[str, Any]], others: Sequence[Mapping[str, Any]]
) -> dict[str, dict[str, Any]]:
    """Each claim, with the number of other recordings in which it holds."""
    found = {}
    for name, one in claims.items():
        count = f"{sum(other[name]['holds'] for other in others)} of {len(others)}"
        text = f"{one['text']}. Other recordings: {count} hold."
        found[name] = {**one, "other_recordings": count, "text": text}
    return found


def coverage_claim(z: Float[np.ndarray, "seeds p"], failed: int) -> dict[str, Any]:
    """Whether the shares of all parameters lie in the bands, at all levels."""
    holds, shares = True, []
    for level in LEVELS:
        inside, (low, high) = coverage(z, level), coverage_band(level, len(z))
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


def _arm_sentence(sd: np.ndarray) -> str:
    return (
        f"The first data set teaches link 2 (sd {sd[1, 2:].max():.3f}) and leaves "
        f"link 1 at the prior (sd {sd[1, :2].min():.2f} of {sd[0, 0]:.2f}); "
        f"the second teaches both (sd at most {sd[2].max():.3f})."
    )


def _noise(learned: LearnedArm) -> dict[str, dict[str, float]]:
    """What EM found on each data set; a locked joint has no noise to find."""
    channels = [channel.name for channel in learned.prior.system.physical_states]
    first, second = learned.posterior1.noise.tolist(), learned.posterior2.noise.tolist()
    locked = [*LOCKED, *LOCKED]
    rows = {}
    for name, sd, one, two, still in zip(
        channels, NOISE, first, second, locked, strict=True
    ):
        rows[name] = {"true": sd} | ({} if still else {"data set 1": one})
        rows[name]["data set 2"] = two
    return rows


def _belief_table(learned: LearnedArm) -> dict[str, Any]:
    """The beliefs in virtual space, one row for each parameter."""
    stages = learned.prior, learned.posterior1, learned.posterior2
    mean = [np.asarray(belief.parameters()[0]) for belief in stages]
    rows = []
    for i, name in enumerate(learned.prior.system.parameters.names):
        pairs = zip(mean, learned.sd, strict=True)
        beliefs = [f"{m[i]:.3f} ± {s[i]:.3f}" for m, s in pairs]
        rows.append([name, f"{float(learned.truth[i]):.3f}", *beliefs])
    return {
        "title": "Virtual parameters, mean ± sd",
        "columns": ["parameter", "truth", "prior", "after data set 1", "after both"],
        "rows": rows,
    }


def _coverage_table(names: Sequence[str], z: np.ndarray) -> dict[str, Any]:
    shares = {level: coverage(z, level) for level in LEVELS}
    rows: list[list[Any]] = [
        [name, *(f"{shares[level][i]:.3f}" for level in LEVELS)]
        for i, name in enumerate(names)
    ]
    bands = [coverage_band(level, len(z)) for level in LEVELS]
    rows.append(["band", *(f"{low:.3f} to {high:.3f}" for low, high in bands)])
    return {
        "title": f"Share of {len(z)} arms inside the interval, after both data sets",
        "columns": ["parameter", *(f"{level} % interval" for level in LEVELS)],
        "rows": rows,
        "note": "Truths are drawn from the prior; the band holds 99.9 % of the counts "
        "of right intervals.",
    }
