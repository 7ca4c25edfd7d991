"""Systems that are functions: a Python step function against the same thing in JAX."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from descents import estimate_of
from sim2gp.data.logs import Log
from sim2gp.data.split_log import cut
from sim2gp.data.transitions import Transitions
from sim2gp.data.windows_likelihood import WindowsLikelihood, linearise
from sim2gp.errors import InputError
from sim2gp.inference.arrowhead import Noise
from sim2gp.inference.parameters import Parameter, Parameters
from sim2gp.models import Sim2GP
from sim2gp.planning import AbstractPlanner
from sim2gp.planning.episode import episode, oracle_world
from sim2gp.planning.loop import psrl
from sim2gp.planning.tasks import furuta_swingup
from sim2gp.robot.export import export_model
from sim2gp.systems import ODE, BlackBox, Channel, Furuta
from sim2gp.types import in_float64

DT = 0.05
TABLE = (
    Parameter("gravity", "1/s^2", "gravity over length", "log_bounded", 3.0, 30.0),
    Parameter("damping", "1/s", "viscous friction", "log_bounded", 0.05, 5.0),
)
STATES = Channel("q", "rad", angle=True), Channel("q.velocity", "rad/s")
ACTIONS = (Channel("torque", "1/s^2", low=-5.0, high=5.0),)
TABLE_OF = Parameters(TABLE)
TRUTH = {"gravity": 9.81, "damping": 0.7}
KEY = jax.random.key(0)


def slope(xp: Any, params: Any, s: Any, a: Any) -> Any:
    """Of a pendulum; ``s`` and ``a`` have their channels last."""
    w = s[..., 1]
    turn = a[..., 0] - params["gravity"] * xp.sin(s[..., 0]) - params["damping"] * w
    return xp.stack([w, turn], -1)


def ode(params: Any, s: Any, a: Any) -> Any:
    return slope(jnp, params, s, a)


def step(params: Any, s: Any, a: Any, h: Any) -> Any:
    """RK4 in NumPy, for one row or many; what it gets is its own to write into."""
    h = np.asarray(h)[..., None]
    k1 = slope(np, params, s, a)
    k2 = slope(np, params, s + h / 2 * k1, a)
    k3 = slope(np, params, s + h / 2 * k2, a)
    k4 = slope(np, params, s + h * k3, a)
    s += h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    a[...], params["gravity"] = 0.0, 0.0
    return s


def black_box(f: Any = step, **options: Any) -> BlackBox:
    return BlackBox(f, TABLE, STATES, ACTIONS, max_substep=DT, **options)


EXACT = ODE(ode, TABLE, STATES, ACTIONS, max_substep=DT)


def exact(x: Any) -> Any:
    """One step of the equation; ``x`` are constants, state and input."""
    params = dict(zip(TRUTH, x[:2], strict=True))
    return EXACT.flow(params, x[2:4], x[4:], DT)


@pytest.fixture(scope="module")
def rows() -> tuple[np.ndarray, ...]:
    """Random constants, states and inputs; where the equation leads, and its slopes."""
    rng = np.random.default_rng(0)
    x = rng.standard_normal((6, 5)) * [3.0, 0.2, 2.0, 2.0, 2.0] + [9, 0.7, 0, 0, 0]
    with jax.enable_x64(True):
        both = jax.jit(jax.vmap(lambda x: (exact(x), jax.jacfwd(exact)(x))))(x)
    return x, *(np.asarray(y) for y in both)


def asked(f: Any, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What a simulator says of those rows: values and slopes."""
    return f.engine.slopes(x[:, :2], x[:, 2:4], x[:, 4:], np.full(len(x), DT))


@in_float64
def data(noise: float = 1e-3) -> Transitions:
    """A walk of the true machine."""
    rng = np.random.default_rng(0)
    params = {k: jnp.asarray(v) for k, v in TRUTH.items()}
    f = jax.jit(lambda s, a: EXACT.step(params, s, a, DT))
    S, A = [np.zeros(2)], rng.uniform(-5.0, 5.0, (40, 1))
    for a in A:
        S.append(np.asarray(f(S[-1], a)) + noise * rng.standard_normal(2))
    rows = np.stack(S)
    return Transitions.of(rows[:-1], A, rows[1:])


