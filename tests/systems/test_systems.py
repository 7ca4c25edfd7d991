"""The equations of motion against independent mechanics."""

import functools
from pathlib import Path

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagrangians
import machines
from machines import close
from sim2gp import systems as sy
from sim2gp.inference.parameters import parameters_of

pytestmark = pytest.mark.usefixtures("float64")


SEEDS = st.integers(0, 2**31 - 1)


def furuta_forces(p, v, a):
    current = (a[0] - p.motor_constant * v[0]) / p.motor_resistance
    return jnp.stack(
        [
            p.motor_constant * current - p.arm_damping * v[0],
            -p.pendulum_damping * v[1],
        ]
    )


def cartpole_forces(p, v, a):
    Rm, Kg, r, efficiency = 2.6, 3.71, 6.35e-3, 0.9
    force = efficiency * Kg * efficiency * p.motor_constant / (Rm * r)
    force = force * (efficiency * a[0] - Kg * p.motor_constant * v[0] / r)
    return jnp.stack([force - p.cart_damping * v[0], -p.pole_damping * v[1]])


def two_link_forces(p, v, a):
    dry = jnp.stack([p.cf1, p.cf2]) * jnp.tanh(v / 0.05)
    return a - jnp.stack([p.b1, p.b2]) * v - dry


def rods_record(p):
    none = 0.0 * p.m1
    I1, I2 = p.m1 * p.l1**2 / 3, p.m2 * p.l2**2 / 3
    return sy.TwoLinkParams(
        p.m1 * p.l1 / 2, I1, p.m2, p.m2 * p.l2 / 2, I2, p.b1, p.b2, none, none, none
    )


ORACLES = {
    "furuta": (lagrangians.furuta, furuta_forces),
    "cartpole": (lagrangians.cartpole, cartpole_forces),
    "two_link": (lambda p: lagrangians.two_link(p, 0.2, 6.0, 9.81), two_link_forces),
    "six": (
        lambda p: lagrangians.two_link(rods_record(p), p.l1, 1.0, 0.0),
        lambda p, v, a: two_link_forces(rods_record(p), v, a),
    ),
}


@functools.cache
def compared(name):
    """Compiled: accelerations by the system and by Euler-Lagrange."""
    system = machines.bare()[name]
    lagrangian, forces = ORACLES[name]

    def both(tt, s, a):
        p = machines.params_at(system, tt)
        q, v = s[:2], s[2:]
        oracle = lagrangians.acceleration(lagrangian(p), forces(p, v, a), q, v)
        return system.ode(p, s, a), jnp.concatenate([v, oracle])

    return system, jax.jit(both)


@pytest.mark.parametrize("name", ORACLES)
@hypothesis.given(seed=SEEDS)
@hypothesis.settings(max_examples=60)
def test_euler_lagrange(name, seed):
    with jax.enable_x64(True):
        system, both = compared(name)
        ((tt, s, a),) = machines.points(system, 1, seed)
        got, expected = both(tt, s, a)
    close(got, expected, 1e-11)


@pytest.mark.parametrize(
    ("name", "off"),
    [
        ("furuta", {"arm_damping": 0, "pendulum_damping": 0, "motor_constant": 0}),
        ("cartpole", {"cart_damping": 0, "pole_damping": 0, "motor_constant": 0}),
        ("two_link", {"b1": 0, "b2": 0, "cf1": 0, "cf2": 0}),
        ("six", {"b1": 0, "b2": 0}),
    ],
)
def test_energy_is_constant_without_friction_and_input(name, off):
    system = machines.bare()[name]
    p = machines.nominal(system, **off)
    L = ORACLES[name][0](p)
    u = jnp.zeros(len(system.actions))
    s0 = jnp.array([0.1, 2.5, 0.5, -1.0])

    @jax.jit
    def drift(s0):
        def body(s, _):
            return (jax.lax.fori_loop(0, 80, lambda i, s: step(s), s), s)

        step = lambda s: system.step(p, s, u, 0.0005)  # noqa: E731
        path = jax.lax.scan(body, s0, length=100)[1]  # 4 s
        energy = jax.vmap(lambda s: lagrangians.energy(L, s[:2], s[2:]))(path)
        return jnp.max(jnp.abs(energy - energy[0])) / jnp.max(jnp.abs(energy))

    assert drift(s0) < 1e-8


