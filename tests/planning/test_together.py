"""Runs of one program are the runs that they are alone."""

import jax
import numpy as np

from mass_task import SMALL, GainModel, mass_task
from sim2gp.errors import NotConverged
from sim2gp.planning import MarkovObjective
from sim2gp.planning import loop as loops
from sim2gp.planning.loop import SamplingRun
from sim2gp.planning.together import learn_together

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