@pytest.mark.parametrize("batched", [False, True])
def test_a_step_and_its_slopes_are_the_equations(batched: bool, rows: Any) -> None:
    """Values to rounding, and never those of another row."""
    x, values, slopes = rows
    found = asked(black_box(batched=batched), x)
    np.testing.assert_allclose(found[0], values, rtol=1e-13, atol=1e-14)
    np.testing.assert_allclose(found[1], slopes, rtol=1e-6, atol=1e-8)


@in_float64
def test_jax_takes_its_derivatives_both_ways(rows: Any) -> None:
    """In virtual constants, state and input, over a period of two substeps."""
    theta, s, a = (jnp.asarray(x) for x in np.split(rows[0][0], [2, 4]))
    args = TABLE_OF.unconstrain(theta), s, a
    box, pendulum = (
        jax.jit(jax.jacrev(lambda *x, f=f: f.transition(*x, 2 * DT), (0, 1, 2)))
        for f in (black_box(), EXACT)
    )
    expected = pendulum(*args)
    for found, right in zip(box(*args), expected, strict=True):
        np.testing.assert_allclose(found, right, rtol=1e-6, atol=1e-8)
    tangent = tuple(jnp.ones_like(x) for x in args)
    _, along = jax.jvp(lambda *x: black_box().transition(*x, 2 * DT), args, tangent)
    total = sum(J.sum(axis=1) for J in expected)
    np.testing.assert_allclose(along, total, rtol=1e-6, atol=1e-8)


@in_float64
def test_all_slopes_of_a_window_are_asked_for_once() -> None:
    """And they are those of the equation, which is asked for one after the other."""
    calls = []

    def counted(*x: Any) -> Any:
        calls.append(1)
        return step(*x)

    rng, L = np.random.default_rng(1), 6
    log = Log(
        name="walk",
        source="walk.csv",
        time=0.01 * np.arange(L + 1),
        channels={"q": 0.1 * rng.standard_normal(L + 1)},
        inputs={"torque": rng.uniform(-5.0, 5.0, L + 1)},
        mask={"q": np.ones(L + 1, bool)},
    )
    boxes = black_box(counted, batched=True), EXACT
    found = []
    for system in boxes:
        windows, _ = cut([log], system, window=0.06, start_sd=None, floor=None)
        prior, noise = TABLE_OF.prior(), Noise(jnp.ones(1), jnp.ones(1))
        still = -windows.start / windows.start_sd
        fitted = estimate_of(prior, prior, noise, jnp.asarray(still))
        likelihood = WindowsLikelihood(system, windows)
        calls.clear()
        found.append(linearise(likelihood, fitted, prior.mean))
        if system is boxes[0]:
            assert 0 < len(calls) <= windows.span.shape[1]
    box, exact = found  # steps of 10 ms, and of 2
    np.testing.assert_allclose(box.state, exact.state[:, ::5], atol=1e-6)
    right = exact.jacobian[:, ::5]
    scale = np.abs(right).max()
    np.testing.assert_allclose(box.jacobian, right, atol=1e-5 * scale)


@pytest.mark.nightly
def test_the_posterior_is_that_of_the_equation() -> None:
    """Constants, noise and evidence, whoever computes the slopes."""
    found = []
    for system in (black_box(batched=True), EXACT):
        model = Sim2GP(system, dt=DT)
        found.append(model.fit(model.init(KEY), data(), key=KEY))
    box, exact = found
    for mine, theirs in zip(box.parameters(), exact.parameters(), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-6)
    np.testing.assert_allclose(box.noise, exact.noise, rtol=1e-6)
    np.testing.assert_allclose(box.log_evidence, exact.log_evidence, rtol=1e-7)
    draws = [belief.sample(KEY) for belief in found]
    s, a = jnp.asarray([1.0, -2.0]), jnp.asarray([3.0])
    np.testing.assert_allclose(draws[0](s, a), draws[1](s, a), rtol=1e-5)
    with pytest.raises(InputError, match="E135"):
        export_model(box, "unused", box.system, dt=DT, draws=1, key=KEY, compiled=True)


