"""MJX, MuJoCo in JAX, as a system's engine: exact derivatives, compiled.

Its solver loops until it has converged, which JAX cannot differentiate backwards. So a
flow is given its dense Jacobian by forward mode, and is then linear in its tangents
either way. What MuJoCo derives from masses and lengths when it compiles a model is a
function of the parameters here as well, as `mujoco.mj_setConst` has it for the C
engine: without it contacts and dry friction would be of another softness.
"""

import copy
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sim2gp.errors import InputError, error
from sim2gp.systems.base import AbstractPlant, steps_in
from sim2gp.systems.effects.forces import ForceField
from sim2gp.systems.mujoco.constants import CENTRED, DERIVED, Constant, set_constants
from sim2gp.systems.mujoco.inertia import unframe
from sim2gp.types import Action, Scalar, State

#: Arrays of C MuJoCo that MJX does not read: a model in which they act is refused.
_UNKNOWN = (
    *("actuator_armature", "actuator_damping", "actuator_dampingpoly"),
    *("actuator_delay", "geom_adhesion", "geom_surfacevel", "jnt_springyield"),
    *("pair_adhesion", "tendon_springyield"),
)


class MJXEngine:
    """A model in MJX with some parameters open, which its arrays are affine in."""

    def __init__(self, model: Any, constants: Sequence[Sequence[Constant]]) -> None:
        every = [c for group in constants for c in group]
        for c in every:
            if c.block is not None:
                raise _unsupported(f"the inertia of {c.path}", "mass and com")
        self.derive = any(c.quantity in DERIVED for c in every)
        _check(model, self.derive)
        self.timestep = float(model.opt.timestep)
        base = copy.copy(model)
        # Rows of friction that are zero in the file would not be there.
        loose = [c for c in every if c.quantity == "frictionloss"]
        set_constants(base, ((c, max(c.get(model), 1e-3)) for c in loose))
        for c in every:
            if c.quantity in CENTRED and c.kind == "body":
                unframe(base, c.index)
        self.affine = _affine(base, constants)
        self.model = _put(base)
        shapes = [len(constants), model.nq + model.nv + model.na, model.nu]
        with _lenient():
            try:
                dtype = jnp.result_type(float)
                args = [jax.ShapeDtypeStruct((n,), dtype) for n in shapes]
                scalar = jax.ShapeDtypeStruct((), dtype)
                jax.eval_shape(self.flow, *args, scalar)
            except NotImplementedError as error:
                raise _unsupported(str(error), "other features") from error

    def flow(
        self, theta: Float[Array, " p"], s: State, a: Action, h: Scalar
    ) -> Float[Array, " n"]:
        """The state ``h`` seconds later, in substeps no longer than the time step.

        ``a`` may have a force on each joint behind the inputs, as the C engine's.
        """
        from mujoco import mjx

        with _lenient():
            model = self.with_values(theta)
            count = steps_in(h, self.timestep)
            step = h / count
            model = model.tree_replace({"opt.timestep": step})
            nq, nv = model.nq, model.nv
            data = mjx.make_data(model)
            data = _cast(data, s.dtype)
            data = data.replace(
                qpos=s[:nq], qvel=s[nq : nq + nv], act=s[nq + nv :], ctrl=a[: model.nu]
            )
            if a.size > model.nu:
                data = data.replace(qfrc_applied=a[model.nu :])
            data = jax.lax.fori_loop(
                0, count, lambda _, d: _cast(mjx.step(model, d), s.dtype), data
            )
            moved = jnp.concatenate([data.qpos, data.qvel, data.act])
            return jnp.where(h > 0.0, moved, s)

    def with_values(self, theta: Float[Array, " p"]) -> Any:
        """The model with these parameters, and what is derived of them."""
        changes = {}
        for name, (at_one, slope) in self.affine.items():
            one, by = (jnp.asarray(x, theta.dtype) for x in (at_one, slope))
            changes[name] = one + jnp.tensordot(theta - 1.0, by, 1)
        with _lenient():
            model = _cast(self.model, theta.dtype).tree_replace(changes)
            return _derived(model) if self.derive else model


class MJXWithForces:
    """A model in MJX under missing forces, as the C engine has them
    (`sim2gp.systems.applied_forces`); their weights are its last parameters."""

    def __init__(
        self, engine: MJXEngine, plant: AbstractPlant, field: ForceField
    ) -> None:
        self.engine, self.plant, self.field = engine, plant, field

    def flow(
        self, theta: Float[Array, " p"], s: State, a: Action, h: Scalar
    ) -> Float[Array, " n"]:
        """As `MJXEngine.flow`; a step's derivative by forces serves all weights."""
        of_engine, w = jnp.split(theta, [theta.size - len(self.field.values)])
        nv = self.engine.model.nv
        count = steps_in(h, self.engine.timestep)
        span = h / count.astype(h.dtype)

        def step(_: Any, s: State) -> State:
            f = self.field.on_joints(self.plant, w, s[:nv], s[nv : 2 * nv])
            both = jnp.concatenate([a, f])
            return mjx_flow(self.engine, of_engine, s, both, span)

        found: State = jax.lax.fori_loop(0, count, step, s)
        return found


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def mjx_flow(
    engine: MJXEngine | MJXWithForces,
    theta: Float[Array, " p"],
    s: State,
    a: Action,
    h: Scalar,
) -> State:
    """`MJXEngine.flow` with derivatives in both modes; none is taken in ``h``."""
    return engine.flow(theta, s, a, h)


