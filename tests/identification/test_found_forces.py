"""Forces of one-step data: the descent and the moments against closed forms."""

import numpy as np
import pytest
import scipy.optimize

import planted_forces as study
from sim2gp.identification.missing_physics.forces import (
    FREE,
    _AtBest,
    _descend,
    find_forces,
)

RNG = np.random.default_rng(0)
SHAPE = RNG.normal(size=(40, 3))
MOTOR = RNG.normal(size=40)
TRUE, SD = np.array([0.8, -1.0, 0.5, 2.0]), 0.05
SEEN = (MOTOR + SHAPE @ TRUE[1:]) / np.exp(TRUE[0]) + SD * RNG.normal(size=40)


def model(y: np.ndarray) -> np.ndarray:
    """A motor and forces over one mass: forces grow with the mass."""
    return np.asarray((MOTOR + SHAPE @ y[1:]) / np.exp(y[0]))


def rows(y: np.ndarray) -> np.ndarray:
    by_mass, by_weight = -model(y)[:, None], SHAPE / np.exp(y[0])
    J = np.concatenate([by_mass, by_weight], axis=1)
    return np.concatenate([J, (model(y) - SEEN)[:, None]], axis=1)[None]


def nats(y: np.ndarray) -> float:
    squares = np.sum((model(y) - SEEN) ** 2)
    return float(20.0 * np.log(squares) + 0.5 * (y[0] ** 2 + FREE**2 * y[1:] @ y[1:]))


@pytest.mark.parametrize("start", [-2.0, 0.0, 2.5])
def test_a_descent_ends_at_the_minimum(start: float) -> None:
    """Against scipy, from far away along the curve of one ratio of mass and forces."""
    found = _descend(rows, np.array([start, 0.0, 0.0, 0.0]), 1, 40.0)
    best = scipy.optimize.minimize(nats, TRUE, method="BFGS", tol=1e-9)
    assert found.nats == pytest.approx(best.fun, abs=0.1)
    assert found.nats == pytest.approx(nats(found.y), abs=1e-9)
    np.testing.assert_allclose(found.y, best.x, atol=0.1)


def test_moments_are_those_of_least_squares() -> None:
    """With weights that the data know, prior and scale do not matter."""
    root = 100.0 * np.linalg.qr(RNG.normal(size=(6, 6)))[0]
    truth = RNG.normal(size=6)
    groups = {"a": np.array([2, 3]), "b": np.array([4, 5])}
    truth[4:] = 0.0
    best = _AtBest(root, root @ truth, truth[:2], groups)
    mean, scale = best.moments({"a": 1.0})
    np.testing.assert_allclose(mean, truth, atol=1e-3)
    # Of orthogonal columns each has its own: parameters with their prior, too.
    wanted = np.diag([1.0 / 10001.0] * 4 + [0.0] * 2)
    np.testing.assert_allclose(scale @ scale.T, wanted, rtol=1e-3, atol=1e-9)


@pytest.mark.nightly
def test_a_detent_is_drawn_and_nothing_is_not() -> None:
    """The study in small: a detent on a cart's rail, and a cart without one."""
    found = study.cell(study.Case("cartpole", "notch", 4))
    assert found["reported"] == ["x by x"]
    assert found["inside"] > 0.9
    assert found["error"] < 0.2 * found["size"]
    data, _, _ = study.data_for(study.Case("cartpole", study.NOTHING, 4))
    assert find_forces(data, data.fit()).found == ()
