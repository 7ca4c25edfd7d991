"""Inputs that share one constant: a machine with ties, and patterns in a project."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2gp import systems as sy
from sim2gp.errors import InputError
from sim2gp.project import load_project
from sim2gp.systems import effects
from sim2gp.types import in_float64

START = np.asarray([0.3, -0.2, 0.5, -0.4])
DT = 0.02
ALIKE = {"torque1.gain": 1.3, "torque1.offset": 0.1, "torque1.delay": 0.027}


def arm(ties: dict[str, str], free: tuple[str, ...]) -> sy.AbstractSystem:
    """A two-link arm with both drives' constants open, each or shared."""
    plant = sy.TwoLink()
    parts = sy.neutral_actuators(plant.actions, ties)
    box = {p.name: p.parameter(plant) for p in parts if p.name in free}
    late = {n: sy.Delay(n.split(".")[0], 0.05).parameter(plant) for n in free}
    box |= {n: p for n, p in late.items() if n.endswith("delay")}
    return sy.with_parts(plant, parts, box, period=DT)


def after_two_periods(system: sy.AbstractSystem, values: dict[str, float]):
    """The state, as a function of these constants."""
    rng = np.random.default_rng(0)
    past = jnp.asarray(rng.uniform(-0.2, 0.2, len(system.states) - 4))
    nominal = {k: jnp.asarray(v) for k, v in system.parameters.nominal().items()}

    def of(x: dict[str, jax.Array]) -> jax.Array:
        s = jnp.concatenate([jnp.asarray(START), past])
        for a in ([0.2, -0.1], [-0.3, 0.25]):
            s = system.step(system.record(nominal | x), s, jnp.asarray(a), DT)
        return s[:4]

    x = {k: jnp.asarray(v) for k, v in values.items()}
    return of(x), jax.jacobian(of)(x)


@pytest.mark.nightly
@in_float64
def test_a_shared_constant_is_both_inputs_own() -> None:
    """The flow is that of two equal constants, its slope the sum of their two."""
    each = {f"torque{i}.{k.split('.')[1]}": v for k, v in ALIKE.items() for i in (1, 2)}
    apart = arm({}, tuple(each))
    tied = arm({"torque2": "torque1"}, tuple(ALIKE))
    assert set(apart.parameters.names) - set(tied.parameters.names) == {
        *("torque2.gain", "torque2.offset", "torque2.delay"),
    }
    out, slopes = after_two_periods(tied, ALIKE)
    expected, both = after_two_periods(apart, each)
    np.testing.assert_allclose(out, expected, rtol=1e-13)
    for name, slope in slopes.items():
        other = name.replace("1", "2")
        np.testing.assert_allclose(slope, both[name] + both[other], rtol=1e-9)
        assert np.abs(both[other]).max() > 1e-4


def test_a_tie_is_to_a_part_that_is_there() -> None:
    plant = sy.TwoLink()
    tied = sy.Delay("torque2", tie="torque1")
    with pytest.raises(
        InputError, match=r"E145 torque2\.delay shares .*torque1\.delay"
    ):
        sy.Machine(plant, actuators=[tied])
    own = sy.Delay("torque1")
    with pytest.raises(InputError, match=r"E145 two parts of one name.*torque2\.delay"):
        sy.Machine(plant, actuators=[own, tied, tied])
    machine = sy.with_parts(sy.Machine(plant, actuators=[own]), [tied])
    assert dict(machine.parameters.fixed)["torque1.delay"] == 0.0


def test_a_delay_that_is_shared_is_not_proposed_again() -> None:
    tied = arm({"torque2": "torque1"}, ("torque1.delay",))
    names = [c.name for c in effects.registry.candidates(tied)]
    assert "torque1.delay" not in names
    assert "torque2.delay" not in names
    alone = [c.name for c in effects.registry.candidates(sy.TwoLink())]
    assert {"torque1.delay", "torque2.delay"} <= set(alone)


def project(folder: Path, text: str) -> sy.AbstractSystem:
    path = folder / "project.toml"
    path.write_text('system = "two_link"\n' + text)
    return load_project(path).build_system()


def test_a_pattern_is_for_each_input_and_a_tie_for_all(tmp_path: Path) -> None:
    said = 'gain = "free"\noffset = 0.1\ndelay = {low = 0.0, high = 0.02}\n'
    text = f'[actuators."torque*"]\n{said}'
    names = {f"torque{i}.{k}" for i in (1, 2) for k in ("gain", "delay")}
    each = project(tmp_path, text).parameters
    assert names <= set(each.names)
    assert {f"torque{i}.offset": 0.1 for i in (1, 2)}.items() <= dict(
        each.fixed
    ).items()
    tied = project(tmp_path, text + "tie = true\n").parameters
    assert {n for n in tied.names if "torque" in n} == {"torque1.gain", "torque1.delay"}
    assert (tied["torque1.delay"].low, tied["torque1.delay"].high) == (0.0, 0.02)
    assert tied["torque1.delay"].meaning == "delay of torque*"
    assert dict(tied.fixed)["torque1.offset"] == 0.1


def test_a_table_of_its_own_is_the_exception_to_a_pattern(tmp_path: Path) -> None:
    text = '[actuators."torque*"]\ndelay = "free"\n[actuators.torque2]\ngain = 2.0\n'
    table = project(tmp_path, text).parameters
    assert "torque1.delay" in table.names
    fixed = dict(table.fixed)
    assert (fixed["torque2.delay"], fixed["torque2.gain"]) == (0.0, 2.0)
