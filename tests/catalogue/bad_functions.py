"""Bad inputs 85 to 90: functions of users that return something else."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from double_integrator import world as world_of
from mass_task import mass_task
from sim2gp import systems as sy
from sim2gp.inference.parameters import Parameter, Parameters
from sim2gp.planning import AbstractObjective, MarkovObjective
from sim2gp.planning.tasks import furuta_swingup
from sim2gp.systems.effects.base import AbstractForce
from tests.catalogue.bad_inputs import Case, Input, case, refusal

TABLE = [Parameter("gravity", "1/s^2", "gravity over length", "log_bounded", 3.0, 30.0)]
STATES = [sy.Channel("q", "rad", angle=True), sy.Channel("q.velocity", "rad/s")]
ACTIONS = [sy.Channel("torque", "1/s^2", low=-5.0, high=5.0)]
Answer = Callable[[Any], Any]

#: What a function of two states may return by mistake: the error, and what it got.
ANSWERS: tuple[tuple[str, str, Answer], ...] = (
    ("another_shape", "got shape ()", lambda s: s[0]),
    ("another_shape", "got shape (1,)", lambda s: s[:1]),
    ("another_shape", "got shape (2, 1)", lambda s: s[:, None]),
    ("another_shape", "got shape (3,)", lambda s: s[np.array([0, 1, 1])]),
    ("another_shape", "got shape (2, 2)", lambda s: s[:, None] * s[None]),
    ("no_real_numbers", "complex64", lambda s: 1j * s.astype("complex64")),
    ("function_raised", "got KeyError: 'mass'", lambda s: {}["mass"]),
)
#: What is an array to NumPy is none to JAX.
TRACED: tuple[tuple[str, str, Answer], ...] = (
    *ANSWERS,
    ("another_shape", "got a list of 2", lambda s: [s[0], s[1]]),
    ("another_shape", "got nothing", lambda s: None),
    ("no_real_numbers", "got int32", lambda s: jnp.asarray([1, 2])),
)


class Plain(sy.AbstractODE):
    """A pendulum as a class, whose derivative is given."""

    parameters: Parameters = eqx.field(static=True)
    answer: object = eqx.field(static=True)
    max_substep = 0.01
    states, actions = tuple(STATES), tuple(ACTIONS)

    def record(self, values):
        return values["gravity"]

    def ode(self, params, s, a):
        return self.answer(s)


class Map(sy.AbstractPlant):
    """A map from state to state, without a derivative."""

    parameters: Parameters = eqx.field(static=True)
    answer: object = eqx.field(static=True)
    max_substep = window_substep = 0.01
    states, actions = tuple(STATES), tuple(ACTIONS)

    def record(self, values):
        return values["gravity"]

    def flow(self, params, s, a, h):
        return self.answer(s)


class Arm(sy.AbstractMechanism):
    """Two joints whose inertia and forces are given."""

    parameters: Parameters = eqx.field(static=True)
    given: tuple = eqx.field(static=True)
    locked = (False, False)
    max_substep = 0.01
    states = tuple(sy.Channel(n, "rad") for n in ("q1", "q2", "v1", "v2"))
    actions = tuple(ACTIONS)

    def record(self, values):
        return values["gravity"]

    def inertia(self, params, q):
        return self.given[0](q)

    def forces(self, params, q, v, a):
        return self.given[1](q)


class Pull(AbstractForce):
    """An effect of one's own, whose force is given."""

    answer: object = eqx.field(static=True)
    where: str = eqx.field(static=True, default="theta")
    magnitude: float = eqx.field(static=True, default=1.0)
    what, meaning, max_substep = "pull", "a pull", 0.005

    def unit(self, system):
        return "N m"

    def force(self, system, params, x, q, v):
        return self.answer(q)


class Halved(AbstractObjective):
    """Its `along` and its `step` disagree about the shape of a reward."""

    def init(self):
        return ()

    def step(self, carry, s, a, s2):
        return carry, s2[0]

    def along(self, carry, S, A, S2):
        return S2[:1, 0]


class Noisy:
    """Answers differently each time."""

    def __init__(self) -> None:
        self.rng = np.random.default_rng(0)

    def __call__(self, params: Any, s: Any, a: Any, h: float) -> Any:
        return s + self.rng.standard_normal(2)


def ode(answer: Answer) -> sy.ODE:
    def pendulum(params, s, a):
        return answer(s)

    return sy.ODE(pendulum, TABLE, STATES, ACTIONS)


def black_box(step: Callable[..., Any]) -> sy.BlackBox:
    return sy.BlackBox(step, TABLE, STATES, ACTIONS)


def host(answer: Answer) -> sy.BlackBox:
    def step(params, s, a, h):
        return answer(s)

    return black_box(step)