@pytest.mark.parametrize("name", ["furuta", "cartpole", "six"])
def test_rk4_is_of_fourth_order(name):
    system = machines.bare()[name]
    p = machines.nominal(system)
    u = jnp.full(len(system.actions), 0.5)
    s0 = jnp.array([0.1, 2.5, 0.5, -1.0])

    def at(count):
        h = 0.16 / count
        step = lambda i, s: sy.rk4(lambda x, w: system.ode(p, x, w), s, u, h)  # noqa: E731
        return jax.lax.fori_loop(0, count, step, s0)

    exact = at(1024)
    coarse, fine = (float(jnp.max(jnp.abs(at(n) - exact))) for n in (32, 64))
    assert 14.0 < coarse / fine < 18.0


@pytest.mark.parametrize("count", [1, 2, 3, 8])
def test_step_is_rk4_over_the_fewest_allowed_substeps(count):
    system = sy.UniformRodArm()  # substeps of 10 ms at most
    p = system.nominal()
    s, u = jnp.array([0.1, 2.0, 1.0, -2.0]), jnp.array([0.5, -0.2])
    expected = s
    for _ in range(count):
        expected = sy.rk4(lambda x, w: system.ode(p, x, w), expected, u, 0.01)
    np.testing.assert_allclose(system.step(p, s, u, 0.01 * count), expected, rtol=1e-13)


def test_hand_checked_accelerations():
    """By hand from the published constants, at rest, one volt or one newton metre."""
    furuta, cartpole = sy.Furuta(), sy.CartPole()
    one = jnp.ones(1)
    A, B = 0.095 * 0.085**2 / 12 + 0.024 * 0.085**2, 0.024 * 0.0645 * 0.085
    C = 0.024 * 0.129**2 / 3
    for alpha, sign in ((0.0, 1.0), (np.pi, -1.0)):
        s = jnp.array([0.3, alpha, 0.0, 0.0])
        expected = 0.042 / 8.4 / (A * C - B**2) * np.array([C, -sign * B])
        close(furuta.ode(furuta.nominal(), s, one)[2:], expected, 1e-12)
    close(expected, [49.727, 49.149], 1e-4)
    m, l, F = 0.127, 0.16825, 0.9**3 * 3.71 * 7.67e-3 / (2.6 * 6.35e-3)
    assert pytest.approx(1.26, abs=0.005) == F  # N per volt at stall
    J = 0.38 + 0.9 * 3.71**2 * 3.9e-7 / 6.35e-3**2
    for theta, sign in ((0.0, 1.0), (np.pi, -1.0)):
        s = jnp.array([0.1, theta, 0.0, 0.0])
        det = (m + J) * 4 / 3 - m
        expected = np.array([4 / 3 * F / det, -sign * F / (l * det)])
        close(cartpole.ode(cartpole.nominal(), s, one)[2:], expected, 1e-12)
    arm = sy.TwoLink(gravity=9.81)
    p = machines.nominal(arm, Ir=0.0)
    s = jnp.array([np.pi / 2, 0.0, 0.0, 0.0])  # both links level: the largest weight
    weight = 9.81 * np.array([0.15173 + 0.2 * 0.33694 + 0.15783, 0.15783])
    force = arm.forces(p, s[:2], s[2:], jnp.zeros(2))
    close(force, -weight, 1e-12)


