"""MuJoCo models as systems: against C MuJoCo itself, and against our own equations."""

import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjcf
from crawler import CRAWLER, USUAL, written
from sim2gp import systems as sy
from sim2gp.data.transitions import Transitions
from sim2gp.errors import InputError
from sim2gp.identification import diagnose
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.parameters import Parameter
from sim2gp.models import Sim2GP
from sim2gp.types import in_float64

mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is not installed")

DT = 0.01
ARM = sy.TwoLink(gravity=9.81, gear_ratio=0.0)


def own(arm: sy.TwoLink) -> dict[str, float]:
    """Constants of an arm of true links, without rotors and dry friction."""
    values = dict(arm.parameters.nominal()) | {"Ir": 0.0, "cf1": 0.0, "cf2": 0.0}
    values["I1"] += values["m1r1"] * 0.1
    values["I2"] += values["m2r2"] ** 2 / values["m2"]
    return values


def arm_xml(values: dict[str, float], *, step: float = 0.002) -> str:
    text = mjcf.two_link(values, length1=0.2, gear=0.0, gravity=9.81, rotors="none")
    return text.replace(
        'integrator="Euler" timestep="0.001"', f'integrator="RK4" timestep="{step}"'
    )


PATHS = {
    "trunk": "body/torso/mass",
    "leg": "body/leg/mass",
    "armature": "joint/hip/armature",
    "dry": "joint/knee/frictionloss",
    "slip": "geom/foot/friction",
    "kp": "actuator/servo/kp",
    "gain": "actuator/motor/gain",
}


def crawled(
    values: dict[str, float], s: np.ndarray, a: np.ndarray, steps: int
) -> np.ndarray:
    """C MuJoCo alone, of a model that was written with these constants."""
    return rolled(CRAWLER.format(**values), s, a, steps)


def rolled(text: str, s: np.ndarray, a: np.ndarray, steps: int) -> np.ndarray:
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.act[:] = s[:4], s[4:8], s[8:]
    data.ctrl[:] = a
    for _ in range(steps):
        mujoco.mj_step(model, data)
    return np.concatenate([data.qpos, data.qvel, data.act])


def crawler(tmp_path: Path, **kwargs) -> sy.MuJoCo:
    return sy.MuJoCo(written(tmp_path, CRAWLER.format(**USUAL)), **kwargs)


STATE = np.array([0.0, 0.02, 0.3, -0.2, 0.1, -0.2, 0.5, 0.3, 0.4])
ACTION = np.array([0.5, -0.3])


@in_float64
def test_a_step_is_c_mujocos_with_the_constants_written_into_the_file(tmp_path):
    """Contacts, limits, dry friction, a servo, activation; derived constants too."""
    system = crawler(tmp_path, constants=list(PATHS.values()))
    changed = dict(zip(USUAL, (1.7, 0.35, 0.03, 0.11, 0.3, 15.0, 0.9), strict=True))
    for values in (USUAL, changed, USUAL):
        params = system.record({PATHS[k]: jnp.asarray(v) for k, v in values.items()})
        found = jax.jit(system.step, static_argnums=3)(
            params, jnp.asarray(STATE), jnp.asarray(ACTION), 0.1
        )
        np.testing.assert_allclose(
            found, crawled(values, STATE, ACTION, 50), atol=1e-10
        )
    names = [c.name for c in system.states]
    assert names[4:] == [
        "x.velocity",
        "z.velocity",
        "hip.velocity",
        "knee.velocity",
        "motor.activation",
    ]
    servo, _ = system.actions
    assert (servo.name, servo.low, servo.high) == ("servo", -1.0, 1.0)
    hip, knee = system.states[2:4]
    assert (hip.angle, hip.high, knee.angle, knee.unit) == (False, 0.9, True, "rad")


@in_float64
def test_a_batch_is_its_rows(tmp_path):
    """Different constants, states and spans in one call, in several threads."""
    system = crawler(tmp_path, constants=list(PATHS.values()))
    rng = np.random.default_rng(0)
    theta = np.asarray([list(USUAL.values())] * 60) * rng.uniform(0.7, 1.4, (60, 7))
    theta[30:] = theta[0]
    S = STATE + 0.05 * rng.standard_normal((60, 9))
    A = rng.uniform(-1.0, 1.0, (60, 2))
    h = np.where(np.arange(60) % 3, 0.02, 0.006)
    h[7] = 0.0
    S[11, 3] = np.nan
    found = system.engine.flow(theta, S, A, h)
    assert np.isnan(found[11]).all()
    np.testing.assert_array_equal(found[7], S[7])
    for i in set(range(60)) - {7, 11}:
        steps = round(h[i] / 0.002)
        values = dict(zip(USUAL, theta[i], strict=True))
        expected = crawled(values, S[i], A[i], steps)
        np.testing.assert_allclose(found[i], expected, atol=1e-9)


