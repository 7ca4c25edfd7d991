"""Functions of users: another shape is refused where it is given, not far away."""

import functools
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from double_integrator import Linear, Quadratic
from double_integrator import world as world_of
from mass_task import mass_task
from sim2gp import checks
from sim2gp import systems as sy
from sim2gp.errors import InputError
from sim2gp.inference.parameters import Parameter, Parameters
from sim2gp.planning import AbstractObjective, MarkovObjective
from sim2gp.planning.tasks import furuta_swingup
from sim2gp.systems.effects.base import AbstractForce

TABLE = [Parameter("gravity", "1/s^2", "gravity over length", "log_bounded", 3.0, 30.0)]
STATES = [sy.Channel("q", "rad", angle=True), sy.Channel("q.velocity", "rad/s")]
ACTIONS = [sy.Channel("torque", "1/s^2", low=-5.0, high=5.0)]
#: What a machine of two states may be answered with by mistake, and what is said of it.
WRONG = {
    "a scalar": (lambda s: s[0], r"E140 .*got shape \(\)"),
    "one element": (lambda s: s[:1], r"E140 .*got shape \(1,\)"),
    "a column": (lambda s: s[:, None], r"E140 .*got shape \(2, 1\)"),
    "three elements": (lambda s: s[np.array([0, 1, 1])], r"E140 .*got shape \(3,\)"),
    "a matrix": (lambda s: s[:, None] * s[None], r"E140 .*got shape \(2, 2\)"),
    "a list": (lambda s: [s[0], s[1]], r"E140 .*got a list of 2"),
    "nothing": (lambda s: None, r"E140 .*got nothing"),
    "whole numbers": (lambda s: jnp.asarray([1, 2]), r"E123 .*got int32"),
    "complex numbers": (lambda s: 1j * s.astype("complex64"), r"E123 .*got complex64"),
    "a missing name": (lambda s: {}["mass"], r"E173 .*got KeyError: 'mass'"),
}
wrong = pytest.mark.parametrize(("answer", "said"), WRONG.values(), ids=WRONG)


@wrong
def test_a_derivative_of_another_shape_is_refused(answer, said) -> None:
    def pendulum(params, s, a):
        return answer(s)

    with pytest.raises(InputError, match=f"^{said}") as caught:
        sy.ODE(pendulum, TABLE, STATES, ACTIONS)
    assert "<locals>.pendulum" in str(caught.value)
    if caught.value.code == "E140":
        assert "expected shape (2,)" in str(caught.value)
    if caught.value.code == "E173":
        assert isinstance(caught.value.__cause__, KeyError)


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


@wrong
@pytest.mark.parametrize("kind", [Plain, Map])
def test_a_class_of_ones_own_likewise(kind, answer, said) -> None:
    with pytest.raises(InputError, match=f"^{said}") as caught:
        kind(Parameters(tuple(TABLE)), answer)
    assert f"{kind.__name__}.{'ode' if kind is Plain else 'flow'}" in str(caught.value)


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


def test_a_mechanism_has_two_joints() -> None:
    def good(q):
        return jnp.ones((), q.dtype), jnp.zeros_like(q[0]), jnp.ones((), q.dtype)

    table = Parameters(tuple(TABLE))
    assert Arm(table, (good, jnp.sin)).states[0].name == "q1"
    for inertia, forces, said in (
        (good, lambda q: q[:1], r"E140 forces in Arm\.forces: got shape \(1,\)"),
        (good, lambda q: jnp.ones(3), r"E140 forces in Arm\.forces: got shape \(3,\)"),
        (lambda q: good(q)[:2], jnp.sin, r"E140 inertia in Arm\.inertia.*\(2,\)"),
        (lambda q: (q, q, q), jnp.sin, r"E140 inertia in Arm\.inertia.*\(3, 2\)"),
    ):
        with pytest.raises(InputError, match=f"^{said}"):
            Arm(table, (inertia, forces))


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


@wrong
def test_an_effect_of_ones_own_likewise(answer, said) -> None:
    """A force of one number would pull at both joints."""
    with pytest.raises(InputError, match=f"^{said}") as caught:
        sy.Machine(sy.Furuta(), [Pull(answer)])
    assert "Pull.force" in str(caught.value)
    assert sy.Machine(sy.Furuta(), [Pull(lambda q: -q)]).effects


HOST = {name: x for name, x in WRONG.items() if name not in ("a list", "nothing")}


