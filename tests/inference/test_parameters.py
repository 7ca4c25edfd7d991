"""Bounds, round trips, priors and tables of constants (S3; priors by quadrature)."""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.stats

from sim2gp.errors import InputError
from sim2gp.inference import bijections
from sim2gp.inference.bijections import MAPS
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.parameters import (
    Parameter,
    Parameters,
    bounded,
    log_bounded,
    parameters_of,
    positive,
    prior_from_moments,
    signed,
)

BOX = Parameter("k", "N", "bounded", "bounded", 0.5, 2.0)
LOG_BOX = Parameter("k", "N", "log box", "log_bounded", 1e-6, 3e-3)
SOFTPLUS = Parameter("k", "N", "softplus", "softplus", -1.5)
LOG = Parameter("k", "N", "log", "log", 0.0)
IDENTITY = Parameter("k", "N", "identity", "identity")
EVERY = [BOX, LOG_BOX, SOFTPLUS, LOG, IDENTITY]
# Boxes where low + (high - low) > high, in double and in single precision.
ROUNDED = [
    Parameter("k", "N", "bounded", "bounded", *b) for b in ((0.3, 0.9), (0.7, 1.9))
]


pytestmark = pytest.mark.usefixtures("float64")


def ids(p):
    return p.map


def virtual_values(dtype):
    """A million: the usual range, far outside, infinities and denormals."""
    rng = np.random.default_rng(3)
    tiny = np.finfo(dtype).smallest_subnormal
    edge = [0.0, 1e6, -1e6, np.inf, -np.inf, tiny, -tiny, 700.0, -700.0, 90.0, -90.0]
    usual = rng.normal(0, 3, 500_000)
    wide = rng.normal(0, 1, 499_989) * 10.0 ** rng.uniform(-300, 6, 499_989)
    return np.concatenate([edge, usual, wide]).astype(dtype)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("p", [*EVERY, *ROUNDED], ids=ids)
def test_physical_values_stay_inside(p, dtype):
    """S3: in the box and finite for any virtual value, and never decreasing."""
    tt = np.sort(virtual_values(dtype))
    table = Parameters((p,))
    theta = np.asarray(jax.jit(jax.vmap(table.constrain))(tt[:, None]))[:, 0]
    assert theta.dtype == dtype
    assert np.all(np.isfinite(theta))
    assert np.all((theta >= dtype(p.low)) & (theta <= dtype(p.high)))
    if p.map != "identity":
        size = np.abs(theta[1:]) + abs(p.low)  # of what was added
        assert np.all(np.diff(theta.astype(float)) >= -2 * np.finfo(dtype).eps * size)
    # Both ends of a box are approached: its range is neither larger nor smaller.
    if p.map in ("bounded", "log_bounded"):
        np.testing.assert_allclose(theta[[0, -1]], [p.low, p.high], rtol=1e-6)


@pytest.mark.parametrize("p", EVERY, ids=ids)
def test_slopes(p):
    """dtheta/dtt >= 0 and finite wherever a parameter can be; equal to differences."""
    table = Parameters((p,))
    slope = jax.jit(jax.vmap(lambda t: jax.grad(lambda t: table.constrain(t)[0])(t)))
    wide = np.asarray(slope(np.linspace(-700, 700, 9973)[:, None]))
    assert np.all(np.isfinite(wide))
    assert np.all(wide >= 0.0)
    t, h = np.linspace(-6, 6, 61)[:, None], 1e-5
    theta = jax.vmap(table.constrain)
    numeric = (theta(jnp.asarray(t + h)) - theta(jnp.asarray(t - h))) / (2 * h)
    np.testing.assert_allclose(slope(t), numeric, rtol=1e-6)


def span(p):
    return p.high - p.low if p.map in ("bounded", "log_bounded") else 1.0


@pytest.mark.parametrize("p", EVERY, ids=ids)
def test_round_trips(p):
    table = Parameters((p,))
    theta = np.asarray(jax.vmap(table.constrain)(jnp.linspace(-8, 8, 4001)[:, None]))
    back = jax.vmap(lambda x: table.constrain(table.unconstrain(x)))(theta)
    error = np.abs(back - theta) / (span(p) if span(p) != 1.0 else np.abs(theta) + 1e-9)
    assert np.max(error) <= 1e-12
    tt = jnp.linspace(-4, 4, 101)[:, None]
    again = jax.vmap(lambda t: table.unconstrain(table.constrain(t)))(tt)
    np.testing.assert_allclose(again, tt, atol=1e-9)


def test_formulas():
    """The paper's own box reaches low + high; ours does not."""
    sigmoid = 1 / (1 + math.exp(-0.3))
    assert BOX.constrain(0.3) == pytest.approx(0.5 + 1.5 * sigmoid, rel=1e-15)
    assert BOX.constrain(0.0) == 1.25
    expected = math.exp(math.log(1e-6) + math.log(3e3) * sigmoid)
    assert LOG_BOX.constrain(0.3) == pytest.approx(expected, rel=1e-14)
    assert SOFTPLUS.constrain(0.3) == pytest.approx(-1.5 + math.log1p(math.exp(0.3)))
    assert LOG.constrain(0.3) == pytest.approx(math.exp(0.3), rel=1e-15)
    assert IDENTITY.constrain(0.3) == 0.3


