"""The demo: swing up a pendulum whose parameters are unknown, in a few trials.

For each seed a machine is drawn from the prior, and three learners meet it under the
same noise: posterior sampling, its point estimate, and the prior mean that never
learns. Every real interaction counts; scores are those of `sim2gp.planning.tasks`.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import jax
import numpy as np

from sim2gp.belief import AbstractModel
from sim2gp.commands.result import AbstractResult
from sim2gp.identification import diagnose
from sim2gp.identification.missing_physics.curves import (
    Curve,
    curves_of,
    force_arrays,
    functions_of,
)
from sim2gp.identification.missing_physics.reach import box_of_rows
from sim2gp.models import (
    MissingForces,
    PointEstimate,
    PriorMean,
    Sim2GP,
    Sim2GPBelief,
)
from sim2gp.planning import MPC
from sim2gp.planning.loop import Episode, History, psrl
from sim2gp.planning.oracle import AcceptedTruth, accept_truth
from sim2gp.planning.tasks import MACHINES, Task, episodes_to_95, hanging_return, score
from sim2gp.runs import Progress
from sim2gp.runs.provenance import provenance
from sim2gp.runs.sinks import Nowhere, Sink, each_episode
from sim2gp.studies.learners import MISSING, misfit_of_belief, reach_of
from sim2gp.systems.base import AbstractPlant, AbstractSystem
from sim2gp.types import Key, in_float64

LEARNER, WITH_FORCES = "posterior sampling", "missing forces"
ORACLE = "a planner that knows the machine (the oracle)"


@dataclass(frozen=True)
class SeedRun:
    """One machine, all learners on it."""

    accepted: AcceptedTruth
    hang: float
    histories: dict[str, History]

    @property
    def oracle(self) -> float:
        return self.accepted.oracle.oracle_return

    def solved(self, method: str) -> int | None:
        """`episodes_to_95` of one learner."""
        return episodes_to_95(self.histories[method].returns, self.hang, self.oracle)


@dataclass(frozen=True, repr=False)
class Demonstration(AbstractResult):
    """What learners achieved on machines whose parameters they did not know."""

    @property
    def returns(self) -> dict[str, np.ndarray]:
        """Of each learner, by seed and episode."""
        start = "returns/"
        return {k.removeprefix(start): v for k, v in self.arrays.items() if start in k}

    @property
    def scores(self) -> dict[str, np.ndarray]:
        """The same as scores: 1 is the oracle's, 0 a pole left hanging."""
        start = "scores/"
        return {k.removeprefix(start): v for k, v in self.arrays.items() if start in k}


def demo(
    *,
    machine: Literal["furuta", "cartpole"] = "furuta",
    seed: int = 0,
    seeds: int = 1,
    episodes: int = 3,
    truth: Literal["prior", "2sd", "3sd", "outside"] = "prior",
    mismatch: bool = False,
    sink: Sink | None = None,
    progress: Progress | None = None,
) -> Demonstration:
    """Swing up ``seeds`` pendulums, each in so many ``episodes`` of 5 s.

    ``truth`` says how the hidden parameters are drawn: from the prior, 2 or 3 sd from
    its mean, or beyond their bounds. With ``mismatch`` the machine has a force that its
    simulator lacks, that of figure 2, and one learner looks for it. ``sink``
    (`sim2gp.sinks`) gets every episode's numbers at once.
    """
    started = time.perf_counter()
    make, make_task = MACHINES[machine]
    system = make()
    effects = (MISSING[machine],) if mismatch else ()
    preset = partial(make_task, effects=effects)
    learners = _learners(system, preset(), mismatch)
    parts, runs = 1 + len(learners) * episodes, []
    sink = sink or Nowhere()
    with (progress or Progress()).task("demo", seeds * parts) as task:
        for s in range(seed, seed + seeds):
            key = jax.random.key(s)
            accepted = accept_truth(preset, system, MPC(), key=key, truth=truth)
            oracle = accepted.oracle.oracle_return
            task.advance(f"seed {s}: oracle, return {oracle:.0f}")
            sink.scalars(0, {f"seed {s}/oracle/return": oracle})
            listener = partial(_episode_listener, task.advance, sink, s)
            histories = _race(accepted.task, learners, episodes, key, listener)
            runs.append(SeedRun(accepted, hanging_return(accepted.task), histories))
    summary, arrays = _demo_summary(system, machine, runs, seed, episodes)
    forces = _forces(next(iter(runs[0].histories.values())))
    arrays |= force_arrays(forces)
    summary["forces"] = {c.name: c.entry() for c in forces}
    summary |= {"truth": truth, "with_mismatch": mismatch}
    return Demonstration(summary | provenance(started), arrays)


