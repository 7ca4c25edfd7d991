"""Friction laws, finite gradients, precision, and the tables of constants."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import machines
from sim2gp import systems as sy
from sim2gp.errors import InputError
from sim2gp.inference.parameters import parameters_of
from sim2gp.systems.effects.friction_laws import coulomb, coulomb_arctangent, dead_zone

pytestmark = pytest.mark.usefixtures("float64")


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("law", [coulomb, coulomb_arctangent])
def test_friction_has_finite_gradients_at_any_slope_and_speed(law, dtype):
    widths = [1e-12, 1e-3, 1.0, 1e12]
    speeds = [0.0, 1e-30, 1e-12, 0.05, 1.0, 1e6, 1e18, 1e30]
    for width in widths:
        for v in speeds:
            for sign in (1.0, -1.0):
                arguments = (jnp.asarray(sign * v, dtype), jnp.asarray(0.3, dtype))
                value = law(*arguments, width)
                slopes = jax.grad(lambda v, k, w=width: law(v, k, w), (0, 1))(
                    *arguments
                )
                assert all(np.isfinite(x) for x in (value, *slopes))
                assert abs(value) <= 0.3 * (1 + 1e-6)
                assert slopes[0] >= 0.0


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_smoothing_width_may_be_a_parameter(dtype):
    for width in (1e-12, 1.0, 1e12):
        for v in (0.0, 1e-3, 1e6, 1e30):
            arguments = [jnp.asarray(x, dtype) for x in (v, 1.0, width)]
            for mode in (jax.jacfwd, jax.jacrev):  # 0 * inf comes in by either way
                assert np.isfinite(mode(coulomb, 2)(*arguments))


def test_friction_laws():
    v = jnp.array(0.03)
    assert coulomb(v, jnp.array(2.0), 0.05) == pytest.approx(2 * np.tanh(0.6))
    assert coulomb_arctangent(v, jnp.array(np.pi / 2), 0.01) == pytest.approx(
        np.arctan(3.0)
    )
    for u in (-3.0, -0.5, 0.0, 0.66, 2.0, 1e8):
        expected = u / (1 + np.exp(np.clip(-(abs(u) - 0.65) / 0.05, -40, 40)))
        got = dead_zone(jnp.array(u), jnp.array(0.65), 0.05)
        assert float(got) == pytest.approx(expected, abs=1e-15)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("name", machines.every())
def test_gradients_are_finite_at_rest_and_at_speed(name, dtype):
    system = machines.every()[name]
    tt = jnp.zeros(len(system.parameters), dtype)
    a = jnp.zeros(len(system.actions), dtype)
    h = 1e-6  # s: what an equation says that is not finite, its flow says too

    def flow(t, s, a):
        return system.flow(machines.params_at(system, t), s, a, h)

    slope = jax.jit(jax.jacfwd(flow, (0, 1, 2)))
    n = len(system.physical_states)
    for speed in (0.0, 1e-12, 1e3, 1e6):
        s = jnp.concatenate([jnp.zeros(2, dtype), jnp.full(n - 2, speed, dtype)])
        for J in slope(tt, s, a):
            assert np.all(np.isfinite(J))


def test_a_draw_is_data():
    """Another draw does not retrace, and its leaves are the constants alone."""
    system = sy.Furuta()
    traces = []

    @jax.jit
    def step(dynamics, s, a):
        traces.append(1)
        return dynamics(s, a)

    s, a = jnp.zeros(4), jnp.ones(1)
    for tt in machines.batch(system, 5, 0)[0]:
        bound = system.bind(machines.params_at(system, tt), 0.02)
        expected = system.transition(tt, s, a, 0.02)
        np.testing.assert_allclose(step(bound, s, a), expected, rtol=1e-12)
    assert len(traces) == 1
    assert len(jax.tree.leaves(bound)) == len(system.parameters)
    assert not jax.tree.leaves(system)


@pytest.mark.parametrize(
    "name", ["furuta", "cartpole", "two_link", "furuta/all", "two_link/actuated"]
)
def test_float32_stays_float32(name):
    system = machines.every()[name]
    tt, s, a = (x.astype(jnp.float32) for x in machines.batch(system, 1, 0))
    step = machines.jitted(system, 0.02)
    out = step(tt[0], s[0], a[0])
    assert out.dtype == jnp.float32
    exact = step(*(x[0].astype(float) for x in (tt, s, a)))
    np.testing.assert_allclose(out, exact, rtol=2e-4, atol=2e-4)


def test_tables():
    furuta = sy.Furuta(parameters_of(sy.FurutaParams).replace(arm_mass=0.1))
    assert "arm_mass" not in furuta.parameters.names
    assert float(furuta.nominal().arm_mass) == 0.1
    for system in machines.bare().values():
        names = [channel.name for channel in system.states]
        assert names[2:] == [f"{name}.velocity" for name in names[:2]]
        assert all(parameter.unit for parameter in system.parameters.free)
    with pytest.raises(InputError, match=r"E145.*arm_mass"):
        sy.Furuta(sy.CartPole().parameters)
    with pytest.raises(InputError, match=r"E145.*arm_mass"):
        sy.Furuta(_without(sy.Furuta().parameters, "arm_mass"))
    with pytest.raises(InputError, match=r"E103.*theta"):
        sy.Furuta().joint("thetta")


def _without(table, name):
    return type(table)(tuple(p for p in table.free if p.name != name))
