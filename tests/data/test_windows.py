"""The likelihood over windows: dense algebra, one-step fits, simulated logs."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2gp.data import split_log
from sim2gp.data.grid import evaluation_windows
from sim2gp.data.logs import Log
from sim2gp.data.split_log import cut
from sim2gp.data.transitions import Transitions
from sim2gp.data.windows import Windows
from sim2gp.data.windows_likelihood import WindowsLikelihood, start_states
from sim2gp.identification.fit import fit_windows
from sim2gp.inference import arrowhead
from sim2gp.inference.gaussian import Gaussian
from sim2gp.models import Sim2GP
from sim2gp.systems import Delay, Furuta, free_parts
from sim2gp.systems import simulate as stretch
from sim2gp.types import in_float64
from simulated_logs import FREE, NAMES, pendulum, simulated


def dropped(log: Log, rows: np.ndarray) -> Log:
    """The log without some rows."""
    keep = np.setdiff1d(np.arange(len(log)), rows)
    parts = {
        field: {n: x[keep] for n, x in getattr(log, field).items()}
        for field in ("channels", "inputs", "mask")
    }
    return dataclasses.replace(log, time=log.time[keep], **parts)


@in_float64
def factor_at(system: Furuta, windows: Windows, z: np.ndarray, noise: np.ndarray):
    """What remains after the elimination."""
    return factor_of(WindowsLikelihood(system, windows), z, noise)


def factor_of(likelihood: WindowsLikelihood, z: np.ndarray, noise: np.ndarray):
    prior = likelihood.system.parameters.prior()
    W, n = likelihood.windows.start.shape
    e = jnp.zeros((W, n))
    blocks = likelihood.blocks(prior.at(jnp.asarray(z)), e, prior.scale)
    return arrowhead.eliminate(
        blocks, e, arrowhead.Noise(jnp.asarray(noise), jnp.ones(W))
    )


@pytest.fixture(scope="module")
def short() -> Log:
    return simulated(seconds=0.6, seed=1, noise=1e-3)


def test_elimination_is_one_dense_system(short: Log) -> None:
    system = pendulum()
    windows, _ = cut([short], system, window=0.2)
    z, noise = np.array([0.3, -0.2, 0.1]), np.array([1e-3, 2e-3])
    arrow = factor_at(system, windows, z, noise)
    W, n, p = len(windows), 4, 3
    with jax.enable_x64(True):
        prior = system.parameters.prior()
        likelihood = WindowsLikelihood(system, windows)

        def residuals(x: jax.Array) -> jax.Array:
            e = x[p:].reshape(W, n)
            tt = prior.at(x[:p])
            r = likelihood.windows.each(
                lambda w, e: likelihood.simulated(w, tt, e)[0], e
            )
            return (r / noise[None, None]).reshape(-1)

        x = jnp.concatenate([jnp.asarray(z), jnp.zeros(W * n)])
        J = np.asarray(jax.jit(jax.jacfwd(residuals))(x))
        r = np.asarray(jax.jit(residuals)(x))
    # Posterior: one dense least-squares system in z and all start states at once.
    whole = np.block([[J], [np.eye(p + W * n)[p:]]])
    rhs = np.concatenate([r, np.zeros(W * n)])
    hessian = whole.T @ whole + np.diag([1.0] * p + [0.0] * (W * n))
    covariance = np.linalg.inv(hessian)[:p, :p]
    R = np.asarray(arrow.data)
    ours = np.linalg.inv(R[:-1, :-1].T @ R[:-1, :-1] + np.eye(p))
    np.testing.assert_allclose(ours, covariance, rtol=1e-7)
    # The gradient and the least cost over the start states.
    best = np.linalg.lstsq(whole[:, p:], rhs, rcond=None)[0]
    rest = rhs - whole[:, p:] @ best
    np.testing.assert_allclose(R[:, -1] @ R[:, -1], rest @ rest, rtol=1e-9)
    np.testing.assert_allclose(
        R[:-1, :-1].T @ R[:-1, -1], whole[:, :p].T @ rest, rtol=1e-6, atol=1e-6
    )
    # Evidence: the determinant of the start states' own block.
    _, log_det = np.linalg.slogdet(hessian[p:, p:])
    pivots = np.diagonal(np.asarray(arrow.R11), axis1=1, axis2=2)
    np.testing.assert_allclose(2 * np.sum(np.log(pivots)), log_det, rtol=1e-10)


@pytest.mark.nightly
def test_window_zero_is_the_one_step_fit() -> None:
    log = simulated(seconds=0.4, seed=2, noise=1e-3, velocities=True)
    system = pendulum()
    windows, places = cut([log], system, window=0.0)
    assert len(places) == len(log) - 1
    s = np.stack([log.channels[n] for n in NAMES], axis=1)
    a = log.inputs["voltage"][:, None]
    with jax.enable_x64(True):
        data = Transitions(
            jnp.asarray(s[:-1]),
            jnp.asarray(a[:-1]),
            jnp.asarray(s[1:]),
            jnp.ones(len(s) - 1, bool),
        )
        model = Sim2GP(system, dt=0.002)
        key = jax.random.key(0)
        one = model.fit(model.init(key), data, key=key)
    ours = fit_windows(system, windows, key=key)
    noise = np.asarray(ours.noise.sd)
    np.testing.assert_allclose(noise, np.asarray(one.noise), rtol=1e-3)
    # At one noise and one z, the two factors are the same.
    arrow = factor_at(system, windows, np.array([0.2, 0.1, -0.3]), noise)
    factor = np.asarray(arrow.data)
    with jax.enable_x64(True):
        prior = system.parameters.prior()

        def rows(z: jax.Array) -> jax.Array:
            tt = prior.mean + prior.scale @ z
            f = jax.vmap(lambda s, a: system.transition(tt, s, a, 0.002))
            r = f(data.state, data.action) - data.next_state
            return (r / noise[None]).reshape(-1)

        z = jnp.array([0.2, 0.1, -0.3])
        J = np.column_stack([np.asarray(jax.jacfwd(rows)(z)), np.asarray(rows(z))])
    np.testing.assert_allclose(
        factor.T @ factor, J.T @ J, rtol=1e-8, atol=1e-8 * np.abs(J).max()
    )
    with jax.enable_x64(True):
        sd = np.asarray(one.posterior.sd())
    np.testing.assert_allclose(
        np.asarray(ours.posterior.mean),
        np.asarray(one.posterior.mean),
        atol=0.02 * sd.min(),
    )
    # Begun at the MAP, a descent ends there.
    again = fit_windows(system, windows, key=key, warm_start=ours)
    moved = np.asarray(again.posterior.mean) - np.asarray(ours.posterior.mean)
    assert np.all(np.abs(moved) < 1e-4 * sd)


def test_masked_rows_count_as_removed_ones() -> None:
    system = pendulum()
    log = simulated(seconds=0.6, seed=3, noise=1e-3)
    log = dataclasses.replace(log, inputs={"voltage": np.full(len(log), 2.0)})
    rows = np.array([31, 47, 150, 201])  # apart: a gap of 4 ms is two steps
    mask = {n: m.copy() for n, m in log.mask.items()}
    for m in mask.values():
        m[rows] = False
    masked, _ = cut([dataclasses.replace(log, mask=mask)], system, window=0.2)
    removed, _ = cut([dropped(log, rows)], system, window=0.2)
    z, noise = np.array([0.3, -0.2, 0.1]), np.array([1e-3, 1e-3])
    same = {"start": masked.start, "start_sd": masked.start_sd}
    R1 = factor_at(system, masked, z, noise).data
    R2 = factor_at(system, dataclasses.replace(removed, **same), z, noise).data
    np.testing.assert_allclose(*map(_sizes, (R1, R2)), rtol=1e-9, atol=1e-9)


@pytest.mark.nightly
def test_order_of_windows_and_masked_windows_do_not_matter(short: Log) -> None:
    system = pendulum()
    windows, _ = cut([short], system, window=0.1)
    z, noise = np.zeros(3), np.array([1e-3, 1e-3])
    order = np.random.default_rng(0).permutation(len(windows))
    bare = eqx.tree_at(lambda w: w.floor, windows, None)
    moved = eqx.tree_at(
        lambda w: w.floor,
        jax.tree.map(lambda x: x[order], bare),
        windows.floor,
        is_leaf=lambda x: x is None,
    )
    R1 = factor_at(system, windows, z, noise).data
    R2 = factor_at(system, moved, z, noise).data
    np.testing.assert_allclose(*map(_sizes, (R1, R2)), rtol=1e-10, atol=1e-10)
    # A fold of a leave-one-out masks windows: the same as leaving them out.
    mask = windows.mask.copy()
    mask[2:] = False
    part = jax.tree.map(lambda x: x[:2], bare)
    part = eqx.tree_at(
        lambda w: w.floor, part, windows.floor, is_leaf=lambda x: x is None
    )
    R1 = factor_at(system, dataclasses.replace(windows, mask=mask), z, noise).data
    R2 = factor_at(system, part, z, noise).data
    np.testing.assert_allclose(*map(_sizes, (R1, R2)), rtol=1e-10, atol=1e-10)


@pytest.mark.nightly
def test_memory_is_linear_in_the_data() -> None:
    system = pendulum()
    log = simulated(seconds=0.6, seed=4, noise=1e-3)
    windows, _ = cut([log], system, window=0.02)

    def bytes_of(copies: int) -> int:
        bare = eqx.tree_at(lambda w: w.floor, windows, None)
        many = jax.tree.map(lambda x: np.concatenate([np.asarray(x)] * copies), bare)
        with jax.enable_x64(True):
            many = eqx.tree_at(
                lambda w: w.floor, many, np.asarray(windows.floor), is_leaf=_none
            )
            many = jax.tree.map(jnp.asarray, many)
            likelihood = WindowsLikelihood(system, many)
            f = eqx.filter_jit(lambda x: factor_of(x, np.zeros(3), np.ones(2)))
            analysis = f.lower(likelihood).compile().compiled.memory_analysis()
        return int(analysis.temp_size_in_bytes)

    assert bytes_of(8) <= 2.1 * bytes_of(4)


def _sizes(factor: jax.Array) -> np.ndarray:
    """A factor up to the signs of its rows."""
    return np.abs(np.asarray(factor))


def _none(x: object) -> bool:
    return x is None


@pytest.mark.parametrize("jitter", [0.0, 0.4])
@pytest.mark.nightly  # one delay is recovered by day in test_project_model
def test_delay_is_recovered_without_velocities(jitter: float) -> None:
    truth = 0.0063
    system = free_parts(pendulum(), [Delay("voltage")])
    logs = [
        simulated(seconds=1.0, seed=s, delay=truth, jitter=jitter, noise=5e-4)
        for s in (5, 6)
    ]
    windows, _ = cut(logs, system, window=0.2)
    belief = fit_windows(system, windows, key=jax.random.key(0))
    table = system.parameters
    with jax.enable_x64(True):
        theta = np.asarray(table.constrain(belief.posterior.mean))
        slope = jax.jvp(
            table.constrain, (belief.posterior.mean,), (jnp.ones(len(table)),)
        )[1]
        sd = np.asarray(slope * belief.posterior.sd())
    found = dict(zip(table.names, theta, strict=True))
    spread = dict(zip(table.names, sd, strict=True))
    assert abs(found["voltage.delay"] - truth) < 3 * spread["voltage.delay"] + 1e-4
    assert spread["voltage.delay"] < 5e-4
    for name in FREE:
        assert abs(found[name] - table.nominal()[name]) < 3.5 * spread[name]
    np.testing.assert_allclose(np.asarray(belief.noise.sd), 5e-4, rtol=0.15)


def test_delayed_inputs_are_smooth_in_the_delay(short: Log) -> None:
    """No kink where the delay is a whole number of samples."""
    system = free_parts(pendulum(), [Delay("voltage")])
    windows, _ = cut([short], system, window=0.1)
    with jax.enable_x64(True):
        one = jax.tree.map(lambda x: jnp.asarray(x[0]), eqx.tree_at(
            lambda w: w.floor, windows, None))  # fmt: skip
        one = eqx.tree_at(lambda w: w.floor, one, jnp.ones(2), is_leaf=_none)
        blur = system.delay_blur

        def mean(delay: float, width: float) -> jax.Array:
            return stretch.inputs_of(one, jnp.asarray([delay]), width)[1:]

        slope = jax.jit(jax.jacfwd(mean), static_argnums=1)
        h = 1e-7
        jump = np.abs(slope(0.004 + h, blur) - slope(0.004 - h, blur)).max()
        kink = np.abs(slope(0.004 + h, 0.0) - slope(0.004 - h, 0.0)).max()
        assert jump < 1e-3 * kink
        # Far from a change of the input the blur does nothing, and never in the mean.
        total = np.sum(mean(0.004, blur)) - np.sum(mean(0.004, 0.0))
        assert abs(total) < 4.0


def test_delayed_inputs_of_numpy_are_those_of_jax(short: Log) -> None:
    """And so is their derivative in the delay, which is written by hand."""
    system = free_parts(pendulum(), [Delay("voltage")])
    windows, _ = cut([short], system, window=0.1)
    held = windows.span[1], windows.knots[1], windows.area[1]
    one, blur = stretch.HeldInputs(*held), system.delay_blur
    with jax.enable_x64(True):
        of = stretch.HeldInputs(*map(jnp.asarray, held))
        for late in ([0.0], [0.004], [0.0137]):
            at = jnp.asarray(late)
            by = jax.jacfwd(lambda d: stretch.inputs_of(of, d, blur)[:, 0])(at)
            u = stretch.inputs_of(one, np.asarray(late), blur)
            assert isinstance(u, np.ndarray)
            scale = np.abs(u).max()
            np.testing.assert_allclose(
                u, stretch.inputs_of(of, at, blur), atol=1e-9 * scale
            )
            found = stretch.inputs_by_delay(one, np.asarray(late), blur)
            assert np.abs(by).max() > 1.0
            # Integrals of the input are differenced over the blur.
            np.testing.assert_allclose(found, by, atol=1e-7 * np.abs(by).max())


@pytest.mark.nightly  # 10 s
def test_a_fit_near_another_ends_where_its_own_windows_say(short: Log) -> None:
    """Begun at the MAP of all windows, a fit of half of them forgets the others."""
    system, key = pendulum(), jax.random.key(0)
    windows, _ = cut([short], system, window=0.1)
    seen = np.arange(len(windows)) < len(windows) // 2
    half = eqx.tree_at(lambda w: w.mask, windows, windows.mask & seen[:, None, None])
    whole = fit_windows(system, windows, key=key, robust=True)
    alone = fit_windows(system, half, key=key, robust=True)
    warm = fit_windows(system, half, key=key, robust=True, warm_start=whole)
    with jax.enable_x64(True):
        sd = np.asarray(alone.posterior.sd())
        moved = np.asarray(warm.posterior.mean - alone.posterior.mean) / sd
        away = np.asarray(whole.posterior.mean - alone.posterior.mean) / sd
    assert np.abs(moved).max() < 0.02
    assert np.abs(away).max() > 0.2
    np.testing.assert_allclose(warm.noise.sd, alone.noise.sd, rtol=2e-3)
    np.testing.assert_allclose(warm.noise.weights, alone.noise.weights, rtol=0.02)
    ours, theirs = (start_states(half, found) for found in (warm, alone))
    np.testing.assert_allclose(ours, theirs, atol=1e-3)


def test_gaussian_prior_comes_back_without_data(short: Log) -> None:
    system = pendulum()
    windows, _ = cut([short], system, window=0.2)
    blank = dataclasses.replace(windows, mask=np.zeros_like(windows.mask))
    factor = factor_at(system, blank, np.zeros(3), np.ones(2)).data
    assert isinstance(system.parameters.prior(), Gaussian)
    np.testing.assert_array_equal(np.asarray(factor)[:, :], 0.0)


def test_causal_windows_stand_where_forecasts_start() -> None:
    """Every 0.1 s from 0.1 s on, and blind to what comes after their start."""
    log = simulated(seconds=1.0, seed=5, noise=1e-3)
    system = pendulum()
    windows, places = cut([log], system, window=0.2, start="causal")
    rows = [row for _, row in places]
    np.testing.assert_allclose(log.time[rows], [0.1, 0.3, 0.5, 0.7], atol=1e-9)
    grid = evaluation_windows([log], system, longest=0.1)
    shared = np.isin(np.round(grid.since, 6), np.round(log.time[rows], 6))
    np.testing.assert_allclose(
        windows.start, grid.windows.start[shared], rtol=1e-6, atol=1e-9
    )
    later = {n: np.where(log.time > 0.5, 9.0, y) for n, y in log.channels.items()}
    changed, _ = cut(
        [dataclasses.replace(log, channels=later)],
        system,
        window=0.2,
        start="causal",
    )
    np.testing.assert_array_equal(changed.start[:3], windows.start[:3])


@pytest.mark.parametrize("most", [10**6, 500])
def test_the_rounding_of_a_channel(most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of an encoder its steps over the root of 12, whether all rows are looked at or
    some; of values without steps a share of their spread."""
    monkeypatch.setattr(split_log, "SORTED", most)
    rng, quantum = np.random.default_rng(0), 2e-3
    y = 0.05 * np.sin(np.arange(4000) / 7.0) + 1e-4 * rng.standard_normal(4000)
    rows = {"encoder": quantum * np.round(y / quantum), "exact": y}
    known = {name: np.ones(4000, bool) for name in rows}
    log = Log("a", "a.csv", 1e-3 * np.arange(4000), rows, {}, known)
    steps = split_log.resolution([log, log], "encoder")
    assert steps == pytest.approx(quantum / np.sqrt(12.0))
    spread = split_log.resolution([log], "exact")
    assert spread == pytest.approx(1e-4 * np.std(y), rel=0.02)
