"""Missing forces: their features, their prior, and what they do to machines."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rail_mass import DT, rail_mass
from sim2gp.systems import Furuta, free_parts
from sim2gp.systems.effects.bases import Gap, Sign, periodic, smooth
from sim2gp.systems.effects.forces import MissingForce, MissingInput
from sim2gp.systems.effects.missing import missing_forces
from sim2gp.systems.effects.scales import drives
from sim2gp.systems.machine import Machine

pytestmark = pytest.mark.usefixtures("float64")
RNG = np.random.default_rng(0)
BOX = {
    "theta": (-2.0, 2.0),
    "theta.velocity": (-15.0, 15.0),
    "alpha.velocity": (-25.0, 25.0),
    "voltage": (-5.0, 5.0),
}
BASES = {
    "smooth": smooth(-2.0, 2.0),
    "periodic": periodic(3),
    "sign": Sign((0.2,)),
    "signs": Sign((0.1, 0.4, 1.6)),
}


def features(basis, z):
    """Each function alone."""
    eye = jnp.eye(len(basis.sds))
    return jnp.stack([basis.value(w, z) for w in eye])


def test_features_are_sines_on_the_interval_and_constant_beyond():
    basis = smooth(-1.0, 3.0, count=5, reach=2.0)  # from -3 to 5
    for z in (-2.5, 0.0, 0.4, 4.9):
        k = np.arange(1, 6)
        expected = np.sin(np.pi * k * (z + 3.0) / 8.0)
        np.testing.assert_allclose(
            features(basis, jnp.asarray(z)), expected, atol=1e-14
        )
    for z in (-7.0, 5.0, 9.0):
        np.testing.assert_allclose(features(basis, jnp.asarray(z)), 0.0, atol=1e-14)


def test_harmonics_are_those_of_the_angle():
    z = 0.83
    found = features(periodic(3), jnp.asarray(z))
    k = np.arange(1, 4)
    np.testing.assert_allclose(found, [*np.sin(k * z), *np.cos(k * z)], atol=1e-14)
    again = features(periodic(3), jnp.asarray(z + 2.0 * np.pi))
    np.testing.assert_allclose(found, again, atol=1e-13)


@pytest.mark.parametrize("name", BASES)
@pytest.mark.parametrize("z", [-7.0, -0.1, 0.3, 1.9])
def test_slopes_are_derivatives(name, z):
    basis, z = BASES[name], jnp.asarray(z)
    x = jnp.asarray(RNG.normal(size=len(basis.sds)))
    slope = jax.grad(lambda z: basis.value(x, z))(z)
    assert float(basis.slope(x, z)) == pytest.approx(float(slope), abs=1e-12)


def test_the_prior_is_a_squared_exponential_where_the_machine_moves():
    """Solin and Sarkka 2020: the features' covariance is the kernel's."""
    basis = smooth(-1.0, 1.0, count=12, reach=3.0, length=0.8)
    at = np.linspace(-1.0, 1.0, 9)
    Phi = np.stack([features(basis, jnp.asarray(z)) for z in at])
    K = (Phi * np.asarray(basis.sds) ** 2) @ Phi.T
    exact = np.exp(-0.5 * ((at[:, None] - at[None]) / 0.8) ** 2)
    np.testing.assert_allclose(K, exact, atol=2e-3)


def forced():
    """A force of each kind on both joints, and of both on the input, with weights."""
    return [
        dataclasses.replace(part, weights=weights(part.basis, 0.3 * part.magnitude))
        for part in missing_forces(Furuta(), BOX)
    ]


def weights(basis, scale=1.0):
    return tuple((scale * RNG.normal(size=len(basis.sds))).tolist())


def test_forces_stand_in_the_equations_of_motion():
    """``M dv/dt`` gains the functions' values, and the input what its own add."""
    parts, plant = forced(), Furuta()
    machine = Machine(plant, effects=parts)
    params = machine.nominal()
    s, a = jnp.asarray([0.4, -1.1, 2.0, -3.0]), jnp.asarray([1.3])
    h = 1e-5
    got = (machine.flow(params, s, a, h) - machine.flow(params, s, a, -h)) / (2.0 * h)
    u, force = a[0], np.zeros(2)
    for part in parts:
        w = part.own({k: jnp.asarray(x) for k, x in part.values.items()})
        if isinstance(part, MissingInput):
            u = u + part.basis.value(w, u)
            continue
        i = plant.joint(part.where)
        force[i] += float(part.basis.value(w, s[i + 2] if part.of_velocity else s[i]))
    M = np.asarray(plant.mass_matrix(params.plant, s[:2]))
    f = np.asarray(plant.forces(params.plant, s[:2], s[2:], u[None])) + force
    np.testing.assert_allclose(got[2:], np.linalg.solve(M, f), rtol=1e-7)


def test_derivatives_are_those_of_differences():
    """By each weight and by the state, through a step; they are rules of our own."""
    machine = free_parts(Furuta(), missing_forces(Furuta(), BOX))
    prior = machine.parameters.prior()
    tt = prior.mean + prior.scale @ (0.3 * RNG.normal(size=prior.mean.size))
    s, a = jnp.asarray([0.4, -1.1, 2.0, -3.0]), jnp.asarray([1.3])

    @jax.jit
    def f(x):
        at = tt + prior.scale @ x[4:]
        return machine.transition(at, s + x[:4], a, 0.02)

    zero = jnp.zeros(4 + tt.size)
    J = jax.jacfwd(f)(zero)
    for k in RNG.choice(zero.size, 12, replace=False):
        step = zero.at[k].set(1e-6)
        slope = (f(step) - f(-step)) / 2e-6
        np.testing.assert_allclose(J[:, k], slope, atol=1e-7, rtol=1e-5)
    np.testing.assert_allclose(jax.jacrev(f)(zero), J, atol=1e-11)


