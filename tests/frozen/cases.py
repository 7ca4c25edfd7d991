"""Figures that a rewrite must not move: what they are, and how they are computed.

Each case returns named arrays. The recorded values are in `values/`: `record.py` writes
them, `test_frozen.py` compares. Data are recorded too, so that a change of one machine
moves the cases of that machine alone. Names from inside the library are in `adapters`.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import machines
import sim2gp as sg
from frozen import adapters
from sim2gp.types import in_float64

VALUES = Path(__file__).parent / "values"
KEY = jax.random.key(5)
ROWS, EPISODE, NEW = 160, 40, 40
Arrays = dict[str, np.ndarray]


def stored(name: str) -> Arrays:
    """The recorded arrays of one case."""
    with np.load(VALUES / f"{name.replace('/', '_')}.npz") as file:
        return {key: file[key] for key in file.files}


@in_float64
def data_of(machine: Any, seed: int) -> Arrays:
    """Rows of a machine at its nominal constants: exact states, noise on each step."""
    rng = np.random.default_rng(seed)
    params = machine.nominal()
    step = jax.jit(lambda s, a: machine.step(params, s, a, 0.02))
    high = np.asarray([channel.high for channel in machine.actions])
    d = len(machine.physical_states)
    rows = []
    for t in range(ROWS + NEW):
        if t % EPISODE == 0:
            s = np.zeros(len(machine.states))
            s[:d] = 0.3 * rng.standard_normal(d)
        a = 0.5 * high * rng.uniform(-1.0, 1.0, len(high))
        s2 = np.array(step(jnp.asarray(s), jnp.asarray(a)))
        s2[:d] += 1e-3 * rng.standard_normal(d)
        rows.append((s, a, s2))
        s = s2
    S, A, S2 = map(np.stack, zip(*rows, strict=True))
    return {"S": S, "A": A, "S2": S2}


def rows_of(name: str) -> tuple[sg.Transitions, Arrays]:
    """The recorded rows to learn from, and those that come later."""
    rows = stored(f"data/{name}")
    first = {key: x[:ROWS] for key, x in rows.items()}
    later = {key: x[ROWS:] for key, x in rows.items()}
    return sg.Transitions.of(first["S"], first["A"], first["S2"]), later


@in_float64
def transition(name: str) -> Arrays:
    """One step of a machine and its derivatives in constants, state and input."""
    machine = adapters.stepped()[name]
    tt, S, A = machines.batch(machine, 5, 11)
    step = machines.jitted(machine, 0.02)
    slopes = jax.jit(jax.vmap(jax.jacfwd(step, argnums=(0, 1, 2))))
    by_tt, by_s, by_a = slopes(tt, S, A)
    return {
        "next": np.asarray(jax.vmap(step)(tt, S, A)),
        "by_constants": np.asarray(by_tt),
        "by_state": np.asarray(by_s),
        "by_input": np.asarray(by_a),
    }


@in_float64
def density(name: str) -> Arrays:
    """Residuals and Jacobians of the one-step likelihood as factors, at two points."""
    data, _ = rows_of(name)
    likelihood, e = adapters.stacked(adapters.one_step()[name], data)
    p = len(adapters.one_step()[name].parameters)
    out = {}
    for label, z in {"prior": np.zeros(p), "away": 0.3 * np.ones(p)}.items():
        R = np.asarray(likelihood.blocks(jnp.asarray(z), e))
        out[label] = np.swapaxes(R, -1, -2) @ R
    return out


@in_float64
def one_step(name: str) -> Arrays:
    """SIM2GP fitted, asked, drawn from, and updated."""
    machine = adapters.one_step()[name]
    data, later = rows_of(name)
    model = sg.Sim2GP(machine)
    belief = model.fit(model.init(KEY), data, key=KEY)
    return asked(model, belief, later) | {
        "mean": np.asarray(belief.posterior.mean),
        "covariance": np.asarray(belief.posterior.covariance()),
        "log_evidence": np.asarray(belief.log_evidence),
    }


@in_float64
def learner(name: str) -> Arrays:
    """A model with a network: fitted twice, asked, drawn from, and updated."""
    model = adapters.learners(adapters.one_step()["furuta"])[name]
    data, later = rows_of("furuta")
    first = sg.Transitions.of(*(np.asarray(x)[:EPISODE] for x in _columns(data)))
    belief = model.fit(model.init(KEY), first, key=KEY)
    belief = model.fit(belief, data, key=jax.random.fold_in(KEY, 1))
    return asked(model, belief, later)


@in_float64
def asked(model: Any, belief: Any, later: Arrays) -> Arrays:
    """What a belief answers, before and after it is updated by rows to come."""
    S, A, S2 = (jnp.asarray(later[name]) for name in ("S", "A", "S2"))

    @eqx.filter_jit
    def before(belief: Any) -> dict[str, Any]:
        def one(s: Any, a: Any) -> tuple[Any, ...]:
            found, own = belief.predict(s, a), belief.latent(s, a)
            return found.mean, found.covariance(), own.covariance()

        names = "predicted", "predicted_covariance", "latent_covariance"
        out = dict(zip(names, jax.vmap(one)(S[:3], A[:3]), strict=True))
        gain = [belief.trajectory_information_gain(S[:n], A[:n]) for n in (1, 20)]
        return out | {"information": jnp.stack(gain), "noise": belief.noise}

    @eqx.filter_jit
    def after(belief: Any) -> dict[str, Any]:
        for k in range(3):
            belief = model.update(belief, S[k], A[k], S2[k])
        found = belief.predict(S[5], A[5])
        return {"updated": found.mean, "updated_covariance": found.covariance()}

    @eqx.filter_jit
    def followed(f: Any) -> Any:
        return jax.vmap(f)(*(x[:3].astype(jnp.float32) for x in (S, A)))

    draw = belief.sample(jax.random.fold_in(KEY, 2))
    out = before(belief) | after(belief)
    out |= {"draw": followed(draw), "point": followed(belief.point())}
    return {key: np.asarray(x) for key, x in out.items()}


@in_float64
def logs(name: str) -> Arrays:
    """A fit of windows of logs, its rows, and its corrected intervals."""
    machine, recorded, options = adapters.windowed()[name]
    options = {"robust": False} | options
    found, of, belief = adapters.cut_and_fit(machine, recorded, **options)
    r, J = adapters.slopes(belief, found)
    corrected = adapters.intervals(belief, found, of)
    likelihood, e = adapters.of_windows(machine, found)
    R = np.asarray(likelihood.blocks(0.2 * jnp.ones(len(machine.parameters)), e))
    out = {
        "factors": np.swapaxes(R, -1, -2) @ R,
        "residual": r,
        "jacobian": J,
        "mean": belief.posterior.mean,
        "covariance": belief.posterior.covariance(),
        "noise": belief.noise,
        "weights": belief.weights,
        "starts": belief.starts,
        "log_evidence": belief.log_evidence,
        "corrected_mean": corrected.mean,
        "corrected_covariance": corrected.covariance(),
    }
    return {key: np.asarray(x) for key, x in out.items()}


def missing() -> Arrays:
    """The gain of each effect that a pendulum's logs may show."""
    machine, recorded, _ = adapters.windowed()["robust"]
    gains = adapters.gains(machine, recorded)
    return {name: np.asarray(gain) for name, gain in sorted(gains.items())}


def _columns(data: sg.Transitions) -> tuple[Any, Any, Any]:
    return data.state, data.action, data.next_state


def every() -> dict[str, Callable[[], Arrays]]:
    """All cases by name; data first, for the others read them."""
    cases: dict[str, Callable[[], Arrays]] = {}
    for seed, (name, machine) in enumerate(adapters.one_step().items()):
        cases[f"data/{name}"] = lambda m=machine, k=seed: data_of(m, k)
    groups = {
        "transition": (transition, adapters.stepped()),
        "density": (density, adapters.one_step()),
        "one_step": (one_step, adapters.one_step()),
        "logs": (logs, adapters.WINDOWED),
        "learner": (learner, adapters.learners(adapters.one_step()["furuta"])),
    }
    for group, (case, names) in groups.items():
        for name in names:
            cases[f"{group}/{name}"] = lambda c=case, n=name: c(n)
    return cases | {"missing": missing}
