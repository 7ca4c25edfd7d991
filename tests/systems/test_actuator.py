"""Gain, offset and delay of the inputs; the identities that a delay must satisfy."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import machines
from sim2gp import systems as sy

DT = 0.02


pytestmark = pytest.mark.usefixtures("float64")


def run(system, params, inputs, s):
    """States under the inputs, one step each."""
    step = jax.jit(lambda s, a: system.step(params, s, a, DT))
    path = [s]
    for a in inputs:
        path.append(step(path[-1], a))
    return jnp.stack(path)


def furuta(delay):
    """(machine, its record) with a free delay of this value."""
    inputs = sy.neutral_actuators(sy.Furuta().actions)
    system = sy.with_parts(sy.Furuta(), inputs, period=DT)
    system = sy.free_parts(system, [sy.Delay("voltage", 0.06)])
    return system, machines.nominal(system, **{"voltage.delay": delay})


with jax.enable_x64(True):
    INPUTS = jax.random.normal(jax.random.key(3), (12, 1))
    START = jnp.array([0.1, 0.4, 0.3, -0.2])


@pytest.mark.parametrize("steps", [0, 1, 2, 3])
def test_whole_steps_of_delay_shift_the_input(steps):
    system, p = furuta(steps * DT)
    path = run(system, p, INPUTS, jnp.append(START, jnp.zeros(3)))
    shifted = jnp.concatenate([jnp.zeros((steps, 1)), INPUTS])[: len(INPUTS)]
    plain = run(sy.Furuta(), sy.Furuta().nominal(), shifted, START)
    np.testing.assert_allclose(path[:, :4], plain, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(path[4:, 4], INPUTS[3:, 0])  # newest first
    np.testing.assert_array_equal(path[4:, 6], INPUTS[1:-2, 0])


def test_half_a_step_of_delay_switches_in_the_middle():
    """The substeps are 10 ms: the old input acts in the first, then the new one."""
    system, p = furuta(0.01)
    bare = sy.Furuta()
    old, new = jnp.array([2.0]), jnp.array([-1.0])
    s = system.step(p, jnp.concatenate([START, old, jnp.zeros(2)]), new, DT)
    x = START
    for u in (old, new):
        x = sy.rk4(lambda x, u: bare.ode(p.plant, x, u), x, u, 0.01)
    np.testing.assert_allclose(s[:4], x, rtol=1e-13)
    np.testing.assert_allclose(s[4:], [-1.0, 2.0, 0.0])


def test_mean_input_is_the_integral_of_the_held_input():
    """By brute force: the average of a staircase over the delayed substep."""
    held = jnp.array([[1.0, -2.0], [3.0, 0.5], [-4.0, 7.0]])
    delay = jnp.array([0.0137, 0.0291])
    means = sy.delayed_means(held, DT, delay, 4)
    h, fine = DT / 4, 200_000
    for i in range(4):
        t = (i + (np.arange(fine) + 0.5) / fine) * h
        for channel in range(2):
            k = np.ceil(-(t - float(delay[channel])) / DT).clip(0).astype(int)
            expected = np.asarray(held)[k, channel].mean()
            assert float(means[i, channel]) == pytest.approx(expected, abs=1e-4)
    total = jnp.sum(sy.delayed_means(held, DT, jnp.zeros(2), 4), 0) / 4
    np.testing.assert_allclose(total, held[0], rtol=1e-13)


def test_gradient_with_respect_to_the_delay():
    system, _ = furuta(0.0)
    s = jnp.concatenate([START, jnp.array([2.0, -1.0, 3.0])])

    @jax.jit
    def after(tau):
        values = system.parameters.nominal() | {"voltage.delay": tau}
        record = system.record({k: jnp.asarray(v, float) for k, v in values.items()})
        return system.step(record, s, jnp.ones(1), DT)[:4]

    forward, reverse = jax.jit(jax.jacfwd(after)), jax.jit(jax.jacrev(after))
    h = 1e-5
    for delay in (0.0037, 0.0123, 0.0311, 0.0472):
        differences = (after(delay + h) - after(delay - h)) / (2 * h)
        scale = float(jnp.max(jnp.abs(differences)))
        assert scale > 1.0  # a delay of one second changes the speed by many rad/s
        slope = forward(delay)
        np.testing.assert_allclose(slope, differences, rtol=0, atol=1e-7 * scale)
        np.testing.assert_allclose(reverse(delay), slope, rtol=0, atol=1e-12 * scale)


@pytest.mark.parametrize("delay", [0.0, 0.01, 0.02, 0.04])
def test_on_a_knot_the_gradient_is_that_of_a_longer_delay(delay):
    held = jnp.array([[1.0], [3.0], [-4.0], [2.0]])
    mean = lambda tau: sy.delayed_means(held, DT, tau[None], 2)  # noqa: E731
    slope = jax.jacfwd(mean)(jnp.asarray(delay))
    beyond = (mean(jnp.asarray(delay + 1e-6)) - mean(jnp.asarray(delay))) / 1e-6
    np.testing.assert_allclose(slope, beyond, rtol=1e-6, atol=1e-6)
    assert jnp.any(slope != 0.0)


def test_gain_and_offset_act_on_each_input():
    arm = sy.TwoLink(gravity=9.81)
    p = arm.nominal()
    fixed = {"torque1.gain": 0.9, "torque2.offset": 0.3, "torque2.gain": 1.2}
    inputs = sy.neutral_actuators(arm.actions)
    system = sy.Machine(arm, actuators=inputs, parameters=fixed)
    assert system.parameters.free == arm.parameters.free
    s, a = jnp.array([0.1, 2.0, -0.3, 0.4]), jnp.array([1.0, -2.0])
    u = jnp.array([0.9, 1.2 * -2.0 + 0.3])
    got = system.flow(system.nominal(), s, a, DT / 4)
    np.testing.assert_allclose(got, arm.flow(p, s, u, DT / 4), rtol=1e-12)
    got = system.step(system.nominal(), s, a, DT)
    np.testing.assert_allclose(got, arm.step(p, s, u, DT), rtol=1e-12)
    neutral = machines.with_parts(system, p)
    np.testing.assert_allclose(
        system.step(neutral, s, a, DT), arm.step(p, s, a, DT), rtol=1e-12
    )


def test_every_input_has_its_own_delay():
    arm = sy.UniformRodArm()
    late = [sy.Delay("torque1", 0.02), sy.Delay("torque2", 0.04)]
    system = sy.Machine(arm, actuators=late, period=DT)
    inputs = jax.random.normal(jax.random.key(5), (8, 2))
    path = run(system, system.nominal(), inputs, jnp.append(START, jnp.zeros(4)))
    one, two = jnp.zeros((1, 1)), jnp.zeros((2, 1))
    shifted = jnp.concatenate(
        [
            jnp.concatenate([one, inputs[:-1, :1]]),
            jnp.concatenate([two, inputs[:-2, 1:]]),
        ],
        axis=1,
    )
    plain = run(arm, arm.nominal(), shifted, START)
    np.testing.assert_allclose(path[:, :4], plain, rtol=1e-9, atol=1e-12)


def test_channels_and_tables():
    system, p = furuta(0.01)
    names = [channel.name for channel in system.states]
    assert names[4:] == ["voltage[-1]", "voltage[-2]", "voltage[-3]"]
    assert system.states[4].unit == "V"
    assert [c.name for c in system.physical_states] == names[:4]
    assert system.history == 3
    assert system.parameters.names[-1] == "voltage.delay"
    np.testing.assert_allclose(system.delays(p), [0.01])
    np.testing.assert_array_equal(sy.Furuta().delays(sy.Furuta().nominal()), [0.0])
    tt = system.parameters.prior().mean
    s = jnp.zeros(7)
    after = system.transition(tt, s, jnp.ones(1), DT)
    assert after.shape == (7,)
    table = system.parameters.replace(**{"voltage.gain": 1.1})
    again = dataclasses.replace(system, parameters=table)
    assert dict(again.parameters.fixed)["voltage.gain"] == 1.1
    assert again.parameters.names == system.parameters.names


def test_actuators_and_effects():
    effects = [sy.Coulomb("theta", 2e-3), sy.Delay("voltage", 0.02)]
    system = sy.with_parts(sy.Furuta(), effects, period=DT)
    bare = sy.Machine(sy.Furuta(), effects[:1])
    path = run(system, system.nominal(), INPUTS, jnp.append(START, 0.0))
    shifted = jnp.concatenate([jnp.zeros((1, 1)), INPUTS[:-1]])
    plain = run(bare, bare.nominal(), shifted, START)
    np.testing.assert_allclose(path[:, :4], plain, rtol=1e-9, atol=1e-12)
    assert system.max_substep == bare.max_substep == 0.0025


def test_inputs_with_a_delay_and_with_a_lag():
    """Of two inputs one is late, the other is filtered."""
    arm = sy.UniformRodArm()
    late = [sy.Delay("torque1", 0.02), sy.Lag("torque2", 0.004)]
    system = sy.Machine(arm, actuators=late, period=DT)
    assert system.history == 1
    held = jnp.array([[1.0, 2.0], [-3.0, 4.0]])
    means = system.mean_inputs(system.nominal(), held, DT, 2)
    lag = sy.lagged_means(held[:, 1], DT, jnp.asarray(0.004), 2)
    np.testing.assert_allclose(means, jnp.stack([held[[1, 1], 0], lag], 1), rtol=1e-12)
