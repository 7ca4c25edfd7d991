"""Held-out forecasts against the protocol's own oracle, and what their bands cover."""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from oracles import log_protocol as protocol
from oracles import plain_least_squares as plain
from sim2gp.data import grid as grid_module
from sim2gp.data.grid import CURVE, evaluation_windows, parabola_slopes, steps_of
from sim2gp.data.logs import Log
from sim2gp.identification.forecasts.forecast import (
    Band,
    _forecast_batch,
    compile_forecast,
    fit_band,
    forecast_windows,
)
from sim2gp.inference.gaussian import Gaussian
from sim2gp.systems import TwoLink
from sim2gp.types import in_float64
from tests.systems.test_black_box import EXACT, TABLE_OF, TRUTH, black_box, step

ROWS = np.asarray([steps_of(h) for h in CURVE])


def arm(numbers: list[float]) -> TwoLink:
    """The arm at the oracle's ten numbers; one constant stays free."""
    names = ("m1r1", "I1", "m2", "m2r2", "I2", "b1", "b2", "cf1", "cf2", "Ir")
    values = dict(zip(names, numbers, strict=True))
    for name in ("cf1", "cf2"):  # there the coefficient of atan(100 v)
        values[name] *= 0.5 * np.pi
    free = values.pop("b1")
    options = {"gravity": 9.81, "coulomb_shape": "arctangent", "coulomb_width": 0.01}
    table = TwoLink().parameters.replace(**values)
    assert free > 0.0
    return TwoLink(table, **options)


@in_float64
def certain(system: TwoLink, b1: float) -> Gaussian:
    """A posterior that knows the last constant exactly."""
    tt = system.parameters.unconstrain(jnp.asarray([b1]))
    return Gaussian(tt, jnp.zeros((1, 1)))


NUMBERS = [*plain.ARM_START, plain.ARM_ROTOR]


