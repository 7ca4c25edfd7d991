"""Bad inputs 77 to 84: settings that nothing real can have."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

import sim2gp as sg
from design_cases import experiment, limits
from double_integrator import world
from linear_system import linear, windows_of
from mass_task import GainModel, mass_task, single
from sim2gp import checks
from sim2gp import systems as sy
from sim2gp.data.grid import evaluation_windows
from sim2gp.experiment_design.goals import DOptimal
from sim2gp.experiment_design.search import optimise_commands
from sim2gp.experiment_design.signals import FreeCommands
from sim2gp.experiment_design.signals import MultisineCommands as Sines
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.linear_measurements import LinearMeasurement
from sim2gp.inference.parameters import Parameter, Parameters, prior_from_moments
from sim2gp.planning import Chirp, Multisine, Observation, RandomInput, oracle, tasks
from sim2gp.robot.export import export_model
from tests.catalogue.bad_inputs import Case, case, refusal, refusals

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
    boxes, signal = limits(plan.system), FreeCommands(0.01, 200)
    return optimise_commands(plan, DOptimal(), boxes, signal, key=KEY, **options)


def sim(**options):
    return sg.Sim2GP(linear(2, 2), **options)


SETTINGS: tuple[Case, ...] = (
    case(
        77,
        "boxes and limits",
        *refusals(
            "wrong_bounds",
            ("Box", lambda: box([1.0], [-1.0])),
            ("Box", lambda: box([0.0, 1.0], [1.0, 0.0])),
            ("Box", lambda: box([NAN], [1.0])),
            ("Box", lambda: box([-1.0], [INF])),
            ("limits of q", lambda: sg.Channel("q", "rad", low=1.0, high=-1.0)),
            ("limits of q", lambda: sg.Channel("q", "rad", high=NAN)),
        ),
    ),
    case(
        78,
        "constants",
        *refusals(
            "wrong_bounds",
            ("a parameter", lambda: sg.bounded(2.0, 1.0, "kg", "")),
            ("a parameter", lambda: sg.log_bounded(1.0, 1.0, "kg", "")),
            ("a parameter", lambda: sg.bounded(NAN, 1.0, "kg", "")),
            ("x", lambda: Parameter("x", "1", "", "identity", low=2.0, high=1.0)),
        ),
        *refusals(
            "no_positive_bound",
            ("lower bound of", lambda: sg.log_bounded(0.0, 1.0, "kg", "")),
        ),
        *refusals(
            "wrong_moments",
            ("the prior of a parameter", lambda: sg.signed(0.0, 0.0, "kg", "")),
            ("the prior of a parameter", lambda: sg.positive(1.0, -1.0, "kg", "")),
            ("the prior of mass", lambda: replace(MASS, mean=NAN)),
            ("the prior of mass", lambda: prior_from_moments(MASS, 0.5, NAN)),
            (
                "the measured mass",
                lambda: LinearMeasurement(("mass",), (1.0,), 0.5, -1.0).check(
                    {"mass": (0.0, 1.0)}
                ),
            ),
        ),
        *refusals(
            "no_bound_to_be_above",
            ("lower bound of x", lambda: Parameter("x", "1", "", "softplus")),
        ),
        *refusals(
            "number_out_of_range",
            (
                "nominal in a parameter",
                lambda: sg.bounded(0.0, 1.0, "kg", "", nominal=NAN),
            ),
            (
                "mass in the parameters held fixed",
                lambda: Parameters((), (("mass", NAN),)),
            ),
            (
                "mass in the parameters held fixed",
                lambda: Parameters((MASS,)).replace(mass=INF),
            ),
        ),
    ),
    case(
        79,
        "machines",
        *refusals(
            "number_out_of_range",
            ("max_substep in ODE", lambda: ode(max_substep=0.0)),
            ("max_substep in ODE", lambda: ode(max_substep=NAN)),
            ("max_substep in BlackBox", lambda: host(max_substep=-1.0)),
            (
                "dt in a step of a system",
                lambda: sy.Furuta().bind(sy.Furuta().nominal(), 0.0),
            ),
            ("gravity in Furuta", lambda: sy.Furuta(gravity=NAN)),
            ("pinion_radius in CartPole", lambda: sy.CartPole(pinion_radius=0.0)),
            ("gear_efficiency in CartPole", lambda: sy.CartPole(gear_efficiency=1.5)),
            (
                "motor_resistance in CartPole",
                lambda: sy.CartPole(motor_resistance=-2.6),
            ),
            ("length1 in TwoLink", lambda: sy.TwoLink(length1=0.0)),
            ("coulomb_width in TwoLink", lambda: sy.TwoLink(coulomb_width=0.0)),
            ("period in Machine", lambda: late(period=0.0)),
            ("period in Machine with a lag", lambda: late(sy.Lag("voltage", 0.1))),
            ("magnitude in Delay", lambda: sy.Delay("voltage", -0.01)),
            ("magnitude in Spring", lambda: sy.Spring("theta", NAN)),
            ("width in Coulomb", lambda: sy.Coulomb("theta", 1e-3, width=0.0)),
            ("width in RailFriction", lambda: sy.RailFriction(width=-0.01)),
            ("speed in Stribeck", lambda: sy.Stribeck("theta", 1e-3, speed=0.0)),
            (
                "smoothing in DeadZone",
                lambda: sy.DeadZone("voltage", 0.5, smoothing=0.0),
            ),
        ),
        *refusals(
            "delay_without_end",
            ("voltage.delay", lambda: late(parameters={"voltage.delay": -0.01})),
            (
                "voltage.delay",
                lambda: late(
                    parameters={"voltage.delay": Parameter("", "s", "", "log", 0.0)}
                ),
            ),
        ),
        *refusals(
            "lag_out_of_range",
            ("voltage.lag", lambda: late(sy.Lag("voltage", 0.0), period=0.02)),
        ),
    ),
    case(
        80,
        "tasks",
        *refusals(
            "wrong_deviation",
            ("noise in Task", lambda: task(noise=single(-1e-3, 1e-2))),
            ("noise in Task", lambda: task(noise=single(NAN, 1e-2))),
            ("start_sd in Task", lambda: task(start_sd=single(0.0, -0.01))),
        ),
        *refusals(
            "number_out_of_range",
            ("start in Task", lambda: task(start=single(INF, 0.0))),
            ("state_bound in Task", lambda: task(state_bound=single(0.0, 1.0))),
            ("state_bound in Task", lambda: task(state_bound=single(NAN, 1.0))),
            ("dt in Task", lambda: task(dt=0.0)),
            ("dt in Task", lambda: task(dt=-0.02)),
            ("dt in Task", lambda: task(dt=INF)),
            ("horizon in Task", lambda: task(horizon=0)),
            ("history in Task", lambda: task(history=-1)),
            ("angle in Task", lambda: task(angle=2)),
            ("planning_horizon in Task", lambda: task(planning_horizon=0)),
            ("planning_iterations in Task", lambda: task(planning_iterations=0)),
            ("noise_colour in Task", lambda: task(noise_colour=NAN)),
            ("returned in a score", lambda: tasks.score(-INF, 1.0, 2.0)),
            ("hanging in a score", lambda: tasks.score(1.0, -INF, 2.0)),
            ("oracle in a score", lambda: tasks.episodes_to_95([1.0], 0.0, NAN)),
        ),
        *refusals(
            "oracle_no_better",
            ("a score", lambda: tasks.score(1.0, 2.0, 1.0)),
        ),
        *refusals(
            "unknown_word",
            ("draw_truth", lambda: tasks.draw_truth(sy.Furuta(), KEY, "4sd")),
        ),
    ),
    case(
        81,
        "worlds and planners",
        *refusals(
            "number_out_of_range",
            ("horizon in World", lambda: world(horizon=0)),
            ("planning_iterations in World", lambda: world(planning_iterations=-1)),
            (
                "state_bound in World",
                lambda: world(state_bound=jnp.asarray([NAN, 1.0])),
            ),
            ("history in World", lambda: world(history=-1)),
            ("scale in Observation", lambda: Observation(jnp.zeros(2))),
            ("angle in Observation", lambda: Observation(jnp.ones(2), 2)),
            ("samples in ICEM", lambda: sg.ICEM(samples=0)),
            ("elites in ICEM", lambda: sg.ICEM(samples=8, elites=9)),
            ("iterations in ICEM", lambda: sg.ICEM(iterations=0)),
            ("sd in ICEM", lambda: sg.ICEM(sd=-0.5)),
            ("finest in ICEM", lambda: sg.ICEM(finest=0.0)),
            ("reuse in ICEM", lambda: sg.ICEM(reuse=1.5)),
            ("smoothing in ICEM", lambda: sg.ICEM(smoothing=-0.1)),
            ("decay in ICEM", lambda: sg.ICEM(decay=0.0)),
            ("samples in MPPI", lambda: sg.MPPI(samples=-3)),
            ("effective in MPPI", lambda: sg.MPPI(effective=0.0)),
            ("sd in MPPI", lambda: sg.MPPI(sd=NAN)),
            ("horizon in MPC", lambda: sg.MPC(horizon=0)),
            ("lengths in MPC", lambda: sg.MPC(lengths=(0.5, 1.5))),
            ("lengths in MPC", lambda: sg.MPC(lengths=())),
            ("every in MPC", lambda: sg.MPC(every=0)),
            ("discount in SAC", lambda: sg.SAC(discount=1.1)),
            ("num_envs in SAC", lambda: sg.SAC(num_envs=0)),
            ("rate in SAC", lambda: sg.SAC(rate=-1e-3)),
            ("hidden in SAC", lambda: sg.SAC(hidden=(64, 0))),
            ("replayed in SAC", lambda: sg.SAC(replayed=-0.1)),
            ("sd in RandomInput", lambda: RandomInput(sd=0.0)),
            ("lowest in Chirp", lambda: Chirp(lowest=0.0)),
            ("tones in Multisine", lambda: Multisine(tones=0)),
        ),
        *refusals(
            "wrong_bounds",
            ("frequencies of Chirp", lambda: Chirp(lowest=0.1, highest=0.01)),
        ),
    ),
    case(
        82,
        "loops",
        *refusals(
            "number_out_of_range",
            ("episodes in a run", lambda: run(episodes=0)),
            ("update_every in a run", lambda: run(update_every=0)),
            ("limit_cost in psal", lambda: run(sg.psal, limit_cost=-1.0)),
            ("weight in optimism", lambda: run(sg.optimism, weight=NAN)),
            (
                "episodes in run_oracle",
                lambda: oracle.run_oracle(mass_task(), sg.MPC(), key=KEY, episodes=0),
            ),
        ),
    ),
    case(
        83,
        "models, windows, designs",
        *refusals(
            "number_out_of_range",
            ("dt in Sim2GP", lambda: sim(dt=0.0)),
            ("hidden in NLM", lambda: sg.NLM(linear(2, 2), hidden=())),
            ("hidden in NLM", lambda: sg.NLM(linear(2, 2), hidden=(8, 0))),
            ("steps in Residual", lambda: sg.Residual(sim(), steps=-1)),
            (
                "refit_steps in ResidualFunctionSpace",
                lambda: sg.ResidualFunctionSpace(sim(), refit_steps=-1),
            ),
            ("pretrain in FunctionSpace", lambda: sg.FunctionSpace(sim(), pretrain=-1)),
            ("x0 in reach", lambda: sg.NLM(linear(2, 2), reach={"x0": 0.0})),
            ("window in cut", lambda: cut(window=-0.2)),
            ("window in cut", lambda: cut(window=NAN)),
            (
                "starts in fit_windows",
                lambda: sg.fit_windows(linear(2, 2), WINDOWS, key=KEY, starts=0),
            ),
            (
                "longest in evaluation_windows",
                lambda: evaluation_windows([], sy.Furuta(), longest=0.0),
            ),
            ("period in Experiment", lambda: replace(experiment(), period=0.0)),
            ("steps in Experiment", lambda: replace(experiment(), steps=0)),
            ("outputs in Experiment", lambda: replace(experiment(), outputs=(0, 9))),
            ("tones in Multisine", lambda: Sines(0.02, 100, tones=0)),
            ("spacing in Free", lambda: FreeCommands(0.02, 100, spacing=0.0)),
            ("draws in design", lambda: searched(draws=0)),
            (
                "draws in export_model",
                lambda: export_model(
                    GainModel().init(KEY),
                    "nowhere",
                    sy.Furuta(),
                    dt=0.02,
                    draws=0,
                    key=KEY,
                ),
            ),
        ),
        *refusals(
            "another_shape",
            ("Sim2GP", lambda: sim(prior=Gaussian(jnp.zeros(3), jnp.eye(3)))),
            (
                "fit_windows",
                lambda: sg.fit_windows(linear(3, 2), WINDOWS, key=KEY, prior=PRIOR),
            ),
        ),
        *refusals(
            "unknown_word",
            ("FunctionSpace", lambda: sg.FunctionSpace(sim(), objective="best")),
            ("Residual", lambda: sg.Residual(sim(), mode="both")),
        ),
        *refusals(
            "too_few_models",
            ("Auto", lambda: sg.Auto([sim()])),
        ),
        *refusals(
            "wrong_deviation",
            ("theta in start_sd", lambda: cut(start_sd={"theta": 0.0})),
            ("theta in floor", lambda: cut(floor={"theta": -1.0})),
            (
                "noise in Experiment",
                lambda: replace(experiment(), noise=0.0 * experiment().noise),
            ),
        ),
    ),
    case(
        84,
        "words and shapes",
        refusal(
            "number_out_of_range", lambda: checks.count("Task", horizon=2.5), "2.5"
        ),
        refusal(
            "unknown_word",
            lambda: checks.one_of("X", ("seq_sum", "joint"), mode="jont"),
            "mode in X",
            "did you mean joint",
        ),
        refusal(
            "another_shape",
            lambda: checks.same_shape("Task", (2,), noise=np.ones(2), start=np.ones(3)),
            "start in Task",
            "got shape (3,)",
        ),
    ),
)