def test_upright_eigenvalues():
    """Open loop, upright, published constants, 1/s."""
    for system, expected in (
        (sy.Furuta(), [-18.2, -2.0, 0.0, 14.6]),
        (sy.CartPole(), [-22.4, -6.6, 0.0, 6.5]),
    ):
        up = jnp.array([0.0, np.pi, 0.0, 0.0])
        slope = jax.jit(jax.jacfwd(system.ode, 1))(system.nominal(), up, jnp.zeros(1))
        eigenvalues = np.sort(np.linalg.eigvals(np.asarray(slope)).real)
        np.testing.assert_allclose(eigenvalues, expected, atol=0.05)


@pytest.mark.parametrize("name", ["furuta", "cartpole", "six"])
@hypothesis.given(seed=SEEDS)
@hypothesis.settings(max_examples=50)
def test_inertia_is_positive_definite_anywhere_in_the_box(name, seed):
    with jax.enable_x64(True):
        system = machines.bare()[name]
        rng = np.random.default_rng(seed)
        tt = jnp.asarray(10.0 * rng.standard_normal(len(system.parameters)))
        q = jnp.asarray(rng.uniform(-7.0, 7.0, 2))
        M = np.asarray(system.mass_matrix(machines.params_at(system, tt), q))
    assert M[0, 0] > 0.0
    assert np.linalg.det(M) > 0.0
    np.testing.assert_array_equal(M, M.T)


@hypothesis.given(seed=SEEDS)
@hypothesis.settings(max_examples=50)
def test_inertia_of_any_physical_arm_is_positive_definite(seed):
    """Two rigid links with rotors: centre anywhere, some spin inertia."""
    rng = np.random.default_rng(seed)
    m1, m2, Ir = 10.0 ** rng.uniform(-2, 2, 3) * [1, 1, 1e-4]
    r1, r2 = rng.uniform(-0.5, 0.5, 2)
    spin1, spin2 = 10.0 ** rng.uniform(-6, 0, 2)
    with jax.enable_x64(True):
        arm = sy.TwoLink(gear_ratio=float(rng.uniform(1, 100)))
        p = machines.nominal(
            arm,
            m1r1=m1 * r1,
            I1=m1 * r1**2 + spin1,
            m2=m2,
            m2r2=m2 * r2,
            I2=m2 * r2**2 + spin2,
            Ir=Ir,
        )
        q = jnp.asarray(rng.uniform(-7.0, 7.0, 2))
        M = np.asarray(arm.mass_matrix(p, q))
    assert M[0, 0] > 0.0
    assert np.linalg.det(M) > 0.0


def published(path: Path) -> dict[str, float]:
    lines = (line.split(":") for line in path.read_text().splitlines() if ":" in line)
    return {key.strip(): float(value) for key, value in lines}


@pytest.mark.parametrize("model", ["1.0", "1.1", "2.0", "3.0"])
def test_published_arm(shared_data, model):
    """``M qdd + C qd - G + F = u`` with the lab's own parameters of its arm."""
    folder = shared_data / "double_pendulum" / "published_parameters"
    k = published(folder / f"c1_model_{model}.yml")
    arm = sy.TwoLink(
        gravity=k["g"],
        length1=k["l1"],
        gear_ratio=k["gr"],
        coulomb_shape="arctangent",
        coulomb_width=0.01,
    )
    p = machines.nominal(
        arm,
        m1r1=k["m1"] * k["r1"],
        I1=k["I1"],
        m2=k["m2"],
        m2r2=k["m2"] * k["r2"],
        I2=k["I2"],
        b1=k["b1"],
        b2=k["b2"],
        cf1=k["cf1"] * np.pi / 2,
        cf2=k["cf2"] * np.pi / 2,
        Ir=k["Ir"],
    )
    ode = jax.jit(arm.ode)
    rng = np.random.default_rng(0)
    for _ in range(200):
        q, v = rng.uniform(-np.pi, np.pi, 2), rng.uniform(-8, 8, 2)
        u = rng.uniform(-6, 6, 2)
        s1, s12 = np.sin(q[0]), np.sin(q[0] + q[1])
        h, gr2 = k["m2"] * k["l1"] * k["r2"], k["gr"] ** 2 * k["Ir"]
        M12 = k["I2"] + h * np.cos(q[1]) - k["gr"] * k["Ir"]
        M11 = k["I1"] + k["I2"] + k["m2"] * k["l1"] ** 2 + 2 * h * np.cos(q[1])
        M = np.array([[M11 + gr2 + k["Ir"], M12], [M12, k["I2"] + gr2]])
        hs = h * np.sin(q[1])
        C = np.array([[-2 * hs * v[1], -hs * v[1]], [hs * v[0], 0.0]])
        G2 = -k["m2"] * k["g"] * k["r2"] * s12
        G1 = -(k["m1"] * k["r1"] + k["m2"] * k["l1"]) * k["g"] * s1 + G2
        F = np.array([k["b1"], k["b2"]]) * v
        F += np.array([k["cf1"], k["cf2"]]) * np.arctan(100 * v)
        expected = np.linalg.solve(M, u - C @ v + [G1, G2] - F)
        got = ode(p, jnp.asarray([*q, *v]), jnp.asarray(u))
        close(got, [*v, *expected], 1e-11)