def _learners(
    system: AbstractPlant, task: Task, mismatch: bool
) -> dict[str, AbstractModel]:
    """Who meets the machine; the first is shown."""
    model = Sim2GP(system)
    if mismatch:
        forces = MissingForces(model, reach=reach_of(task, system))
        return {WITH_FORCES: forces, LEARNER: model}
    return {
        LEARNER: model,
        "point estimate": PointEstimate(model),
        "prior mean": PriorMean(model),
    }


def _race(
    task: Task,
    learners: dict[str, AbstractModel],
    episodes: int,
    key: Key,
    listener: Callable[[str], Callable[[Episode], None]],
) -> dict[str, History]:
    """Every learner on the same machine, under the same noise."""
    return {
        name: psrl(
            task, learner, MPC(), episodes=episodes, key=key, on_episode=listener(name)
        )
        for name, learner in learners.items()
    }


def _episode_listener(
    advance: Callable[[str], None], sink: Sink, seed: int, name: str
) -> Callable[[Episode], None]:
    """Who hears of a learner's episodes: the bar, and wherever numbers go."""
    write = each_episode(sink, f"seed {seed}/{name}")

    def tell(episode: Episode) -> None:
        total = float(episode.trajectory.total)
        advance(f"{name}, episode {episode.index}: return {total:.0f}")
        write(episode)

    return tell


