"""Forces as curves, and the ranges that they are drawn over."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2gp.data.logs import Log
from sim2gp.data.split_log import cut
from sim2gp.identification.missing_physics.curves import (
    LEVEL,
    SHARE,
    band_width,
    curves_of,
    functions_of,
)
from sim2gp.identification.missing_physics.reach import box_of
from sim2gp.inference.gaussian import Gaussian
from sim2gp.systems import Furuta, UniformRodArm, free_parts
from sim2gp.systems.effects.missing import missing_forces

pytestmark = pytest.mark.usefixtures("float64")
BOX = {
    "theta": (-1.0, 1.0),
    "alpha": (-3.0, 3.0),
    "theta.velocity": (-10.0, 10.0),
    "alpha.velocity": (-20.0, 20.0),
    "voltage": (-5.0, 5.0),
}


def test_curves_are_the_functions_of_drawn_weights():
    """Mean and sd against the functions themselves, at many draws of the weights."""
    machine = free_parts(Furuta(), missing_forces(Furuta(), BOX, fine=True))
    table, functions = machine.parameters, functions_of(machine)
    p, rng = len(table), np.random.default_rng(0)
    scale = np.diag([q.sd for q in table.free]) @ (0.2 * rng.normal(size=(p, p)))
    # What shapes a function is held: a curve is linear in its weights.
    scale[[i for i, q in enumerate(table.free) if q.shape]] = 0.0
    mean = np.asarray([q.mean for q in table.free]) + 0.1 * rng.normal(size=p)
    mean = np.where([q.shape for q in table.free], [q.mean for q in table.free], mean)
    virtual = Gaussian(jnp.asarray(mean), jnp.asarray(scale))
    curves = curves_of(machine, functions, BOX, virtual)
    assert len(curves) == 5  # by each joint's position and velocity, and by the input
    drawn = mean + rng.normal(size=(4000, p)) @ scale.T
    for curve in curves:
        z = jnp.asarray(curve.at[7])
        total = np.zeros(len(drawn))
        for f in functions:
            velocity = getattr(f, "of_velocity", False)
            of = f"{f.where}.velocity" if velocity else f.where
            if (f.where, of) != (curve.where, curve.of):
                continue
            names = list(f.values)
            w = drawn[:, [table.names.index(name) for name in names]]
            shaped = [table[name].shape for name in names]
            w = np.where(shaped, [f.values[name] for name in names], w)
            total += np.asarray(jax.vmap(f.basis.value, (0, None))(jnp.asarray(w), z))
        noise = curve.sd[7] / np.sqrt(len(drawn))
        assert abs(total.mean() - curve.mean[7]) < 4.0 * noise
        assert total.std() == pytest.approx(curve.sd[7], rel=0.06)


@pytest.mark.parametrize("length", [0.05, 0.2, 1.0])
def test_a_band_holds_nine_tenths_of_a_curve_with_its_probability(length: float):
    """Of other draws; two-sided sd, which hold for a value, hold fewer curves."""
    x, rng = np.linspace(0.0, 1.0, 101), np.random.default_rng(1)
    C = (
        np.exp(-0.5 * (x[:, None] - x[None]) ** 2 / length**2)
        * (1.0 + x[:, None])
        * (1.0 + x[None])
    )
    values, vectors = np.linalg.eigh(C)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    away = np.abs(root @ rng.standard_normal((101, 4000))) / (1.0 + x)[:, None]
    inside = lambda width: np.mean(np.mean(away <= width, axis=0) >= SHARE)  # noqa: E731
    assert inside(band_width(root)) == pytest.approx(LEVEL, abs=0.02)
    assert inside(1.96) < LEVEL - 0.02


def test_a_band_of_one_direction_is_two_sided():
    assert band_width(np.ones((50, 1))) == pytest.approx(1.96, rel=0.05)


def test_a_box_holds_where_the_recordings_have_been():
    """Measured positions, and velocities that are not measured."""
    time, system = np.arange(0.0, 6.0, 0.01), UniformRodArm()
    q = {"q1": 2.0 + 0.5 * np.sin(time), "q2": 0.8 * np.cos(3.0 * time)}
    speeds = {"q1": 0.5 * np.cos(time), "q2": -2.4 * np.sin(3.0 * time)}
    log = Log(
        name="turned",
        source="turned.csv",
        time=time,
        channels=q,
        inputs={"torque1": 0.0 * time, "torque2": 0.0 * time},
        mask={name: np.ones(time.size, bool) for name in q},
    )
    windows, _ = cut([log], system, window=0.2)
    box = box_of(system, windows)
    for name in q:
        seen = {name: q[name], f"{name}.velocity": speeds[name]}
        for of, values in seen.items():
            low, high = box[of]
            assert low <= values.min() < values.max() <= high
            assert high - low < 2.5 * np.ptp(values)
    assert box["torque1"] == (system.actions[0].low, system.actions[0].high)
