"""Bad inputs 120 to 126: machines and their parts, tasks, models, designs."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import payload_arm
import sim2gp as sg
from design_cases import experiment, limits
from linear_system import linear
from sim2gp import systems as sy
from sim2gp.data.split_log import cut
from sim2gp.experiment_design.search import prediction_rows
from sim2gp.inference.convergence import NOT_FINITE, Convergence
from sim2gp.inference.parameters import Parameter, Parameters, prior_from_moments
from sim2gp.inference.stacked import Stacked
from sim2gp.planning import tasks
from sim2gp.planning.tasks import furuta_swingup
from sim2gp.robot.export import export_model
from sim2gp.robot.gymnasium_vector import seeds_of
from sim2gp.robot.policy import NumpyPolicy
from sim2gp.systems import Delay, Machine, Variant, with_variants
from sim2gp.systems.variants import own_table
from sim2gp.types import in_float64
from simulated_logs import simulated
from tests.catalogue.bad_functions import Pull, ode
from tests.catalogue.bad_inputs import Case, Input, Patch, case, refusal, refusals

KEY = jax.random.key(0)
START = np.asarray([0.3, -0.2, 0.5, -0.4])
VOLTAGE = [Delay("voltage", 0.02)]

# Parts of machines


def furuta(*effects: Any, **options: Any) -> Machine:
    return Machine(sy.Furuta(), list(effects), **options)


def lagged(*parts: Any) -> Machine:
    return furuta(actuators=parts, period=0.02)


def step(period: float | None, dt: float) -> object:
    """One step of a machine whose delay is longer than what it carries."""
    system = sy.free_parts(sy.Furuta(), VOLTAGE, period=period)
    start = START if period is None else np.append(START, 0.0)
    return system.step(system.nominal(), jnp.asarray(start), jnp.ones(1), dt)


def without_mass(name: str) -> Parameters:
    table = sy.Furuta().parameters
    return Parameters(tuple(p for p in table.free if p.name != name), table.fixed)


def other_fixed() -> Machine:
    table = sy.free_parts(sy.Furuta(), VOLTAGE, period=0.02).parameters
    fixed = dataclasses.replace(table, fixed=(("voltge.gain", 1.0),))
    return furuta(actuators=VOLTAGE, parameters=fixed)


def tie() -> Delay:
    return Delay("torque2", tie="torque1")


def two_link(*parts: Any) -> Machine:
    return Machine(sy.TwoLink(), actuators=list(parts))


# Configurations

BARE = Variant("bare", fixed=(("payload", 0.0),))
LOADED = Variant("loaded", own=("payload",))


def variants(*found: Variant, **priors: Parameter) -> object:
    return with_variants(payload_arm.arm(), found, priors)


def held() -> object:
    arm = payload_arm.arm()
    fixed = arm.parameters.replace(payload=0.2)
    machine = sy.ODE(arm.function, fixed, arm.channels, arm.inputs)
    return with_variants(machine, [LOADED])


def delayed(*fixed: Any, own: Any = (), **priors: Any) -> object:
    machine = sy.free_parts(payload_arm.arm(), [Delay("torque")])
    return with_variants(machine, [Variant("a", fixed, own)], priors)


LONG = {"torque.delay @ a": Parameter("", "", "", "bounded", 0.0, 0.03)}


BOX = Parameter("k", "", "", "bounded", 0.5, 2.0)
LOG = Parameter("k", "", "", "log", 0.0)

# Models and data


@in_float64
def lost() -> None:
    """A fit whose simulation is finite at no start."""
    one = jnp.zeros(())
    found = Convergence(jnp.asarray(NOT_FINITE), one, one, 0, jnp.zeros(1))
    found.check(("k",), "here")


def short_logs() -> object:
    (log,) = [simulated(seconds=0.1, seed=1)]
    return cut([log], sy.Furuta(), window=5.0)


def policy() -> NumpyPolicy:
    one, none = np.ones((1, 1), "f4"), np.zeros(1, "f4")
    return NumpyPolicy(
        ("x",), ("u",), (one, one), (none, none), one[0], -one[0], one[0], None
    )


def no_constants() -> object:
    belief = sg.NLM(sy.Furuta(), hidden=(4,)).init(KEY)
    return export_model(belief, "nowhere", sy.Furuta(), dt=0.02, draws=2, key=KEY)


def on_the_host() -> object:
    states, torque = [sy.Channel("q", "rad")], [sy.Channel("u", "V")]
    constants = [Parameter("damping", "1/s", "", "log_bounded", 0.1, 1.0)]
    box = sy.BlackBox(lambda p, s, a, h: s, constants, states, torque)
    belief = sg.Sim2GP(box, dt=0.02).init(KEY)
    how = {"dt": 0.02, "draws": 2, "key": KEY, "compiled": True}
    return export_model(belief, "nowhere", box, **how)


def no_flatbuffers(folder: Path, patch: Patch) -> None:
    from jax.export import Exported

    def serialize(self: Any) -> bytes:
        raise ImportError("No module named 'flatbuffers'")

    patch.setattr(Exported, "serialize", serialize)
    system = linear(2, 2)
    belief = sg.Sim2GP(system, dt=1.0).init(KEY)
    how = {"dt": 1.0, "draws": 1, "key": KEY, "compiled": True}
    export_model(belief, folder / "model", system, **how)


# Designs


def design(stated: Any, rates: Any, start: Any = (0.0, 0.0, 0.0, 0.0)) -> object:
    return limits(experiment().system, stated, rates, start)


# Environments


def environment(**options: Any) -> Any:
    gymnasium = pytest.importorskip("gymnasium")
    from sim2gp.robot.gymnasium import register

    register()

    return gymnasium.make("sim2gp/Furuta-v0", **options).unwrapped


def started(**options: Any) -> Any:
    env = environment(**options)
    env.reset(seed=0)
    return env


def followed() -> None:
    env = started(params={"arm_damping": 1e30})
    for _ in range(5):
        env.step(np.ones(1, np.float32))


def without_gymnasium(folder: Path, patch: Patch) -> None:
    import sys

    from sim2gp.robot import gymnasium as module

    module._environment_class.cache_clear()
    patch.setitem(sys.modules, "gymnasium", None)
    module.make_environment("furuta")


SYSTEMS: tuple[Case, ...] = (
    case(
        120,
        "parts of a machine",
        *refusals(
            "delay_longer_than_history",
            ("0.02 s", lambda: step(None, 0.02)),
            ("delay", lambda: step(0.02, 0.01)),
        ),
        *refusals(
            "unknown_parameter",
            (
                "voltage.delay",
                lambda: furuta(actuators=VOLTAGE, parameters={"voltge.delay": 0.01}),
            ),
            ("voltage.delay", other_fixed),
        ),
        refusal(
            "delay_without_end",
            lambda: furuta(actuators=VOLTAGE, parameters={"voltage.delay": -0.01}),
        ),
        *refusals(
            "two_parts_of_one_name",
            ("voltage.delay", lambda: furuta(actuators=[*VOLTAGE, *VOLTAGE])),
            (
                "theta.spring",
                lambda: furuta(sy.Spring("theta", 1.0), sy.Spring("theta", 2.0)),
            ),
            ("torque2.delay", lambda: two_link(Delay("torque1"), tie(), tie())),
        ),
        refusal("constant_to_share_missing", lambda: two_link(tie()), "torque1.delay"),
        *refusals(
            "no_such_channel",
            ("mean voltage", lambda: furuta(actuators=[sy.Gain("voltge")])),
            ("voltage", lambda: lagged(sy.Lag("volage", 0.01))),
            ("theta", lambda: furuta(sy.Spring("thta", 1.0))),
            ("theta", lambda: sy.Furuta().joint("thetta")),
            ("mean alpha", lambda: furuta(sensors=[sy.EncoderOffset("alfa", 0.1)])),
        ),
        refusal(
            "lag_of_delayed_input", lambda: lagged(*VOLTAGE, sy.Lag("voltage", 0.01))
        ),
        refusal(
            "lag_over_windows",
            lambda: (system := lagged(sy.Lag("voltage", 0.01))).delays(
                system.nominal()
            ),
        ),
        *refusals(
            "effect_of_other_machine",
            ("TwoLink", lambda: Machine(sy.TwoLink(), [sy.Payload("q2", 0.1)])),
            ("CartPole", lambda: Machine(sy.CartPole(), [sy.BaseTilt(where="theta")])),
        ),
        refusal(
            "effect_without_mass_matrix",
            lambda: Machine(ode(lambda s: s), [Pull(lambda q: -q, "q")]),
            "ODE",
        ),
        refusal(
            "encoder_of_no_position",
            lambda: furuta(sensors=[sy.EncoderOffset("alpha.velocity", 0.1)]),
            "alpha.velocity",
        ),
    ),
    case(
        121,
        "catalogue of effects, tables of constants",
        *refusals(
            "unknown_in_effects",
            ("spring", lambda: sy.effect("furuta", "sprng", "mild")),
            ("strong", lambda: sy.effect("furuta", "spring", "stron")),
            ("furuta", lambda: sy.catalogue("furutta")),
        ),
        *refusals(
            "missing_parameter",
            ("arm_mass", lambda: sy.Furuta(without_mass("arm_mass"))),
        ),
        refusal("unknown_map", lambda: Parameter("k", "", "", "cube"), "cube"),
        *refusals(
            "impossible_prior",
            ("k", lambda: prior_from_moments(LOG, -1.0, 0.1)),
            ("k", lambda: prior_from_moments(BOX, 3.0, 0.1, 0.5, 2.0)),
            ("k", lambda: prior_from_moments(BOX, 1.25, 0.8, 0.5, 2.0)),
        ),
        refusal("unknown_parameter", lambda: Parameters((BOX,)).replace(kk=1.0), "kk"),
    ),
    case(
        122,
        "configurations",
        refusal("unknown_parameter", lambda: variants(Variant("a", own=("paylod",)))),
        refusal(
            "constant_stated_twice",
            lambda: variants(Variant("a", (("payload", 0.1),), ("payload",))),
        ),
        refusal("two_configurations_of_one_name", lambda: variants(BARE, BARE)),
        refusal(
            "unknown_parameter",
            lambda: variants(BARE, LOADED, **{"payload @ bare": BOX}),
            "payload @ bare",
        ),
        refusal("fixed_constant_freed", held, "payload = 0.2"),
        *refusals(
            "delay_of_configuration_too_long",
            ("torque.delay", lambda: delayed(("torque.delay", 0.021))),
            ("torque.delay", lambda: delayed(("torque.delay", -0.001))),
            ("0.03 s", lambda: delayed(own=("torque.delay",), **LONG)),
        ),
        refusal(
            "which_configuration",
            lambda: variants(BARE, LOADED).values(jnp.zeros(4)),
            "bare, loaded",
        ),
        refusal(
            "unknown_configuration",
            lambda: own_table(
                (system := variants(BARE, LOADED)).parameters, system.variants, "load"
            ),
            "loaded",
        ),
    ),
    case(
        123,
        "tasks and truths",
        refusal(
            "truth_of_other_constants",
            lambda: furuta_swingup(sy.CartPole().nominal()),
            "Furuta",
        ),
        refusal(
            "no_bounds_to_exceed",
            lambda: tasks.draw_truth(linear(2, 2), KEY, "outside"),
        ),
        refusal("too_few_models", lambda: sg.Auto([sg.Sim2GP(linear(2, 2), dt=1.0)])),
        refusal("no_likelihoods", lambda: Stacked([])),
        refusal("fit_not_finite", lost, "here"),
        refusal("no_window_to_learn_from", short_logs),
    ),
    case(
        124,
        "limits and predictions of a design",
        *refusals(
            "no_motion_in_limits",
            ("voltage", lambda: design({"voltage": (1.0, 2.0)}, {})),
            ("alpha", lambda: design({"alpha": (-1.0, 1.0)}, {}, (0, 2.0, 0, 0))),
        ),
        refusal("rate_admits_no_motion", lambda: design({}, {"voltage": 0.0}), "volt"),
        *refusals(
            "no_such_channel",
            ("did you mean voltage", lambda: design({"voltag": (-1.0, 1.0)}, {})),
            ("voltage", lambda: design({}, {"theta": 1.0})),
        ),
        refusal("limits_out_of_order", lambda: sg.Limits(q=(2.0, 1.0)), "q"),
        refusal(
            "prediction_too_long",
            lambda: prediction_rows(
                experiment(), limits(experiment().system), 3.0, KEY
            ),
            "3 s",
        ),
    ),
    case(
        125,
        "export and policies",
        refusal("belief_without_constants", no_constants, "NLM"),
        refusal("simulator_on_host", on_the_host),
        Input("no_flatbuffers", ("flatbuffers",), no_flatbuffers),
        refusal("no_action", lambda: policy()(np.asarray([np.inf])), "a policy"),
        refusal("no_action", lambda: policy()(np.asarray([np.nan])), "a policy"),
    ),
    case(
        126,
        "environments",
        refusal("unknown_truth", lambda: environment(truth="pror"), "pror"),
        refusal(
            "unknown_parameter",
            lambda: environment(params={"arm_mas": 0.1}),
            "did you mean arm_mass",
        ),
        refusal(
            "constant_not_finite",
            lambda: environment(params={"arm_mass": math.nan}),
            "arm_mass",
        ),
        refusal(
            "unknown_in_effects",
            lambda: environment(effects=["coulom mild"]),
            "did you mean coulomb",
        ),
        refusal("unknown_in_effects", lambda: environment(effects=["coulomb"]), "mild"),
        refusal("seed_of_reset", lambda: environment().reset(seed=2**32)),
        refusal(
            "unknown_option_of_reset",
            lambda: environment().reset(seed=0, options={"start": 0}),
            "start",
        ),
        refusal(
            "action_not_finite", lambda: started().step(np.full(1, np.nan, np.float32))
        ),
        refusal("seeds_of_reset", lambda: seeds_of([1, 2, 3], 2), "3 seeds"),
        refusal("environment_not_finite", followed),
        Input("missing_extra", ("sim2gp[gym]",), without_gymnasium),
    ),
)
