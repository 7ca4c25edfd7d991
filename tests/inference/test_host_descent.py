"""Fits on simulators of the host: their posterior, first answers, failures."""

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sim2gp.inference.host_descent as host
from sim2gp.cli import main
from sim2gp.cli.late import FirstFolder
from sim2gp.data.logs import Log
from sim2gp.data.split_log import cut
from sim2gp.errors import NotConverged
from sim2gp.identification import fit
from sim2gp.identification.fit import fit_windows
from sim2gp.inference.arrowhead import Noise
from sim2gp.inference.convergence import NEAR
from sim2gp.inference.estimate import estimate
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.least_squares import factor
from sim2gp.inference.linear_likelihood import LinearLikelihood
from sim2gp.inference.parameters import Parameter, Parameters
from sim2gp.inference.prior import ParameterPrior
from sim2gp.systems import ODE, BlackBox, Channel, EncoderOffset, free_parts
from sim2gp.types import in_float64
from tests.commands.test_passive_model import PROJECT, SWING

mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is not installed")

TABLE = (
    Parameter("gravity", "1/s^2", "gravity over length", "log_bounded", 3.0, 30.0),
    Parameter("damping", "1/s", "viscous friction", "log_bounded", 0.05, 5.0),
)
PAIR = tuple(Parameter(n, "1", n, "identity", mean=0.0, sd=1.0) for n in "ab")
STATES = Channel("q", "rad", angle=True), Channel("q.velocity", "rad/s")
ACTIONS = (Channel("torque", "1/s^2", low=-5.0, high=5.0),)
STEP, NOISE = 2e-3, 1e-3
KEY = jax.random.key(0)


def slope(xp: Any, k: Any, s: Any, a: Any) -> Any:
    turn = a[..., 0] - k["gravity"] * xp.sin(s[..., 0]) - k["damping"] * s[..., 1]
    return xp.stack([s[..., 1], turn], -1)


def rk4(k: Any, s: Any, a: Any, h: Any) -> Any:
    h = np.asarray(h)[..., None]
    k1 = slope(np, k, s, a)
    k2 = slope(np, k, s + h / 2 * k1, a)
    k3 = slope(np, k, s + h / 2 * k2, a)
    return s + h / 6 * (k1 + 2 * k2 + 2 * k3 + slope(np, k, s + h * k3, a))


EXACT = ODE(lambda k, s, a: slope(jnp, k, s, a), TABLE, STATES, ACTIONS)
BOX = BlackBox(rk4, TABLE, STATES, ACTIONS, batched=True, max_substep=STEP)