def test_the_nominal_arm_is_the_published_one(shared_data):
    folder = shared_data / "double_pendulum" / "published_parameters"
    k = published(folder / "c1_model_2.0.yml")
    expected = {
        **{name: k[name] for name in ("I1", "m2", "I2", "b1", "b2", "Ir")},
        "m1r1": k["m1"] * k["r1"],
        "m2r2": k["m2"] * k["r2"],
        "cf1": k["cf1"] * np.pi / 2,
        "cf2": k["cf2"] * np.pi / 2,
    }
    assert sy.TwoLink().parameters.nominal() == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("locked", [(True, False), (False, True), (True, True)])
def test_locked_joints_stay(locked):
    arm = sy.UniformRodArm(locked=locked)
    p = arm.nominal()
    s, u = jnp.array([0.4, 1.0, 3.0, 2.0]), jnp.array([0.7, 0.3])
    rate = arm.ode(p, s, u)
    de, alpha = 0.8 * 0.4**2 / 3, np.cos(1.0)
    whole = 0.5**2 / 3 + 0.8 * 0.5**2 + de + 2 * 0.5 * 0.8 * 0.5 * 0.4 * alpha
    expected = {
        (True, False): [0.0, 2.0, 0.0, (0.3 - 0.1 * 2.0) / de],
        (False, True): [3.0, 0.0, (0.7 - 0.1 * 3.0) / whole, 0.0],
        (True, True): [0.0, 0.0, 0.0, 0.0],
    }
    np.testing.assert_allclose(rate, expected[locked], rtol=1e-12)


def test_uniform_rods_are_a_two_link_arm():
    rods = machines.bare()["six"]
    for tt, s, a in machines.points(rods, 20, 3):
        p = machines.params_at(rods, tt)
        arm = sy.TwoLink(length1=float(p.l1))
        got = rods.ode(p, s, a)
        close(got, arm.ode(rods.as_two_link(p), s, a), 1e-12)


@pytest.mark.parametrize(
    ("system", "rank"),
    [
        (sy.Furuta(), 6),
        (sy.CartPole(), 5),
        (sy.UniformRodArm(parameters_of(sy.UniformRodParams)), 5),
        (sy.UniformRodArm(), 4),
        (sy.TwoLink(gravity=9.81), 9),
    ],
)
def test_structural_rank(system, rank):
    """Directions in the constants that a motion can show at all (accelerations)."""
    _, s, a = machines.batch(system, 300, 1)
    tt = jnp.zeros(len(system.parameters))
    slope = jax.jacfwd(lambda t, s, a: system.ode(machines.params_at(system, t), s, a))
    J = jax.jit(jax.vmap(slope, (None, 0, 0)))(tt, s, a).reshape(-1, len(tt))
    singular = np.linalg.svd(np.asarray(J), compute_uv=False)
    assert np.sum(singular > 1e-10 * singular[0]) == rank