@pytest.mark.parametrize("p", [BOX, LOG_BOX], ids=ids)
def test_a_value_on_a_bound_maps_just_inside(p):
    for bound in (p.low, p.high):
        tt = p.unconstrain(bound)
        assert math.isfinite(tt)
        assert abs(p.constrain(tt) - bound) <= 1e-12 * (p.high - p.low)


def moments(p):
    """Physical mean and sd by adaptive quadrature in the virtual value."""
    inner = {
        "bounded": lambda t: p.low + (p.high - p.low) / (1 + math.exp(-t)),
        "log_bounded": lambda t: p.low * (p.high / p.low) ** (1 / (1 + math.exp(-t))),
        "log": math.exp,
        "identity": lambda t: t,
    }[p.map]

    def expect(g):
        def f(z):
            return g(inner(p.mean + p.sd * z)) * scipy.stats.norm.pdf(z)

        return scipy.integrate.quad(f, -9, 9, epsabs=0, epsrel=1e-10, limit=200)[0]

    mean = expect(lambda x: x)
    return mean, math.sqrt(expect(lambda x: (x - mean) ** 2))


@pytest.mark.parametrize(
    ("p", "mean", "sd", "bounds"),
    [
        (BOX, 1.1, 0.3, (0.5, 2.0)),
        (BOX, 0.55, 0.02, (0.5, 2.0)),
        (BOX, 1.25, 0.6, (0.5, 2.0)),
        (LOG_BOX, 3e-4, 1e-4, (1e-6, 3e-3)),
        (LOG_BOX, 2e-3, 5e-4, (None, 4e-3)),
        (LOG, 0.5, 0.1, (None, None)),
        (BOX, 1.0, 0.2, (None, None)),
        (IDENTITY, -0.2, 0.5, (None, None)),
        (IDENTITY, -0.2, 0.1, (-1.0, 0.5)),
    ],
)
def test_priors_from_physical_moments(p, mean, sd, bounds):
    matched = prior_from_moments(p, mean, sd, *bounds)
    got = moments(matched)
    assert got == (pytest.approx(mean, rel=1e-5), pytest.approx(sd, rel=1e-5))
    assert (matched.name, matched.unit) == (p.name, p.unit)
    if bounds[1] is None and p is not IDENTITY:
        assert matched.map == "log"


class Record(eqx.Module):
    stiffness: jax.Array = bounded(1.0, 3.0, "N/m", "spring", nominal=1.5)
    damping: jax.Array = log_bounded(1e-4, 1e-2, "N s/m", "damper")
    mass: jax.Array = positive(0.4, 0.1, "kg", "load")
    offset: jax.Array = signed(0.1, 0.2, "m", "zero of the scale", nominal=0.0)
    remark: str = eqx.field(static=True, default="")


TABLE = parameters_of(Record)


def test_a_table_is_read_from_the_record():
    assert TABLE.names == ("stiffness", "damping", "mass", "offset")
    assert TABLE.units == ("N/m", "N s/m", "kg", "m")
    assert [p.map for p in TABLE.free] == ["bounded", "log_bounded", "log", "identity"]
    assert {p.map for p in TABLE.free} <= set(MAPS)
    assert len(TABLE) == 4
    assert moments(TABLE["mass"]) == (pytest.approx(0.4), pytest.approx(0.1))


def test_order_is_the_records_own_whatever_the_maps():
    tt = jnp.asarray([0.2, -0.4, 0.7, 1.1])
    for table in (TABLE, Parameters(TABLE.free[::-1])):
        theta = table.constrain(tt)
        for p, t, x in zip(table.free, tt, theta, strict=True):
            assert float(x) == pytest.approx(p.constrain(float(t)), rel=1e-14)
        np.testing.assert_allclose(table.unconstrain(theta), tt, rtol=1e-10)


def test_prior_and_nominal():
    prior = TABLE.prior()
    np.testing.assert_array_equal(prior.mean, [p.mean for p in TABLE.free])
    np.testing.assert_array_equal(prior.covariance(), np.diag(prior.sd() ** 2))
    nominal = TABLE.nominal()
    assert (nominal["stiffness"], nominal["offset"]) == (1.5, 0.0)
    assert nominal["damping"] == pytest.approx(1e-3)  # the median
    assert TABLE["damping"].quantile(0.5) == pytest.approx(1e-3)
    z = scipy.stats.norm.ppf(0.9)
    assert TABLE["offset"].quantile(0.9) == pytest.approx(0.1 + 0.2 * z)