def log(seconds: float) -> Log:
    """A driven pendulum, its angle alone, every 10 ms."""
    rng, count = np.random.default_rng(0), round(seconds / 0.01)
    torque = np.repeat(rng.uniform(-5.0, 5.0, count // 20 + 1), 20)[:count]
    s, q = np.asarray([0.5, 0.0]), np.empty(count)
    for i in range(count):
        q[i] = s[0] + NOISE * rng.standard_normal()
        for _ in range(5):
            s = rk4({"gravity": 9.81, "damping": 0.7}, s, torque[i : i + 1], STEP)
    return Log(
        name="swing",
        source="swing.csv",
        time=0.01 * np.arange(count),
        channels={"q": q},
        inputs={"torque": torque},
        mask={"q": np.ones(count, bool)},
    )


@in_float64
def test_the_posterior_is_that_of_one_compiled_program():
    """The same pendulum as JAX: other steps, another EM, one posterior."""
    found = []
    for system in (EXACT, BOX):
        windows, _ = cut([log(6.0)], system, window=0.5)
        found.append(fit_windows(system, windows, key=KEY))
    exact, box = found
    sd = np.asarray(exact.posterior.sd())
    away = (np.asarray(box.posterior.mean) - np.asarray(exact.posterior.mean)) / sd
    assert np.abs(away).max() < 0.02
    np.testing.assert_allclose(box.posterior.sd(), sd, rtol=5e-3)
    np.testing.assert_allclose(box.noise.sd, exact.noise.sd, rtol=5e-3)
    assert float(box.log_evidence) == pytest.approx(float(exact.log_evidence), abs=0.1)
    assert int(box.convergence.steps) <= 20


@in_float64
def test_starts_are_compared_on_some_windows_and_each_step_is_reported(monkeypatch):
    monkeypatch.setattr(fit, "MANY", 0)
    windows, _ = cut([log(12.0)], BOX, window=0.5)
    said: list[tuple[int, int]] = []
    answers = []

    def report(at: host.Progress, estimate: Any) -> None:
        said.append((len(at.noise.weights), at.steps))
        answers.append(estimate())

    found = fit_windows(BOX, windows, key=KEY, report=report)
    sizes = [count for count, _ in said]
    assert (sizes[0], sizes[-1], len(windows)) == (5, 24, 24)
    assert sizes == sorted(sizes)
    first = answers[sizes.index(24) - 1]
    # What a fifth of the data knows holds what all of them know.
    away = np.asarray(first.posterior.mean) - np.asarray(found.posterior.mean)
    assert np.all(np.abs(away) < 4.0 * np.asarray(first.posterior.sd()))
    assert np.all(np.asarray(first.posterior.sd()) > np.asarray(found.posterior.sd()))


@pytest.mark.nightly
@in_float64
def test_an_encoders_offset_is_learned_on_the_host_as_by_jax():
    """What a machine adds around its plant is differentiated beside the simulator."""
    found = []
    for system in (EXACT, BOX):
        machine = free_parts(system, [EncoderOffset("q", 0.0)])
        windows, _ = cut([log(6.0)], machine, window=0.5)
        found.append(fit_windows(machine, windows, key=KEY, starts=1))
    exact, box = (np.asarray(fitted.posterior.mean) for fitted in found)
    sd = np.asarray(found[0].posterior.sd())
    assert np.abs((box - exact) / sd).max() < 0.03
    np.testing.assert_allclose(found[1].posterior.sd(), sd, rtol=0.01)


def kinked() -> BlackBox:
    """Dry friction without smoothing: its steps have kinks."""

    def step(k: Any, s: Any, a: Any, h: Any) -> Any:
        w = s[..., 1] + h * (a[..., 0] - k["gravity"] * np.sin(s[..., 0]))
        slowed = np.maximum(np.abs(w) - h * k["damping"], 0.0)
        w = np.sign(w) * slowed
        return np.stack([s[..., 0] + h * w, w], -1)

    return BlackBox(step, TABLE, STATES, ACTIONS, batched=True, max_substep=0.01)


@in_float64
def test_a_machine_with_kinks_has_an_answer():
    windows, _ = cut([log(6.0)], kinked(), window=0.5)
    found = fit_windows(kinked(), windows, key=KEY)
    assert float(found.convergence.newton_step_sd) <= NEAR


@in_float64
def test_a_failed_fit_names_its_parameters_and_keeps_what_it_knows(monkeypatch):
    monkeypatch.setattr(host, "MOST_STEPS", 2)
    monkeypatch.setattr(host, "FIRST_STEPS", 1)
    windows, _ = cut([log(3.0)], BOX, window=0.5)
    with pytest.raises(NotConverged, match=r"E201 .*farthest off: \w+ \(.* sd\)") as e:
        fit_windows(BOX, windows, key=KEY)
    known = e.value.known
    assert np.isfinite(np.asarray(known.posterior.mean)).all()
    worst = TABLE[int(np.argmax(known.convergence.away))].name
    assert f"farthest off: {worst}" in str(e.value)


def identified(folder: Path) -> tuple[int, Path]:
    """`sim2gp identify --quick` of a swing that was let go."""
    (folder / "swing.xml").write_text(SWING.format(0.012))
    (folder / "swing.toml").write_text(PROJECT)
    model = mujoco.MjModel.from_xml_string(SWING.format(0.02))
    rng, data, rows = np.random.default_rng(0), mujoco.MjData(model), []
    data.qpos[:] = 1.0
    for _ in range(200):
        rows.append(f"{data.time:.6f},{data.qpos[0] + NOISE * rng.normal():.9f}")
        mujoco.mj_step(model, data, 2)
    (folder / "log.csv").write_text("t,angle\n" + "\n".join(rows) + "\n")
    run = folder / "run"
    project = str(folder / "swing.toml")
    return main(["identify", project, "--quick", "--out", str(run)]), run


@pytest.mark.nightly
def test_the_first_answer_is_replaced_by_the_run(tmp_path, capsys, monkeypatch):
    replaced, seen = FirstFolder.replaced, []

    def look(self: FirstFolder) -> None:
        text = (self.folder / "summary.json").read_text()
        seen.append(json.loads(text))
        replaced(self)

    monkeypatch.setattr(FirstFolder, "replaced", look)
    code, run = identified(tmp_path)
    said = capsys.readouterr()
    assert code == 0, said.err
    assert "1 parameters, 10 windows of 0.2 s, 1 measured columns" in said.err
    assert not (tmp_path / "run-first").exists()
    final = json.loads((run / "summary.json").read_text())
    first = seen[0]
    assert first["first_answer"]
    assert (first["converged"], final["converged"]) == (False, True)
    was, now = (x["parameters"]["joint/q/damping"] for x in (first, final))
    assert was["mean"] == pytest.approx(now["mean"], abs=4.0 * was["sd"])
    assert was["sd"] < 0.2 * was["prior_sd"]  # not the prior under the first noise
    assert final["convergence"]["newton_step_sd"] <= NEAR


def test_a_failed_fit_leaves_what_it_knows(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(host, "MOST_STEPS", 1)
    monkeypatch.setattr(host, "FIRST_STEPS", 1)
    code, run = identified(tmp_path)
    said = capsys.readouterr().err
    assert code != 0
    assert "E201" in said
    assert "run-first" in said
    assert not run.exists()
    known = json.loads((tmp_path / "run-first" / "summary.json").read_text())
    assert known["first_answer"]
    assert "E201" in known["headline"]
    assert "joint/q/damping" in known["parameters"]
    assert (tmp_path / "run-first" / "report.html").exists()


@in_float64
def test_a_large_first_noise_does_not_end_a_descent():
    """Beside it the first step promises nothing, whatever it is of the true noise."""
    rng = np.random.default_rng(0)
    J = rng.normal(size=(200, 2))
    y = J @ [0.3, -0.2] + 1e-3 * rng.normal(size=200)
    at = factor(J, -y)[None, None]
    counts, floor = jnp.full((1, 1), 200.0), jnp.full(1, 1e-6)
    prior, found = Gaussian(jnp.zeros(2), jnp.eye(2)), []
    for first in (1e3, 1e-3):
        noise = Noise(jnp.full(1, first), jnp.ones(1))
        about = np.zeros(2), np.zeros((1, 0)), noise
        likelihood = LinearLikelihood(counts, floor, at, *about)
        known = ParameterPrior(prior, Parameters(PAIR))
        found.append(estimate(likelihood, known, starts=jnp.zeros((1, 2))))
    for x in found:
        assert float(x.noise.sd[0]) == pytest.approx(1e-3, rel=0.2)
        exact, _ = np.linalg.lstsq(J, y, rcond=None)[:2]
        away = (x.posterior.mean - exact) / x.posterior.sd()
        assert np.abs(away).max() < 0.05
