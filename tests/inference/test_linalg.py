"""Linear algebra that waits for no other thread: values, slopes, our programs."""

import math
import os
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import numpy as np
import pytest

from sim2gp.data.transitions import Transitions
from sim2gp.inference import linalg
from sim2gp.models import (
    NLM,
    FunctionSpace,
    Residual,
    ResidualFunctionSpace,
    Sim2GP,
    function_space,
    nlm,
    residual,
    residual_function_space,
    sim2gp,
)
from sim2gp.models.function_space_training import Schedule
from sim2gp.systems import Furuta

pytestmark = pytest.mark.usefixtures("float64")

LAPACK = {"qr", "geqrf", "householder_product", "cholesky", "triangular_solve", "eigh"}
LAPACK |= {"svd", "lu", "eig", "schur", "hessenberg", "tridiagonal"}
CUT = 2e5  # operations from which jaxlib cuts a batch into tasks

PAIRS = {
    "qr": (linalg.qr, lambda A: jnp.linalg.qr(A, mode="r")),
    "cholesky": (
        lambda A: linalg.cholesky(A @ A.mT),
        lambda A: jnp.linalg.cholesky(A @ A.mT),
    ),
    "eigh": (
        lambda A: linalg.eigh(A + A.mT)[0],
        lambda A: jnp.linalg.eigh(A + A.mT)[0],
    ),
    "solve": (
        lambda A: linalg.solve_triangular(A, A @ A, lower=True, transposed=True),
        lambda A: jsl.solve_triangular(A, A @ A, lower=True, trans="T"),
    ),
}


@pytest.mark.parametrize("name", PAIRS)
def test_values_and_slopes_are_those_of_jax(name, getkey):
    ours, theirs = PAIRS[name]
    A = jax.random.normal(getkey(), (5, 4, 4)) + 3.0 * jnp.eye(4)[None]
    for function in (ours, theirs):
        assert jnp.isfinite(jax.vmap(function)(A)).all()

    def slope(function):
        return jax.grad(lambda A: jnp.sum(jnp.sin(jax.vmap(function)(A))))

    def along(function):
        return jax.jvp(jax.vmap(function), (A,), (jnp.cos(A),))[1]

    close = {"rtol": 1e-10, "atol": 1e-12}
    np.testing.assert_allclose(jax.vmap(ours)(A), jax.vmap(theirs)(A), **close)
    np.testing.assert_allclose(slope(ours)(A), slope(theirs)(A), **close)
    np.testing.assert_allclose(along(ours), along(theirs), **close)


def large_batches(jaxpr):
    """The batches of matrices in a program that jaxlib would cut into tasks."""
    found = []
    for eqn in jaxpr.eqns:
        if eqn.primitive.name in LAPACK:
            *batch, rows, columns = eqn.invars[0].aval.shape
            count = math.prod(batch)  # jaxlib's cost of any of them is at most
            cost = 2 * count * rows * columns * min(rows, columns)
            if count > 1 and cost > CUT:
                found.append(f"{eqn.primitive.name} of {eqn.invars[0].aval.shape}")
        inner = jax.tree.leaves(eqn.params, is_leaf=lambda x: hasattr(x, "eqns"))
        for part in inner:
            if hasattr(part, "eqns"):
                found += large_batches(getattr(part, "jaxpr", part))
    return found


def test_a_large_batch_is_seen():
    A = jnp.ones((64, 32, 32))
    plain = jax.make_jaxpr(jax.vmap(jnp.linalg.cholesky))(A)
    assert large_batches(plain.jaxpr) == ["cholesky of (64, 32, 32)"]
    assert not large_batches(jax.make_jaxpr(jax.vmap(linalg.cholesky))(A).jaxpr)


KEY = jax.random.key(0)


def program(name):
    """The compiled function of a model's fit, and arguments of the usual size."""
    data = jax.tree.map(jnp.asarray, Transitions.empty(2500, 4, 1))
    sim = Sim2GP(Furuta())
    steps, schedule = jnp.asarray(100), Schedule.of(100, 100, 1e-3, 0.1)
    if name == "SIM2GP":
        return sim2gp._fit, (sim, data, jnp.zeros((4, sim.prior.mean.size)))
    if name == "NLM":
        return nlm._fit, (NLM(Furuta()).init(KEY), data, KEY, steps)
    physics = sim.init(KEY)
    if name.startswith("RES "):
        mode = name.split()[1]
        belief = Residual(sim, mode=mode).init(KEY)
        return residual._fit, (belief, physics, data, KEY, steps, mode)
    kind, room = {
        "FS": (FunctionSpace, function_space),
        "RES-FS": (ResidualFunctionSpace, residual_function_space),
    }[name]
    model = kind(sim)
    several = (physics,) * (2 if kind is FunctionSpace else 1)
    return room._fit, (
        model.init(KEY), *several, data, KEY, schedule, model.objective
    )  # fmt: skip


NAMES = ("SIM2GP", "NLM", *(f"RES {m}" for m in residual.MODES), "FS", "RES-FS")


@pytest.mark.parametrize("name", NAMES)
def test_no_fit_hands_a_large_batch_to_the_thread_pool(name):
    function, arguments = program(name)
    jaxpr, _, _ = eqx.filter_make_jaxpr(function)(*arguments)
    assert not large_batches(jaxpr.jaxpr)


FIT = """
import jax, numpy as np
from sim2gp.models import ResidualFunctionSpace, Sim2GP
from sim2gp.systems import Furuta
from sim2gp.data.transitions import Transitions
rng = np.random.default_rng(0)
S, A = rng.uniform(-1, 1, (250, 4)), rng.uniform(-1, 1, (250, 1))
system = Furuta()
sim = Sim2GP(system, dt=0.02)
step = jax.vmap(lambda s, a: system.transition(sim.prior.mean, s, a, 0.02))
S2 = np.asarray(step(S, A)) + 1e-3 * rng.standard_normal(S.shape)
data = Transitions.empty(250, 4, 1).extend(S, A, S2)
key = jax.random.key(0)
model = ResidualFunctionSpace(sim, steps=100)
model.fit(model.init(key), data, key=key)
"""


@pytest.mark.nightly
def test_a_fit_on_two_threads_comes_back():
    """It never did, with the batches left to LAPACK."""
    two = os.environ | {"PJRT_NPROC": "2"}
    subprocess.run([sys.executable, "-c", FIT], env=two, timeout=180, check=True)
