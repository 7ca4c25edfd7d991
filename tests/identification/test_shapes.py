"""Names of curves: shapes of the registry inside a band, and shapes that are not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2gp.identification.missing_physics.curves import Curve
from sim2gp.identification.missing_physics.shapes import (
    addition_of,
    is_nothing,
    name_of,
)
from sim2gp.systems import Coulomb, DeadZone, Spring, UniformRodArm
from sim2gp.systems.effects.tables import PositionTable, VelocityTable

pytestmark = pytest.mark.usefixtures("float64")
AT = np.linspace(-2.0, 2.0, 101)
SD = 0.02


def curve(f: np.ndarray, of: str, seed: int = 0, where: str = "q1") -> Curve:
    """A truth seen through smooth errors of sd 0.02, as a posterior has them."""
    rng = np.random.default_rng(seed)
    places = np.linspace(-2.2, 2.2, 20)
    root = np.exp(-0.5 * ((AT[:, None] - places) / 0.25) ** 2)
    root *= SD / np.linalg.norm(root, axis=1).mean()
    unit = {"q1": "rad", "q1.velocity": "rad/s"}.get(of, "N m")
    mean = f + root @ rng.normal(size=20)
    return Curve(where, of, "N m", unit, ("some",), AT, mean, root)


def test_a_spring_is_named_with_its_value_and_centre():
    """Of 40 posteriors the spring is in 38 or more, and its sd is that of the error."""
    named, errors = 0, []
    for seed in range(40):
        found = name_of(curve(-0.3 * (AT - 0.4), "q1", seed), UniformRodArm())
        if found is None:
            continue
        assert isinstance(found.effect, Spring)
        named += 1
        errors.append((found.magnitude - 0.3) / found.sd)
        assert found.about == pytest.approx(0.4, abs=0.1)
    assert named >= 37
    assert 0.6 < np.std(errors) < 1.4


@pytest.mark.parametrize("seed", range(3))
def test_friction_is_named_up_to_damping(seed: int):
    f = -0.5 * np.tanh(AT / 0.06) + 0.2 * AT
    found = name_of(curve(f, "q1.velocity", seed), UniformRodArm())
    assert found is not None
    assert isinstance(found.effect, Coulomb)
    assert abs(found.magnitude - 0.5) < 4.0 * found.sd + 0.02


def test_a_dead_zone_is_named_with_its_width():
    width = 0.5
    zone, w = DeadZone("torque1", width, 0.05), jnp.asarray(width)
    taken = jax.vmap(lambda u: zone.through(w, u) - u)(jnp.asarray(AT))
    seen = curve(np.asarray(taken) + 0.1 * AT, "torque1", where="torque1")
    found = name_of(seen, UniformRodArm())
    assert found is not None
    assert isinstance(found.effect, DeadZone)
    assert found.magnitude == pytest.approx(width, abs=0.1)
    assert found.unit == "N m"


@pytest.mark.parametrize(
    ("f", "of"),
    [
        (0.3 * np.sin(6.0 * AT), "q1"),
        (-0.3 * np.maximum(AT, 0.0) ** 2, "q1"),
        (0.3 * np.sin(3.0 * AT), "q1.velocity"),
        (0.5 * np.tanh(AT / 0.06), "q1.velocity"),  # it would push
    ],
)
def test_other_shapes_have_no_name_and_become_tables(f: np.ndarray, of: str):
    seen = curve(f, of)
    assert name_of(seen, UniformRodArm()) is None
    assert not is_nothing(seen)
    table = addition_of(seen, None).effect
    assert isinstance(table, PositionTable if of == "q1" else VelocityTable)
    back = jax.vmap(lambda z: table.along(jnp.ones(()), z, z))(jnp.asarray(AT))
    np.testing.assert_allclose(back, seen.mean, rtol=2e-3, atol=1e-6)


def test_what_parameters_do_as_well_is_nothing():
    assert is_nothing(curve(0.0 * AT, "q1"))
    assert is_nothing(curve(0.3 - 0.4 * AT, "q1.velocity"))
    assert not is_nothing(curve(-0.3 * AT, "q1"))


def test_a_spring_about_another_place_is_a_table():
    for centre, kind in ((0.0, Spring), (0.6, PositionTable)):
        seen = curve(-0.3 * (AT - centre), "q1")
        found = name_of(seen, UniformRodArm())
        assert found is not None
        assert isinstance(addition_of(seen, found).effect, kind)
