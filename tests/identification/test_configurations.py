"""Several configurations of one machine in one fit: gathers, closed forms, payloads."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from descents import Found, minimise
from linear_system import linear, windows_of
from payload_arm import TRUTH, arm, log
from sim2gp.data.logs import Log
from sim2gp.data.split_log import cut
from sim2gp.data.transitions import Transitions
from sim2gp.data.windows import Windows
from sim2gp.data.windows_likelihood import WindowsLikelihood
from sim2gp.errors import InputError
from sim2gp.identification.fit import fit_windows
from sim2gp.identification.misfit.residuals import misfit_of_windows
from sim2gp.inference.arrowhead import Noise
from sim2gp.inference.estimate import Estimate
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.parameters import Parameter
from sim2gp.inference.prior import ParameterPrior
from sim2gp.models import Sim2GP
from sim2gp.systems import (
    ODE,
    AbstractSystem,
    BlackBox,
    Channel,
    Delay,
    Variant,
    free_parts,
    one_variant,
    with_variants,
)
from sim2gp.systems.variants import own_table
from sim2gp.types import in_float64

KEY = jax.random.key(0)
BARE = Variant("bare", fixed=(("payload", 0.0),))
LOADED = Variant("loaded", own=("payload",))
SHARED = ("inertia", "weight", "damping")


def joint(*configurations: Variant) -> Any:
    return with_variants(arm(), configurations)


@pytest.fixture(scope="module")
def logs() -> tuple[Log, Log]:
    return log(0, seed=1), log(1, seed=2)


@in_float64
def moments(system: AbstractSystem, belief: Estimate) -> dict[str, tuple[float, float]]:
    """Virtual mean and sd by column."""
    mean, sd = np.asarray(belief.posterior.mean), np.asarray(belief.posterior.sd())
    names = system.parameters.names
    return dict(zip(names, zip(mean.tolist(), sd.tolist(), strict=True), strict=True))


# The table.


def test_columns_are_the_shared_ones_and_each_own() -> None:
    table = joint(BARE, LOADED).parameters
    assert table.names == (*SHARED, "payload @ loaded")
    assert table["payload @ loaded"].meaning == "mass at the tip"
    both = (Variant("a", own=("weight",)), Variant("b"))
    assert joint(*both).parameters.names == (
        "inertia",
        "weight @ a",
        "weight",
        "damping",
        "payload",
    )


@in_float64
def test_each_configuration_has_its_constants() -> None:
    third = Variant("third", fixed=(("damping", 0.7),))
    system = joint(BARE, LOADED, third)
    table = system.parameters
    names = ("inertia", "weight", "damping", "payload @ loaded", "payload")
    assert table.names == names
    tt = jnp.asarray([0.1, 0.2, 0.3, 0.4, 0.5])
    theta = dict(zip(names, np.asarray(table.constrain(tt)), strict=True))
    shared = {"inertia": theta["inertia"], "weight": theta["weight"]}
    damping = theta["damping"]
    expected = (
        {"damping": damping, "payload": 0.0},
        {"damping": damping, "payload": theta["payload @ loaded"]},
        {"damping": 0.7, "payload": theta["payload"]},
    )
    traced = jax.jit(lambda i: system.values(tt, i))
    for i, alone_ in enumerate(expected):
        for found in (system.values(tt, i), traced(i)):
            assert {k: float(v) for k, v in found.items()} == pytest.approx(
                {k: float(v) for k, v in (shared | alone_).items()}, rel=1e-14
            )
    with pytest.raises(InputError, match=r"E152 which configuration.*bare, loaded"):
        system.values(tt)


def test_a_configuration_alone_is_an_ordinary_machine(float64: None) -> None:
    system = joint(BARE, LOADED)
    rng = np.random.default_rng(0)
    belief = Gaussian(jnp.arange(4.0), jnp.asarray(rng.normal(size=(4, 6))))
    for name, places in (("bare", [0, 1, 2]), ("loaded", [0, 1, 2, 3])):
        machine, own = one_variant(system, belief, name)
        table = machine.parameters
        free = [n for n in arm().parameters.names if n != "payload" or len(places) > 3]
        assert table.names == tuple(free)
        assert dict(table.fixed) == ({"payload": 0.0} if name == "bare" else {})
        whole = np.asarray(belief.covariance())[np.ix_(places, places)]
        np.testing.assert_allclose(np.asarray(own.covariance()), whole, atol=1e-12)
        assert own.scale.shape == (len(places), len(places))
        values = table.values(own.mean)
        joint_values = system.values(belief.mean, ("bare", "loaded").index(name))
        assert {k: float(v) for k, v in values.items()} == pytest.approx(
            {k: float(v) for k, v in joint_values.items()}
        )
        s, a = jnp.asarray([0.3, 0.1]), jnp.asarray([0.4])
        index = jnp.asarray(("bare", "loaded").index(name))
        np.testing.assert_array_equal(
            machine.transition(own.mean, s, a, 0.01),
            system.transition(belief.mean, s, a, 0.01, index),
        )
    with pytest.raises(InputError, match=r"E152 unknown configuration.*loaded"):
        own_table(system.parameters, system.variants, "load")


def test_a_delay_as_long_as_inputs_are_kept_is_taken() -> None:
    machine = free_parts(arm(), [Delay("torque")])
    found = with_variants(machine, [Variant("a", (("torque.delay", 0.02),))])
    assert found.variants[0].fixed == (("torque.delay", 0.02),)


# The fit.


def test_a_linear_machine_has_the_closed_form() -> None:
    """A dense regression: shared columns, own ones, known values on the right."""
    rng = np.random.default_rng(3)
    bare = linear(3, 2)
    a = Variant("a", (("k2", 0.5),), ("k1",))
    prior = {"k1 @ b": Parameter("", "", "", "identity", mean=1.5, sd=0.3)}
    system = with_variants(bare, [a, Variant("b", own=("k1",))], prior)
    assert system.parameters.names == ("k0", "k1 @ a", "k1 @ b", "k2")
    truth = {"k0": 1.0, "k1 @ a": -1.0, "k1 @ b": 2.0, "k2": 0.3}
    N, d = 40, 2
    A = rng.normal(size=(N, d, 3))
    group = rng.integers(0, 2, N)
    X, known = np.zeros((N, d, 4)), np.zeros((N, d))
    X[..., 0] = A[..., 0]
    X[group == 0, :, 1], X[group == 1, :, 2] = A[group == 0, :, 1], A[group == 1, :, 1]
    X[group == 1, :, 3] = A[group == 1, :, 2]
    known[group == 0] = 0.5 * A[group == 0, :, 2]
    y = X @ np.asarray([*truth.values()]) + known + 0.1 * rng.normal(size=(N, d))
    belief = fit_windows(system, windows_of(A, y, group), key=KEY)
    sd = np.asarray(belief.noise.sd)
    white = (X / sd[None, :, None]).reshape(-1, 4)
    mu0, sd0 = np.asarray([0.0, 0.0, 1.5, 0.0]), np.asarray([1.0, 1.0, 0.3, 1.0])
    precision = white.T @ white + np.diag(1.0 / sd0**2)
    rhs = white.T @ ((y - known) / sd[None]).reshape(-1) + mu0 / sd0**2
    scale = np.asarray(belief.posterior.scale)
    np.testing.assert_allclose(scale @ scale.T, np.linalg.inv(precision), rtol=1e-8)
    mean = np.linalg.solve(precision, rhs)
    np.testing.assert_allclose(belief.posterior.mean, mean, rtol=1e-9)
    # The evidence, of all rows at once.
    X0 = white * sd0[None]
    covariance = np.eye(len(X0)) + X0 @ X0.T
    r = ((y - known) / sd[None]).reshape(-1) - white @ mu0
    _, log_det = np.linalg.slogdet(covariance)
    log_evidence = -0.5 * (r @ np.linalg.solve(covariance, r) + log_det)
    log_evidence -= N * np.sum(np.log(sd)) + 0.5 * len(X0) * np.log(2.0 * np.pi)
    np.testing.assert_allclose(belief.log_evidence, log_evidence, rtol=1e-10)


@eqx.filter_jit
def descend(likelihood: WindowsLikelihood) -> Found:
    table = likelihood.system.parameters
    prior = table.prior()
    W, n = likelihood.windows.start.shape
    noise = Noise(jnp.asarray([1e-3]), jnp.ones(W))
    about = ParameterPrior(prior, table)
    start, e = jnp.zeros(prior.mean.size), jnp.zeros((W, n))
    return minimise(likelihood, start, e, noise, about)


@pytest.mark.nightly
@in_float64
def test_sharing_nothing_is_two_fits(logs: tuple[Log, Log]) -> None:
    machine = arm()
    every = machine.parameters.names
    system = joint(*(Variant(n, own=every) for n in ("a", "b")))
    whole, _ = cut(logs, system, window=0.2)
    both = descend(WindowsLikelihood(system, whole))
    order = [[f"{n} @ {c}" for n in every] for c in ("a", "b")]
    cost = evidence = 0.0
    for k, columns in enumerate(order):
        mine = whole.configuration == k
        part = jax.tree.map(lambda x, m=mine: x[m] if len(x) == len(m) else x, whole)
        one = descend(WindowsLikelihood(machine, part))
        at = [system.parameters.names.index(name) for name in columns]
        scale = np.asarray(one.about.scale())
        sd = np.sqrt(np.sum(scale**2, axis=1))
        # As near as a descent ends by its joint tolerance.
        np.testing.assert_allclose(np.asarray(both.z)[at] / sd, one.z / sd, atol=1e-4)
        ours = np.asarray(both.about.scale())[at]
        np.testing.assert_allclose(ours @ ours.T, scale @ scale.T, rtol=1e-4)
        cost, evidence = cost + one.cost, evidence + one.about.log_joint()
    np.testing.assert_allclose(both.cost, cost, rtol=1e-10)
    np.testing.assert_allclose(both.about.log_joint(), evidence, atol=1e-4)


@pytest.fixture(scope="module")
def joined(logs: tuple[Log, Log]) -> tuple[Any, Estimate, Windows]:
    system = joint(BARE, LOADED)
    windows, _ = cut(logs, system, window=0.2)
    return system, fit_windows(system, windows, key=KEY), windows


def test_a_payload_is_found_and_the_arm_is_known_better(
    joined: tuple[Any, Estimate, Windows],
) -> None:
    system, belief, windows = joined
    found, table = moments(system, belief), system.parameters
    for name, (mean, sd) in found.items():
        truth = table[name].unconstrain(TRUTH[name.split(" @ ")[0]])
        assert abs(mean - truth) < 3.5 * sd, name
    mean, sd = found["payload @ loaded"]
    p = table["payload @ loaded"]
    assert p.constrain(mean + sd) - p.constrain(mean - sd) < 0.02  # kg
    # Each of the logs alone: the other one's windows are masked.
    for k in (0, 1):
        mask = windows.mask & (windows.configuration == k)[:, None, None]
        part = dataclasses.replace(windows, mask=mask)
        one = moments(system, fit_windows(system, part, key=KEY))
        for name in SHARED:
            assert found[name][1] < one[name][1], name
        mean, sd = one["payload @ loaded"]
        if k:
            assert found["payload @ loaded"][1] < sd
        else:  # nothing was seen of it: its prior
            assert (mean, sd) == pytest.approx((p.mean, p.sd))


@pytest.mark.nightly
def test_a_value_that_is_wrong_is_seen(
    joined: tuple[Any, Estimate, Windows],
) -> None:
    """0.15 kg were there; 0.05 are stated. The bare log says what the arm is."""
    system, belief, windows = joined
    likelihood = WindowsLikelihood(system, windows)
    assert not misfit_of_windows(likelihood, belief).alarm
    known = Variant("loaded", fixed=(("payload", 0.05),))
    light = joint(BARE, known)
    wrong = fit_windows(light, windows, key=KEY)
    assert light.parameters.names == SHARED
    assert float(wrong.log_evidence) < float(belief.log_evidence) - 50.0
    assert misfit_of_windows(WindowsLikelihood(light, windows), wrong).alarm


@in_float64
def test_the_program_does_not_grow_with_configurations(
    logs: tuple[Log, Log],
) -> None:
    """The simulation is traced as often for three configurations as for one."""
    traced: list[int] = []

    def counted(k: Any, s: Any, a: Any) -> Any:
        traced.append(1)
        return arm().function(k, s, a)

    machine = ODE(counted, arm().parameters, arm().channels, arm().inputs)
    third = Variant("third", own=("weight",))
    windows, _ = cut(logs, machine, window=0.2)
    counts = []
    for system in (machine, with_variants(machine, [BARE, LOADED, third])):
        prior = system.parameters.prior()
        likelihood, e = (
            WindowsLikelihood(system, windows),
            jnp.zeros(windows.start.shape),
        )
        traced.clear()
        jax.make_jaxpr(likelihood.blocks)(prior.mean, e, prior.scale)
        counts.append(len(traced))
    assert counts[0] == counts[1] > 0


@in_float64
def test_one_step_is_fitted_jointly_as_well(getkey: Any) -> None:
    """Of a linear machine: regression by configuration, rows in any order."""
    a = Variant("a", (("k1", 0.5),))
    system = with_variants(linear(2, 1), [a, Variant("b", own=("k1",))])
    assert system.parameters.names == ("k0", "k1 @ b")
    rng = np.random.default_rng(5)
    A, group = rng.normal(size=(30, 1, 2)), rng.integers(0, 2, 30)
    k1 = np.where(group == 0, 0.5, -1.0)
    y = A[..., 0] * 1.5 + A[..., 1] * k1[:, None] + 0.1 * rng.normal(size=(30, 1))
    data = Transitions.of(np.zeros_like(y), A.reshape(30, -1), y, group)
    more = data.extend(data.state[:2], data.action[:2], data.next_state[:2])
    assert more.configuration is not None
    assert more.configuration[:32].tolist() == [*group, 0, 0]
    model = Sim2GP(system, dt=1.0)
    belief = model.fit(model.init(getkey()), data, key=getkey())
    X = np.stack([A[:, 0, 0], A[:, 0, 1] * group], axis=1) / float(belief.noise[0])
    right = (y[:, 0] - 0.5 * A[:, 0, 1] * (1 - group)) / float(belief.noise[0])
    precision = X.T @ X + np.eye(2)
    scale = np.asarray(belief.posterior.scale)
    np.testing.assert_allclose(scale @ scale.T, np.linalg.inv(precision), rtol=1e-8)
    mean = np.linalg.solve(precision, X.T @ right)
    np.testing.assert_allclose(belief.posterior.mean, mean, rtol=1e-8)
    with pytest.raises(InputError, match="E152"):  # a draw is of one configuration
        belief.latent(jnp.zeros(1), jnp.zeros(2))


def test_rows_on_the_host_have_constants_of_their_own() -> None:
    """A known value beyond the prior's bounds is simulated as it is."""
    inside = Parameter("k", "1", "gain", "bounded", 0.5, 2.0)
    asked: list[float] = []

    def step(params: Any, s: Any, a: Any, h: Any) -> Any:
        asked.extend(np.atleast_1d(params["k"]).tolist())
        return s + np.asarray(params["k"] * h)[..., None] * a

    channel = Channel("x", "m")
    machine = BlackBox(step, [inside], [channel], [Channel("u", "1")], batched=True)
    known = Variant("a", (("k", 5.0),))
    system = with_variants(machine, [known, Variant("b")])

    @in_float64
    def slopes() -> tuple[np.ndarray, np.ndarray]:
        def f(tt: Any, which: Any) -> Any:
            s, a = jnp.ones(1), 2.0 * jnp.ones(1)
            return system.transition(tt, s, a, 0.1, which)

        tt, which = jnp.zeros(1), jnp.asarray([0, 1])
        value = jax.vmap(f, in_axes=(None, 0))(tt, which)
        return value, jax.vmap(jax.jacfwd(f), in_axes=(None, 0))(tt, which)

    value, J = slopes()
    np.testing.assert_allclose(value[:, 0], [2.0, 1.25], rtol=1e-12)
    # dk/dtt is a quarter of the box at its middle.
    np.testing.assert_allclose(J[:, 0, 0], [0.0, 0.2 * 1.5 / 4.0], rtol=1e-7)
    assert max(asked) <= 5.0 + 1e-3
