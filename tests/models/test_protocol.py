"""Every public model goes through everything that takes one.

A model of one's own promises the same (docs/your_model.md).
"""

import functools
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

import sim2gp as sg
from mass_task import mass_task, single
from rail_mass import DT, rail_mass
from sim2gp.data import one_step_log as stepping
from sim2gp.errors import InputError
from sim2gp.models.auto import log_scores
from sim2gp.models.ensemble import ensemble
from sim2gp.planning import MarkovObjective, RandomInput
from sim2gp.planning.episode import world_of
from sim2gp.planning.exploration import InformationGain, Optimistic
from sim2gp.robot.export import export_model
from sim2gp.runs.sinks import each_episode
from sim2gp.systems import Delay, free_parts
from sim2gp.types import single as in_float32

KEY = jax.random.key(0)
D, ROWS, CAPACITY = 2, 16, 20  # the rows of an episode: one program


SYSTEM = rail_mass()
TRUTH = {"gain": single(2.0)[0], "drag": single(0.4)[0]}
TINY = {"hidden": (5,), "steps": 100, "refit_steps": 0}


def sim(**options):
    return sg.Sim2GP(SYSTEM, dt=DT, **options)


def nlm():
    return sg.NLM(SYSTEM, **TINY)


PLAIN = {
    "Sim2GP": sim,
    "NLM": nlm,
    "Residual": lambda: sg.Residual(sim(), **TINY),
    "FunctionSpace": lambda: sg.FunctionSpace(sim(), pretrain=0, **TINY),
    "ResidualFunctionSpace": lambda: sg.ResidualFunctionSpace(sim(), **TINY),
    "MissingForces": lambda: sg.MissingForces(sim()),
}
MODELS = {
    **PLAIN,
    "Auto": lambda: sg.Auto([sim(), nlm()]),
    **{
        f"PointEstimate({name})": lambda make=make: sg.PointEstimate(make())
        for name, make in PLAIN.items()
        if name != "MissingForces"  # whose beliefs are those of Sim2GP
    },
    "PointEstimate(Auto)": lambda: sg.PointEstimate(sg.Auto([sim(), nlm()])),
    "Auto(PointEstimate)": lambda: sg.Auto([sg.PointEstimate(sim()), sim()]),
    "PriorMean": lambda: sg.PriorMean(sim()),
}
#: Models whose draws all are one function, and those with constants to report.
CERTAIN = {n for n in MODELS if n.startswith(("PointEstimate", "PriorMean", "Auto("))}
WITHOUT = {"NLM", "PointEstimate(NLM)", "Auto", "PointEstimate(Auto)"}
KNOWING = set(MODELS) - WITHOUT
#: Of a function's numbers; `Auto` adds the index of its choice.
SINGLE = {jnp.dtype("float32"), jnp.dtype("int32")}


def rows():
    """Transitions of the real machine, in a buffer that is not full."""
    rng = np.random.default_rng(0)
    step = eqx.filter_jit(SYSTEM.bind(TRUTH, DT))
    A = rng.uniform(-1.0, 1.0, (ROWS, 1)).astype("f4")
    S = [np.zeros(D, "f4")]
    for a in A:
        noise = np.asarray([1e-3, 1e-2]) * rng.standard_normal(D)
        S.append((np.asarray(step(*map(jnp.asarray, (S[-1], a)))) + noise).astype("f4"))
    S = np.stack(S)
    return sg.Transitions.empty(CAPACITY, D, 1).extend(S[:-1], A, S[1:])


@functools.cache
def fitted(name):
    """A model, its data, and its belief before and after them."""
    model, data = MODELS[name](), rows()
    before = model.init(KEY)
    return model, data, before, model.fit(before, data, key=KEY)


def sd_of(gaussian):
    """Of each output; in float64, which is off in these tests as it is for users."""
    return np.sqrt(np.sum(np.asarray(gaussian.scale) ** 2, axis=1))


def point_of(data, n=3):
    return jnp.asarray(data.state[n]), jnp.asarray(data.action[n])


def moments(name, model, data, before, belief):
    """Finite, of all outputs, and wider with noise than without."""
    for each in (before, belief):
        latent, predicted = (f(*point_of(data)) for f in (each.latent, each.predict))
        assert latent.mean.shape == predicted.mean.shape == (D,)
        assert np.all(np.isfinite(np.asarray(predicted.mean)))
        assert np.all(sd_of(predicted) >= np.asarray(each.noise) * (1.0 - 1e-6))
        assert np.all(sd_of(latent) < sd_of(predicted))
        assert (name in CERTAIN) == bool(np.all(sd_of(latent) == 0.0))


