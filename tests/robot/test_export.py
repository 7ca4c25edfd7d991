"""What leaves the project: a policy that needs no JAX, constants for other trainers."""

import json
import os
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2gp.errors import InputError, NotFinite
from sim2gp.models import NLM, Sim2GP
from sim2gp.planning import SAC, Observation, Policy
from sim2gp.planning.episode import oracle_world
from sim2gp.planning.tasks import furuta_swingup
from sim2gp.robot import NumpyPolicy, load_policy
from sim2gp.robot.export import export_model, export_policy
from sim2gp.runs import load_run, new_run, store
from sim2gp.systems import CartPole, Delay, Furuta, Machine, MuJoCo
from tests.catalogue import bad_policies

KEY = jax.random.key(0)
TASK, SYSTEM = furuta_swingup(), Furuta()
GOLDEN = Path(__file__).parents[1] / "golden"


CART = """
<mujoco><worldbody><body name="cart">
  <joint name="x" type="slide" axis="1 0 0" damping="2"/>
  <geom type="box" size=".1 .05 .02" mass=".4"/>
  <body name="pole">
    <joint name="theta" axis="0 -1 0" damping="1e-3"/>
    <geom type="capsule" size=".01" fromto="0 0 0 0 0 -.3" mass=".1"/>
  </body>
</body></worldbody>
<actuator><motor name="voltage" joint="x" gear="1.5"/></actuator></mujoco>
"""


@pytest.fixture(scope="module")
def policy() -> Policy:
    """Of networks as they begin, with wider layers than any action needs."""
    world = oracle_world(TASK)
    learner = SAC().init(world, key=KEY)
    actor = jax.tree.map(lambda x: 3.0 * x, learner.actor)
    return eqx.tree_at(lambda l: l.actor, learner, actor).policy


