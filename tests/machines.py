"""Every bundled system with points to test it at, away from numerical blow-up."""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import lagrangians
from sim2gp import systems as sy
from sim2gp.systems import AbstractMechanism, AbstractSystem, Machine

SPEEDS = {"rad": 8.0, "m": 1.5}


def bare() -> dict[str, AbstractMechanism]:
    """The machines themselves."""
    six = sy.UniformRodArm(sy.base.parameters_of(sy.UniformRodParams))
    return {
        "furuta": sy.Furuta(),
        "cartpole": sy.CartPole(),
        "two_link": sy.TwoLink(gravity=9.81),
        "horizontal": sy.TwoLink(coulomb_shape="arctangent"),
        "six": six,
        "locked": sy.UniformRodArm(locked=(True, False)),
    }


def every() -> dict[str, AbstractSystem]:
    """The machines, alone, with all effects of the catalogue, and with actuators."""
    systems: dict[str, AbstractSystem] = dict(bare())
    for name in ("furuta", "cartpole"):
        effects = [sy.effect(name, what, "strong") for what in sy.catalogue(name)]
        systems[f"{name}/all"] = sy.with_parts(bare()[name], effects, period=0.02)
    arm = bare()["two_link"]
    free = sy.free_parts(arm, sy.neutral_actuators(arm.actions), period=0.02)
    return systems | {"two_link/actuated": free}


def points(system: AbstractSystem, count: int, seed: int) -> Iterator[tuple[Any, ...]]:
    """Random (tt, s, a): constants around the published ones, states over the range."""
    yield from zip(*batch(system, count, seed), strict=True)


def batch(system: AbstractSystem, count: int, seed: int) -> tuple[Array, ...]:
    """As `points`, stacked: (count, p), (count, n), (count, m)."""
    rng = np.random.default_rng(seed)
    nominal = system.parameters.nominal()
    theta = jnp.array([nominal[name] for name in system.parameters.names])
    tt = system.parameters.unconstrain(theta)[None] + 0.3 * rng.standard_normal(
        (count, len(theta))
    )
    tt = _feasible(system, tt)
    high = np.array([c.high for c in system.actions])
    a = rng.uniform(-1.0, 1.0, (count, len(high))) * high
    columns = []
    for channel in system.physical_states:
        position = channel.name.removesuffix(".velocity")
        unit = next(c.unit for c in system.states if c.name == position)
        if channel.name != position:
            span = SPEEDS[unit]
        else:
            span = np.pi if unit == "rad" else 0.4
        columns.append(rng.uniform(-span, span, count))
    past = rng.uniform(-1.0, 1.0, (count, system.history * len(high)))
    s = np.stack([*columns, *past.T], 1)
    return tt, jnp.asarray(s), jnp.asarray(a)


def params_at(system: AbstractSystem, tt: Array) -> Any:
    """The record at a virtual point."""
    return system.record(system.parameters.values(tt))


def close(got: Any, expected: Any, rtol: float = 1e-11) -> None:
    """Relative to the largest entry: an entry may vanish by cancellation."""
    scale = np.max(np.abs(expected))
    np.testing.assert_allclose(got, expected, rtol=0.0, atol=rtol * scale)


def against(machine: str, effect: Any, lagrangian: Any, forces: Any) -> None:
    """Accelerations of a machine with an effect against Euler-Lagrange."""
    plain = bare()[machine]
    system = Machine(plain, [effect])

    def both(tt: Array, s: Array, a: Array) -> tuple[Array, Array]:
        p = params_at(plain, tt)
        q, v = s[:2], s[2:]
        got = ode(system, with_parts(system, p), s, a)[2:]
        return got, lagrangians.acceleration(lagrangian(p), forces(p, v, a), q, v)

    got, expected = jax.jit(jax.vmap(both))(*batch(plain, 100, 4))
    for row, oracle in zip(got, expected, strict=True):
        close(row, oracle)


def with_parts(machine: Machine, params: Any) -> sy.MachineParams:
    """A record of the plant with every part at its own magnitude."""
    like = jax.tree.leaves(params)[0].dtype
    parts = {part.name: jnp.asarray(part.magnitude, like) for part in machine.parts}
    return sy.MachineParams(params, parts)


def equations(machine: Machine, params: Any, q: Array, v: Array, a: Array) -> Any:
    """Inertia and forces of a machine with effects; the input is what arrives."""
    assert isinstance(machine.plant, AbstractMechanism)
    return machine.plant.equations(params.plant, machine.acting(params), q, v, a)


def ode(machine: Machine, params: Any, s: Array, a: Array) -> Array:
    """Time derivative of a machine with effects on its joints."""
    assert isinstance(machine.plant, AbstractMechanism)
    return machine.plant.ode_with(params.plant, machine.acting(params), s, a)


def nominal(system: AbstractSystem, **changes: float) -> Any:
    """The published record, with some constants changed."""
    values = system.parameters.nominal() | changes
    return system.record({k: jnp.asarray(v, float) for k, v in values.items()})


def jitted(system: AbstractSystem, dt: float) -> Any:
    """The step of (tt, s, a), compiled."""
    return jax.jit(lambda tt, s, a: system.transition(tt, s, a, dt))


def _feasible(system: AbstractSystem, tt: Array) -> Array:
    """Independent constants of an arm may give it a negative inertia: replace those."""
    machine = sy.plant_of(system)
    if not isinstance(machine, sy.TwoLink):
        return tt

    def margin(t: Array, q2: float) -> Array:
        p = machine.record(system.parameters.values(t))
        M = machine.mass_matrix(p, jnp.array([0.0, q2]))
        return 1.0 - M[0, 1] ** 2 / (M[0, 0] * M[1, 1])

    least = jnp.minimum(
        *(jax.vmap(lambda t, q=q: margin(t, q))(tt) for q in (0.0, np.pi))
    )
    good = least > 0.1
    return jnp.where(good[:, None], tt, tt[jnp.argmax(good)][None])
