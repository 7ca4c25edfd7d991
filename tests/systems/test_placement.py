"""Effects on friction, geometry and inputs against mechanics or closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import lagrangians
import machines
from machines import against, close
from sim2gp import systems as sy
from sim2gp.errors import InputError
from tests.systems.test_systems import cartpole_forces, furuta_forces

pytestmark = pytest.mark.usefixtures("float64")


def pendulum_at(p, r):
    """A place on the Furuta's pendulum, ``r`` from its joint, in the base's frame."""

    def position(q):
        sin, cos = jnp.sin(q[0]), jnp.cos(q[0])
        side = r * jnp.sin(q[1])
        return jnp.stack(
            [
                p.arm_length * cos - side * sin,
                p.arm_length * sin + side * cos,
                -r * jnp.cos(q[1]),
            ]
        )

    return position


@pytest.mark.parametrize(
    ("kind", "rising"), [(sy.BaseTilt, [1.0, 0.0]), (sy.BaseTiltSide, [0.0, 1.0])]
)
@pytest.mark.parametrize("tilt", [0.3, -0.02])
@pytest.mark.nightly
def test_base_tilt_turns_gravity(kind, rising, tilt):
    up = jnp.array([*(np.sin(tilt) * np.array(rising)), np.cos(tilt)])

    def lagrangian(p):
        centre = pendulum_at(p, p.pendulum_length / 2)

        def with_height(q):  # `point` takes the last coordinate as height
            return jnp.append(centre(q), 0.0)

        def L(q, v):
            moving = lagrangians.point(with_height, p.pendulum_mass, 0.0)(q, v)
            return moving - p.pendulum_mass * 9.81 * centre(q) @ up

        own = p.pendulum_mass * p.pendulum_length**2 / 12
        arm = p.arm_mass * p.arm_length**2 / 12
        return lagrangians.together(
            lagrangians.spin(lambda q: q[0], arm),
            lagrangians.spin(lambda q: q[1], own),
            L,
        )

    against("furuta", kind(magnitude=tilt), lagrangian, furuta_forces)


def test_payload_is_a_point_at_the_end():
    def furuta(p):
        end = pendulum_at(p, p.pendulum_length)
        return lagrangians.together(
            lagrangians.furuta(p), lagrangians.point(end, 0.01, 9.81)
        )

    def cartpole(p):
        def end(q):
            r = 2.0 * p.pole_half_length
            return jnp.stack([q[0] + r * jnp.sin(q[1]), -r * jnp.cos(q[1])])

        return lagrangians.together(
            lagrangians.cartpole(p), lagrangians.point(end, 0.03, 9.81)
        )

    against("furuta", sy.Payload("alpha", 0.01), furuta, furuta_forces)
    against("cartpole", sy.Payload("theta", 0.03), cartpole, cartpole_forces)


@pytest.mark.parametrize("machine", ["furuta", "cartpole", "two_link"])
def test_an_encoders_offset_moves_the_machine_not_its_equations(machine):
    """The flow is that at the true position, whatever the actuators are."""
    bare = machines.bare()[machine]
    one, two = (channel.name for channel in bare.states[:2])
    sensors = [sy.EncoderOffset(one, 0.2), sy.EncoderOffset(two, -0.3)]
    system = sy.Machine(bare, sensors=sensors)
    offset = jnp.array([0.2, -0.3, 0.0, 0.0])
    for tt, s, a in machines.points(bare, 5, 5):
        p = machines.params_at(bare, tt)
        got = system.flow(machines.with_parts(system, p), s, a, 0.002)
        close(got, bare.flow(p, s + offset, a, 0.002) - offset)


def test_an_encoders_offset_is_a_constant():
    bare = sy.Furuta()
    system = sy.free_parts(bare, [sy.EncoderOffset("alpha", 0.1)])
    assert system.parameters.names == (*bare.parameters.names, "alpha.encoder")
    assert system.parameters["alpha.encoder"].sd == 0.1
    assert sy.EncoderOffset("alpha").parameter(bare).sd == 0.05
    assert sy.plant_of(system) is bare
    with pytest.raises(InputError, match="E145 encoder of"):
        sy.Machine(bare, sensors=[sy.EncoderOffset("alpha.velocity", 0.1)])
    with pytest.raises(InputError, match=r"E103.*did you mean alpha"):
        sy.Machine(bare, sensors=[sy.EncoderOffset("alfa", 0.1)])


def test_friction_formulas():
    furuta = sy.Furuta()
    q, v, a = jnp.array([0.7, 2.0]), jnp.array([-1.5, 0.4]), jnp.array([1.1])
    p = furuta.nominal()
    for effect, expected in (
        (
            sy.Stribeck("theta", 4e-3, speed=2.0),
            [2e-3 * (1.0 + np.exp(-(0.75**2))), 0.0],
        ),
        (sy.Stribeck("alpha", 4e-3, width=0.4), [0.0, -2e-3 * (1 + np.exp(-0.16))]),
        (sy.Viscous("theta", 1e-3), [1.5e-3, 0.0]),
    ):
        system = sy.Machine(furuta, [effect])
        known = machines.with_parts(system, p)
        f = machines.equations(system, known, q, v, a)[1] - furuta.forces(p, q, v, a)
        expected = np.array(expected) * [1.0, np.tanh(1.0) if expected[0] == 0 else 1.0]
        np.testing.assert_allclose(f, expected, rtol=1e-9, atol=1e-15)
    assert sy.Stribeck("theta", 1.0).unit(furuta) == "N m"
    assert sy.Viscous("theta", 1.0).unit(furuta) == "N m s/rad"


def test_friction_only_takes_energy():
    """In free motion every friction lowers the energy of the Furuta."""
    furuta = sy.Furuta()
    p = machines.nominal(furuta, arm_damping=1e-6, pendulum_damping=1e-7)
    energy = lagrangians.energy
    L = lagrangians.furuta(p)
    none = jnp.zeros(1)
    for effect in (sy.Stribeck("theta", 4e-3), sy.Viscous("alpha", 1e-4)):
        system = sy.Machine(furuta, [effect])

        @jax.jit
        def rates(s, system=system):
            """Of the energy, with the effect and without."""
            known = machines.with_parts(system, p)
            moves = machines.ode(system, known, s, none), furuta.ode(p, s, none)
            return [
                jax.jvp(lambda q, v: energy(L, q, v), (s[:2], s[2:]), (s[2:], ds[2:]))[
                    1
                ]
                for ds in moves
            ]

        for _, s, _ in machines.points(furuta, 20, 6):
            rate, bare = rates(s)
            assert rate < bare


@pytest.mark.parametrize("lag", [2e-3, 0.015, 0.08])
def test_lagged_means_are_those_of_a_low_pass(lag):
    """Against a stiff integrator; the oldest input was held for ever before."""
    held, dt, count = np.array([1.0, -2.0, 3.0, 0.5]), 0.02, 4
    got = sy.lagged_means(jnp.asarray(held), dt, jnp.asarray(lag), count)
    now = held[-1]
    for u in held[:0:-1]:  # the oldest first
        now = u + (now - u) * np.exp(-dt / lag)
    edges = np.linspace(0.0, dt, count + 1)
    solved = scipy.integrate.solve_ivp(
        lambda t, y: [(held[0] - y[0]) / lag, y[0]],
        (0.0, dt),
        [now, 0.0],
        t_eval=edges,
        rtol=1e-10,
        atol=1e-12,
    )
    np.testing.assert_allclose(got, np.diff(solved.y[1]) / (dt / count), rtol=1e-7)


def test_a_lag_of_a_constant_is_the_constant_and_no_lag_the_newest():
    lag = jnp.asarray(0.01)
    same = sy.lagged_means(jnp.full(4, 2.5), 0.02, lag, 3)
    np.testing.assert_allclose(same, 2.5, rtol=1e-13)
    newest = sy.lagged_means(jnp.array([1.0, 5.0, 9.0]), 0.02, jnp.asarray(1e-9), 3)
    np.testing.assert_allclose(newest, 1.0, rtol=1e-6)


def test_lagged_machine_carries_what_still_matters():
    furuta = sy.Furuta()
    system = sy.Machine(furuta, actuators=[sy.Lag("voltage", 0.01)], period=0.02)
    assert system.history == 3  # 50 ms in steps of 20
    assert len(system.states) == 7
    p = system.record(system.parameters.values(jnp.zeros(8)))
    s = jnp.array([0.1, 0.4, 0.3, -0.2, 2.0, 2.0, 2.0])
    got = system.step(p, s, jnp.array([2.0]), 0.02)
    plain = furuta.step(p.plant, s[:4], jnp.array([2.0]), 0.02)
    np.testing.assert_allclose(got[:4], plain, rtol=1e-12)
    later = system.step(p, s, jnp.array([-1.0]), 0.02)
    np.testing.assert_allclose(later[4:], [-1.0, 2.0, 2.0])
    assert abs(later[2] - got[2]) > 1e-3


def test_library_offers_what_the_machine_has_not():
    furuta = sy.Furuta()
    names = [c.name for c in sy.candidates(furuta)]
    assert len(set(names)) == len(names)
    assert {"theta.coulomb", "voltage.delay", "voltage.lag"} <= {*names}
    held = sy.with_parts(furuta, [sy.Coulomb("theta", 1e-3)])
    held = sy.free_parts(held, [sy.Delay("voltage")])
    rest = [c.name for c in sy.candidates(held, windows=True)]
    gone = {"theta.coulomb", "voltage.delay", "voltage.lag"}
    assert {*names} - {*rest} == gone
    for machine in ("furuta", "cartpole", "two_link", "six"):
        bare = machines.bare()[machine]
        for candidate in sy.candidates(bare):
            free = sy.free_parts(bare, [candidate.effect], period=0.02)
            assert free.parameters.names.count(candidate.name) == 1
            assert len(free.parameters) == len(bare.parameters) + 1
