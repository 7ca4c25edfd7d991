"""The bundled machines' tasks as Gymnasium environments: `sim2gp/Furuta-v0`, ...

    import gymnasium, sim2gp.robot.gymnasium        # the import registers them
    env = gymnasium.make("sim2gp/Furuta-v0", truth="prior")

An environment is a `Task`, step for step: hidden parameters, process noise, its reward
and its clock. Observed are the physical states, in their units and unwrapped; actions
are shares of the largest input, in [-1, 1]. After ``reset(seed=s)`` the e-th episode
has the start and the noise that it has in `psrl` with ``key=jax.random.key(s)``. All
environments of one machine in a process share their compiled programs.
"""

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sim2gp.errors import NotFinite, error, missing_extra
from sim2gp.inference.parameters import unknown_parameter
from sim2gp.planning.episode import Purpose, key_for
from sim2gp.planning.mpc import from_unit
from sim2gp.planning.tasks import MACHINES, TRUTHS, Task, draw_truth
from sim2gp.systems import AbstractPart
from sim2gp.systems.effects.strengths import effect
from sim2gp.types import Action, AnyArray, Key, Scalar, State

#: Environments by name, and their machines.
NAMES = {"Furuta": "furuta", "CartPole": "cartpole"}
PUBLISHED = "published"
SEEDS = 2**32


def register() -> None:
    """Register every environment here with Gymnasium; a second call changes nothing."""
    import gymnasium

    for name, machine in NAMES.items():
        known = f"sim2gp/{name}-v0"
        if known not in gymnasium.registry:
            gymnasium.register(
                known,
                entry_point=f"{__name__}:make_environment",
                vector_entry_point=f"{__name__}_vector:make_environments",
                max_episode_steps=Task.horizon,
                kwargs={"machine": machine},
            )


def make_environment(
    machine: str,
    *,
    truth: str = PUBLISHED,
    params: Mapping[str, float] | None = None,
    effects: Sequence[AbstractPart | str] = (),
    render_mode: None = None,
) -> Any:
    """The swing-up of ``furuta`` or ``cartpole`` as a `gymnasium.Env`.

    ``truth`` is "published", or one of `tasks.TRUTHS`: then every ``reset(seed=)``
    draws the hidden parameters, as the first draw of ``sim2gp demo --seed`` does.
    ``params`` sets some of them. ``effects`` is physics that the machine has and its
    model lacks: effects, or words of their catalogue such as ``"coulomb mild"``.

    Raises `InputError` E135 without Gymnasium, E145 for an unknown truth, parameter or
    effect, E101 for a parameter that is not finite.
    """
    made = make_machine_spec(machine, truth, params or {}, effects)
    try:
        return _environment_class()(made)
    except ImportError as error:
        what = "an environment cannot be made"
        raise missing_extra(what, error, "gym") from error


@functools.cache
def _environment_class() -> Any:
    """The one class of environments; it exists where Gymnasium does."""
    import gymnasium
    from gymnasium.spaces import Box

    class TaskEnv(gymnasium.Env[np.ndarray, np.ndarray]):
        """A task, one step at a time; `StepOutcome` is what each step returns.

        Terminated where a state leaves the task's bounds, at which it is then seen;
        truncated when the task's time is up.
        """

        metadata = {"render_modes": [], "render_fps": round(1.0 / Task.dt)}  # noqa: RUF012
        render_mode = None

        def __init__(self, made: MachineSpec) -> None:
            self.made = made
            self.task = made.published()
            self.bound = bound_of(self.task, made.machine)
            m = self.task.actions.low.size
            self.action_space = Box(-1.0, 1.0, (m,), np.float32)
            self.observation_space = Box(-self.bound, self.bound, dtype=np.float32)
            self.key: Key | None = None
            self.episode = 0
            self.steps = 0
            self.state: State | None = None

        def reset(
            self, *, seed: int | None = None, options: dict[str, Any] | None = None
        ) -> tuple[np.ndarray, dict[str, Any]]:
            """The next episode; with a seed, the first one of that seed's machine."""
            super().reset(seed=seed)
            if options:
                got = ", ".join(map(str, options))
                raise error("unknown_option_of_reset", got=got)
            if seed is not None or self.key is None:
                drawn = int(self.np_random.integers(SEEDS)) if seed is None else seed
                self.key, self.episode = key_of(drawn), 0
                self.task = self.made.task(self.key)
            self.episode, self.steps = self.episode + 1, 0
            self.flying = key_for(self.key, self.episode, Purpose.EPISODE)
            self.state, seen = reset_task(self.task, self.bound, self.flying)
            return np.array(seen), {"status": "running"}

        def step(
            self, action: np.ndarray
        ) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
            """One period. Raises E140, E101 for an action, E203 for a state."""
            if self.state is None:
                raise gymnasium.error.ResetNeeded("call reset before step")
            u = validate_action(action, self.task.actions.low.shape)
            t = np.asarray(self.steps, np.int32)
            met = step_task(self.task, self.bound, self.state, u, t, self.flying)
            self.state, self.steps = met.state, self.steps + 1
            return step_result(met, self.steps == self.task.horizon)

    return TaskEnv