def test_a_draw_of_float32_follows_its_direction_as_in_float64():
    """Planning takes one direction of all weights, by a rule for that alone."""
    machine = free_parts(Furuta(), missing_forces(Furuta(), BOX))
    prior = machine.parameters.prior()
    tt = prior.mean + prior.scale @ (0.3 * RNG.normal(size=prior.mean.size))
    delta = prior.scale @ (0.1 * RNG.normal(size=tt.size))
    s, a = jnp.asarray([0.4, -1.1, 2.0, -3.0]), jnp.asarray([1.3])

    @jax.jit
    def along(tt, delta, s, a):
        f = lambda tt: machine.transition(tt, s, a, 0.02)  # noqa: E731
        return jax.jvp(f, (tt,), (delta,))[1]

    exact = along(tt, delta, s, a)
    single = along(*(x.astype(jnp.float32) for x in (tt, delta, s, a)))
    assert single.dtype == jnp.float32
    size = float(jnp.max(jnp.abs(exact)))
    np.testing.assert_allclose(single, exact, atol=1e-4 * size)


def test_a_function_is_pushed_as_if_the_force_were_its_own():
    """Kicks around a plant without equations: of second order in the step."""
    plant = rail_mass()
    x = plant.states[0].name
    basis = smooth(-1.0, 1.0)
    spring, drag = weights(basis), weights(basis, 0.4)
    machine = Machine(
        plant,
        effects=[
            MissingForce(x, 1.0, basis, weights=spring),
            MissingForce(
                x, 1.0, basis, of_velocity=True, what="velocity_force", weights=drag
            ),
        ],
    )
    params, s, a = machine.nominal(), jnp.asarray([0.3, -0.5]), jnp.asarray([0.2])

    def error(h):
        fine, coarse = s, machine.flow(params, s, a, h)
        for _ in range(64):
            fine = machine.flow(params, fine, a, h / 64)
        return float(jnp.max(jnp.abs(fine - coarse)))

    assert error(0.5 * DT) < error(DT) / 5.0  # local error of third order

    h = 1e-4
    got = (machine.flow(params, s, a, h) - plant.flow(params.plant, s, a, h)) / h
    pairs = zip((spring, drag), s, strict=True)
    added = sum(float(basis.value(jnp.asarray(w), z)) for w, z in pairs)
    assert float(got[1]) == pytest.approx(added, rel=1e-3)


def test_scales_are_the_motor_and_the_weight():
    """Furuta's stall torque at 5 V, and its pendulum's weight half a radian away."""
    found = drives(Furuta())
    assert found["theta"].force == pytest.approx(0.042 * 5.0 / 8.4)
    weight = 0.024 * 9.81 * 0.5 * 0.129 * np.sin(0.5)
    assert found["alpha"].force == pytest.approx(weight)
    M = Furuta().mass_matrix(Furuta().nominal(), jnp.zeros(2))
    assert found["theta"].acceleration == pytest.approx(
        0.042 * 5.0 / 8.4 / float(M[0, 0])
    )


def test_weights_are_groups_of_one_function_each():
    machine = free_parts(Furuta(), missing_forces(Furuta(), BOX))
    groups = machine.parameters.groups
    assert len(groups) == 8  # three a joint, two an input
    every = np.concatenate(list(groups.values()))
    shapes = [k for k, p in enumerate(machine.parameters.free) if p.shape]
    assert [machine.parameters.names[k] for k in shapes] == [
        f"voltage.dead_zone.{x}" for x in ("width", "softness")
    ]
    assert sorted([*every, *shapes]) == list(range(8, len(machine.parameters)))
    assert len(machine.parameters.ungrouped()) == 8


def test_a_gap_takes_the_input_away_below_its_width():
    gap, w = Gap(0.5), 0.8
    for share in (1.0, 0.5):
        x = jnp.asarray([share * w, w, 0.05])
        for u, there in ((0.4, 1.0), (-0.6, 1.0), (1.2, 0.0)):
            found = float(gap.value(x, jnp.asarray(u)))
            assert found == pytest.approx(-share * u * there, abs=6e-3)


def test_friction_of_logs_slips_at_several_widths():
    """From the steepest to a tenth of the velocities' range, each four times as wide.

    Their span follows friction of any width in between, to a tenth of its level.
    """
    found = missing_forces(Furuta(), BOX, fine=True)
    bases = {f.where: f.basis for f in found if f.what == "dry_friction"}
    for joint, basis in bases.items():
        low, high = BOX[f"{joint}.velocity"]
        widths = np.asarray(basis.widths)
        assert len(widths) > 1
        np.testing.assert_allclose(widths[1:] / widths[:-1], 4.0)
        assert widths[-1] < 0.1 * (high - low) <= 4.0 * widths[-1]
        v = np.linspace(low, high, 4001)
        Phi = np.asarray(basis.features(v))
        for width in np.geomspace(widths[0], widths[-1], 9):
            wanted = -np.tanh(v / width)
            rest = wanted - Phi @ np.linalg.lstsq(Phi, wanted, rcond=None)[0]
            assert np.max(np.abs(rest)) < 0.1
    box = BOX | {"alpha": (-3.0, 3.0)}
    closely = missing_forces(Furuta(), box, fine=True, closely=True)
    for f in closely:
        if f.what == "dry_friction":
            assert f.basis.widths == bases[f.where].widths[:1]