def test_an_uneven_span_is_divided_evenly(tmp_path):
    """7 ms at a time step of 2 ms: four substeps of 1.75 ms."""
    system = crawler(tmp_path, constants=["body/torso/mass"])
    found = system.engine.flow(
        np.array([[0.8]]), STATE[None], ACTION[None], np.array([7e-3])
    )
    text = CRAWLER.format(**USUAL).replace('timestep="0.002"', 'timestep="0.00175"')
    expected = rolled(text, STATE, ACTION, 4)
    np.testing.assert_allclose(found[0], expected, atol=1e-12)


def test_spans_that_differ_by_rounding_are_one(tmp_path, monkeypatch):
    """Differences of time stamps are; each other span is a rollout of its own."""
    engine = crawler(tmp_path, constants=["body/torso/mass"]).engine
    stamps = 0.01 * np.arange(60, 101)
    h = np.append(np.diff(stamps), 0.02)
    assert len(np.unique(h)) > 2
    rollouts, rolled = [], engine._rolled
    monkeypatch.setattr(
        engine, "_rolled", lambda *x: rollouts.append(x[-1]) or rolled(*x)
    )
    rows = [np.tile(x, (len(h), 1)) for x in (np.array([0.8]), STATE, ACTION)]
    found = engine.flow(*rows, h)
    assert rollouts == [0.01, 0.02]
    np.testing.assert_array_equal(found[1:-1], found[:-2])
    assert np.isfinite(found).all()


@in_float64
@pytest.mark.nightly
def test_slopes_are_those_of_our_own_equations(tmp_path):
    """The same arm, integrated alike: its exact derivative, both ways."""
    values = own(ARM)
    paths = ["joint/q1/damping", "joint/q2/damping"]
    system = sy.MuJoCo(written(tmp_path, arm_xml(values)), paths)
    theta = jnp.asarray([values["b1"], values["b2"]])
    s, a = jnp.asarray([0.4, -0.8, 1.0, 2.0]), jnp.asarray([0.5, -0.2])

    def ours(theta, s, a):
        p = ARM.record(
            {k: jnp.asarray(v) for k, v in values.items()}
            | {"b1": theta[0], "b2": theta[1]}
        )
        return ARM.step(p, s, a, DT)

    def theirs(theta, s, a):
        return system.step(theta, s, a, DT)

    np.testing.assert_allclose(theirs(theta, s, a), ours(theta, s, a), rtol=1e-8)
    for i in range(3):
        expected = jax.jacfwd(ours, i)(theta, s, a)
        for mode in (jax.jacfwd, jax.jacrev):
            found = mode(theirs, i)(theta, s, a)
            np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9)


@in_float64
def test_the_posterior_is_that_of_our_own_equations(tmp_path):
    """Two dampings, one-step data: mean and covariance."""
    values = own(ARM)
    free = {
        name: Parameter(name, "N m s/rad", name, "log_bounded", 1e-3, 0.1)
        for name in ("b1", "b2")
    }
    held = {k: v for k, v in values.items() if k not in free}
    table = ARM.parameters.replace(**free, **held)
    arm = sy.TwoLink(table, gravity=9.81, gear_ratio=0.0)
    paths = {"joint/q1/damping": free["b1"], "joint/q2/damping": free["b2"]}
    theirs = sy.MuJoCo(written(tmp_path, arm_xml(values)), list(paths), paths)
    constants = values | {"b1": 0.02, "b2": 0.008}
    truth = arm.record({k: jnp.asarray(v) for k, v in constants.items()})
    rng = np.random.default_rng(1)
    S, A = rng.uniform(-2.0, 2.0, (80, 4)), rng.uniform(-1.0, 1.0, (80, 2))
    follow = jax.vmap(lambda s, a: arm.step(truth, s, a, DT))
    S2 = np.asarray(follow(jnp.asarray(S), jnp.asarray(A)))
    data = Transitions.of(S, A, S2 + 1e-3 * rng.standard_normal(S2.shape))
    key, found = jax.random.key(0), []
    for system in (arm, theirs):
        model = Sim2GP(system, dt=DT)
        found.append(model.fit(model.init(key=key), data, key=key).posterior)
    np.testing.assert_allclose(found[1].mean, found[0].mean, atol=1e-5)
    covariances = [np.asarray(g.scale @ g.scale.T) for g in found]
    np.testing.assert_allclose(covariances[1], covariances[0], rtol=1e-4)
    assert np.abs(found[0].mean - arm.parameters.prior().mean).max() > 0.5


def test_tied_constants_are_one_number(tmp_path):
    system = crawler(tmp_path, constants=[["joint/hip/damping", "joint/x/damping"]])
    assert system.parameters.names == ("joint/hip/damping",)
    model = system.engine.with_values(np.array([0.3]))
    assert model.dof_damping.tolist() == [0.3, 0.0, 0.3, 0.0]
    assert system.engine.model.dof_damping.tolist() == [0.05, 0.0, 0.02, 0.0]


