"""Runs of one program are the runs that they are alone."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mass_task import SMALL, GainModel, Mass, mass_task
from sim2gp.errors import NotConverged, Sim2GPError
from sim2gp.planning import MarkovObjective
from sim2gp.planning import loop as loops
from sim2gp.planning.loop import SamplingRun
from sim2gp.planning.oracle import accept_truth
from sim2gp.planning.tasks import Task
from sim2gp.planning.together import accept_together, learn_together
from sim2gp.systems import Furuta

KEYS = [jax.random.key(k) for k in range(3)]


def learning(key, model=None) -> SamplingRun:
    task = mass_task()
    return SamplingRun(
        task,
        model or GainModel(),
        SMALL,
        lambda _: MarkovObjective(task.reward),
        3,
        key,
    )


def test_each_run_is_the_run_alone() -> None:
    """Keys, draws, fits and plans: states agree to float32's rounding."""
    together = learn_together([learning(key) for key in KEYS], 3)
    for key, (episodes, why) in zip(KEYS, together, strict=True):
        alone = loops.psrl(mass_task(), GainModel(), SMALL, episodes=3, key=key)
        assert why == ""
        got = np.stack([t.state for t in episodes])
        np.testing.assert_allclose(got, alone.state, atol=1e-5)


class Stubborn(GainModel):
    """Fits nothing."""

    def fit(self, belief, data, *, key):
        raise NotConverged("E201", "no MAP")


def test_a_run_whose_fit_fails_ends_and_the_others_go_on() -> None:
    runs = [learning(KEYS[0]), learning(KEYS[1], Stubborn()), learning(KEYS[2])]
    together = learn_together(runs, 3)
    assert [len(episodes) for episodes, _ in together] == [3, 1, 3]
    assert [bool(why) for _, why in together] == [False, True, False]
    assert "no MAP" in together[1][1]


class Near(eqx.Module):
    """The mass has come close to where it should be."""

    def __call__(self, s: jax.Array) -> jax.Array:
        return s[0] > 0.75


def heavy(record: Any) -> Task:
    """A mass that only some motors move far enough, in time."""
    gain = jnp.where(record.pendulum_mass < 0.024, jnp.nan, 20.0 * record.arm_mass)
    task = mass_task(dynamics=Mass(gain.astype(jnp.float32)))
    return dataclasses.replace(task, goal=Near())


def test_truths_are_accepted_as_they_are_alone() -> None:
    """Those that their oracle fails on, and those that diverge, are drawn again."""
    keys = [jax.random.key(k) for k in range(6)]
    together = accept_together([heavy] * 6, Furuta(), SMALL, keys=keys)
    alone = [accept_truth(heavy, Furuta(), SMALL, key=key) for key in keys]
    redrawn = [found.redrawn for found in together]
    assert redrawn == [found.redrawn for found in alone]
    assert min(redrawn) == 0
    assert max(redrawn) > 1
    for one, other in zip(together, alone, strict=True):
        returns = one.oracle.returns
        np.testing.assert_allclose(returns, other.oracle.returns, rtol=1e-4)
    with pytest.raises(Sim2GPError, match=r"E204 .* got 1 draws"):
        accept_together([heavy] * 6, Furuta(), SMALL, keys=keys, attempts=1)
