"""Effects on joints of plants without a mass matrix: equations, functions, MuJoCo."""

import math
from pathlib import Path
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import payload_arm
from sim2gp.data.logs import Log
from sim2gp.data.split_log import cut
from sim2gp.identification.fit import fit_windows
from sim2gp.project import load_project
from sim2gp.systems import (
    ODE,
    BlackBox,
    CartPole,
    Coulomb,
    DeadZone,
    Delay,
    Drag,
    EncoderOffset,
    Furuta,
    Machine,
    MuJoCo,
    Spring,
    Stribeck,
    UniformRodArm,
    Viscous,
    candidates,
    free_parts,
    plant_of,
)
from sim2gp.systems.assemble import carrying_inputs
from sim2gp.systems.effects import registry
from sim2gp.systems.effects.springs import AbstractSpring
from sim2gp.types import Scalar, in_float64

ARM = payload_arm.arm()
ABOUT = payload_arm.TABLE, payload_arm.STATES, payload_arm.ACTIONS
MODEL = """<mujoco><option timestep="0.002" integrator="RK4"/>
<worldbody><body name="link"><joint name="q" axis="0 -1 0" damping="{damping}"/>
<geom type="capsule" size=".02" fromto="0 0 0 0 0 -.3" mass=".5"/></body></worldbody>
<actuator><motor name="torque" joint="q" ctrlrange="-1 1"/></actuator></mujoco>"""


@in_float64
def slowed(effect: Any, v: float, t: float, q: float = 0.6) -> float:
    """Velocity after ``t`` seconds of an effect alone, by its closed form."""
    numbers = (jnp.asarray(x, float) for x in (effect.magnitude, q, v, t))
    return float(effect.accelerated(*numbers))


def integrated(effect: Any, v: float, t: float) -> float:
    """Velocity after ``dv/dt = along(x, q, v)``, by an independent integrator."""

    @in_float64
    def rate(_: float, v: np.ndarray) -> np.ndarray:
        numbers = (jnp.asarray(x, float) for x in (effect.magnitude, 0.6, v[0]))
        return np.asarray([float(effect.along(*numbers))])

    exact = scipy.integrate.solve_ivp(
        rate, (0.0, t), [v], method="LSODA", rtol=1e-10, atol=1e-12
    )
    return float(exact.y[0, -1])


@pytest.mark.parametrize("v", [1.5, 0.06, 0.01, -0.2, 0.0])
@pytest.mark.parametrize("t", [1e-3, 0.02, 0.3])
@pytest.mark.parametrize(
    "effect",
    [Viscous("q", 3.0), Drag("q", 2.0), Spring("q", 2.0), Coulomb("q", 2.0)],
)
def test_a_kick_is_the_solution(effect: Any, t: float, v: float) -> None:
    expected = integrated(effect, v, t)
    assert slowed(effect, v, t) == pytest.approx(expected, rel=1e-6, abs=1e-9)


def test_a_kick_of_stribeck_friction_is_of_second_order() -> None:
    effect = Stribeck("q", 2.0, 0.5)
    errors = [slowed(effect, 1.5, t) - integrated(effect, 1.5, t) for t in (0.1, 0.05)]
    assert 7.0 < errors[0] / errors[1] < 9.0  # of one step: the third


def test_steep_friction_stops_and_does_not_turn() -> None:
    for effect in (Coulomb("q", 2.0, 1e-3), Stribeck("q", 2.0, 1e-3)):
        for v in (5.0, 0.1, 1e-3, 1e-6):
            for t in (1e-3, 0.1, 100.0):
                assert 0.0 <= slowed(effect, v, t) < v
                assert slowed(effect, -v, t) == -slowed(effect, v, t)
    assert slowed(Coulomb("q", 2.0), 50.0, 1.0) == pytest.approx(48.0)