def test_fixing_replacing_and_merging():
    wider = dataclasses.replace(TABLE["stiffness"], high=9.0)
    table = TABLE.replace(mass=0.3, stiffness=wider)
    assert table.names == ("stiffness", "damping", "offset")
    assert table.fixed == (("mass", 0.3),)
    values = table.values(jnp.zeros(3))
    assert float(values["mass"]) == 0.3
    assert float(values["stiffness"]) == 5.0
    assert set(values) == set(TABLE.names)
    freed = table.replace(mass=TABLE["mass"])
    assert set(freed.names) == set(TABLE.names)
    both = table.merge(Parameters((BOX,)))
    assert both.names == (*table.names, "k")
    assert both.fixed == table.fixed
    with pytest.raises(InputError, match=r"E145.*did you mean stiffness"):
        TABLE.replace(stifness=1.0)


def test_a_table_without_free_constants():
    table = TABLE.replace(stiffness=1.0, damping=1e-3, mass=0.4, offset=0.0)
    assert len(table) == 0
    assert table.constrain(jnp.zeros(0)).shape == (0,)
    assert set(table.values(jnp.zeros(0))) == set(TABLE.names)


@pytest.mark.nightly
def test_curvature_is_what_the_maps_add_to_a_hessian():
    """A function linear in theta has no other: autodiff's Hessian, any prior scale."""
    kinds = ("bounded", "log_bounded", "softplus", "log", "identity")
    free = tuple(
        Parameter(f"{kind}{k}", "kg", "", kind, low=0.5, high=4.0, mean=0.2 * k)
        for k, kind in enumerate(kinds)
    )
    table = Parameters(free)
    with jax.enable_x64(True):
        rng = np.random.default_rng(0)
        scale = jnp.asarray(np.tril(rng.standard_normal((5, 5))) + 2.0 * np.eye(5))
        prior = Gaussian(jnp.asarray(rng.standard_normal(5)), scale)
        z = jnp.asarray(0.3 * rng.standard_normal(5))
        weight = jnp.asarray(rng.standard_normal(5))

        def f(z):
            return weight @ table.constrain(prior.mean + prior.scale @ z)

        found = table.curvature(prior, z, jax.grad(f)(z))
        np.testing.assert_allclose(found, jax.hessian(f)(z), rtol=1e-10, atol=1e-12)
        far = table.curvature(prior, 1e4 * z, jnp.ones(5))
        assert np.all(np.isfinite(np.asarray(far)))


@pytest.mark.parametrize("kind", bijections.MAPS)
def test_slopes_of_the_maps_are_those_that_jax_finds(kind: str) -> None:
    low, high = np.asarray([0.5]), np.asarray([20.0])
    t = np.linspace(-6.0, 6.0, 13)

    def physical(t: jax.Array) -> jax.Array:
        return bijections.constrain(kind, t[None], low, high)[0]

    with jax.enable_x64(True):
        first = jax.vmap(jax.grad(physical))(jnp.asarray(t))
        second = jax.vmap(jax.grad(jax.grad(physical)))(jnp.asarray(t))
        in_jax = bijections.slopes(kind, jnp.asarray(t), low, high)
        slope, bend = bijections.slopes(kind, t, low, high)
    np.testing.assert_allclose(slope, first, rtol=1e-12)
    np.testing.assert_allclose(bend, second / first, rtol=0.0, atol=1e-12)
    for mine, theirs in zip((slope, bend), in_jax, strict=True):
        np.testing.assert_allclose(theirs, mine, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("dz", [1e-3, 0.2])
def test_a_step_keeps_products_of_powers(dz):
    """Mass, force and damping by one factor: what a machine shows stays the same."""
    table = Parameters(
        (
            Parameter("mass", "kg", "", "bounded", 0.5, 2.0),
            Parameter("force", "N", "", "bounded", 1.0, 9.0),
            Parameter("damping", "N s/m", "", "log_bounded", 1e-3, 1.0),
            Parameter("offset", "m", "", "identity"),
        )
    )
    tt = jnp.asarray([0.1, -0.4, 0.3, 0.2])
    first, _ = table.slopes(tt)
    theta = table.constrain(tt)
    step = jnp.where(first > 0.0, dz * theta / first, 0.0).at[3].set(dz)
    new = table.constrain(table.moved(tt, step))
    np.testing.assert_allclose(new[:3] / theta[:3], np.exp(dz), rtol=1e-10)
    assert float(new[3]) == pytest.approx(0.2 + dz)


def test_a_step_begins_as_it_is_asked_for_and_stays_in_the_bounds():
    table = Parameters(
        (
            Parameter("mass", "kg", "", "bounded", 0.5, 2.0),
            Parameter("damping", "N s/m", "", "log_bounded", 1e-3, 1.0),
            Parameter("any", "1", "", "bounded", -1.0, 1.0),
            Parameter("level", "1", "", "log", 0.0),
        )
    )
    tt = jnp.asarray([0.5, -1.0, 0.2, 0.7])
    step = jnp.asarray([0.3, -0.2, 0.1, 0.4])
    slope = jax.jvp(lambda t: table.moved(tt, t * step), (0.0,), (1.0,))[1]
    np.testing.assert_allclose(slope, step, rtol=1e-9)
    for far in (-30.0, -3.0, 3.0, 30.0):
        new = table.moved(tt, far * step)
        theta = table.constrain(new)
        assert np.isfinite(new).all()
        assert (theta >= jnp.asarray([0.5, 1e-3, -1.0, 0.0])).all()