def test_what_is_zero_in_the_model_is_left_alone_or_needs_a_prior(tmp_path):
    names = crawler(tmp_path).parameters.names
    assert "joint/x/frictionloss" in names
    assert "joint/hip/frictionloss" not in names
    with pytest.raises(
        InputError, match=r"E142 no prior for joint/z/damping.*low and high"
    ):
        crawler(tmp_path, constants=["joint/*/damping"])
    prior = Parameter("", "N s/m", "damping", "bounded", 0.0, 1.0)
    system = crawler(
        tmp_path, constants=["joint/z/damping"], priors={"joint/z/damping": prior}
    )
    assert system.parameters["joint/z/damping"].high == 1.0


@pytest.mark.parametrize("speed", [1e7, 1e12])
def test_what_ran_away_is_not_the_start_again(tmp_path, monkeypatch, capfd, speed):
    """MuJoCo would reset such a state, go on, and write a log file."""
    monkeypatch.chdir(tmp_path)
    system = crawler(tmp_path, constants=["body/torso/mass"])
    S = np.stack([STATE, STATE])
    S[0, 6] = speed
    masses, spans = np.full((2, 1), 0.8), np.full(2, 0.5)
    found = system.engine.flow(masses, S, np.stack([ACTION] * 2), spans)
    assert np.isnan(found[0]).all()
    expected = crawled(USUAL, STATE, ACTION, 250)
    np.testing.assert_allclose(found[1], expected, atol=1e-8)
    assert os.listdir(tmp_path) == ["model.xml"]
    assert capfd.readouterr() == ("", "")


RESTING = """
<mujoco><worldbody>
  <body name="cart"><joint name="x" type="slide" axis="1 0 0" damping="1"/>
    <geom type="box" size=".1 .1 .02" mass=".5"/>
    <body name="pole" pos="0 .03 .02"><joint name="q" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 .3" size=".02" mass=".1"/></body></body>
  <body name="other" pos="0 2 0"><joint name="y" type="slide" axis="0 1 0"/>
    <geom size=".1" mass="1"/></body>
</worldbody></mujoco>
"""


@in_float64
def test_what_rests_is_dead_and_not_identified(tmp_path):
    """Dry friction that is zero in the file, a mass, a length that nothing turns."""
    dead = ["joint/y/frictionloss", "body/other/mass", "body/pole/length"]
    dry = Parameter("", "N", "dry friction", "bounded", 0.0, 1.0)
    path = written(tmp_path, RESTING)
    system = sy.MuJoCo(path, ["joint/x/damping", *dead], {dead[0]: dry})
    prior = system.parameters.prior()
    theta = np.asarray(system.parameters.constrain(prior.mean))
    rng = np.random.default_rng(0)
    S = rng.normal(size=(20, 6))
    S[:, [2, 5]] = 0.0  # y rests
    rows = np.tile(theta, (20, 1)), S, np.zeros((20, 0)), np.full(20, DT)
    _, J = system.engine.slopes(*rows)
    slope = jax.jacfwd(system.parameters.constrain)(prior.mean) @ prior.scale
    A = jnp.asarray(J[..., :4].reshape(-1, 4)) @ slope / 1e-3
    scale = jnp.linalg.solve(jnp.linalg.cholesky(jnp.eye(4) + A.T @ A).T, jnp.eye(4))
    found = diagnose.summary(
        system.parameters, prior, Gaussian(prior.mean, prior.scale @ scale), A
    )
    words = {name: entry["verdict"] for name, entry in found["parameters"].items()}
    assert words == {"joint/x/damping": "identified"} | dict.fromkeys(dead, "dead")


SERVO = """<mujoco><option gravity="0 0 0"/><worldbody><body>
<joint name="q" axis="0 1 0" damping=".05" frictionloss=".02" armature=".01"/>
<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".4"/></body></worldbody>
<actuator><position name="servo" joint="q" kp="3" kv=".1"/></actuator></mujoco>"""


@in_float64
def test_gains_of_servos_are_held_as_they_share_a_factor_with_all_else(tmp_path):
    """Twice the mass, friction and gains move alike; without the gains they do not."""
    path = written(tmp_path, SERVO)
    held = sy.MuJoCo(path).parameters.names
    assert {name.split("/")[-1] for name in held} == {
        *("damping", "frictionloss", "armature", "mass"),
    }
    gains = ("actuator/servo/kp", "actuator/servo/kv")
    system = sy.MuJoCo(path, [*held, *gains])
    own = system.parameters.nominal()
    doubled = {k: 2.0 * v for k, v in own.items()}

    def after(values):
        params = system.record({k: jnp.asarray(v) for k, v in values.items()})
        s, a = jnp.asarray([0.2, -1.0]), jnp.asarray([0.5])
        return np.asarray(system.flow(params, s, a, 0.1))

    np.testing.assert_allclose(after(doubled), after(own), rtol=1e-6)
    apart = after(doubled | {k: own[k] for k in gains}) - after(own)
    assert np.abs(apart).max() > 1e-2
