"""`bench` times calls in turns and judges their ratio, with known times."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
import pytest

from sim2gp.cli import main
from sim2gp.commands import bench, bench_jobs
from sim2gp.commands.bench import JOBS, Job
from sim2gp.commands.bench_jobs import Pair
from sim2gp.planning.episode import oracle_world
from sim2gp.planning.tasks import cartpole_swingup
from sim2gp.runs import Progress


class Clock:
    """Seconds that pass where a call says so."""

    now = 0.0

    def perf_counter(self) -> float:
        return self.now

    def takes(self, *seconds: float) -> Callable[[], object]:
        """A call of so long: the first time, the second, and from then on."""
        left = list(seconds)

        def work() -> None:
            self.now += left.pop(0) if len(left) > 1 else left[0]

        return work


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(bench, "time", clock)
    return clock


def absent() -> Pair:
    raise ModuleNotFoundError("No module named 'peer'", name="peer")


def test_ratios_are_judged(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first turn compiles, and does not count."""
    once, twice = clock.takes(9.0, 1.0), clock.takes(9.0, 2.0)
    jobs = (
        Job("twice", "once", 1.5, lambda: Pair(twice, once)),
        Job("once", "twice", 1.5, lambda: Pair(once, twice)),
        Job("a call", "3 s", 1.0, lambda: Pair(twice, 3.0)),
        Job("ours", "a peer", 1.0, absent),
    )
    monkeypatch.setattr(bench, "JOBS", jobs)
    monkeypatch.setattr(bench, "provenance", lambda started: {})
    summary = bench.bench(progress=Progress(quiet=True)).summary
    slow, fast, against_seconds, missing = summary["rows"]
    assert (slow["ours"], slow["theirs"], slow["ratio"]) == (2.0, 1.0, 2.0)
    assert fast["ratio"] == 0.5
    assert against_seconds["ratio"] == pytest.approx(2.0 / 3.0)
    assert [row["meets_target"] for row in summary["rows"]] == [False, True, True, None]
    assert (missing["missing"], missing["ratio"]) == ("peer", None)
    assert summary["headline"] == "2 of 4 targets met"


def test_a_ratio_is_that_of_each_turn(clock: Clock) -> None:
    """On a machine that becomes slower both calls do."""
    ours = clock.takes(0.0, 2.0, 2.0, 20.0, 20.0, 20.0, 20.0)
    theirs = clock.takes(0.0, 1.0, 1.0, 10.0, 10.0, 10.0, 10.0)
    assert bench.timed(Pair(ours, theirs))[2] == 2.0


def test_a_bare_rollout_is_the_task_s_own() -> None:
    """What plans are compared with makes as many steps as they do."""
    task = cartpole_swingup()
    (states,) = bench_jobs.bare_rollout(task)()
    assert states.shape == (bench_jobs.SAMPLES, bench_jobs.HORIZON, task.size)
    assert np.isfinite(states).all()
    world = oracle_world(task)
    rows = bench_jobs.random_rows(task)
    s2 = world.dynamics(
        jnp.asarray(rows.state[3], "f"), jnp.asarray(rows.action[3], "f")
    )
    np.testing.assert_allclose(s2, rows.next_state[3], atol=8 * np.max(task.noise))


@pytest.mark.parametrize("job", JOBS, ids=lambda job: job.what)
@pytest.mark.nightly  # compiles a plan, fits and SAC
def test_every_job_runs(job: Job, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "SECONDS", 0.0)
    row = bench.timed_row(job)
    assert 0.0 < row["ratio"] < 100.0


def test_the_command_prints_a_table(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    job = Job("nothing", "1 s", 1.0, lambda: Pair(lambda: None, 1.0))
    monkeypatch.setattr(bench, "JOBS", (job,))
    assert main(["bench", "--quiet"]) == 0
    said = capsys.readouterr().out
    assert "1 of 1 targets met" in said
    assert "nothing" in said
