"""Forces as tables: against laws that a table holds exactly, and read from a file."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

from sim2gp.errors import InputError
from sim2gp.project import load_project
from sim2gp.systems import Candidate, Furuta, Spring, with_parts
from sim2gp.systems.effects.registry import possible
from sim2gp.systems.effects.tables import InputTable, PositionTable, VelocityTable

pytestmark = pytest.mark.usefixtures("float64")
FRICTION = ((-4.0, 1.0), (-0.1, 0.6), (0.1, -0.6), (4.0, -1.0))
LINE = ((-3.0, 0.012), (3.0, -0.012))
TEXT = """system = "furuta"
[effects.theta.position_table]
points = [[-3.0, 0.012], [3.0, -0.012]]
[effects.voltage]
input_table = {points = [[-1, 0], [1, 0.5]], mean = 1.0, sd = 0.1}
"""


def flow(machine, s, u):
    known = machine.plant.parameters.nominal() | dict(machine.parameters.fixed)
    record = machine.record({k: jnp.asarray(v, float) for k, v in known.items()})
    return machine.flow(record, jnp.asarray(s), jnp.asarray([u]), 0.02)


def test_a_line_is_a_spring_and_a_table_of_an_input_is_its_value():
    s = [0.7, 0.4, -2.0, 3.0]
    spring = with_parts(Furuta(), [Spring("theta", 4e-3)])
    table = with_parts(Furuta(), [PositionTable("theta", 1.0, LINE)])
    np.testing.assert_allclose(flow(table, s, 1.0), flow(spring, s, 1.0), rtol=1e-12)
    bare = with_parts(Furuta(), [Spring("theta", 0.0)])
    points = ((-1.0, 0.0), (1.0, 0.5))
    added = with_parts(Furuta(), [InputTable("voltage", 2.0, points)])
    # Twice the table: 0.8 V at 0.6 V, and 1 V beyond its end.
    for u, more in ((0.6, 0.8), (3.0, 1.0)):
        wanted = flow(bare, s, u + more)
        np.testing.assert_allclose(flow(added, s, u), wanted, rtol=1e-12)


@pytest.mark.parametrize("v0", [0.05, -0.08, 2.0, 6.0])
def test_a_kick_of_a_table_is_its_differential_equation(v0):
    """Within one line it is exact; over several, of second order."""
    table = VelocityTable("theta", 1.0, FRICTION)
    x = jnp.ones(())

    def rate(t, v):
        return [float(table.along(x, x, jnp.asarray(v[0])))]

    wanted = scipy.integrate.solve_ivp(rate, (0.0, 0.02), [v0], rtol=1e-10)
    found = table.accelerated(x, x, jnp.asarray(v0), jnp.asarray(0.02))
    assert float(found) == pytest.approx(wanted.y[0, -1], rel=1e-6)
    slope = jax.grad(table.looked_up)(jnp.asarray(v0))
    assert float(table.slope(jnp.asarray(v0))) == pytest.approx(float(slope))


def test_a_file_states_tables(tmp_path: Path):
    file = tmp_path / "p.toml"
    file.write_text(TEXT)
    machine = load_project(file).system
    assert dict(machine.parameters.fixed)["theta.position_table"] == 1.0
    free = machine.parameters["voltage.input_table"]
    assert (free.mean, free.sd, free.unit) == (1.0, 0.1, "1")
    by_hand = with_parts(
        Furuta(),
        [
            PositionTable("theta", 1.0, LINE),
            InputTable("voltage", 1.0, ((-1.0, 0.0), (1.0, 0.5))),
        ],
    )
    assert machine.effects == by_hand.effects


@pytest.mark.parametrize(
    ("points", "code"),
    [
        ("[]", "E148"),
        ("[[0.0, 1.0]]", "E148"),
        ("[[0.0, 1.0], [0.0, 2.0]]", "E148"),
        ("[[1.0, 1.0], [0.0, 2.0]]", "E148"),
        (str([[float(k), 0.0] for k in range(1001)]), "E148"),
        ("[[0.0, 1.0], [1.0]]", "E160"),
        ("[[0.0, nan], [1.0, 0.0]]", "E160"),
        ('[["0", 1.0], [1.0, 0.0]]', "E160"),
        ('"0, 1"', "E160"),
    ],
)
def test_points_that_are_no_table_are_refused(points, code, tmp_path: Path):
    file = tmp_path / "p.toml"
    file.write_text(
        f'system = "furuta"\n[effects.theta.velocity_table]\npoints = {points}'
    )
    with pytest.raises(InputError) as caught:
        load_project(file)
    assert caught.value.code == code
    assert "p.toml" in str(caught.value)


def test_tables_are_where_their_variable_is():
    assert possible(Furuta(), "position_table", "theta")
    assert possible(Furuta(), "input_table", "voltage")
    assert not possible(Furuta(), "position_table", "voltage")
    assert not possible(Furuta(), "input_table", "theta")
    assert Candidate(PositionTable("theta", 1.0)).name == "theta.position_table"
