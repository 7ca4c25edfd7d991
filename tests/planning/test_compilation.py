"""One compilation per run: after the second episode nothing is compiled any more."""

import dataclasses

import jax
import pytest

from sim2gp.models import Sim2GP
from sim2gp.planning import ICEM, MPC
from sim2gp.planning.loop import Episode, psrl
from sim2gp.planning.tasks import Task, furuta_swingup
from sim2gp.systems import Furuta


def counts_after(
    task: Task, planner: MPC, episodes: int, compilations: list[str]
) -> list[int]:
    """How many programs had been compiled when each episode ended."""
    counts = []

    def on_episode(episode: Episode) -> None:
        counts.append(len(compilations))

    psrl(
        task,
        Sim2GP(Furuta()),
        planner,
        episodes=episodes,
        key=jax.random.key(0),
        on_episode=on_episode,
    )
    return counts


def test_nothing_is_compiled_after_the_second_episode(compilations: list[str]) -> None:
    task = dataclasses.replace(furuta_swingup(), horizon=40)
    planner = MPC(update=ICEM(samples=32, iterations=2), horizon=10)
    counts = counts_after(task, planner, 6, compilations)
    assert counts[0] > 0, "the counter counts"
    assert counts[2:] == counts[1:2] * 4


@pytest.mark.nightly
def test_a_run_of_twenty_episodes_compiles_nothing_late(
    compilations: list[str],
) -> None:
    counts = counts_after(furuta_swingup(), MPC(), 20, compilations)
    assert counts[0] > 0
    assert counts[2:] == counts[1:2] * 18