def test_nan_is_an_answer(rows: Any) -> None:
    """Of one row alone; the function is not asked about what is not finite."""

    def lost(params: Any, s: Any, a: Any, h: float) -> Any:
        assert np.isfinite([*params.values(), *s, *a]).all()
        assert h > 0.0
        return step(params, s, a, h) if s[0] < 9.0 else [np.nan, 0.0]

    x = rows[0].copy()
    x[1, 2], x[2, 3], x[3, 0] = 10.0, np.inf, np.nan
    theta, s, a, h = x[:, :2], x[:, 2:4], x[:, 4:], np.full(6, DT)
    h[5] = 0.0
    found = black_box(lost).engine.flow(theta, s, a, h)
    assert np.isnan(found[:4]).sum(axis=1).tolist() == [0, 1, 2, 2]
    np.testing.assert_array_equal(found[5], s[5])
    np.testing.assert_allclose(found[[0, 4]], rows[1][[0, 4]], rtol=1e-13)


@pytest.mark.parametrize("single", [True, False])
def test_single_precision_is_differenced_coarsely(single: bool, rows: Any) -> None:
    def rounded(params: Any, s: Any, a: Any, h: float) -> Any:
        return step(params, s, a, h).astype(np.float32 if single else np.float64)

    _, slopes = asked(black_box(rounded), rows[0])
    rtol, atol = (2e-3, 1e-4) if single else (1e-6, 1e-8)
    np.testing.assert_allclose(slopes, rows[2], rtol=rtol, atol=atol)


def raises(*_: Any) -> Any:
    raise ZeroDivisionError("no\nway")


def late(params: Any, s: Any, a: Any, h: float) -> Any:
    """Well at rest, as long as nobody looks."""
    return step(params, s, a, h) if not s.any() else raises()


def test_a_later_fault_ends_a_fit_as_one_line() -> None:
    """Out of a compiled program, which lives on."""
    model = Sim2GP(black_box(late), dt=DT)
    belief = model.init(KEY)
    with pytest.raises(InputError, match="ZeroDivisionError: no way") as caught:
        belief.latent(jnp.ones(2), jnp.ones(1))
    assert caught.value.code == "E173"
    assert "\n" not in str(caught.value)
    assert str(caught.value).count("E173") == 1


class Broken(AbstractPlanner):
    """Says what JAX says of a program that called back in vain."""

    said: str = eqx.field(static=True)

    def init(self, world: Any, *, key: Any) -> Any:
        raise RuntimeError(self.said)

    def prepare(self, state: Any, world: Any, data: Any, *, key: Any) -> Any:
        raise RuntimeError(self.said)

    def act(self, state: Any, world: Any, s: Any, *, key: Any) -> Any:
        raise RuntimeError(self.said)

    def failed(self, state: Any) -> Any:
        return jnp.asarray(False)


def test_a_fault_amid_an_episode_is_one_line_too() -> None:
    """Of a draw that is planned in, or trained in; what is not ours passes."""
    task = furuta_swingup()
    world, model = oracle_world(task), Sim2GP(Furuta())
    ours = Broken("A traceback:\n  a line\nInputError: E173 answer.")
    with pytest.raises(InputError, match=r"^E173 answer\.$"):
        episode(task, ours, (), world, key=KEY)
    with pytest.raises(InputError, match=r"^E173 answer\.$"):
        psrl(task, model, ours, episodes=1, key=KEY)
    with pytest.raises(RuntimeError, match="InputError: nothing"):
        episode(task, Broken("InputError: nothing"), (), world, key=KEY)


def test_long_steps_are_divided() -> None:
    """Over a period by what the function can do, between rows of logs by 10 ms."""
    for longest, expected in ((np.inf, 0.01), (1e-3, 1e-3)):
        box = BlackBox(step, TABLE, STATES, ACTIONS, max_substep=longest)
        assert (box.max_substep, box.window_substep) == (longest, expected)


def test_a_fixed_constant_is_passed_on() -> None:
    table = TABLE_OF.replace(gravity=9.0)
    params = {"gravity": jnp.asarray(9.0), "damping": jnp.asarray(0.5)}
    s, a = jnp.asarray([1.0, 2.0]), jnp.asarray([0.5])
    expected = EXACT.flow(params, s, a, DT)
    for make, f in ((ODE, ode), (BlackBox, step)):
        system = make(f, table, STATES, ACTIONS)
        found = system.flow(system.record(params | {"other": s[0]}), s, a, DT)
        np.testing.assert_allclose(found, expected, rtol=1e-6)
