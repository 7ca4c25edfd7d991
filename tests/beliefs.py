"""Beliefs made by hand for the tests of `sim2gp.identification`."""

import json

import jax
import jax.numpy as jnp

from sim2gp.identification import diagnose
from sim2gp.identification.identifiability.table import verdicts
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.least_squares import triangular
from sim2gp.inference.parameters import Parameter, Parameters
from sim2gp.types import in_float64


def named(names, kind="identity", sd=1.0, **more):
    """A table of like parameters."""
    free = tuple(Parameter(n, "kg", "", kind, sd=sd, **more) for n in names.split())
    return Parameters(free)


@in_float64
def believe(parameters, A, tt=None, prior=None):
    """Posterior around ``tt`` of data with the factor ``A`` (whitened)."""
    A = jnp.asarray(A, float)
    prior = parameters.prior() if prior is None else prior
    tt = prior.mean if tt is None else jnp.asarray(tt, float)
    R = triangular(jnp.concatenate([A, jnp.eye(A.shape[1])]))
    scale = jax.scipy.linalg.solve_triangular(R, prior.scale.T, trans="T").T
    return parameters, prior, Gaussian(tt, scale), A


def study(*belief, **more):
    """The summary, after a round trip through strict JSON."""
    text = json.dumps(diagnose.summary(*belief, **more), allow_nan=False)
    return json.loads(text)


def words_of(*belief):
    return [verdict for verdict, _ in verdicts(diagnose.spectrum(*belief))]


def rows_of(f, parameters):
    """``tt -> factor`` of the rows ``f(values)``, whitened by the table's prior."""

    @jax.jit
    def factor(tt):
        prior = parameters.prior()
        J = jax.jacfwd(lambda t: f(parameters.values(t)))(tt) @ prior.scale
        return triangular(J)

    return in_float64(lambda tt: factor(jnp.asarray(tt, float)))
