"""The mismatch catalogue: each effect against mechanics or its defining formula."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagrangians
import machines
from machines import against
from sim2gp import systems as sy
from sim2gp.systems import STRENGTHS
from tests.systems.test_systems import cartpole_forces, furuta_forces

pytestmark = pytest.mark.usefixtures("float64")


def test_rod_inertia_is_the_true_rod():
    lagrangian = lambda p: lagrangians.furuta(p, full_rod=True)  # noqa: E731
    against("furuta", sy.RodInertia(), lagrangian, furuta_forces)


def test_tilted_rail():
    lagrangian = lambda p: lagrangians.cartpole(p, tilt=0.05)  # noqa: E731
    against("cartpole", sy.RailTilt(magnitude=0.05), lagrangian, cartpole_forces)


def test_pole_whose_centre_is_not_its_middle():
    effect = sy.PoleGeometry(magnitude=0.02)

    def lagrangian(p):
        return lagrangians.cartpole(p, centre=p.pole_half_length + 0.02)

    against("cartpole", effect, lagrangian, cartpole_forces)


with jax.enable_x64(True):
    q, v, a = jnp.array([0.7, 2.0]), jnp.array([-1.5, 4.0]), jnp.array([1.1])

FORMULAS = {
    "coulomb": (sy.Coulomb("theta", 3e-3), [3e-3 * np.tanh(1.5 / 0.05), 0.0]),
    "slow": (sy.Coulomb("alpha", 3e-3, width=8.0), [0.0, -3e-3 * np.tanh(0.5)]),
    "spring": (sy.Spring("theta", 4e-3), [-4e-3 * 0.7, 0.0]),
    "drag": (sy.Drag("alpha", 1e-5), [0.0, -1e-5 * 16.0]),
    "drag_back": (sy.Drag("theta", 1e-5), [1e-5 * 2.25, 0.0]),
}


@pytest.mark.parametrize("name", FORMULAS)
def test_added_forces(name):
    effect, expected = FORMULAS[name]
    bare = sy.Furuta()
    system = sy.Machine(bare, [effect])
    p = bare.nominal()
    M, f = machines.equations(system, machines.with_parts(system, p), q, v, a)
    added = f - bare.forces(p, q, v, a)
    np.testing.assert_allclose(added, expected, rtol=1e-9, atol=1e-15)
    np.testing.assert_array_equal(M, bare.inertia(p, q))


def test_a_dead_zone_is_on_the_input():
    bare = sy.Furuta()
    system = sy.Machine(bare, [sy.DeadZone("voltage", 1.0)])
    s = jnp.concatenate([q, v])
    u = 1.1 / (1.0 + jnp.exp(-jnp.array([0.1 / 0.05])))
    got = system.flow(machines.with_parts(system, bare.nominal()), s, a, 0.002)
    np.testing.assert_allclose(got, bare.flow(bare.nominal(), s, u, 0.002), rtol=1e-12)


def test_rail_friction():
    bare = sy.CartPole()
    system = sy.Machine(bare, [sy.RailFriction(magnitude=0.1)])
    p = bare.nominal()
    known = machines.with_parts(system, p)
    for speed in (-1.5, 0.004):
        w = jnp.array([speed, 4.0])
        added = machines.equations(system, known, q, w, a)[1] - bare.forces(p, q, w, a)
        weight = (0.38 + 0.127) * 9.81
        expected = [-0.1 * weight * np.tanh(speed / 0.01), 0.0]
        np.testing.assert_allclose(added, expected, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("machine", ["furuta", "cartpole"])
def test_no_magnitude_no_effect(machine):
    """Every effect vanishes with its magnitude; the dead zone but for its smoothing."""
    bare = machines.bare()[machine]
    for what in sy.catalogue(machine):
        effect = sy.effect(machine, what, "strong")
        if isinstance(effect, sy.Delay):
            continue
        system = sy.Machine(bare, [effect])
        p = machines.nominal(system, **{effect.name: 0.0})
        u = jnp.array([3.0])
        s = jnp.concatenate([q, v])
        got, plain = (
            system.flow(p, s, u, 0.002),
            bare.flow(p.plant, s, u, 0.002),
        )
        np.testing.assert_allclose(got, plain, rtol=1e-12)
        u = jnp.array([0.8])  # inside the dead zone
        known = machines.with_parts(system, p.plant)
        got, plain = system.flow(known, s, u, 1e-3), bare.flow(p.plant, s, u, 1e-3)
        assert jnp.max(jnp.abs(got - plain)) > 1e-6, what


def test_catalogue_is_registered_at_three_strengths():
    """The figures that comparisons are registered with."""
    F = {w: [sy.effect("furuta", w, k).magnitude for k in STRENGTHS] for w in
         sy.catalogue("furuta")}  # fmt: skip
    C = {w: [sy.effect("cartpole", w, k).magnitude for k in STRENGTHS] for w in
         sy.catalogue("cartpole")}  # fmt: skip
    assert STRENGTHS == ("mild", "middle", "strong")
    assert F["coulomb"][::2] == [1.5e-3, 4e-3]
    assert F["dead_zone"][::2] == [0.65, 1.2]
    assert F["spring"][::2] == [2e-3, 1e-2]
    assert F["delay"][::2] == [0.01, 0.02]
    assert F["rod_inertia"] == [1.0, 1.0, 1.0]
    assert C["coulomb"][::2] == [0.02, 0.1]
    assert C["dead_zone"][::2] == [0.5, 1.0]
    assert C["tilt"][1] == pytest.approx(np.radians(1.0))
    for strengths in (*F.values(), *C.values()):
        assert strengths == sorted(strengths)


def test_a_magnitude_is_a_constant_like_any_other():
    effect = sy.Spring("theta", 4e-3)
    fixed = sy.Machine(sy.Furuta(), [effect])
    assert dict(fixed.parameters.fixed) == {"theta.spring": 4e-3}
    free = sy.free_parts(sy.Furuta(), [effect])
    assert free.parameters.names[-1] == "theta.spring"
    assert free.parameters.units[-1] == "N m/rad"
    tt = free.parameters.prior().mean
    s = jnp.concatenate([q, v])
    slope = jax.jacfwd(lambda t: free.transition(t, s, a, 0.02))(tt)
    assert float(jnp.max(jnp.abs(slope[:, -1]))) > 0.0
    tt = tt.at[-1].set(4e-3)
    np.testing.assert_allclose(
        free.transition(tt, s, a, 0.02),
        fixed.transition(tt[:-1], s, a, 0.02),
        rtol=1e-12,
    )


def test_effects_add_up_and_nest():
    bare = sy.Furuta()
    one, two = sy.Spring("theta", 4e-3), sy.Drag("alpha", 1e-5)
    both, nested = (
        sy.Machine(bare, [one, two]),
        sy.with_parts(sy.Machine(bare, [one]), [two]),
    )
    s = jnp.concatenate([q, v])
    np.testing.assert_array_equal(
        both.flow(both.nominal(), s, a, 0.01), nested.flow(nested.nominal(), s, a, 0.01)
    )
    assert sy.with_parts(bare, []) is bare


def test_units():
    furuta, cart = sy.Furuta(), sy.CartPole()
    assert sy.Coulomb("theta", 0.0).unit(furuta) == "N m"
    assert sy.Coulomb("x", 0.0).unit(cart) == "N"
    assert sy.Spring("x", 0.0).unit(cart) == "N/m"
    assert sy.Drag("x", 0.0).unit(cart) == "N s^2/m^2"
    assert sy.Drag("theta", 0.0).unit(furuta) == "N m s^2/rad^2"
    assert sy.DeadZone("voltage", 0.0).unit(furuta) == "V"