@in_float64
def test_a_step_is_of_second_order() -> None:
    effects = [Coulomb("q", 3.0, 0.5), Spring("q", 4.0), Drag("q", 0.2)]
    machine = Machine(ARM, effects)
    params = machine.nominal()
    known = {k: float(v) for k, v in ARM.parameters.nominal().items()}

    def rate(_: float, s: np.ndarray) -> np.ndarray:
        out = payload_arm.slope(np, known, s, np.asarray([0.3]))
        q, v = s
        out[1] += -3.0 * np.tanh(v / 0.5) - 4.0 * q - 0.2 * v * abs(v)
        return np.asarray(out)

    s0 = np.asarray([0.5, 1.0])
    exact = scipy.integrate.solve_ivp(rate, (0.0, 0.4), s0, rtol=1e-11, atol=1e-12)
    flow = jax.jit(machine.flow)

    def error(h: float) -> float:
        s = jnp.asarray(s0)
        for _ in range(round(0.4 / h)):
            s = flow(params, s, jnp.asarray([0.3]), h)
        return float(np.max(np.abs(np.asarray(s) - exact.y[:, -1])))

    assert error(0.005) < 1e-3
    assert 3.5 < error(0.02) / error(0.01) < 4.5


def written(folder: Path, damping: float) -> MuJoCo:
    """The arm as a model's file."""
    file = folder / f"arm{damping:.3f}.xml"
    file.write_text(MODEL.format(damping=damping))
    return MuJoCo(file, ["body/link/mass"])


def test_damping_is_mujocos_own(tmp_path: Path) -> None:
    """An acceleration ``x v`` on one hinge is a damping of ``x I`` in the model."""
    pytest.importorskip("mujoco")
    one = written(tmp_path, 0.0)
    other = written(tmp_path, 0.5 * _inertia(one))
    machine = Machine(one, [Viscous("q", 0.5)])
    a, fastest = np.asarray([0.4]), 0.0
    with jax.enable_x64(True):
        s = t = jnp.asarray([0.5, 0.0])
        for _ in range(50):
            s = machine.flow(machine.nominal(), s, jnp.asarray(a), 0.01)
            t = other.flow(other.nominal(), t, jnp.asarray(a), 0.01)
            np.testing.assert_allclose(s, t, atol=2e-4)
            fastest = max(fastest, abs(float(t[1])))
    assert fastest > 0.3


def _inertia(plant: Any) -> float:
    import mujoco

    model = plant.engine.model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    out = np.zeros(1)
    mujoco.mj_mulM(model, data, out, np.ones(1))
    return float(out[0])


def black_box() -> BlackBox:
    """The arm as a function on the host: the midpoint rule, in steps of 2.5 ms."""

    def step(k: dict[str, Any], s: np.ndarray, a: np.ndarray, h: Any) -> np.ndarray:
        count = 4
        t = np.asarray(h)[..., None] / count
        for _ in range(count):
            middle = s + 0.5 * t * payload_arm.slope(np, k, s, a)
            s = s + t * payload_arm.slope(np, k, middle, a)
        return s

    return BlackBox(step, *ABOUT, batched=True)


def systems(folder: Path) -> dict[str, Any]:
    """Six plants: three bundled, a model, an equation, a function on the host."""
    return {
        "furuta": Furuta(),
        "cartpole": CartPole(),
        "arm": UniformRodArm(),
        "mujoco": written(folder, 0.05),
        "ode": ODE(payload_arm.ode, *ABOUT, max_substep=0.002),  # as windows are
        "function": black_box(),
    }