def _demo_summary(
    system: AbstractSystem,
    machine: str,
    runs: list[SeedRun],
    seed: int,
    episodes: int,
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    methods = list(runs[0].histories)
    returns = {m: np.stack([r.histories[m].returns for r in runs]) for m in methods}
    solved = {m: [r.solved(m) for r in runs] for m in methods}
    leader = methods[0]
    first, shown = runs[0], runs[0].histories[leader]
    learned = shown.belief
    assert isinstance(learned, Sim2GPBelief)
    belief, table = learned.without_functions(), system.parameters
    found = diagnose.summary(table, belief.prior, belief.posterior, belief.information)
    for name, value in first.accepted.task.truth.items():
        if name in found["parameters"]:
            found["parameters"][name]["truth"] = float(value)
    states = [channel.name for channel in system.physical_states]
    seconds = first.accepted.task.seconds
    summary: dict[str, Any] = {
        "command": "demo",
        "machine": machine,
        "seed": seed,
        "seeds": len(runs),
        "episodes": episodes,
        "headline": _demo_headline(runs, leader, found["parameters"]),
        "returns": {m: _squeeze(returns[m].tolist()) for m in methods},
        "oracle_return": _squeeze([r.oracle for r in runs]),
        "hang_return": _squeeze([r.hang for r in runs]),
        "redrawn_truths": sum(r.accepted.redrawn for r in runs),
        "episodes_to_95": {m: _squeeze(solved[m]) for m in methods},
        "solved_within": {m: _within(solved[m], episodes) for m in methods},
        "interaction_seconds": {
            m: _squeeze([None if n is None else n * seconds for n in solved[m]])
            for m in methods
        },
        "noise": dict(zip(states, np.asarray(belief.noise).tolist(), strict=True)),
        "misfit": misfit_of_belief(learned, shown.data).as_dict(),
        "log_evidence": float(belief.log_evidence),
        "n_transitions": int(belief.count),
        **found,
    }
    scores = {
        m: np.asarray(
            [[score(x, r.hang, r.oracle) for x in r.histories[m].returns] for r in runs]
        )
        for m in methods
    }
    summary["tables"] = [_score_table(runs, methods, scores)]
    summary["animation"] = _animation(first.accepted.task, machine, scores[leader][0])
    arrays = {f"returns/{m}": returns[m] for m in methods}
    arrays |= {f"scores/{m}": scores[m] for m in methods}
    # Each episode's last state is left out: time and actions then are T long.
    arrays["animation/state"] = np.concatenate(shown.state[:, :-1])
    arrays["animation/action"] = np.concatenate(shown.action)
    key = jax.random.fold_in(jax.random.key(seed), 1)
    arrays |= diagnose.arrays(table, belief.prior, belief.posterior, key=key)
    return summary, arrays


@in_float64
def _forces(history: History) -> tuple[Curve, ...]:
    """Forces that the data have turned on, over where the machine has been."""
    belief, data = history.belief, history.data
    assert isinstance(belief, Sim2GPBelief)
    system = belief.system
    there = np.asarray(data.mask)
    rows = np.asarray(data.state)[there], np.asarray(data.action)[there]
    box = box_of_rows(system, *rows)
    return curves_of(system, functions_of(system), box, belief.posterior)


def _animation(task: Task, machine: str, scores: np.ndarray) -> dict[str, Any]:
    """What the report needs to draw the machine's episodes."""
    return {
        "system": machine,
        "dt": task.dt,
        "params": {k: float(v) for k, v in task.truth.items()},
        "title": "the machine, controlled by the learned model",
        "marks": [
            {"time": e * task.seconds, "text": f"episode {e + 1}, score {s:.2f}"}
            for e, s in enumerate(scores)
        ],
    }


def _demo_headline(
    runs: list[SeedRun], leader: str, parameters: Mapping[str, Mapping[str, Any]]
) -> str:
    counts, held = [r.solved(leader) for r in runs], _held_sentence(parameters)
    done = sorted(n for n in counts if n is not None)
    if not done:
        return f"The learner did not reach 95 % of the score of {ORACLE}. {held}"
    middle = done[len(done) // 2]
    machines = (
        "The machine was"
        if len(runs) == 1
        else f"{len(done)} of {len(runs)} machines were"
    )
    return (
        f"{machines} swung up at 95 % of the score of {ORACLE}, or better; "
        f"in episode {middle}{' (median)' if len(runs) > 1 else ''}, that is "
        f"after {middle * runs[0].accepted.task.seconds:g} s on the machine. {held}"
    )


def _held_sentence(parameters: Mapping[str, Mapping[str, Any]]) -> str:
    """How many of the 95 % intervals have the true value in them."""
    known = [x for x in parameters.values() if "truth" in x]
    held = sum(x["q025"] <= x["truth"] <= x["q975"] for x in known)
    return (
        f"{held} of {len(known)} intervals of 95 % hold the true value; about one in "
        "twenty should not."
    )


def _within(solved: list[int | None], episodes: int) -> dict[str, int]:
    """How many seeds were solved within so many episodes."""
    return {
        str(n): sum(1 for s in solved if s is not None and s <= n)
        for n in range(1, episodes + 1)
    }


def _score_table(
    runs: list[SeedRun], methods: list[str], scores: dict[str, np.ndarray]
) -> dict[str, Any]:
    """Median score of each episode, and how soon the seeds are solved."""
    episodes = scores[methods[0]].shape[1]
    rows = []
    for m in methods:
        counts = [r.solved(m) for r in runs]
        soon = [sum(n is not None and n <= k for n in counts) for k in (1, 2, 3)]
        rows.append(
            [m, *(f"{x:.2f}" for x in np.median(scores[m], axis=0)), *map(str, soon)]
        )
    heads = [f"episode {e + 1}" for e in range(episodes)]
    return {
        "title": "Score of each episode (median over machines) and machines solved",
        "columns": ["method", *heads, "by 1", "by 2", "by 3"],
        "rows": rows,
        "note": f"Machines: {len(runs)}; a score of 1 is the oracle's, 0 is hanging; "
        f"solved means a score of at least 0.95 in any episode so far.",
    }


def _squeeze(values: list[Any]) -> Any:
    """One seed's value alone, several as a list."""
    return values[0] if len(values) == 1 else values
