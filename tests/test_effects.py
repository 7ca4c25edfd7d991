"""The mismatch catalogue: each effect against mechanics or its defining formula."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagrangians
import machines
from machines import against
from sim2gp import systems as sy
from sim2gp.errors import InputError
from sim2gp.systems import STRENGTHS
from test_systems import cartpole_forces, furuta_forces

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
    "dead_zone": (
        sy.DeadZone("voltage", 1.0),
        [0.042 / 8.4 * 1.1 * (1 / (1 + np.exp(-0.1 / 0.05)) - 1), 0.0],
    ),
}


@pytest.mark.parametrize("name", FORMULAS)
def test_added_forces(name):
    effect, expected = FORMULAS[name]
    bare = sy.Furuta()
    system = sy.Perturbed(bare, [effect])
    p = bare.nominal()
    added = system.forces(system.with_effects(p), q, v, a) - bare.forces(p, q, v, a)
    np.testing.assert_allclose(added, expected, rtol=1e-9, atol=1e-15)
    same = system.mass_matrix(system.with_effects(p), q)
    np.testing.assert_array_equal(same, bare.mass_matrix(p, q))


def test_rail_friction():
    bare = sy.CartPole()
    system = sy.Perturbed(bare, [sy.RailFriction(magnitude=0.1)])
    p = bare.nominal()
    for speed in (-1.5, 0.004):
        w = jnp.array([speed, 4.0])
        added = system.forces(system.with_effects(p), q, w, a) - bare.forces(p, q, w, a)
        weight = (0.38 + 0.127) * 9.81
        expected = [-0.1 * weight * np.tanh(speed / 0.01), 0.0]
        np.testing.assert_allclose(added, expected, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("machine", ["furuta", "cartpole"])
def test_no_magnitude_no_effect(machine):
    """Every effect vanishes with its magnitude; the dead zone but for its smoothing."""
    bare = machines.bare()[machine]
    for what in sy.catalogue(machine):
        effect = sy.effect(machine, what, "strong")
        if isinstance(effect, sy.InputDelay):
            continue
        system = sy.Perturbed(bare, [effect])
        p = machines.nominal(system, **{effect.name: 0.0})
        u = jnp.array([3.0])
        s = jnp.concatenate([q, v])
        got, plain = system.ode(p, s, u), bare.ode(p.system, s, u)
        np.testing.assert_allclose(got, plain, rtol=1e-12)
        u = jnp.array([0.8])  # inside the dead zone
        got, plain = (
            system.ode(system.with_effects(p.system), s, u),
            bare.ode(p.system, s, u),
        )
        assert jnp.max(jnp.abs(got - plain)) > 1e-3, what


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
    fixed = sy.Perturbed(sy.Furuta(), [effect])
    assert dict(fixed.parameters.fixed) == {"theta.spring": 4e-3}
    free = sy.Perturbed(sy.Furuta(), [effect], free=True)
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
        sy.Perturbed(bare, [one, two]),
        sy.Perturbed(sy.Perturbed(bare, [one]), [two]),
    )
    s = jnp.concatenate([q, v])
    np.testing.assert_array_equal(
        both.ode(both.nominal(), s, a), nested.ode(nested.nominal(), s, a)
    )
    assert sy.perturb(bare, []) is bare


def test_units():
    furuta, cart = sy.Furuta(), sy.CartPole()
    assert sy.Coulomb("theta", 0.0).unit(furuta) == "N m"
    assert sy.Coulomb("x", 0.0).unit(cart) == "N"
    assert sy.Spring("x", 0.0).unit(cart) == "N/m"
    assert sy.Drag("x", 0.0).unit(cart) == "N s^2/m^2"
    assert sy.Drag("theta", 0.0).unit(furuta) == "N m s^2/rad^2"
    assert sy.DeadZone("voltage", 0.0).unit(furuta) == "V"


def test_mistakes_are_named():
    with pytest.raises(InputError, match=r"E103.*theta"):
        sy.Perturbed(sy.Furuta(), [sy.Spring("thta", 1.0)])
    with pytest.raises(InputError, match="E145"):
        sy.Perturbed(sy.Furuta(), [sy.Spring("theta", 1.0), sy.Spring("theta", 2.0)])
    with pytest.raises(InputError, match=r"E145.*spring"):
        sy.effect("furuta", "sprng", "mild")
    with pytest.raises(InputError, match=r"E145.*strong"):
        sy.effect("furuta", "spring", "stron")
    with pytest.raises(InputError, match=r"E145.*furuta"):
        sy.catalogue("furutta")
