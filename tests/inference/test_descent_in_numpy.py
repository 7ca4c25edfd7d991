"""The descent in NumPy: its pieces are those of JAX, and it asks no more than due."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

from descents import some_noise
from sim2gp.errors import DeadParameters, NotFinite
from sim2gp.inference.arrowhead import Blocks, Noise
from sim2gp.inference.estimate import estimate
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.host_descent import SMALL, begin_at, descend, search
from sim2gp.inference.laplace import expected_noise, laplace, log_normaliser
from sim2gp.inference.least_squares import factor
from sim2gp.inference.levenberg_marquardt import point, step
from sim2gp.inference.likelihood import AbstractLikelihood, Trial
from sim2gp.inference.parameters import Parameter, Parameters
from sim2gp.inference.prior import ParameterPrior

pytestmark = pytest.mark.usefixtures("float64")

TABLE = Parameters(
    (
        Parameter("a", "", "bounded", "bounded", 0.0, 1.0),
        Parameter("b", "", "positive", "log", 0.0, np.inf),
        Parameter("c", "", "any", "identity", -np.inf, np.inf),
    )
)
UNBOUNDED = Parameters((Parameter("z", "", "any", "identity", -np.inf, np.inf),))


def numpy_of(tree):
    return jax.tree.map(np.asarray, tree)


@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_the_pieces_are_those_of_jax(damping: float) -> None:
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(3, 2, 7, 6))
    blocks = jax.vmap(jax.vmap(lambda x: factor(x[:, :-1], x[:, -1])))(
        jnp.asarray(rows)
    )
    z, e = jnp.asarray(rng.normal(size=3)), jnp.asarray(rng.normal(size=(3, 2)))
    prior = ParameterPrior(Gaussian(jnp.zeros(3), 0.7 * jnp.eye(3)), TABLE)
    counts, floor = jnp.full((3, 2), 7.0), jnp.asarray([1e-3, 1e-2])

    def pieces(prior, blocks, z, e, noise, counts, floor):
        at = point(z, e, blocks, prior.rows(z), noise)
        found = laplace(at, noise)
        squares = found.squares()
        learned = expected_noise(noise, *squares, counts, floor, 4.0)
        return (
            at,
            prior.curvature(z, at.by_z - z),
            step(prior, at, noise, damping),
            squares,
            learned,
            found.newton_step_sd(),
            found.log_joint() + log_normaliser(noise, counts),
            found.convergence(jnp.asarray(3)),
        )

    args = prior, blocks, z, e, some_noise(), counts, floor
    by_jax = jax.tree.leaves(pieces(*args))
    by_numpy = jax.tree.leaves(pieces(*numpy_of(args)))
    for a, b in zip(by_jax, by_numpy, strict=True):
        assert not isinstance(b, jax.Array) or b.shape == ()
        np.testing.assert_allclose(b, a, rtol=1e-10, atol=1e-12)


class Arctangent(AbstractLikelihood):
    """``10 atan(z)``, whose Gauss-Newton steps overshoot; it notes what is asked."""

    counts: Float[Array, "1 1"]
    floor: Float[Array, " 1"]
    asked: list[str]

    @property
    def n_nuisances(self) -> int:
        return 0

    def first_noise(self) -> Noise:
        return Noise(jnp.ones(1), jnp.ones(1))

    def blocks(
        self, tt: Float[Array, " p"], e: Float[Array, "1 0"], scale: Float[Array, "p p"]
    ) -> Blocks:
        raise AssertionError("only trials are asked for")

    def trial(self, tt, e, scale) -> Trial:
        self.asked.append("value")
        r = 10.0 * np.arctan(tt)

        def blocks():
            self.asked.append("slopes")
            J = np.diag(10.0 / (1.0 + tt**2)) @ scale
            return factor(J, r)[None, None]

        return Trial(np.sum(r**2)[None, None], blocks)


class Given(Arctangent):
    """``value`` of every residual and of its slope, wherever it is asked."""

    value: tuple[float, float]

    @property
    def on_host(self) -> bool:
        return True

    def trial(self, tt, e, scale) -> Trial:
        r, J = (np.full(x, v) for x, v in zip((1, (1, 1)), self.value, strict=True))
        return Trial((r**2)[None], lambda: factor(J @ scale, r)[None, None])


@pytest.mark.parametrize(
    ("value", "error", "code"),
    [((1.0, 0.0), DeadParameters, "E146"), ((np.nan, np.nan), NotFinite, "E203")],
)
def test_what_no_step_can_better_is_named(value, error, code) -> None:
    likelihood = Given(jnp.ones((1, 1)), jnp.ones(1), [], value)
    prior = ParameterPrior(Gaussian(jnp.zeros(1), jnp.eye(1)), UNBOUNDED)
    found = estimate(likelihood, prior, starts=jnp.zeros((1, 1)))
    with pytest.raises(error, match=code):
        found.convergence.check(("z",), "here")


def test_a_step_that_runs_away_is_refused() -> None:
    class Cliff(Arctangent):
        def trial(self, tt, e, scale) -> Trial:
            found = super().trial(tt, e, scale)
            # Steps over the top of the arctangent end far from everything.
            return found._replace(squares=found.squares + 1e200 * (abs(tt[0]) > 5.0))

    likelihood = Cliff(jnp.ones((1, 1)), jnp.zeros(1), [])
    prior = ParameterPrior(Gaussian(np.zeros(1), 1e3 * np.eye(1)), UNBOUNDED)
    noise = numpy_of(likelihood.first_noise())
    begin = begin_at(likelihood, prior, np.asarray([3e-3]), np.zeros((1, 0)), noise)
    *_, last = descend(likelihood, prior, begin, noise, None, damping=1e-4)
    assert abs(1e3 * float(last.at.z[0])) < 1e-2


def test_a_refused_step_is_not_linearised() -> None:
    likelihood = Arctangent(jnp.ones((1, 1)), jnp.zeros(1), [])
    prior = ParameterPrior(Gaussian(np.zeros(1), 1e3 * np.eye(1)), UNBOUNDED)
    noise = numpy_of(likelihood.first_noise())
    begin = begin_at(likelihood, prior, np.asarray([3e-3]), np.zeros((1, 0)), noise)
    kept = list(descend(likelihood, prior, begin, noise, None, damping=1e-4))
    assert likelihood.asked.count("slopes") == len(kept)
    assert likelihood.asked.count("value") > len(kept)
    assert abs(1e3 * float(kept[-1].at.z[0])) < 1e-2
    costs = [float(x.at.cost) for x in kept]
    assert costs == sorted(costs, reverse=True)


class TwoWells(Arctangent):
    """Two minima, at 2 without a misfit and at about -1.96 with one."""

    def trial(self, tt, e, scale) -> Trial:
        z = tt[0]
        r = np.asarray([2.5 * (z**2 - 4.0), z - 2.0])
        J = np.asarray([[5.0 * z], [1.0]]) @ scale
        return Trial(np.sum(r**2)[None, None], lambda: factor(J, r)[None, None])


@pytest.mark.parametrize(
    ("starts", "descents", "where"),
    [((-2.5, 2.5), 2, 2.0), ((2.5, -2.5), 1, 2.0), ((-2.2, -2.5), 1, -1.96)],
)
def test_another_start_is_followed_where_it_is_better_and_elsewhere(
    starts: tuple[float, ...], descents: int, where: float
) -> None:
    likelihood = TwoWells(jnp.ones((1, 1)), jnp.zeros(1), [])
    prior = ParameterPrior(Gaussian(np.zeros(1), 10.0 * np.eye(1)), UNBOUNDED)
    noise = numpy_of(likelihood.first_noise())
    whitened = 0.1 * np.asarray(starts)[:, None]
    e = np.zeros((1, 0))
    steps = list(
        search(likelihood, prior, whitened, e, noise, lambda _, known: known, SMALL)
    )
    assert sum(at.steps == 1 for at in steps) == descents
    assert abs(10.0 * float(steps[-1].at.z[0]) - where) < 0.1
