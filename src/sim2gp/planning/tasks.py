"""Tasks: a machine with hidden parameters, process noise, a reward and a clock.

    s' = f(s, a) + sd * eps,    eps ~ N(0, I) on the physical states,  observed exactly

The task knows the truth and never gives it to a model. Both presets are swing-ups of
250 steps of 20 ms with ``hanging = 0``; rewards, noise and limits follow the published
descriptions of the two rigs (`sim2gp.systems`). Scores are defined here once.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sim2gp import checks
from sim2gp.errors import error
from sim2gp.systems import (
    AbstractEffect,
    AbstractPart,
    AbstractPlant,
    AbstractSystem,
    CartPole,
    Furuta,
    with_parts,
)
from sim2gp.systems.trigonometry import cosine
from sim2gp.types import (
    Action,
    Box,
    Dynamics,
    Key,
    Reward,
    Scalar,
    State,
    check_reward,
    in_float64,
)

#: A task's states are bounded at so many times the box that models are trusted in.
TRUSTED = 3.0
#: A pole counts as upright below this cosine of its angle (hanging = 0).
UPRIGHT_COSINE = -0.9
#: The solved band of the score.
SOLVED = 0.95
#: How hidden parameters are drawn: from the prior, further away, or beyond the bounds.
TRUTHS = ("prior", "2sd", "3sd", "outside")
BEYOND = 1.2


class Task(eqx.Module):
    """The "real" robot, simulated. All arrays are data: a new truth retraces nothing.

    noise: sd of the state increment per step, of the physical states, state units.
    state_bound: `TRUSTED` times the box of states that a model is trusted in.
    horizon: steps of ``dt`` seconds in an episode.
    history: past actions that the state of ``dynamics`` carries (delayed inputs).
    angle: the state whose turns do not count: a policy sees its sine and cosine.
    goal: whether one state is where the task is to end, or None where nobody asks.
    planning_horizon, planning_iterations, noise_colour: what suits this machine.
    truth: the hidden parameters by name, for reports and tests only.

    Raises `InputError` E144 for a sd that is negative or not finite, E148 for another
    number that cannot be, E140 for arrays or functions of another shape; E123 and E173
    for functions whose answers are no real numbers, and that raise.
    """

    dynamics: Dynamics
    reward: Reward
    noise: Float[Array, " n"]
    start: Float[Array, " n"]
    start_sd: Float[Array, " n"]
    state_bound: Float[Array, " n"]
    actions: Box
    truth: dict[str, Scalar]
    name: str = eqx.field(static=True)
    horizon: int = eqx.field(static=True, default=250)
    dt: float = eqx.field(static=True, default=0.02)
    history: int = eqx.field(static=True, default=0)
    angle: int | None = eqx.field(static=True, default=None)
    goal: Callable[[State], Bool[Array, ""]] | None = None
    planning_horizon: int = eqx.field(static=True, default=30)
    planning_iterations: int = eqx.field(static=True, default=4)
    noise_colour: float = eqx.field(static=True, default=1.0)

    def __check_init__(self) -> None:
        n = np.shape(self.noise)
        alike = {"start": self.start, "start_sd": self.start_sd}
        checks.same_shape("Task", n, **alike, state_bound=self.state_bound)
        checks.deviation_or_zero("Task", noise=self.noise, start_sd=self.start_sd)
        checks.finite("Task", start=self.start, noise_colour=self.noise_colour)
        checks.positive_or_infinite("Task", state_bound=self.state_bound)
        checks.positive("Task", dt=self.dt)
        lengths = {"horizon": self.horizon, "planning_horizon": self.planning_horizon}
        checks.count("Task", **lengths, planning_iterations=self.planning_iterations)
        checks.whole("Task", history=self.history)
        checks.index("Task", self.size, angle=self.angle)
        self._check_functions()

    def _check_functions(self) -> None:
        """Of a state with its past actions: the next one, and a number."""
        m, kind = np.shape(self.actions.low), jnp.result_type(self.start)
        size = self.size + self.history * m[0]
        s = jax.ShapeDtypeStruct((size,), kind)
        a = jax.ShapeDtypeStruct(m, jnp.result_type(self.actions.low))
        meaning = "the state with its past actions" if self.history else "the state's"
        checks.returns("a next state", self.dynamics, (s, a), (size,), meaning=meaning)
        check_reward(self.reward, s, a)

    @property
    def size(self) -> int:
        """Number of physical states, those that are observed."""
        return self.noise.shape[0]

    @property
    def seconds(self) -> float:
        """Duration of one episode."""
        return self.horizon * self.dt

    def reset(self, key: Key) -> State:
        """A start near rest, pole hanging; no past actions."""
        eps = jax.random.normal(key, self.start.shape, self.start.dtype)
        past = jnp.zeros(self.history * self.actions.low.size, self.start.dtype)
        return jnp.concatenate([self.start + self.start_sd * eps, past])

    def limit(self, a: Action) -> Action:
        """The action that the machine really gets; NaN stays NaN and is seen."""
        return jnp.clip(a, self.actions.low, self.actions.high)

    def step(self, s: State, a: Action, *, key: Key) -> State:
        """The next state of the real machine under the limited action."""
        eps = jax.random.normal(key, self.noise.shape, self.noise.dtype)
        return self.dynamics(s, self.limit(a)).at[: self.size].add(self.noise * eps)

    @property
    def trusted(self) -> Float[Array, " n"]:
        """Half-widths of the box of states that a model is trusted in."""
        return self.state_bound / TRUSTED

    def at_goal(self, states: Float[Array, "T n"]) -> Bool[Array, " T"]:
        """Whether each state is where the task is to end; all are without a goal."""
        if self.goal is None:
            return jnp.ones(len(states), bool)
        return jax.vmap(self.goal)(states)

    def reached(self, states: Float[Array, "T n"]) -> Bool[Array, ""]:
        """Whether the goal holds over the whole last second of an episode."""
        last = round(1.0 / self.dt)
        return jnp.all(self.at_goal(states[-last:]))


class PoleUpright(eqx.Module):
    """The goal of a swing-up: the pole, one of the states, is upright (hanging = 0)."""

    pole: int = eqx.field(static=True)

    def __call__(self, s: State) -> Bool[Array, ""]:
        return cosine(s[self.pole]) < UPRIGHT_COSINE


class FurutaReward(eqx.Module):
    """``exp(-[(1 + cos al) + .1 th^2 + 5e-3 th'^2 + 1e-3 al'^2 + 3e-3 u^2])``.

    Smooth in the angle, in (0, 1]; ``e^-2`` for a pendulum left hanging.
    """

    def terms(self, s: State, a: Action, s2: State) -> dict[str, Scalar]:
        """The terms of the exponent, each at most zero; their sum is the log."""
        theta, alpha, arm_speed, pole_speed = s2[0], s2[1], s2[2], s2[3]
        return {
            "height": -(1.0 + cosine(alpha)),
            "arm": -0.1 * theta**2,
            "input": -3e-3 * a[0] ** 2,
            "arm_speed": -5e-3 * arm_speed**2,
            "pole_speed": -1e-3 * pole_speed**2,
        }

    def __call__(self, s: State, a: Action, s2: State) -> Scalar:
        return jnp.exp(_total(self.terms(s, a, s2)))


class CartPoleReward(eqx.Module):
    """``(1 - cos th)/2 - .1 x^2 - 10 (|x| - .3)_+ - 1e-4 th'^2 - 1e-3 (u/3)^2``.

    At most 1; 0 for a pole left hanging in the middle of the rail.
    """

    def terms(self, s: State, a: Action, s2: State) -> dict[str, Scalar]:
        """What the reward is the sum of."""
        x, theta, pole_speed = s2[0], s2[1], s2[3]
        rail = 0.1 * x**2 + 10.0 * jnp.maximum(jnp.abs(x) - 0.3, 0.0)
        return {
            "height": 0.5 * (1.0 - cosine(theta)),
            "rail": -rail,
            "pole_speed": -1e-4 * pole_speed**2,
            "input": -1e-3 * (a[0] / 3.0) ** 2,
        }

    def __call__(self, s: State, a: Action, s2: State) -> Scalar:
        return _total(self.terms(s, a, s2))


def _total(terms: Mapping[str, Scalar]) -> Scalar:
    """The terms added up, in their order."""
    first, *rest = terms.values()
    return sum(rest, first)


def furuta_swingup(truth: Any = None, effects: Sequence[AbstractPart] = ()) -> Task:
    """Swing up the Furuta pendulum; ``truth`` None is the published machine.

    ``truth`` is a record of parameters (`draw_truth`); ``effects`` are what the real
    machine has and its model lacks: effects, delays, lags or offsets. State: theta,
    alpha, and their rates.
    """
    return _preset(
        Furuta(),
        truth,
        effects,
        name="furuta_swingup",
        reward=FurutaReward(),
        noise=_single(1e-3, 1e-3, 2e-2, 2e-2),
        start=_single(0.0, 0.0, 0.0, 0.0),
        start_sd=_single(0.02, 0.02, 0.02, 0.02),
        state_bound=TRUSTED * _single(2.0, math.inf, 15.0, 25.0),
        angle=1,
        goal=PoleUpright(1),
        planning_horizon=45,
        noise_colour=2.0,
    )


def cartpole_swingup(truth: Any = None, effects: Sequence[AbstractPart] = ()) -> Task:
    """Swing up the cart-pole; ``truth`` None is the published machine.

    Arguments as in `furuta_swingup`. State: x, theta, and their rates.
    """
    return _preset(
        CartPole(),
        truth,
        effects,
        name="cartpole_swingup",
        reward=CartPoleReward(),
        noise=_single(5e-4, 1e-3, 1e-2, 2e-2),
        start=_single(0.0, 0.0, 0.0, 0.0),
        start_sd=_single(0.0, 0.02, 0.0, 0.02),
        state_bound=TRUSTED * _single(0.35, math.inf, 1.5, 15.0),
        angle=1,
        goal=PoleUpright(1),
        planning_horizon=50,
        planning_iterations=3,
        noise_colour=2.0,
    )


#: Each machine that has a task, and its task: of a record and effects, both optional.
MACHINES: dict[str, tuple[Callable[[], AbstractPlant], Callable[..., Task]]] = {
    "furuta": (Furuta, furuta_swingup),
    "cartpole": (CartPole, cartpole_swingup),
}


@in_float64
def draw_truth(system: AbstractSystem, key: Key, truth: str = "prior") -> Any:
    """A record of hidden parameters, in float32.

    ``truth`` is one of `TRUTHS`: from the system's own prior, or with every parameter 2
    or 3 prior sd from its mean (in virtual space), or a fifth beyond its bounds, each
    on a random side. Raises `InputError` E145 for another word, E142 where a parameter
    has no bounds to be beyond.
    """
    checks.one_of("draw_truth", TRUTHS, truth=truth)
    table = system.parameters
    side = jnp.where(jax.random.bernoulli(key, shape=(len(table),)), 1.0, -1.0)
    prior = table.prior()
    away = {"2sd": 2.0, "3sd": 3.0}.get(truth)
    tt = prior.sample(key) if away is None else prior.mean + away * prior.sd() * side
    values = table.values(tt)
    if truth == "outside":
        for p, s in zip(table.free, side.tolist(), strict=True):
            if not (p.low > 0.0 and math.isfinite(p.high)):
                raise error("no_bounds_to_exceed", name=p.name)
            beyond = BEYOND * p.high if s > 0.0 else p.low / BEYOND
            values[p.name] = jnp.asarray(beyond)
    return system.record({k: v.astype(jnp.float32) for k, v in values.items()})


def hanging_return(task: Task) -> float:
    """The return of doing nothing: true dynamics, no noise, from rest, zero input."""
    return float(_hanging_return(task))


@eqx.filter_jit
def _hanging_return(task: Task) -> Scalar:
    a = jnp.zeros_like(task.actions.low)
    past = jnp.zeros(task.history * a.size, task.start.dtype)

    def step(s: State, _: None) -> tuple[State, Scalar]:
        s2 = task.dynamics(s, a)
        return s2, task.reward(s, a, s2)

    start = jnp.concatenate([task.start, past])
    return jnp.sum(jax.lax.scan(step, start, None, length=task.horizon)[1])


def score(returned: float, hanging: float, oracle: float) -> float:
    """``(R - R_hang) / (R_oracle - R_hang)``: 0 for doing nothing, 1 for the oracle.

    Raises `InputError` E148 for returns that are not finite, and where the oracle is no
    better than doing nothing.
    """
    checks.finite("a score", returned=returned, hanging=hanging, oracle=oracle)
    if not oracle > hanging:
        got, least = f"{oracle:g}", f"{hanging:g}"
        raise error("oracle_no_better", where="a score", got=got, least=least)
    return (returned - hanging) / (oracle - hanging)


def episodes_to_95(
    returns: Sequence[float] | np.ndarray, hanging: float, oracle: float
) -> int | None:
    """The first episode, counted from 1, that scores at least 0.95; None if never."""
    for episode, returned in enumerate(returns, start=1):
        if score(float(returned), hanging, oracle) >= SOLVED:
            return episode
    return None


def _preset(
    plant: AbstractPlant,
    truth: Any,
    effects: Sequence[AbstractPart],
    *,
    dt: float = 0.02,
    **fields: Any,
) -> Task:
    """A task on ``plant`` with ``effects``; all arrays float32."""
    # Magnitudes are data: one program serves every strength, none included.
    kinds = [
        dataclasses.replace(e, magnitude=0.0) if isinstance(e, AbstractEffect) else e
        for e in effects
    ]
    system = with_parts(plant, kinds, period=dt)
    record = plant.nominal() if truth is None else truth
    values = _values(record, plant)
    # An effect's magnitude is a fixed parameter of the machine's table.
    strengths = {e.name: e.magnitude for e in effects if isinstance(e, AbstractEffect)}
    values |= {
        name: jnp.asarray(strengths.get(name, value), jnp.float32)
        for name, value in system.parameters.fixed
        if name not in values
    }
    low = _single(*(channel.low for channel in plant.actions))
    high = _single(*(channel.high for channel in plant.actions))
    return Task(
        dynamics=system.bind(system.record(values), dt),
        truth=values,
        actions=Box(low, high),
        dt=dt,
        history=system.history,
        **fields,
    )


def _values(record: Any, system: AbstractSystem) -> dict[str, Scalar]:
    """A record's parameters by name, in float32; E145 where one is missing."""
    names = system.parameters.names
    given = (
        dict(record)
        if isinstance(record, Mapping)
        else {f.name: getattr(record, f.name) for f in dataclasses.fields(record)}
    )
    if set(given) != set(names):
        got, expected = ", ".join(sorted(given)), ", ".join(names)
        machine = type(system).__name__
        raise error(
            "truth_of_other_constants", got=got, expected=expected, machine=machine
        )
    return {name: jnp.asarray(given[name], jnp.float32) for name in names}


def _single(*values: float) -> Float[Array, " n"]:
    return jnp.asarray(values, jnp.float32)
