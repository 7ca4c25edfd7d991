"""Settings that nothing real can have are refused where they are given."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sim2gp as sg
from design_cases import experiment, limits
from double_integrator import world
from linear_system import linear, windows_of
from mass_task import GainModel, mass_task, single
from sim2gp import checks
from sim2gp import systems as sy
from sim2gp.data.grid import evaluation_windows
from sim2gp.errors import InputError
from sim2gp.experiment_design.goals import Everything
from sim2gp.experiment_design.search import design
from sim2gp.experiment_design.signals import Free
from sim2gp.experiment_design.signals import Multisine as Sines
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.linear_measurements import LinearMeasurement
from sim2gp.inference.parameters import Parameter, Parameters, prior_from_moments
from sim2gp.planning import Chirp, Multisine, Observation, RandomInput, oracle, tasks
from sim2gp.robot.export import export_model

NAN, INF = float("nan"), float("inf")
KEY = jax.random.key(0)
MASS = Parameter("mass", "kg", "of the pole", "log_bounded", 0.1, 1.0)
CONSTANTS = [Parameter("damping", "1/s", "", "log_bounded", 0.1, 1.0)]
WINDOWS = windows_of(np.ones((3, 2, 2)), np.ones((3, 2)), np.zeros(3))
PRIOR = Gaussian(jnp.zeros(2), jnp.eye(2))
STATES, INPUTS = [sg.Channel("q", "rad")], [sg.Channel("u", "1")]


def ode(**options):
    return sy.ODE(lambda p, s, a: -s, CONSTANTS, STATES, INPUTS, **options)


def late(*parts, **options):
    actuators = parts or [sy.Delay("voltage")]
    return sy.Machine(sy.Furuta(), actuators=actuators, **options)


def host(**options):
    return sy.BlackBox(lambda p, s, a, h: s, CONSTANTS, STATES, INPUTS, **options)


def box(low, high):
    return sg.Box(single(*low), single(*high))


def task(**changes):
    return replace(mass_task(), **changes)


def run(loop=sg.psrl, **options):
    return loop(
        mass_task(), GainModel(), sg.MPC(), **{"episodes": 1, "key": KEY, **options}
    )


def cut(**options):
    return sg.cut([], sy.Furuta(), **{"window": 0.2, **options})


def searched(**options):
    plan = experiment()
    boxes, signal = limits(plan.system), Free(0.01, 200)
    return design(plan, Everything(), boxes, signal, key=KEY, **options)


def sim(**options):
    return sg.Sim2GP(linear(2, 2), **options)


#: Name of a case: what makes it, and the code of the refusal.
IMPOSSIBLE = {
    # Boxes and limits
    "box reversed": (lambda: box([1.0], [-1.0]), "E141"),
    "box half reversed": (lambda: box([0.0, 1.0], [1.0, 0.0]), "E141"),
    "box of NaN": (lambda: box([NAN], [1.0]), "E141"),
    "box without end": (lambda: box([-1.0], [INF]), "E141"),
    "channel reversed": (lambda: sg.Channel("q", "rad", low=1.0, high=-1.0), "E141"),
    "channel of NaN": (lambda: sg.Channel("q", "rad", high=NAN), "E141"),
    # Constants
    "prior reversed": (lambda: sg.bounded(2.0, 1.0, "kg", ""), "E141"),
    "prior of one value": (lambda: sg.log_bounded(1.0, 1.0, "kg", ""), "E141"),
    "prior of NaN": (lambda: sg.bounded(NAN, 1.0, "kg", ""), "E141"),
    "log of zero": (lambda: sg.log_bounded(0.0, 1.0, "kg", ""), "E141"),
    "prior sd zero": (lambda: sg.signed(0.0, 0.0, "kg", ""), "E144"),
    "prior sd negative": (lambda: sg.positive(1.0, -1.0, "kg", ""), "E144"),
    "prior mean NaN": (lambda: replace(MASS, mean=NAN), "E144"),
    "free range reversed": (
        lambda: Parameter("x", "1", "", "identity", low=2.0, high=1.0),
        "E141",
    ),
    "softplus without a bound": (lambda: Parameter("x", "1", "", "softplus"), "E141"),
    "nominal NaN": (lambda: sg.bounded(0.0, 1.0, "kg", "", nominal=NAN), "E148"),
    "moments": (lambda: prior_from_moments(MASS, 0.5, NAN), "E144"),
    "a value held at NaN": (lambda: Parameters((), (("mass", NAN),)), "E148"),
    "a value fixed at NaN": (lambda: Parameters((MASS,)).replace(mass=INF), "E148"),
    "measured sum": (
        lambda: LinearMeasurement(("mass",), (1.0,), 0.5, -1.0).check(
            {"mass": (0.0, 1.0)}
        ),
        "E144",
    ),
    # Machines
    "substep zero": (lambda: ode(max_substep=0.0), "E148"),
    "substep NaN": (lambda: ode(max_substep=NAN), "E148"),
    "host's substep": (lambda: host(max_substep=-1.0), "E148"),
    "step of no time": (lambda: sy.Furuta().bind(sy.Furuta().nominal(), 0.0), "E148"),
    "gravity": (lambda: sy.Furuta(gravity=NAN), "E148"),
    "pinion": (lambda: sy.CartPole(pinion_radius=0.0), "E148"),
    "efficiency": (lambda: sy.CartPole(gear_efficiency=1.5), "E148"),
    "resistance": (lambda: sy.CartPole(motor_resistance=-2.6), "E148"),
    "length": (lambda: sy.TwoLink(length1=0.0), "E148"),
    "width of friction": (lambda: sy.TwoLink(coulomb_width=0.0), "E148"),
    "delay negative": (
        lambda: late(parameters={"voltage.delay": -0.01}),
        "E141",
    ),
    "delay without end": (
        lambda: late(parameters={"voltage.delay": Parameter("", "s", "", "log", 0.0)}),
        "E141",
    ),
    "machine's period": (lambda: late(period=0.0), "E148"),
    "lag": (lambda: late(sy.Lag("voltage", 0.0), period=0.02), "E141"),
    "lag's period": (lambda: late(sy.Lag("voltage", 0.1)), "E148"),
    "input delay": (lambda: sy.Delay("voltage", -0.01), "E148"),
    "magnitude": (lambda: sy.Spring("theta", NAN), "E148"),
    "width": (lambda: sy.Coulomb("theta", 1e-3, width=0.0), "E148"),
    "rail's width": (lambda: sy.RailFriction(width=-0.01), "E148"),
    "speed": (lambda: sy.Stribeck("theta", 1e-3, speed=0.0), "E148"),
    "smoothing": (lambda: sy.DeadZone("voltage", 0.5, smoothing=0.0), "E148"),
    # Tasks
    "noise negative": (lambda: task(noise=single(-1e-3, 1e-2)), "E144"),
    "noise NaN": (lambda: task(noise=single(NAN, 1e-2)), "E144"),
    "reset negative": (lambda: task(start_sd=single(0.0, -0.01)), "E144"),
    "start infinite": (lambda: task(start=single(INF, 0.0)), "E148"),
    "bound zero": (lambda: task(state_bound=single(0.0, 1.0)), "E148"),
    "bound NaN": (lambda: task(state_bound=single(NAN, 1.0)), "E148"),
    "period zero": (lambda: task(dt=0.0), "E148"),
    "period negative": (lambda: task(dt=-0.02), "E148"),
    "period infinite": (lambda: task(dt=INF), "E148"),
    "horizon zero": (lambda: task(horizon=0), "E148"),
    "history": (lambda: task(history=-1), "E148"),
    "angle": (lambda: task(angle=2), "E148"),
    "plan of nothing": (lambda: task(planning_horizon=0), "E148"),
    "no iteration": (lambda: task(planning_iterations=0), "E148"),
    "colour": (lambda: task(noise_colour=NAN), "E148"),
    "return of -inf": (lambda: tasks.score(-INF, 1.0, 2.0), "E148"),
    "hanging at -inf": (lambda: tasks.score(1.0, -INF, 2.0), "E148"),
    "oracle of NaN": (lambda: tasks.episodes_to_95([1.0], 0.0, NAN), "E148"),
    "oracle below": (lambda: tasks.score(1.0, 2.0, 1.0), "E148"),
    "truth": (lambda: tasks.draw_truth(sy.Furuta(), KEY, "4sd"), "E145"),
    # Worlds and planners
    "world's horizon": (lambda: world(horizon=0), "E148"),
    "world's plans": (lambda: world(planning_iterations=-1), "E148"),
    "world's bound": (lambda: world(state_bound=jnp.asarray([NAN, 1.0])), "E148"),
    "world's history": (lambda: world(history=-1), "E148"),
    "observed scale": (lambda: Observation(jnp.zeros(2)), "E148"),
    "observed angle": (lambda: Observation(jnp.ones(2), 2), "E148"),
    "samples": (lambda: sg.ICEM(samples=0), "E148"),
    "elites": (lambda: sg.ICEM(samples=8, elites=9), "E148"),
    "iterations": (lambda: sg.ICEM(iterations=0), "E148"),
    "icem's sd": (lambda: sg.ICEM(sd=-0.5), "E148"),
    "finest": (lambda: sg.ICEM(finest=0.0), "E148"),
    "reuse": (lambda: sg.ICEM(reuse=1.5), "E148"),
    "smoothing of elites": (lambda: sg.ICEM(smoothing=-0.1), "E148"),
    "decay": (lambda: sg.ICEM(decay=0.0), "E148"),
    "mppi's samples": (lambda: sg.MPPI(samples=-3), "E148"),
    "effective": (lambda: sg.MPPI(effective=0.0), "E148"),
    "mppi's sd": (lambda: sg.MPPI(sd=NAN), "E148"),
    "mpc's horizon": (lambda: sg.MPC(horizon=0), "E148"),
    "mpc's lengths": (lambda: sg.MPC(lengths=(0.5, 1.5)), "E148"),
    "no lengths": (lambda: sg.MPC(lengths=()), "E148"),
    "every": (lambda: sg.MPC(every=0), "E148"),
    "sac's discount": (lambda: sg.SAC(discount=1.1), "E148"),
    "sac's episodes": (lambda: sg.SAC(num_envs=0), "E148"),
    "sac's rate": (lambda: sg.SAC(rate=-1e-3), "E148"),
    "sac's width": (lambda: sg.SAC(hidden=(64, 0)), "E148"),
    "sac's share": (lambda: sg.SAC(replayed=-0.1), "E148"),
    "input's sd": (lambda: RandomInput(sd=0.0), "E148"),
    "chirp reversed": (lambda: Chirp(lowest=0.1, highest=0.01), "E141"),
    "chirp from zero": (lambda: Chirp(lowest=0.0), "E148"),
    "tones": (lambda: Multisine(tones=0), "E148"),
    # Loops
    "no episode": (lambda: run(episodes=0), "E148"),
    "never updated": (lambda: run(update_every=0), "E148"),
    "limit's cost": (lambda: run(sg.psal, limit_cost=-1.0), "E148"),
    "optimism": (lambda: run(sg.optimism, weight=NAN), "E148"),
    "no oracle": (
        lambda: oracle.run_oracle(mass_task(), sg.MPC(), key=KEY, episodes=0),
        "E148",
    ),
    # Models, windows, designs
    "model's period": (lambda: sim(dt=0.0), "E148"),
    "model's prior": (lambda: sim(prior=Gaussian(jnp.zeros(3), jnp.eye(3))), "E140"),
    "no layer": (lambda: sg.NLM(linear(2, 2), hidden=()), "E148"),
    "no width": (lambda: sg.NLM(linear(2, 2), hidden=(8, 0)), "E148"),
    "steps": (lambda: sg.Residual(sim(), steps=-1), "E148"),
    "refits": (lambda: sg.ResidualFunctionSpace(sim(), refit_steps=-1), "E148"),
    "distillation": (lambda: sg.FunctionSpace(sim(), pretrain=-1), "E148"),
    "objective": (lambda: sg.FunctionSpace(sim(), objective="best"), "E145"),
    "mode": (lambda: sg.Residual(sim(), mode="both"), "E145"),
    "reach": (lambda: sg.NLM(linear(2, 2), reach={"x0": 0.0}), "E148"),
    "one model": (lambda: sg.Auto([sim()]), "E148"),
    "window": (lambda: cut(window=-0.2), "E148"),
    "window NaN": (lambda: cut(window=NAN), "E148"),
    "sd of a start": (lambda: cut(start_sd={"theta": 0.0}), "E144"),
    "floor": (lambda: cut(floor={"theta": -1.0}), "E144"),
    "no start": (
        lambda: sg.fit_windows(linear(2, 2), WINDOWS, key=KEY, starts=0),
        "E148",
    ),
    "windows' prior": (
        lambda: sg.fit_windows(linear(3, 2), WINDOWS, key=KEY, prior=PRIOR),
        "E140",
    ),
    "forecast": (lambda: evaluation_windows([], sy.Furuta(), longest=0.0), "E148"),
    "experiment's period": (lambda: replace(experiment(), period=0.0), "E148"),
    "experiment's steps": (lambda: replace(experiment(), steps=0), "E148"),
    "experiment's noise": (
        lambda: replace(experiment(), noise=0.0 * experiment().noise),
        "E144",
    ),
    "experiment's outputs": (lambda: replace(experiment(), outputs=(0, 9)), "E148"),
    "experiment's tones": (lambda: Sines(0.02, 100, tones=0), "E148"),
    "experiment's knots": (lambda: Free(0.02, 100, spacing=0.0), "E148"),
    "no draws": (lambda: searched(draws=0), "E148"),
    "no variants": (
        lambda: export_model(
            GainModel().init(KEY), "nowhere", sy.Furuta(), dt=0.02, draws=0, key=KEY
        ),
        "E148",
    ),
}


@pytest.mark.parametrize(("make", "code"), IMPOSSIBLE.values(), ids=IMPOSSIBLE)
def test_what_cannot_be_is_refused(make, code) -> None:
    with pytest.raises(InputError) as caught:
        make()
    assert caught.value.code == code, caught.value
    assert "expected" in str(caught.value)


def test_what_can_be_is_taken() -> None:
    """The edges of what is allowed; a machine without noise, an input that is fixed."""
    box([0.0], [0.0])
    sg.Channel("q", "rad", low=0.0)
    task(noise=single(0.0, 0.0), start_sd=single(0.0, 0.0), state_bound=single(INF, 1))
    ode(max_substep=INF)
    sg.ICEM(samples=2, elites=2, reuse=0.0, smoothing=1.0, finest=1.0)
    sg.SAC(discount=1.0, rate=0.0, hidden=())
    sg.NLM(linear(2, 2), steps=0, refit_steps=0)
    sy.Coulomb("theta", 0.0)
    sy.Delay("voltage", 0.0)


def test_numbers_that_nobody_knows_yet_are_not_checked() -> None:
    """Tasks, boxes and learners are made inside compiled functions."""

    def limited(x):
        made = task(
            noise=x * jnp.ones(2),
            actions=sg.Box(-x[None], x[None]),
            start=x * jnp.ones(2),
        )
        rate = sg.SAC(rate=x, discount=x).rate
        return made.limit(jnp.asarray([9.0])) + rate

    found = jax.jit(jax.vmap(limited))(jnp.asarray([1.0, 2.0]))
    np.testing.assert_array_equal(found, [[2.0], [4.0]])
    reversed_ = jax.jit(lambda x: sg.Box(x, -x))(jnp.ones(1))
    assert float(reversed_.high[0]) == -1.0


def test_what_is_put_together_again_is_not_checked() -> None:
    """JAX fills a tree with anything."""
    leaves, tree = jax.tree.flatten(mass_task())
    empty = jax.tree.unflatten(tree, [object() for _ in leaves])
    assert isinstance(empty.noise, object)
    moved = eqx.tree_at(lambda t: t.noise, mass_task(), single(-1.0, 0.0))
    assert float(moved.noise[0]) == -1.0


@pytest.mark.parametrize("rule", ["positive", "count", "share", "deviation", "finite"])
def test_what_is_no_number_is_refused(rule) -> None:
    for value in ("1", True, [1, "2"], {"a": 1}, 1j):
        with pytest.raises(InputError):
            getattr(checks, rule)("here", value=value)
    getattr(checks, rule)("here", value=1, other=None, third=np.ones(3, int))


def test_words_and_shapes() -> None:
    """What the types of these tests would stop before."""
    with pytest.raises(InputError, match=r"^E148 horizon in Task: got 2\.5, "):
        checks.count("Task", horizon=2.5)
    with pytest.raises(InputError, match=r"^E145 unknown mode in X: got jont"):
        checks.one_of("X", ("seq_sum", "joint"), mode="jont")
    with pytest.raises(InputError, match=r"^E140 start in Task: got shape \(3,\), exp"):
        checks.same_shape("Task", (2,), noise=np.ones(2), start=np.ones(3))
