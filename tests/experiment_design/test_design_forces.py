"""Forces that an experiment would show: information with all forces, and the words."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sim2gp.experiment_design as d
from design_cases import commands, experiment, rail_experiment
from sim2gp.experiment_design.forces import (
    evidence_if_there,
    forces_shown,
    forces_table,
    not_excited,
)
from sim2gp.experiment_design.search import DesignResult, scale_after
from sim2gp.inference.relevance import EARNED

pytestmark = pytest.mark.usefixtures("float64")


def test_evidence_is_what_draws_of_the_prior_give() -> None:
    """x ~ N(0, I), y = A x + noise: the mean log ratio of densities at zero."""
    rng = np.random.default_rng(0)
    A = rng.standard_normal((5, 3)) * np.asarray([0.1, 1.0, 3.0])
    covariance = np.linalg.inv(np.eye(3) + A.T @ A)
    x = rng.standard_normal((200_000, 3))
    y = x @ A.T + rng.standard_normal((200_000, 5))
    mean = y @ A @ covariance
    at_zero = np.einsum("ni,ij,nj->n", mean, np.linalg.inv(covariance), mean)
    ratio = 0.5 * (np.linalg.slogdet(covariance)[1] + at_zero)
    found = evidence_if_there(np.linalg.cholesky(covariance))
    assert found == pytest.approx(ratio.mean(), rel=0.02)
    assert evidence_if_there(np.eye(3)) == pytest.approx(0.0, abs=1e-12)


def test_what_commands_leave_is_their_information() -> None:
    e, U = experiment(), commands()
    states = jax.jit(lambda U: d.trajectory(e, e.belief.mean, U))(U)
    A = jax.jit(lambda s: d.information(e, jnp.zeros_like(e.belief.mean), U, s))(states)
    S = np.asarray(scale_after(e, U))
    root = np.asarray(d.posterior_scale(e.belief, A))
    np.testing.assert_allclose(S @ S.T, root @ root.T, rtol=1e-9)


def designed(e: d.Experiment, U: np.ndarray) -> DesignResult:
    """Commands as if they had been found."""
    states = np.asarray(jax.jit(lambda U: d.trajectory(e, e.belief.mean, U))(U))
    zero = np.zeros((e.belief.mean.size, e.belief.mean.size))
    return DesignResult(np.asarray(U), 0.0, zero, states, states, states, 0.0, 1)


@pytest.mark.nightly  # 18 s; by day: what commands leave, and the MuJoCo arm
def test_a_joint_that_moves_shows_its_forces_and_one_at_rest_does_not() -> None:
    """At rest and hanging nothing is excluded, not even by exact sensors."""
    e = dataclasses.replace(experiment(), start=jnp.zeros(4))
    moving = forces_shown(e, designed(e, commands()))
    assert set(moving) == {
        "theta by theta",
        "theta by theta.velocity",
        "alpha by alpha",
        "alpha by alpha.velocity",
        "voltage by voltage",
    }
    assert moving["theta by theta"]["unit"] == "N m"
    assert moving["voltage by voltage"]["unit"] == "V"
    for entry in moving.values():
        assert entry["nats"] > EARNED
    assert not_excited(moving) == []
    still = forces_shown(e, designed(e, 0.0 * commands()))
    for entry in still.values():
        assert entry["nats"] == 0.0
    (note,) = not_excited(still)
    assert "theta by theta, theta by theta.velocity" in note
    assert [row[0] for row in forces_table(still)["rows"]] == list(still)


@pytest.mark.nightly  # 10 s
def test_better_sensors_show_more() -> None:
    e = experiment()
    found = designed(e, commands())
    poor = dataclasses.replace(e, noise=30.0 * e.noise)
    pairs = zip(
        forces_shown(e, found).values(),
        forces_shown(poor, found).values(),
        strict=True,
    )
    for good, bad in pairs:
        assert good["nats"] > bad["nats"] > 0.0


def test_a_machine_that_takes_no_forces_has_none() -> None:
    """A function of the user's, whose accelerations are no forces."""
    e = dataclasses.replace(rail_experiment(), corrected=None)
    assert forces_shown(e, designed(e, jnp.zeros((e.steps, 1)))) == {}