def test_what_any_plant_may_lack_is_registered(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    for name in ("mujoco", "ode", "function"):
        plant = systems(tmp_path)[name]
        found = {c.name: c.effect for c in candidates(plant, windows=True)}
        joint = {"coulomb", "stribeck", "viscous", "drag", "spring", "encoder"}
        whole = {f"q.{what}" for what in joint}
        assert set(found) == whole | {"torque.dead_zone", "torque.delay"}
        units = {what: found[f"q.{what}"].unit(plant) for what in joint}
        assert units["coulomb"] == units["stribeck"] == "rad/s^2"
        assert units["viscous"] == "1/s"
        assert units["spring"] == "1/s^2"
        assert units["drag"] == "1/rad"
    k = {name: float(x) for name, x in ARM.parameters.nominal().items()}
    inertia = k["inertia"] + k["payload"] * payload_arm.ARM**2
    weight = k["weight"] + k["payload"] * payload_arm.GRAVITY * payload_arm.ARM
    most = (2.0 + weight * math.sin(0.5)) / inertia
    scale = {c.name: c.effect.magnitude for c in candidates(ARM)}["q.coulomb"]
    assert scale == pytest.approx(0.2 * most, rel=0.05)  # over 10 ms it gives way


class CubicSpring(AbstractSpring):
    """A spring that stiffens, ``-magnitude q^3``: a law that the list does not have."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    what: ClassVar[str] = "cubic_spring"
    powers: ClassVar[tuple[int, int]] = 3, 0
    meaning: ClassVar[str] = "stiffening of a cable"
    max_substep: ClassVar[float] = 0.005

    def along(self, x: Scalar, q: Scalar, v: Scalar) -> Scalar:
        return -x * q**3


class Churning(CubicSpring):
    """``-magnitude q v^3``, as a law of both: its unit and its prior alone."""

    what: ClassVar[str] = "churning"
    powers: ClassVar[tuple[int, int]] = 1, 3


def test_a_new_law_is_a_candidate_with_its_unit_and_prior(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One entry of `FORCES` is enough, on machines with a mass matrix and without."""
    more = *registry.FORCES, CubicSpring, Churning
    monkeypatch.setattr(registry, "FORCES", more)
    ode = ODE(payload_arm.ode, *ABOUT)
    expected = {
        ("furuta", "theta"): ("N m/rad^3", "N m s^3/rad^4", 0.025, 10.0, 1.0),
        ("furuta", "alpha"): ("N m/rad^3", "N m s^3/rad^4", 0.015, 15.0, 1.0),
        ("cartpole", "x"): ("N/m^3", "N s^3/m^4", 12.6, 1.0, 0.3),
        ("ode", "q"): ("1/(rad^2 s^2)", "s/rad^3", None, 10.0, 1.0),
    }
    plants = {"furuta": Furuta(), "cartpole": CartPole(), "ode": ode}
    for (name, q), (cubic, churning, force, speed, reach) in expected.items():
        plant = plants[name]
        found = {c.name: c for c in candidates(plant)}
        spring, other = found[f"{q}.cubic_spring"], found[f"{q}.churning"]
        units = spring.effect.unit(plant), other.effect.unit(plant)
        assert units == (cubic, churning)
        scale = 0.2 * force if force else found[f"{q}.coulomb"].effect.magnitude
        assert spring.effect.magnitude == pytest.approx(scale / reach**3)
        assert other.effect.magnitude == pytest.approx(scale / (reach * speed**3))
    assert slowed(CubicSpring("q", 2.0), 1.5, 0.1) == pytest.approx(
        integrated(CubicSpring("q", 2.0), 1.5, 0.1)
    )


def test_a_project_names_effects_of_a_model(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    written(tmp_path, 0.05)
    file = tmp_path / "robot.toml"
    file.write_text(
        'system = "arm0.050.xml"\n[parameters."body/link/mass"]\nrelative_sd = 0.2\n'
        "[effects.q.coulomb]\nmean = 0.0\nsd = 1.0\nwidth = 0.1\n"
        '[[logs]]\nfiles = ["a.csv"]\ncolumns = {q = "q", torque = "u"}\n'
    )
    system = load_project(file).system
    assert system.parameters.names == ("body/link/mass", "q.coulomb")
    assert system.parameters["q.coulomb"].unit == "rad/s^2"
    (effect,) = system.effects
    assert effect.width == 0.1


@in_float64
def recorded(machine: Machine, seed: int, seconds: float = 6.0, times: int = 1) -> Log:
    """Positions of the machine itself under random inputs, every 10 ms, with noise.

    In so many ``times`` as many steps: an input that arrives within a step acts by its
    mean over that step.
    """
    rng, count = np.random.default_rng(seed), round(100 * seconds)
    plant = plant_of(machine)
    high = np.asarray([c.high if math.isfinite(c.high) else 1.0 for c in plant.actions])
    held = np.repeat(rng.uniform(-0.6, 0.6, (count // 15 + 1, len(high))), 15, axis=0)
    held = held[:count] * high
    moving = carrying_inputs(machine, 0.01 / times)
    params = moving.nominal()
    one = jax.jit(lambda s, a: moving.step(params, s, a, 0.01 / times))

    def step(s: Any, a: Any) -> Any:
        for _ in range(times):
            s = one(s, a)
        return s

    s = jnp.zeros(len(moving.states)).at[0].set(0.3)
    states = [np.asarray(s)]
    for a in held[:-1]:
        s = step(s, jnp.asarray(a))
        states.append(np.asarray(s))
    names = [c.name for c in plant.physical_states if "velocity" not in c.name]
    q = np.stack(states)[:, : len(names)]
    q = q + 1e-4 * rng.standard_normal(q.shape)
    return Log(
        name="log",
        source="log.csv",
        time=0.01 * np.arange(count),
        channels={n: q[:, i] for i, n in enumerate(names)},
        inputs={c.name: held[:, i] for i, c in enumerate(plant.actions)},
        mask={n: np.ones(count, bool) for n in names},
    )


SYSTEMS = ("furuta", "cartpole", "arm", "mujoco", "ode", "function")
KINDS: dict[str, Any] = {
    "coulomb": lambda plant, q, u, x: Coulomb(q, 0.5 * x),
    "stribeck": lambda plant, q, u, x: Stribeck(q, 0.5 * x),
    "viscous": lambda plant, q, u, x: Viscous(q, 0.1 * x),
    "drag": lambda plant, q, u, x: Drag(q, 0.05 * x),
    "spring": lambda plant, q, u, x: Spring(q, 0.5 * x),
    "encoder": lambda plant, q, u, x: EncoderOffset(q, 0.03),
    "dead_zone": lambda plant, q, u, x: DeadZone(u.name, 0.1 * min(u.high, 10.0)),
    "delay": lambda plant, q, u, x: Delay(u.name, 0.012),
}


@pytest.mark.nightly
@pytest.mark.parametrize(
    "name", ["furuta", "cartpole", "arm", "mujoco", "ode", "function"]
)
@pytest.mark.parametrize("kind", KINDS)
def test_an_effect_is_recovered(name: str, kind: str, tmp_path: Path) -> None:
    """Freed, it is found in one log as well as its interval says; the rest is known.

    Of 48 intervals at 95 % two or three miss: here four sd are asked of each.
    """
    pytest.importorskip("mujoco")
    plant = systems(tmp_path)[name]
    by_name = {c.name: c.effect.magnitude for c in candidates(plant)}
    where = plant.states[1 if name in ("furuta", "cartpole") else 0].name
    if kind == "encoder" and name == "arm":
        where = "q2"  # nothing depends on the first joint of a horizontal arm
    scale = 5.0 * by_name.get(f"{where}.coulomb", 1.0)
    part = KINDS[kind](plant, where, plant.actions[0], 0.2 * scale)
    known = plant.parameters.nominal()
    fixed = Machine(plant, parameters=dict(known))
    true = free_parts(fixed, [part])
    true = Machine(true.plant, true.effects, true.sensors, true.actuators, (), {
        **known, part.name: part.magnitude
    })  # fmt: skip
    # A fit steps MuJoCo as its file does; the function's steps are what they are.
    times = {"mujoco": 5, "function": 1}.get(name, 20 if kind == "delay" else 1)
    log = recorded(true, seed=3, times=times)
    searched = free_parts(fixed, [type(part)(part.where, 3.0 * part.magnitude)])
    windows, _ = cut([log], searched, window=0.3)
    found = fit_windows(searched, windows, key=jax.random.key(0))
    mean = float(np.asarray(found.posterior.mean)[0])
    sd = float(np.linalg.norm(np.asarray(found.posterior.scale)[0]))
    table = searched.parameters
    low, high = (table.free[0].constrain(mean + k * sd) for k in (-4.0, 4.0))
    inside = (table.free[0].constrain(mean + k * 1.96 * sd) for k in (-1, 1))
    print(f"{part.name} {part.magnitude:g} in", *(f"{x:.6g}" for x in inside))
    assert low <= part.magnitude <= high
    assert high - low < part.magnitude