def noise(name, model, data, before, belief):
    """Of each physical state, before data too."""
    for each in (before, belief):
        sd = np.asarray(each.noise)
        assert sd.shape == (D,)
        assert np.all(np.isfinite(sd) & (sd > 0.0))


def parameters(name, model, data, before, belief):
    """As many as the table has, or none; as many before as after."""
    p = len(SYSTEM.parameters) if name in KNOWING else 0
    for each in (before, belief):
        mean, sd = map(np.asarray, each.parameters())
        assert mean.shape == sd.shape == (p,)
        assert np.all(np.isfinite(mean) & (sd > 0.0))


def draws(name, model, data, before, belief):
    """A draw is one function, in single precision, and a tree of arrays."""
    s, a = (x.astype("float32") for x in point_of(data))
    one, again, other = (belief.sample(jax.random.key(k))(s, a) for k in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert one.dtype == s.dtype
    assert one.shape == belief.point()(s, a).shape == (D,)
    assert (name in CERTAIN) == bool(np.all(one == other))
    assert {x.dtype for x in jax.tree.leaves(belief.point())} <= SINGLE


def scores(name, model, data, before, belief):
    """The predictive's log density, and zero where there is no row."""
    found = np.asarray(log_scores(belief, data))
    assert found.shape == (CAPACITY,)
    assert np.all(found[ROWS:] == 0.0)
    predicted = belief.predict(*point_of(data))
    scale = np.asarray(predicted.scale)
    known = multivariate_normal(np.asarray(predicted.mean), scale @ scale.T)
    assert found[3] == pytest.approx(known.logpdf(data.next_state[3]), rel=1e-6)


def auto(name, model, data, before, belief):
    """One of two; what is chosen speaks."""
    chooser = sg.Auto([model, sim()])
    chosen = chooser.fit(chooser.init(KEY), data, key=KEY)
    speaks = chosen.beliefs[int(chosen.index)]
    np.testing.assert_array_equal(chosen.noise, speaks.noise)
    np.testing.assert_allclose(log_scores(chosen, data), log_scores(speaks, data))
    assert chosen.parameters()[0].size == (2 if name in KNOWING else 0)


def update(name, model, data, before, belief):
    """The same tree, other numbers: it runs inside a scan."""
    with jax.enable_x64(True):
        row = (data.state[0], data.action[0], data.next_state[0])
        changed = eqx.filter_jit(model.update)(belief, *map(jnp.asarray, row))
    assert jax.tree.structure(changed) == jax.tree.structure(belief)
    pairs = zip(jax.tree.leaves(changed), jax.tree.leaves(belief), strict=True)
    assert all(x.shape == y.shape and x.dtype == y.dtype for x, y in pairs)


def information(name, model, data, before, belief):
    """Never negative; nothing where all draws are one function."""
    s, a = point_of(data)
    S, A = jnp.asarray(data.state[:4]), jnp.asarray(data.action[:4])
    one = float(belief.information_gain(s, a))
    four = float(belief.trajectory_information_gain(S, A))
    assert (one == four == 0.0) if name in CERTAIN else 0.0 < one < four
    untempered = belief.untempered()
    planned, four = (
        InformationGain(in_float32(untempered)),
        float(untempered.trajectory_information_gain(S, A)),
    )
    gains = eqx.filter_jit(planned.along)(planned.init(), S, A, S)
    assert float(jnp.sum(gains)) == pytest.approx(four, rel=2e-2, abs=1e-6)
    bonus = Optimistic(mass_task().reward, in_float32(belief), single(1.0)[0])
    assert np.isfinite(bonus(S[0], A[0], S[1]))


def world(name, model, data, before, belief):
    """A draw is planned in like the real machine."""
    task = mass_task()
    made = world_of(task, belief.untempered().sample(KEY), MarkovObjective(task.reward))
    rewards, valid = sg.rollout(made, task.start, single(1.0, -1.0, 0.5)[:, None])
    assert rewards.shape == (3,)
    assert bool(valid)


def loop(name, model, data, before, belief):
    """An episode on the prior, a fit, numbers for a report."""
    said = []

    class Sink:
        def scalars(self, step, values):
            said.append(values)

        def close(self):
            pass

    history = sg.psrl(
        mass_task(dynamics=SYSTEM.bind(TRUTH, DT)),
        model,
        RandomInput(),
        episodes=1,
        key=KEY,
        on_episode=each_episode(Sink()),
    )
    p = 2 if name in KNOWING else 0
    assert history.parameter_mean.shape == history.parameter_sd.shape == (2, p)
    assert np.isfinite(said[0]["return"])


def forecast(name, model, data, before, belief):
    """Rolled out for some steps, with its noise."""
    S = np.asarray(data.state[:3])
    steps = stepping.Steps(
        S,
        np.zeros((3, 4, 1)),
        np.zeros((3, 1, D)),
        np.ones((3, 1, D), bool),
        np.zeros(3, int),
        (4,),
        (0, 1),
    )
    found = ensemble(belief, steps, np.zeros(D), draws=5, key=KEY)
    assert found.finite()
    assert found.draws.shape == (5, 3, 1, D)
    assert np.all(np.std(found.draws, axis=0) > 0.0)


def export(name, model, data, before, belief, tmp_path):
    """Of a simulator's own belief; of others one line says why not.

    Where no force is on, that of `MissingForces` is one.
    """
    out = tmp_path / "machine"
    if name in ("Sim2GP", "MissingForces"):
        export_model(belief, out, SYSTEM, dt=DT, draws=3, key=KEY)
        assert (out / "arrays.npz").exists()
        return
    with pytest.raises(InputError, match=r"^E134 no parameters in a belief of type"):
        export_model(belief, out, SYSTEM, dt=DT, draws=3, key=KEY)
    assert not out.exists()


CONSUMERS = [
    *(moments, noise, parameters, draws, scores, auto, update, information),
    *(world, loop, forecast, export),
]


#: Wrapped models share nearly all of their code; these are tried every night alone.
WRAPPED = ("PointEstimate(", "Auto(")
LONG = {draws, update, information, world, loop, forecast}
#: Models that train a network around another model: by day in tests of their own.
NETWORKS = ("Residual", "Auto")


def cases():
    for name, consumer in itertools.product(MODELS, CONSUMERS):
        cheap = name in ("PointEstimate(Sim2GP)", "PointEstimate(NLM)")
        wrapped = name.startswith(WRAPPED) and not cheap
        rare = consumer in LONG and (wrapped or name in NETWORKS)
        rare |= wrapped and name.endswith(("Residual)", "FunctionSpace)"))
        rare |= name.endswith("FunctionSpace")
        rare |= (name, consumer) == ("MissingForces", moments)
        marks = [pytest.mark.nightly] if rare else []
        yield pytest.param(
            name, consumer, marks=marks, id=f"{name}-{consumer.__name__}"
        )


@pytest.mark.parametrize(("name", "consumer"), list(cases()))
def test_every_model_goes_through_every_consumer(name, consumer, tmp_path) -> None:
    more = {"tmp_path": tmp_path} if consumer is export else {}
    consumer(name, *fitted(name), **more)


def test_every_public_model_is_tried() -> None:
    public = {
        name
        for name in sg.__all__
        if isinstance(getattr(sg, name), type)
        and issubclass(getattr(sg, name), sg.AbstractModel)
    } - {"AbstractModel"}
    assert public == {type(make()).__name__ for make in MODELS.values()}


def test_a_belief_says_how_large_its_noise_is() -> None:
    """Without it no belief is made: what needs it would fail far away."""

    class Silent(sg.AbstractBelief):
        def latent(self, s, a): ...

        predict = sample = point = sensitivity = coordinates = latent

    with pytest.raises(TypeError, match="noise"):
        Silent()


@pytest.mark.parametrize("name", MODELS)
def test_a_model_says_how_many_past_actions_its_states_carry(name, monkeypatch):
    """Those of its machine, whatever it is wrapped in; none without delayed inputs."""
    assert MODELS[name]().history == 0
    delay = Delay(SYSTEM.actions[0].name, 2.5 * DT)
    late = free_parts(SYSTEM, [delay], period=DT)
    monkeypatch.setitem(globals(), "SYSTEM", late)
    assert late.history == MODELS[name]().history == 3