@pytest.mark.parametrize(("answer", "said"), HOST.values(), ids=HOST)
def test_a_function_on_the_host_is_called(answer, said) -> None:
    """It may return a list, which is one array to NumPy, and whole numbers."""

    def step(params, s, a, h):
        return answer(s)

    if "int32" in said:
        assert sy.BlackBox(step, TABLE, STATES, ACTIONS).states
        return
    if "complex" in said:
        said = r"E123 .*complex64"
    with pytest.raises(InputError, match=f"^{said}") as caught:
        sy.BlackBox(step, TABLE, STATES, ACTIONS)
    assert "<locals>.step" in str(caught.value)


@wrong
def test_a_task_checks_its_machine(answer, said) -> None:
    with pytest.raises(InputError, match=f"^{said}") as caught:
        mass_task(dynamics=lambda s, a: answer(s))
    assert "<lambda>" in str(caught.value)


PAID = {
    "one element": (lambda s, a, s2: s[:1], r"E140 a reward .*got shape \(1,\)"),
    "each state": (lambda s, a, s2: s, r"E140 a reward .*got shape \(2,\)"),
    "whole": (lambda s, a, s2: 0, r"E123 a reward .*got int32"),
    "true": (lambda s, a, s2: s[0] > 0.0, r"E123 a reward .*got bool"),
    "a pair": (lambda s, a, s2: (s[0], s[1]), r"E140 a reward .*got a tuple of 2"),
    "none": (lambda s, a: s[0], r"E173 the function raised .*got TypeError"),
}


@pytest.mark.parametrize(("reward", "said"), PAID.values(), ids=PAID)
def test_a_reward_is_a_number(reward, said) -> None:
    with pytest.raises(InputError, match=f"^{said}"):
        replace(mass_task(), reward=reward)
    with pytest.raises(InputError, match=f"^{said}"):
        world_of(objective=MarkovObjective(reward))


class Halved(AbstractObjective):
    """Its `along` and its `step` disagree about the shape of a reward."""

    def init(self):
        return ()

    def step(self, carry, s, a, s2):
        return carry, s2[0]

    def along(self, carry, S, A, S2):
        return S2[:1, 0]


@wrong
def test_a_world_checks_its_dynamics(answer, said) -> None:
    with pytest.raises(InputError, match=f"^{said}"):
        world_of(lambda s, a: answer(s))


def test_a_world_checks_what_else_it_is_made_of() -> None:
    said = r"^E140 rewards in Halved\.along: got shape \(1,\), expected shape \(2,\)"
    with pytest.raises(InputError, match=said):
        world_of(objective=Halved())
    for start, got in ((jnp.zeros((2, 1)), r"shape \(2, 1\)"), ((0.0,), "a tuple")):
        with pytest.raises(InputError, match=f"^E140 a start in .*got {got}"):
            world_of(reset=lambda key, start=start: start)
    with pytest.raises(InputError, match=r"^E140 state_bound in World: .*\(3,\)"):
        world_of(state_bound=jnp.ones(3))


def test_a_function_is_traced_once_for_its_kind() -> None:
    """Another draw of the same machine is new data, and no new trace."""
    traced = []

    class Counted(Linear):
        def __call__(self, s, a):
            traced.append(1)
            return super().__call__(s, a)

    A, B = jnp.eye(2), jnp.ones((2, 1))
    worlds = [world_of(Counted(x * A, B)) for x in (1.0, 2.0, 3.0)]
    assert len(worlds) == 3
    assert traced == [1]


def test_worlds_are_made_inside_compiled_functions() -> None:
    """Of numbers that nobody knows yet, shapes are known."""

    def best(x):
        w = world_of(Linear(x * jnp.eye(2), jnp.ones((2, 1))))
        return w.step(jnp.ones(2), jnp.ones(1))[0]

    found = jax.jit(jax.vmap(best))(jnp.asarray([1.0, 2.0]))
    np.testing.assert_array_equal(found, [[2.0, 2.0], [3.0, 3.0]])
    with pytest.raises(InputError, match=r"^E140 .*got shape \(1,\)"):
        jax.jit(lambda x: world_of(lambda s, a: x * s[:1]).horizon)(1.0)


def test_names_are_the_users() -> None:
    def reach(s, a, s2):
        return s2[0]

    for function, name in (
        (functools.partial(reach, 1.0), "reach"),
        (Quadratic(), "Quadratic"),
        (jnp.sin, "sin"),
    ):
        assert checks.name_of(function).endswith(name)


def test_what_is_ours_says_itself_what_is_wrong() -> None:
    """An error with a code is not wrapped in another one."""
    delayed = sy.Machine(
        sy.Furuta(), actuators=[sy.Delay("voltage", 0.05)], period=0.02
    )
    short = delayed.bind(delayed.nominal(), 0.001)
    with pytest.raises(InputError, match=r"^E113 delay longer"):
        replace(furuta_swingup(), dynamics=short, history=delayed.history)