@mjx_flow.defjvp
def _(engine: MJXEngine | MJXWithForces, primals: Any, tangents: Any) -> Any:
    theta, s, a, h = primals
    cuts = [theta.size, theta.size + s.size]

    def of(x: Array) -> tuple[Array, Array]:
        theta, s, a = jnp.split(x, cuts)
        found = engine.flow(theta, s, a, h)
        return found, found

    J, value = jax.jacfwd(of, has_aux=True)(jnp.concatenate([theta, s, a]))
    return value, J @ jnp.concatenate(tangents[:3])


def _affine(
    model: Any, constants: Sequence[Sequence[Constant]]
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Arrays that depend on parameters: where all are one, and the slope in each."""
    names = [name for name in dir(model) if name[0] != "_"]
    arrays = {n: getattr(model, n) for n in names}
    fields = [
        name
        for name, x in arrays.items()
        if isinstance(x, np.ndarray) and x.dtype.kind == "f"
    ]

    def put(values: Sequence[float]) -> dict[str, np.ndarray]:
        changed = copy.copy(model)
        pairs = zip(constants, values, strict=True)
        set_constants(changed, ((c, v) for group, v in pairs for c in group))
        found = {name: getattr(changed, name).copy() for name in fields}
        return found | {"opt.gravity": changed.opt.gravity.copy()}

    ones = np.ones(len(constants))
    at_one = put(ones.tolist())
    up = [put((ones + row).tolist()) for row in np.eye(len(constants))]
    slopes = {n: np.stack([u[n] - at_one[n] for u in up]) for n in at_one}
    return {n: (at_one[n], x) for n, x in slopes.items() if np.any(x)}


def _derived(model: Any) -> Any:
    """What `mujoco.mj_setConst` derives of masses and lengths (hinges, slides)."""
    from mujoco import mjx

    data = mjx.make_data(model).replace(qpos=model.qpos0)
    data = _cast(data, model.qpos0.dtype)
    data = mjx.com_pos(model, mjx.kinematics(model, data))
    data = mjx.crb(model, data)
    M = mjx.full_m(model, data)
    spread = jnp.diagonal(jnp.linalg.solve(M, jnp.eye(len(M), dtype=M.dtype)))
    weights = [jnp.zeros(2, M.dtype)]
    for body in range(1, model.nbody):
        if model.body_weldid[body] == 0:  # it cannot move
            weights.append(jnp.zeros(2, M.dtype))
            continue
        if model.body_simple[body] == 2:  # it only slides
            weights.append(
                jnp.stack([1.0 / model.body_mass[body], jnp.zeros_like(spread[0])])
            )
            continue
        both = mjx.jac(model, data, data.xipos[body], jnp.asarray(body))
        each = [jnp.sum(J * jnp.linalg.solve(M, J)) / 3.0 for J in both]
        weights.append(jnp.stack(each))
    changes = {
        "dof_M0": jnp.diagonal(M),
        "dof_invweight0": spread,
        "body_invweight0": jnp.stack(weights),
    }
    return model.tree_replace(changes)


def _put(model: Any) -> Any:
    """The model for MJX, its numbers in float64 on the host (E172)."""
    from mujoco import mjx

    with jax.enable_x64(True), _lenient():
        try:
            found = mjx.put_model(model)
        except NotImplementedError as error:
            raise _unsupported(str(error), "other features") from error
        return jax.tree.map(np.asarray, found)


def _cast(tree: Any, dtype: Any) -> Any:
    """Numbers of a tree in one precision."""

    def one(x: Any) -> Any:
        kind = jnp.issubdtype(jnp.result_type(x), jnp.floating)
        return jnp.asarray(x, dtype) if kind else jnp.asarray(x)

    return jax.tree.map(one, tree)


def _check(model: Any, derive: bool) -> None:
    """Features that MJX would leave out without a word are refused (E172)."""
    for name in _UNKNOWN:
        if np.any(getattr(model, name, 0)):
            raise _unsupported(name, "0")
    if model.nplugin:
        raise _unsupported("plugins", "a model without them")
    if derive and (model.ntendon or np.any(model.actuator_gaintype == 2)):
        raise _unsupported("tendons or muscles with open masses", "engine='c'")


def _unsupported(got: str, expected: str) -> InputError:
    return error("unsupported_by_mjx", got=got, expected=expected)


@contextmanager
def _lenient() -> Iterator[None]:
    """MJX mixes ranks and dtypes inside."""
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        yield