@pytest.fixture(scope="module")
def folder(policy: Policy, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("policy") / "policy"
    export_policy(policy, out, SYSTEM)
    return out


def test_numpy_does_what_jax_does(policy: Policy, folder: Path) -> None:
    """On 10,000 states, turned and fast ones as well."""
    run = load_policy(folder)
    reach = np.asarray([3.0, 40.0, 20.0, 40.0])
    S = np.random.default_rng(0).uniform(-reach, reach, (10_000, 4)).astype("f4")
    expected = np.asarray(jax.vmap(policy)(jnp.asarray(S)))
    got = np.stack([run(s) for s in S])
    assert got.dtype == np.float32
    np.testing.assert_allclose(got, expected, rtol=0.0, atol=1e-5)
    assert expected.std() > 1.0
    assert run.states == tuple(c.name for c in SYSTEM.states)
    assert np.abs(got).max() <= 5.0


def test_states_without_an_angle(policy: Policy, tmp_path: Path) -> None:
    plain = eqx.tree_at(
        lambda p: (p.observe, p.actor.weights[0]),
        policy,
        (
            Observation(jnp.asarray([1.0, 2.0, 3.0, 4.0])),
            policy.actor.weights[0][:4],
        ),
    )
    export_policy(plain, tmp_path / "plain", SYSTEM)
    s = np.asarray([0.1, 3.0, -1.0, 2.0], "f4")
    expected = np.asarray(plain(jnp.asarray(s)))
    np.testing.assert_allclose(load_policy(tmp_path / "plain")(s), expected, atol=1e-5)


def test_a_control_computer_needs_no_jax(folder: Path) -> None:
    code = (
        "import sys; from sim2gp.robot import load_policy\n"
        f"a = load_policy({str(folder)!r})([0.1, 0.2, 0.3, 0.4])\n"
        "assert a.shape == (1,), a\n"
        "assert not {'jax', 'equinox', 'scipy'} & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_no_action_is_made_of_nothing(folder: Path) -> None:
    run = load_policy(folder)
    for bad in (np.nan, np.inf, -np.inf):
        with pytest.raises(NotFinite, match="E203"):
            run(np.asarray([0.0, 0.0, bad, bad]))
    with pytest.raises(ValueError, match="shape"):
        run(np.zeros(3))
    one, none = np.ones((1, 1), "f4"), np.zeros(1, "f4")
    wide = NumpyPolicy(
        ("x",), ("u",), (one, one), (none, none), one[0], -one[0], one[0], None
    )
    assert wide(np.asarray([5.0]))[0] == pytest.approx(np.tanh(5.0))
    with pytest.raises(NotFinite, match="E203"):
        wide(np.asarray([np.inf]))


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A good policy of two layers: four states, of which one turns, one action."""
    out = tmp_path_factory.mktemp("small") / "policy"
    rng = np.random.default_rng(0)
    widths, states = (5, 3, 2), ("x", "theta", "x.velocity", "theta.velocity")
    arrays = {"scale": [1.0, 2.0, 3.0, 4.0], "low": [-5.0], "high": [5.0]}
    for i, shape in enumerate(pairwise(widths)):
        arrays |= {f"weights/{i}": rng.normal(size=shape)}
        arrays |= {f"biases/{i}": rng.normal(size=shape[1])}
    units = dict(
        zip((*states, "voltage"), ("m", "rad", "m/s", "rad/s", "V"), strict=True)
    )
    about = {"format": 1, "layers": 2, "angle": 1, "states": states}
    about |= {"actions": ["voltage"], "units": units}
    with new_run(out, "export policy") as writer:
        plain = {name: np.asarray(x, np.float32) for name, x in arrays.items()}
        writer.write_arrays("arrays.npz", plain)
        writer.write_summary({"policy": about})
    return out


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hundreds of runs in a moment: none waits for the disk, or asks for versions."""
    monkeypatch.setattr(os, "fsync", lambda handle: None)
    monkeypatch.setattr(store, "environment", dict)


@pytest.mark.usefixtures("hasty")
def test_no_malformed_policy_is_accepted(small: Path, tmp_path: Path) -> None:
    """More than 300 of them; each is refused with the error of its kind."""
    assert load_policy(small)(np.zeros(4)).shape == (1,)
    accepted, surprises = [], []
    found = bad_policies.cases(small)
    for i, case in enumerate(found):
        case.make(tmp_path / str(i))
        try:
            load_policy(tmp_path / str(i))
            accepted.append(case.name)
        except InputError as error:
            if error.code != case.code:
                surprises.append(f"{case.name}: {error}")
        except Exception as error:
            surprises.append(f"{case.name}: {error!r}")
    assert len(found) >= 300
    assert accepted == []
    assert surprises == []


@pytest.mark.usefixtures("hasty")
def test_sizes_are_checked_before_an_array_is_built(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor is anything built where only names or units are wrong."""
    from sim2gp.robot import policy

    def built(content: bytes) -> dict[str, np.ndarray]:
        raise AssertionError("an array was built")

    monkeypatch.setattr(policy, "load_arrays", built)
    words = ("declares too much", "units: ", "no rows", "no states", "as <f8")
    found = [c for c in bad_policies.cases(small) if any(w in c.name for w in words)]
    assert len(found) > 20
    for i, case in enumerate(found):
        case.make(tmp_path / str(i))
        with pytest.raises(InputError, match=case.code):
            load_policy(tmp_path / str(i))


def test_a_policy_of_the_first_version_still_acts_as_it_did() -> None:
    """Files and actions that version 0.1.0 wrote."""
    run = load_policy(GOLDEN / "policy")
    said = json.loads((GOLDEN / "policy.json").read_text())
    for s, a in zip(said["states"], said["actions"], strict=True):
        np.testing.assert_allclose(run(np.asarray(s, "f4")), a, rtol=1e-6)


def test_nothing_is_exported_that_a_robot_refuses(
    policy: Policy, tmp_path: Path
) -> None:
    lost = eqx.tree_at(lambda p: p.actor.biases[0], policy, replace_fn=lambda b: b / 0)
    with pytest.raises(InputError, match="E181"):
        export_policy(lost, tmp_path / "lost", SYSTEM)
    assert not (tmp_path / "lost").exists()


def test_a_policy_of_another_machine_is_not_named_after_this_one(
    policy: Policy, tmp_path: Path
) -> None:
    few = eqx.tree_at(lambda p: p.observe.scale, policy, jnp.ones(3))
    with pytest.raises(ValueError, match="3 states, the system has 4"):
        export_policy(few, tmp_path / "few", SYSTEM)
    assert not (tmp_path / "few").exists()


def test_draws_are_machines_and_keep_what_ties_their_constants(tmp_path: Path) -> None:
    """Row by row the posterior's own draws: moments in virtual space."""
    system = CartPole()
    belief = Sim2GP(system).init(KEY)
    p = belief.posterior.mean.size
    mix = np.random.default_rng(1).normal(size=(p, p)) / np.sqrt(p)
    with jax.enable_x64(True):
        scale = jnp.asarray(0.3 * mix)
    belief = eqx.tree_at(lambda b: b.posterior.scale, belief, scale)
    out = tmp_path / "model"
    export_model(belief, out, system, dt=0.02, draws=4000, key=KEY)
    run = load_run(out)
    table = system.parameters
    rows = np.stack([run.arrays[f"draws/{name}"] for name in table.names], axis=1)
    with jax.enable_x64(True):
        tt = np.asarray(jax.vmap(table.unconstrain)(jnp.asarray(rows)))
    cov = 0.09 * mix @ mix.T
    np.testing.assert_allclose(np.cov(tt.T), cov, atol=0.12 * np.diag(cov).max())
    about = run.summary["model"]
    name = table.names[0]
    assert about["constants"][name]["unit"] == table.units[0]
    low, high = np.quantile(rows[:, 0], [0.45, 0.55])
    assert low <= about["constants"][name]["map"] <= high
    sd = [about["constants"][name]["sd"] for name in table.names]
    np.testing.assert_allclose(sd, rows.std(axis=0), rtol=0.06)
    few = tmp_path / "few"  # the posterior's, however many are drawn of it
    export_model(belief, few, system, dt=0.02, draws=2, key=KEY)
    constants = load_run(few).summary["model"]["constants"]
    assert [constants[name]["sd"] for name in table.names] == sd
    assert not (out / "step.jax").exists()


def test_draws_of_a_mujoco_model_are_its_files(tmp_path: Path) -> None:
    """Behind a delayed input as well; row ``i`` of the arrays is file ``i``."""
    mujoco = pytest.importorskip("mujoco", reason="sim2gp[mujoco] is not installed")
    path = tmp_path / "cart.xml"
    path.write_text(CART)
    bare = MuJoCo(path, ["body/pole/mass", "joint/x/damping"])
    system = Machine(bare, actuators=[Delay("voltage", 0.01)])
    belief = Sim2GP(system).init(KEY)
    export_model(belief, tmp_path / "model", system, dt=0.02, draws=3, key=KEY)
    run = load_run(tmp_path / "model")
    for i in range(3):
        text = tmp_path / "model" / f"variant_{i:03d}.xml"
        model = mujoco.MjModel.from_xml_path(str(text))
        mass = run.arrays["draws/body/pole/mass"][i]
        damping = run.arrays["draws/joint/x/damping"][i]
        assert model.body("pole").mass[0] == pytest.approx(mass, rel=1e-12)
        assert model.joint("x").damping[0] == pytest.approx(damping, rel=1e-12)
    with pytest.raises(InputError, match="E135"):
        export_model(
            belief, tmp_path / "m", system, dt=0.02, draws=1, key=KEY, compiled=True
        )
    assert not (tmp_path / "m").exists()


def test_a_compiled_step_comes_back(tmp_path: Path) -> None:
    pytest.importorskip("flatbuffers", reason="sim2gp[deploy] is not installed")
    from jax import export

    belief = Sim2GP(SYSTEM).init(KEY)
    out = tmp_path / "model"
    export_model(belief, out, SYSTEM, dt=0.02, draws=2, key=KEY, compiled=True)
    step = export.deserialize(bytearray((out / "step.jax").read_bytes())).call
    s, a = jnp.asarray([0.1, 0.5, 1.0, -2.0]), jnp.asarray([2.0])
    central = load_run(out).summary["model"]["constants"]
    record = SYSTEM.record(
        {k: jnp.asarray(v["map"], jnp.float32) for k, v in central.items()}
    )
    expected = SYSTEM.bind(record, 0.02)(s, a)
    np.testing.assert_allclose(step(s, a), expected, rtol=1e-5, atol=1e-6)


def test_a_belief_without_constants_is_refused(tmp_path: Path) -> None:
    belief = NLM(SYSTEM, hidden=(4,)).init(KEY)
    with pytest.raises(InputError, match="E134"):
        export_model(belief, tmp_path / "m", SYSTEM, dt=0.02, draws=2, key=KEY)
    assert not (tmp_path / "m").exists()
