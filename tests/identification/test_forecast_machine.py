"""Forecasts with missing forces: on simulated arms, and read back from a run."""

import json
from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import interval_arms
from descents import estimate_of
from interval_arms import CONDITIONS
from sim2gp.data.grid import Grid, evaluation_windows, steps_of
from sim2gp.data.split_log import cut
from sim2gp.data.windows_likelihood import WindowsLikelihood
from sim2gp.errors import NotConverged
from sim2gp.identification.fit import fit_windows
from sim2gp.identification.forecasts import forecast_machine
from sim2gp.identification.forecasts.forecast_machine import (
    ForecastMachine,
    fit_forecast_machine,
    stored_forecast_machine,
)
from sim2gp.identification.forecasts.prediction import forecast_grid, subset
from sim2gp.identification.missing_physics.at_zero import at_zero
from sim2gp.inference.arrowhead import Noise
from sim2gp.systems import UniformRodArm
from sim2gp.types import in_float64

UNTIL = 7.0  # s of ten that are fitted


class Arm(NamedTuple):
    """A hidden arm's fit of the first seconds, and windows of the last, without noise.

    From measured starts the noise of their rates is most of an error.
    """

    plain: ForecastMachine
    machine: ForecastMachine
    tested: Grid


@pytest.fixture(scope="module", autouse=True)
def coarse_simulation() -> Iterator[None]:
    """Friction here is not sharp: a third of the benchmark's steps will do."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(interval_arms, "SUBSTEPS", 3)
        yield


@in_float64
def arm(condition: str) -> Arm:
    system = UniformRodArm()
    log = interval_arms.recordings(CONDITIONS[condition], 2, 0).log(0)
    windows, places = cut([log], system, window=0.2)
    train = np.asarray([log.time[row] for _, row in places]) < UNTIL - 0.2
    mask = np.asarray(windows.mask) & train[:, None, None]
    windows = eqx.tree_at(lambda w: w.mask, windows, mask)
    fitted = fit_windows(system, windows, key=jax.random.key(0), starts=1)
    recording = np.zeros(len(windows), int)
    fit = at_zero(WindowsLikelihood(system, windows), fitted, recording)
    machine = fit_forecast_machine(fit, recording)
    exact = CONDITIONS[condition]._replace(noise=1e-5)
    clean = interval_arms.recordings(exact, 2, 0).log(0)
    grid = evaluation_windows([clean], system, longest=1.0)
    plain = ForecastMachine(system, fitted.posterior)
    return Arm(plain, machine, subset(grid, grid.since > UNTIL))


def errors(machine: ForecastMachine, grid: Grid) -> np.ndarray:
    """Root mean square errors of both joints half a second ahead."""
    return (
        forecast_grid(machine.system, machine.posterior, grid, 0.5)
        .at(np.asarray([steps_of(0.5)]))
        .rmse()[0]
    )


@pytest.fixture(scope="module")
def with_friction() -> Arm:
    return arm("friction20")


def test_missing_friction_is_part_of_forecasts(with_friction: Arm) -> None:
    plain, machine, tested = with_friction
    assert "dry_friction" in machine.scales
    assert np.all(errors(machine, tested) < 0.6 * errors(plain, tested))
    names = machine.system.parameters.names
    mean = dict(zip(names, np.asarray(machine.posterior.mean), strict=True))
    # Of 20 mN m, drawn towards zero by its prior, of all widths together.
    for q in ("q1", "q2"):
        level = sum(x for name, x in mean.items() if f"{q}.dry_friction[" in name)
        assert 0.008 < level < 0.03


@in_float64
def test_scales_stay_as_chosen_and_a_fit_that_fails_is_not_used(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each kind's prior sd has its scale, no group is left whose scale a fit learns."""
    given = {}

    def failed(system, windows, *, prior, warm_start, **how):
        given.update(system=system, prior=prior, warm_start=warm_start)
        raise NotConverged("E201", "no MAP")

    scales = {"dry_friction": 0.1, "dead_zone": 0.3}
    monkeypatch.setattr(forecast_machine, "_helpful", lambda *_: scales)
    monkeypatch.setattr(forecast_machine, "fit_windows", failed)
    system = UniformRodArm()
    log = interval_arms.recordings(CONDITIONS["white"], 2, 0).log(0)
    windows, _ = cut([log], system, window=0.2)
    known, none = system.parameters.prior(), jnp.zeros(1)
    fitted = estimate_of(known, known, Noise(none, none), none[None])
    recording = np.zeros(len(windows), int)
    fit = at_zero(WindowsLikelihood(system, windows), fitted, recording)
    found = fit_forecast_machine(fit, recording)
    assert found.system is system
    assert found.scales == {}
    table = given["system"].parameters
    assert table.groups == {}
    first = dict(zip(table.names, np.asarray(table.prior().sd()), strict=True))
    sd = dict(zip(table.names, np.asarray(given["prior"].sd()), strict=True))
    for name in table.names:
        scale = scales.get(name.split(".")[-1].split("[")[0], 1.0)
        assert sd[name] == pytest.approx(scale * first[name])
    widths = [len(f.basis.sds) for f in fit.forces if f.what == "dry_friction"]
    assert sum("dry_friction" in name for name in table.names) == sum(widths) > 2
    assert sum("dead_zone" in name for name in table.names) == 6  # and two shapes each
    own = [table.names.index(name) for name in system.parameters.names]
    np.testing.assert_array_equal(
        np.asarray(given["warm_start"].posterior.mean)[own], known.mean
    )