def rewarded(reward: Callable[..., Any]) -> list[Callable[[], object]]:
    """The same reward, of a task and of a world."""
    return [
        lambda: replace(mass_task(), reward=reward),
        lambda: world_of(objective=MarkovObjective(reward)),
    ]


def raises(*_: Any) -> Any:
    raise ZeroDivisionError("no\nway")


def each(name: str, make: Callable[[Answer], object], answers: Any) -> list[Input]:
    return [
        refusal(key, lambda answer=answer: make(answer), name, got)
        for key, got, answer in answers
    ]


def inertia_of(q):
    return jnp.ones((), q.dtype), jnp.zeros_like(q[0]), jnp.ones((), q.dtype)


def arm(inertia: Answer, forces: Answer) -> Arm:
    return Arm(Parameters(tuple(TABLE)), (inertia, forces))


def short_history() -> object:
    """An error with a key is not wrapped in another one."""
    parts = [sy.Delay("voltage", 0.05)]
    delayed = sy.Machine(sy.Furuta(), actuators=parts, period=0.02)
    short = delayed.bind(delayed.nominal(), 0.001)
    return replace(furuta_swingup(), dynamics=short, history=delayed.history)


TWICE = [*ACTIONS, STATES[1]]
FUNCTIONS: tuple[Case, ...] = (
    case(
        85,
        "derivative",
        *each("<locals>.pendulum", ode, TRACED),
        refusal(
            "name_given_twice",
            lambda: sy.ODE(lambda p, s, a: s, TABLE, STATES, TWICE),
            "q.velocity",
        ),
    ),
    case(
        86,
        "class of one's own",
        *each("Plain.ode", lambda f: Plain(Parameters(tuple(TABLE)), f), TRACED),
        *each("Map.flow", lambda f: Map(Parameters(tuple(TABLE)), f), TRACED),
        *each("Pull.force", lambda f: sy.Machine(sy.Furuta(), [Pull(f)]), TRACED),
        *[
            refusal("another_shape", lambda pair=pair: arm(*pair), *words)
            for pair, *words in (
                ((inertia_of, lambda q: q[:1]), "Arm.forces", "shape (1,)"),
                ((inertia_of, lambda q: jnp.ones(3)), "Arm.forces", "shape (3,)"),
                ((lambda q: inertia_of(q)[:2], jnp.sin), "Arm.inertia", "(2,)"),
                ((lambda q: (q, q, q), jnp.sin), "Arm.inertia", "(3, 2)"),
            )
        ],
    ),
    case(
        87,
        "step on the host",
        *each("<locals>.step", host, ANSWERS),
        refusal("function_raised", lambda: black_box(raises), "Error: no way"),
        refusal("simulator_answers_differently", lambda: black_box(Noisy()), "Noisy"),
        refusal("no_real_numbers", lambda: host(lambda s: None), "NoneType"),
        refusal("no_real_numbers", lambda: host(lambda s: s + 1j), "complex128"),
        refusal("function_raised", lambda: host(lambda s: [0, [1]]), "ValueError"),
        refusal(
            "function_raised",
            lambda: black_box(lambda p, s, a, h: p["gravty"]),
            "KeyError: 'gravty'",
        ),
        refusal(
            "name_given_twice",
            lambda: sy.BlackBox(lambda p, s, a, h: s, TABLE, STATES, TWICE),
            "q.velocity",
        ),
    ),
    case(
        88,
        "dynamics of a task, of a world",
        *each("<lambda>", lambda f: mass_task(dynamics=lambda s, a: f(s)), TRACED),
        *each("<lambda>", lambda f: world_of(lambda s, a: f(s)), TRACED),
        refusal("delay_longer_than_history", short_history),
    ),
    case(
        89,
        "reward",
        *[
            refusal(key, make, got)
            for key, got, reward in (
                ("another_shape", "got shape (1,)", lambda s, a, s2: s[:1]),
                ("another_shape", "got shape (2,)", lambda s, a, s2: s),
                ("no_real_numbers", "got int32", lambda s, a, s2: 0),
                ("no_real_numbers", "got bool", lambda s, a, s2: s[0] > 0.0),
                ("another_shape", "a tuple of 2", lambda s, a, s2: (s[0], s[1])),
                ("function_raised", "got TypeError", lambda s, a: s[0]),
            )
            for make in rewarded(reward)
        ],
        refusal(
            "another_shape",
            lambda: world_of(objective=Halved()),
            "Halved.along",
            "got shape (1,), expected shape (2,)",
        ),
    ),
    case(
        90,
        "start, bound of a world",
        refusal(
            "another_shape",
            lambda: world_of(reset=lambda key: jnp.zeros((2, 1))),
            "shape (2, 1)",
        ),
        refusal("another_shape", lambda: world_of(reset=lambda key: (0.0,)), "a tuple"),
        refusal("another_shape", lambda: world_of(state_bound=jnp.ones(3)), "World"),
    ),
)