@dataclass(frozen=True)
class MachineSpec:
    """What a machine is made of, but for what a seed draws."""

    machine: str
    truth: str
    params: Mapping[str, float]
    effects: tuple[AbstractPart, ...]

    def published(self) -> Task:
        """The machine before anything is drawn."""
        make, preset = MACHINES[self.machine]
        values = make().parameters.nominal()
        return preset(values | dict(self.params), self.effects)

    def task(self, key: Key) -> Task:
        """The machine that a key draws."""
        if self.truth == PUBLISHED:
            return self.published()
        make, preset = MACHINES[self.machine]
        drawn = draw_truth(make(), key_for(key, 0, Purpose.TRUTH), self.truth)
        return preset(vars(drawn) | dict(self.params), self.effects)


def make_machine_spec(
    machine: str,
    truth: str,
    params: Mapping[str, float],
    effects: Sequence[AbstractPart | str],
) -> MachineSpec:
    """The same, checked; words name effects of the catalogue and their strength.

    Raises `InputError` E145 for an unknown truth, parameter or effect, E101 for a
    parameter that is not a finite number.
    """
    if truth not in (PUBLISHED, *TRUTHS):
        known = ", ".join((PUBLISHED, *TRUTHS))
        raise error("unknown_truth", got=truth, known=known)
    names = MACHINES[machine][0]().parameters.names
    for name, value in params.items():
        if name not in names:
            raise unknown_parameter(name, names)
        if not np.isfinite(value):
            where = f"params of {machine}"
            raise error("constant_not_finite", where=where, got=value, name=name)
    made = tuple(_effect(machine, e) if isinstance(e, str) else e for e in effects)
    return MachineSpec(machine, truth, dict(params), made)


def _effect(machine: str, words: str) -> AbstractPart:
    name, _, strength = words.partition(" ")
    return effect(machine, name, strength)


class StepOutcome(eqx.Module):
    """The outcome of a step: the machine's state and what is seen of it."""

    state: Float[Array, " k"]
    observation: Float[Array, " n"]
    reward: Scalar
    terms: dict[str, Scalar]
    action: Action
    outside: Bool[Array, ""]


@eqx.filter_jit
def reset_task(task: Task, bound: AnyArray, key: Key) -> tuple[State, Array]:
    """The start of an episode, and what is seen of it."""
    s = task.reset(jax.random.fold_in(key, Purpose.RESET))
    return s, jnp.clip(s[: task.size], -bound, bound)


@eqx.filter_jit
def step_task(
    task: Task, bound: AnyArray, s: State, u: AnyArray, t: AnyArray, key: Key
) -> StepOutcome:
    """Step ``t`` of an episode under a share of the inputs' range."""
    a = task.limit(from_unit(u[None], task.actions)[0])
    noise = jax.random.fold_in(jax.random.fold_in(key, Purpose.NOISE), t)
    s2 = task.step(s, a, key=noise)
    seen = s2[: task.size]
    terms: Any = getattr(task.reward, "terms", lambda *_: {})
    # Judged before it is clipped; NaN is no "outside", the host raises.
    return StepOutcome(
        s2,
        jnp.clip(seen, -bound, bound),
        task.reward(s, a, s2),
        terms(s, a, s2),
        a,
        jnp.any(jnp.abs(seen) > bound),
    )


def step_result(
    met: StepOutcome, over: bool
) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
    """A step as Gymnasium returns it (`NotFinite` E203 where it is not finite)."""
    met = jax.device_get(met)
    check_met(met.state, met.reward)
    ended = bool(met.outside)
    status = "limits" if ended else "horizon" if over else "running"
    terms = {name: float(value) for name, value in met.terms.items()}
    info = {"status": status, "reward_terms": terms, "input": np.array(met.action)}
    return np.array(met.observation), float(met.reward), ended, over, info


def check_met(state: AnyArray, reward: AnyArray) -> None:
    """Raise `NotFinite` E203 where a state or a reward is no number."""
    if not (np.isfinite(state).all() and np.isfinite(reward).all()):
        got = f"{state.tolist()}, {reward.tolist()}"
        raise error(
            "environment_not_finite", NotFinite, where="an environment", got=got
        )


def validate_action(action: Any, shape: tuple[int, ...]) -> np.ndarray:
    """An action in float32 (E140 for another shape, E101 where it is not finite)."""
    u = np.asarray(action, np.float32)
    if u.shape != shape:
        got = f"shape {u.shape}"
        raise error("action_of_another_shape", where="step", got=got, shape=shape)
    if not np.isfinite(u).all():
        raise error("action_not_finite", got=u.tolist())
    return u


def key_of(seed: int) -> Key:
    """A run's key (E149 for a seed that JAX has no key for)."""
    if not 0 <= seed < SEEDS:
        raise error("seed_of_reset", got=seed, most=SEEDS)
    return jax.random.key(seed)


def bound_of(task: Task, machine: str) -> np.ndarray:
    """Where states end. An angle goes no farther than its velocity takes it in time."""
    names = [channel.name for channel in MACHINES[machine][0]().states]
    bound = np.asarray(task.state_bound).copy()
    for i in np.flatnonzero(~np.isfinite(bound)):
        bound[i] = bound[names.index(f"{names[i]}.velocity")] * task.seconds
    return bound


if find_spec("gymnasium") is not None:
    register()