@pytest.mark.nightly  # 24 s
def test_nothing_is_added_where_nothing_is_missing() -> None:
    plain, machine, _ = arm("ar80")
    assert machine.system is plain.system
    assert machine.scales == {}
    np.testing.assert_array_equal(machine.posterior.mean, plain.posterior.mean)


def test_a_run_forecasts_with_the_same_machine(with_friction: Arm) -> None:
    """Its summary is JSON, its arrays are by name."""
    plain, machine, tested = with_friction
    summary = json.loads(json.dumps(machine.entries()))
    again = stored_forecast_machine(plain.system, summary, machine.arrays())
    assert again.scales == machine.scales
    assert again.system.parameters == machine.system.parameters
    np.testing.assert_array_equal(errors(again, tested), errors(machine, tested))


def test_what_no_run_can_say_is_refused(with_friction: Arm) -> None:
    plain, machine, _ = with_friction
    entry, arrays = machine.entries(), machine.arrays()
    scales, box = entry["forecast_forces"], entry["forecast_box"]
    p = len(machine.system.parameters)
    wrong = [
        (entry | {"forecast_forces": {}}, arrays),
        (entry | {"forecast_forces": ["dry_friction"]}, arrays),
        (entry | {"forecast_forces": {"dry_friction": "1"}}, arrays),
        (entry | {"forecast_forces": {"dry_friction": -1.0}}, arrays),
        (entry | {"forecast_forces": {"dry_friction": float("nan")}}, arrays),
        (entry | {"forecast_forces": {"no_such_kind": 1.0}}, arrays),
        (
            entry | {"forecast_forces": scales | {"ripple": 1.0}},
            arrays,
        ),  # of other arrays
        (entry | {"forecast_box": {}}, arrays),
        (entry | {"forecast_box": box | {"q1": [1.0, -1.0]}}, arrays),
        (entry | {"forecast_box": box | {"q1": [1.0]}}, arrays),
        (entry | {"forecast_box": box | {"q1": [0.0, float("inf")]}}, arrays),
        (entry, {}),
        (entry, arrays | {"forecast/mean": np.zeros(p + 1)}),
        (entry, arrays | {"forecast/scale": np.full((p, p), np.nan)}),
        (entry, arrays | {"forecast/mean": np.full(p, "1")}),
    ]
    for about, stored in wrong:
        with pytest.raises(ValueError, match="forces"):
            stored_forecast_machine(plain.system, about, stored)