def moved(
    seed: int,
    *,
    disturbance: float = 0.0,
    noise: float = 0.0,
    seconds: float = 3.0,
    torque: float = 1.5,
) -> Log:
    """The oracle's arm under random torques on jittered stamps, seen by a sensor."""
    rng = np.random.default_rng(seed)
    count = int(seconds / protocol.PERIOD)
    time = protocol.PERIOD * np.arange(count)
    knots = np.arange(0, count + 50, 50)
    u = np.stack(
        [np.interp(np.arange(count), knots, torque * rng.standard_normal(len(knots)))
         for _ in range(2)], axis=1,
    )  # fmt: skip
    push = np.repeat(
        disturbance * rng.standard_normal((count // 250 + 1, 2)), 250, axis=0
    )[:count]
    q = protocol.rollout(
        plain.bound(plain.arm_acceleration, np.asarray(NUMBERS)),
        np.zeros((1, 2)),
        np.zeros((1, 2)),
        (u + push)[:-1, None],
    )[:, 0]
    q = q + noise * rng.standard_normal(q.shape)
    return Log(
        name=f"log{seed}",
        source=f"log{seed}.csv",
        time=time,
        channels={"q1": q[:, 0], "q2": q[:, 1]},
        inputs={"torque1": u[:, 0], "torque2": u[:, 1]},
        mask={n: np.ones(count, bool) for n in ("q1", "q2")},
    )


def recording(log: Log) -> protocol.Recording:
    return protocol.Recording(
        log.time,
        np.stack([log.channels["q1"], log.channels["q2"]], axis=1),
        np.stack([log.inputs["torque1"], log.inputs["torque2"]], axis=1),
    )


def test_errors_are_the_protocols() -> None:
    system = arm(NUMBERS)
    log = moved(0, noise=2e-4, disturbance=0.1)
    grid = evaluation_windows([log], system, longest=CURVE[-1])
    found = forecast_windows(system, certain(system, NUMBERS[5]), grid, ROWS)
    gridded = protocol.on_grid(recording(log))
    model = plain.bound(plain.arm_acceleration, np.asarray(NUMBERS))
    for i, horizon in enumerate(CURVE):
        expected = protocol.errors(model, gridded, horizon)
        ours = found.error[found.valid[:, i].all(axis=1), i]
        np.testing.assert_allclose(ours, expected, atol=1e-9)
    np.testing.assert_allclose(
        found.rmse(), protocol.error_curve(model, gridded), rtol=1e-7
    )


def test_slopes_know_the_past_alone() -> None:
    rng = np.random.default_rng(1)
    y = rng.standard_normal((80, 2))
    _, causal = parabola_slopes(y, causal=True)
    np.testing.assert_allclose(causal, protocol.causal_velocity(y), rtol=1e-9)
    changed = y.copy()
    changed[51:] += 1.0
    np.testing.assert_array_equal(
        parabola_slopes(changed, causal=True)[1][:51], causal[:51]
    )
    t = 0.002 * np.arange(80)[:, None]
    _, centred = parabola_slopes(1.0 + 3.0 * t - 4.0 * t**2, causal=False)
    np.testing.assert_allclose(centred[12:-12], 3.0 - 8.0 * t[12:-12], rtol=1e-9)


def test_a_forecast_compiled_in_advance_is_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    system = arm(NUMBERS)
    grid = evaluation_windows([moved(2)], system, longest=0.2)
    belief, rows = certain(system, NUMBERS[5]), np.asarray([50])
    plain = forecast_windows(system, belief, grid, rows)
    compile_forecast(system, grid)
    forecast_windows(system, belief, grid, rows)
    monkeypatch.setattr(
        _forecast_batch, "_jitted", None
    )  # nothing is left to compile with
    again = forecast_windows(system, belief, grid, rows)
    np.testing.assert_array_equal(again.mean, plain.mean)
    np.testing.assert_array_equal(again.by_constants, plain.by_constants)


def test_sensitivities_are_differences() -> None:
    system = arm(NUMBERS)
    grid = evaluation_windows([moved(2)], system, longest=0.3)
    rows = np.asarray([50, 150])
    belief = certain(system, NUMBERS[5])
    found = forecast_windows(system, belief, grid, rows)
    h = 1e-5

    def shifted(**changes: np.ndarray) -> np.ndarray:
        windows = grid.windows
        fields = {f: getattr(windows, f) for f in windows.__dataclass_fields__}
        other = replace(grid, windows=type(windows)(**fields | changes))
        return forecast_windows(system, belief, other, rows).mean

    for i in range(4):
        unit = h * np.eye(4)[i]
        slope = shifted(start=grid.windows.start + unit) - found.mean
        np.testing.assert_allclose(slope / h, found.by_start[..., i], atol=2e-3)
    for i in range(2):
        more = h * grid.windows.knots[..., None] * np.eye(2)[i]
        slope = shifted(area=grid.windows.area + more) - found.mean
        np.testing.assert_allclose(slope / h, found.by_input[..., i], atol=2e-2)


def swing(every: int) -> Log:
    """A pendulum under a held torque, every so many samples of 2 ms."""
    rng = np.random.default_rng(4)
    held = np.repeat(rng.uniform(-5.0, 5.0, 11), 50)
    s, q = np.zeros((1, 2)), []
    for u in held:
        q.append(s[0, 0])
        constants = {name: np.asarray([value]) for name, value in TRUTH.items()}
        s = step(constants, s, np.asarray([[u]]), np.asarray([2e-3]))
    time = 2e-3 * np.arange(len(held))[::every]
    good = {"q": np.ones(len(time), bool)}
    inputs = {"torque": held[::every]}
    return Log("swing", "swing.csv", time, {"q": np.asarray(q)[::every]}, inputs, good)


@in_float64
def test_a_simulator_is_stepped_as_in_a_fit() -> None:
    """As its own window asks and as often as was sampled, and its forecasts are right.

    Oracle: the same pendulum as an equation, in steps of 2 ms.
    """
    spans: set[float] = set()

    def recorded(params, s, a, h):
        spans.update(np.round(h, 9).tolist())
        return step(params, s, a, h)

    box, log, rows = black_box(recorded, batched=True), swing(5), np.arange(0, 251, 50)
    grid = evaluation_windows([log], box, longest=0.5)
    assert grid.every == 5
    assert evaluation_windows([swing(1)], box, longest=0.5).every == 1
    tt = TABLE_OF.unconstrain(jnp.asarray(list(TRUTH.values())))
    belief = Gaussian(tt, 0.1 * jnp.eye(2))
    found = forecast_windows(box, belief, grid, rows)
    assert spans == {2e-3, 8e-3, 1e-2}  # the first sample is one of all forecasts
    fine = evaluation_windows([log], EXACT, longest=0.5)
    assert fine.every == 1
    exact = forecast_windows(EXACT, belief, fine, rows)
    np.testing.assert_array_equal(found.valid, exact.valid)
    for mine, right in zip(jax.tree.leaves(found), jax.tree.leaves(exact), strict=True):
        np.testing.assert_allclose(mine, right, rtol=1e-5, atol=1e-6)
    assert np.abs(found.error[found.valid]).max() < 2e-2  # starts are differences
    one = forecast_windows(box, belief, grid, np.asarray([1])).mean
    np.testing.assert_allclose(
        one, forecast_windows(EXACT, belief, fine, np.asarray([1])).mean, atol=1e-9
    )


def test_a_masked_past_starts_no_window() -> None:
    system = arm(NUMBERS)
    log = moved(3, seconds=1.0)
    whole = evaluation_windows([log], system, longest=0.2)
    log.mask["q1"][140] = False  # 0.28 s: before the start at 0.3 s
    cut = evaluation_windows([log], system, longest=0.2)
    assert len(cut.windows) == len(whole.windows) - 1
    assert 0.3 not in np.round(cut.since, 9)
    at = int(np.flatnonzero(np.round(cut.since, 9) == 0.2)[0])
    assert not cut.windows.mask[at, 40, 0]
    assert cut.windows.mask[at, 40, 1]


def test_of_long_logs_windows_start_further_apart(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One in three of those that start 0.1 s apart, from the first on."""
    logs, system = [moved(3, seconds=1.0), moved(4, seconds=2.0)], arm(NUMBERS)
    whole = evaluation_windows(logs, system, longest=0.2)
    monkeypatch.setattr(grid_module, "MOST", 10)  # of 30: they start 0.3 s apart
    some = evaluation_windows(logs, system, longest=0.2)
    for log in (0, 1):
        mine, all_of = some.since[some.log == log], whole.since[whole.log == log]
        np.testing.assert_allclose(mine, all_of[::3])
    kept = np.isin(whole.log + 1j * whole.since, some.log + 1j * some.since)
    np.testing.assert_array_equal(some.windows.y, whole.windows.y[kept])


@pytest.fixture(scope="module")
def disturbed():
    """Forecasts of logs whose torques are off by a constant, new every half second."""
    system = arm(NUMBERS)
    # Gentle: a band is a linearisation, and an arm that turns over is not.
    logs = [moved(s, torque=0.4, disturbance=0.05, noise=2e-4) for s in range(10, 40)]
    grid = evaluation_windows(logs, system, longest=CURVE[-1])
    return grid, forecast_windows(system, certain(system, NUMBERS[5]), grid, ROWS)


def some_logs(grid, which):
    return type(grid)(grid.windows, grid.log[which], grid.since[which], grid.lag[which])


def test_band_covers_what_it_says(disturbed) -> None:
    """Learned from 15 logs, on 15 others; their disturbances are what it assumes."""
    grid, found = disturbed
    train = grid.log < 15
    band = fit_band(found.of(train), some_logs(grid, train), 15)
    # One joint's disturbance may explain both joints' errors: the sum is what counts.
    assert 0.02 < np.linalg.norm(band.input_sd) < 0.15
    test = found.of(~train)
    inside = np.abs(test.error) <= band.half_width(0.9) * band.scale(test)
    share = np.sum(inside & test.valid, axis=0) / test.valid.sum(axis=0)
    # 15 logs hold 90 disturbances: a share of .9 has a standard error of .032.
    assert share.min() > 0.85
    assert np.mean(share) < 0.975
    z = np.where(test.valid, test.error / band.scale(test), np.nan)
    spread = np.sqrt(np.nanmean(z**2, axis=0))
    print("coverage", share.min(), share.mean(), "spread", spread.min(), spread.max())
    assert spread.min() > 0.75
    assert spread.max() < 1.1


def test_band_has_the_errors_own_shape(disturbed) -> None:
    """Scaled to mean squares: at each row the training errors' rms, before raising."""
    grid, found = disturbed
    band = fit_band(found, grid, 5)
    assert band.inflation == 1.5
    z = np.where(found.valid, found.error / band.scale(found), np.nan)
    np.testing.assert_allclose(np.nanmean(z**2, axis=0), 1.0 / 1.5, rtol=1e-9)
    fewer = found.at(ROWS[::2])
    assert fewer.rows == tuple(ROWS[::2].tolist())
    scale = band.scale(fewer)
    # A running maximum knows the rows before it, so the shape alone is compared.
    assert np.all(scale <= band.scale(found)[:, ::2] * (1 + 1e-12))
    assert fit_band(found, grid, 1).inflation == 4.0


def test_band_is_normal() -> None:
    band = Band(np.ones(1), np.ones(1), np.ones(1), np.zeros(1), np.ones((1, 1)), 1.2)
    assert band.half_width(0.9) == pytest.approx(1.644854, abs=1e-6)
    assert band.half_width(0.95) == pytest.approx(1.959964, abs=1e-6)


@pytest.mark.parametrize(
    ("model", "pooled"),
    [
        ("2.0", (0.0302, 0.0528)),
        pytest.param("1.0", (0.0330, 0.0622), marks=pytest.mark.nightly),
    ],
)
def test_published_models_score_as_known(
    shared_data: Path, model: str, pooled: tuple[float, float]
) -> None:
    """The figures that the recordings come with, through the package's own path."""
    from sim2gp.data.logs import Column, read_log

    arm_folder = shared_data / "double_pendulum"
    text = (arm_folder / "published_parameters" / f"c1_model_{model}.yml").read_text()
    v = {
        k: float(x) for k, x in (line.split(":") for line in text.splitlines() if line)
    }
    first, second = v["m1"] * v["r1"], v["m2"] * v["r2"]
    rest = [v[k] for k in ("b1", "b2", "cf1", "cf2", "Ir")]
    numbers = [first, v["I1"], v["m2"], second, v["I2"], *rest]
    system = arm(numbers)
    columns = {"q1": Column("pos_meas1"), "q2": Column("pos_meas2")}
    columns |= {"torque1": Column("tau_con1"), "torque2": Column("tau_con2")}
    logs = [
        log
        for file in sorted((arm_folder / "excitation").glob("*.csv"))
        for log in read_log(
            file, columns, states=system.physical_states, actions=system.actions
        )
    ]
    grid = evaluation_windows(logs, system, longest=0.2)
    rows = np.asarray([100])
    found = forecast_windows(system, certain(system, numbers[5]), grid, rows)
    np.testing.assert_allclose(found.rmse()[0], pooled, rtol=0.01)
    assert not jax.config.jax_enable_x64
