"""Loops: one trace, one draw per episode, keys by purpose, faults that speak."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import pytest
from jaxtyping import Array

from mass_task import (
    DT,
    KEY,
    SMALL,
    GainBelief,
    GainModel,
    draws,
    fits,
    fly_mass,
    fresh_counters,  # noqa: F401  (a fixture for every test here)
    mass_task,
    same,
    single,
    traces,
)
from sim2gp.belief import AbstractBelief
from sim2gp.data.transitions import Transitions
from sim2gp.errors import NotFinite, Sim2GPError
from sim2gp.planning import MPC, AbstractPlanner, MarkovObjective, World, tasks
from sim2gp.planning import loop as loops
from sim2gp.planning import oracle as references
from sim2gp.planning.episode import Purpose, Trajectory, key_for, world_of
from sim2gp.planning.tasks import Task
from sim2gp.systems import Furuta
from sim2gp.types import Key, State


# ------------------------------------------------------------------- the loop
def run(episodes: int = 3, key: Key = KEY, **more: Any) -> loops.History:
    return loops.psrl(
        mass_task(), GainModel(), SMALL, episodes=episodes, key=key, **more
    )


def test_posterior_sampling_learns_the_gain_and_reaches_the_oracle() -> None:
    history = run()
    assert draws == ["draw"] * 3  # one draw holds for a whole episode
    assert fits == [(20, 60), (40, 60), (60, 60)]  # all of the data, one capacity
    assert history.state.shape == (3, 21, 2)
    assert history.returns.shape == (3,)
    np.testing.assert_array_equal(history.parameter_mean[0], [1.0])
    assert np.all(np.diff(history.parameter_sd[:, 0]) < 0.0)
    z = (history.parameter_mean[-1] - 2.0) / history.parameter_sd[-1]
    assert np.abs(z).max() < 4.0
    oracle = float(fly_mass().total)
    assert history.returns[-1] > oracle - 0.5
    assert history.data.count == 60


class Doubtful(GainBelief):
    """Doubts its simulator: what it believes is wider than what it acts on."""

    def untempered(self) -> GainBelief:
        return GainBelief(self.mean, self.sd)

    def sample(self, key: Key) -> Any:
        raise AssertionError("drawn from what no data settle")


def test_it_acts_on_what_data_can_settle(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = run()
    monkeypatch.setattr(
        GainModel, "init", lambda self, key: Doubtful(single(1.0)[0], single(1.0)[0])
    )
    np.testing.assert_array_equal(run().returns, plain.returns)


def test_the_last_episode_need_not_be_learned_from() -> None:
    learned, rollout = run(), run(final_fit=False)
    assert fits[3:] == [(20, 60), (40, 60)]
    np.testing.assert_array_equal(rollout.returns, learned.returns)
    np.testing.assert_array_equal(rollout.parameter_mean[3], rollout.parameter_mean[2])
    assert rollout.data.count == 60


def test_the_closed_form_posterior_is_what_the_loop_reports() -> None:
    history = run()
    x = DT * history.action[..., 0].ravel().astype(float)
    y = np.diff(history.state[..., 1], axis=1).ravel().astype(float)
    precision = 1.0 + x @ x / 1e-4
    mean = (1.0 + x @ y / 1e-4) / precision
    assert history.parameter_mean[-1, 0] == pytest.approx(mean, rel=1e-5)
    assert history.parameter_sd[-1, 0] == pytest.approx(precision**-0.5, rel=1e-5)


def test_what_is_added_to_a_run_changes_nothing() -> None:
    plain = run()
    assert same(plain, run())
    seen: list[int] = []

    def evaluate(report: loops.Episode) -> None:
        seen.append(report.index)
        task = mass_task()
        references.run_oracle(task, SMALL, key=KEY, episodes=1)
        assert report.belief.parameters()[0].shape == (1,)

    assert same(plain, run(on_episode=evaluate))
    assert seen == [1, 2, 3]
    longer = run(episodes=4)
    np.testing.assert_array_equal(longer.state[:3], plain.state)
    assert not same(plain, run(key=jax.random.key(1)))


class NeverUpdated(GainModel):
    """Learns between episodes alone."""

    def fit(
        self, belief: AbstractBelief, data: Transitions, *, key: Key
    ) -> AbstractBelief:
        return belief if data.count < 20 else super().fit(belief, data, key=key)

    def update(
        self, belief: AbstractBelief, s: State, a: Array, s2: State
    ) -> AbstractBelief:
        return belief


@pytest.mark.parametrize("part", [1, 7, 20, 50])
def test_parts_of_an_unchanged_belief_are_the_episode_itself(part: int) -> None:
    whole, parts = (
        loops.psrl(
            mass_task(), NeverUpdated(), SMALL, episodes=2, key=KEY, update_every=every
        )
        for every in (None, part)
    )
    assert same(whole, parts)


def test_within_an_episode_the_belief_is_the_posterior_of_its_rows_so_far() -> None:
    """By the closed form, at every part; the first episode is fitted, not updated."""
    seen: list[tuple[int, GainBelief]] = []
    task, model = mass_task(), GainModel()
    empty = Transitions.empty(40, 2, 1)
    rollout = fly_mass()
    rows = jax.tree.map(np.asarray, rollout)
    one = empty.extend(*rows.transitions())
    for data, before in ((empty, model.init(KEY)), (one, None)):
        start_of = (
            model.fit(model.init(KEY), one, key=KEY) if before is None else before
        )

        def note(belief: AbstractBelief) -> World:
            assert isinstance(belief, GainBelief)
            seen.append((0, belief))
            return world_of(task, belief.point(), MarkovObjective(task.reward))

        world_at = loops.within(model, start_of, data, 0, note, key=KEY)
        for upto in (5, 12, 20):
            part = Trajectory(
                rows.state[: upto + 1],
                rows.action[:upto],
                rows.reward[:upto],
                rows.failed[:upto],
            )
            world_at(part)
            all_rows = data.extend(*part.transitions())
            expected = model.fit(model.init(KEY), all_rows, key=KEY)
            found = seen[-1][1]
            assert float(found.mean) == pytest.approx(float(expected.mean), rel=1e-4)
            assert float(found.sd) == pytest.approx(float(expected.sd), rel=1e-4)


def test_updates_within_an_episode_change_the_draw_and_nothing_at_its_end() -> None:
    plain, updated = run(episodes=1), run(episodes=1, update_every=5)
    np.testing.assert_array_equal(plain.state[0, :6], updated.state[0, :6])
    assert not np.array_equal(plain.state[0, 6:], updated.state[0, 6:])
    assert updated.data.count == 20
    x = DT * updated.action[..., 0].ravel().astype(float)
    assert updated.parameter_sd[-1, 0] == pytest.approx(
        (1 + x @ x / 1e-4) ** -0.5, rel=1e-5
    )


def test_the_whole_run_is_one_trace() -> None:
    run(episodes=2)
    count = len(traces)
    run(episodes=5, key=jax.random.key(7))
    assert len(traces) == count


def test_keys_differ_by_episode_and_purpose() -> None:
    keys = {
        tuple(jax.random.key_data(key_for(KEY, e, purpose)).tolist())
        for e in range(20)
        for purpose in Purpose
    }
    assert len(keys) == 20 * len(Purpose)


# ------------------------------------------------------------------- oracles
@pytest.mark.parametrize(
    ("preset", "least"),
    [
        pytest.param(tasks.cartpole_swingup, 190.0 / 250.0, marks=pytest.mark.nightly),
        pytest.param(tasks.furuta_swingup, 140.0 / 200.0, marks=pytest.mark.nightly),
    ],
)
def test_the_oracle_swings_up_the_published_machine(
    preset: Callable[[], Task], least: float
) -> None:
    oracle = references.run_oracle(preset(), MPC(), key=KEY)
    assert len(oracle.returns) == 5
    assert oracle.reached
    assert oracle.oracle_return == np.median(oracle.returns)
    assert oracle.oracle_return >= least * 250


def test_truths_are_redrawn_until_the_oracle_swings_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[Task] = []

    def judge(
        task: Task, planner: AbstractPlanner, *, key: Key
    ) -> references.OracleRun:
        asked.append(task)
        if len(asked) == 1:
            raise NotFinite("E203", "state 72")
        return references.OracleRun(np.asarray([1.0, 3.0, 2.0]), len(asked) == 3)

    monkeypatch.setattr(references, "run_oracle", judge)
    arguments = (tasks.furuta_swingup, Furuta(), MPC())
    accepted = references.accept_truth(*arguments, key=KEY)
    assert accepted.redrawn == 2
    assert accepted.oracle.oracle_return == 2.0
    assert accepted.task is asked[2]
    masses = {float(task.truth["arm_mass"]) for task in asked}
    assert len(masses) == 3
    asked.clear()
    answer = "E204 no truth that MPC can swing up: got 2 draws .* 1 of them not finite"
    with pytest.raises(Sim2GPError, match=answer):
        references.accept_truth(*arguments, key=KEY, attempts=2)
