"""EM's noise of Student-t windows against the maximum that scipy finds."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from sim2gp.inference import (
    arrowhead,
)
from sim2gp.inference import (
    expectation_maximisation as em,
)
from sim2gp.inference import (
    levenberg_marquardt as laplace,
)


class Nothing(laplace.AbstractLikelihood):
    """No data at all."""

    def blocks(self, z, e):
        return jnp.zeros((len(e), 1, 2, 2))

    def known(self, z):
        return jnp.zeros((0, 2))

    def curvature(self, z, gradient):
        return jnp.zeros((1, 1))


@pytest.mark.nightly
def test_student_noise_of_long_windows_is_found_in_a_few_rounds(monkeypatch):
    """Against scipy's maximum of ``sum_w log t_4(r_w | sig)``, from a noise far off."""
    rng = np.random.default_rng(3)
    squares = np.sum(rng.standard_normal((12, 60)) ** 2, axis=1)
    squares[7] *= 100.0

    def cost(log_sd):
        misfit = squares / np.exp(2.0 * log_sd)
        return np.sum(60.0 * log_sd + 32.0 * np.log1p(misfit / 4.0))

    best = np.exp(scipy.optimize.minimize_scalar(cost, bounds=(-3, 3)).x)
    # Windows without data have a weight, and no say.
    count = jnp.asarray([60.0] * 12 + [0.0] * 400)[:, None]
    noise = arrowhead.Noise(jnp.full(1, 100.0), jnp.ones(412))
    found = jnp.asarray(np.append(squares, np.zeros(400))[:, None])
    monkeypatch.setattr(laplace.Fit, "squares", lambda fit: (found, 0.0 * found))
    fit = laplace.minimise(Nothing(), jnp.zeros(1), jnp.zeros((412, 0)), noise)
    update = em.expectation(count, jnp.full(1, 1e-6), 4.0)
    for _ in range(8):
        noise = update(fit, noise)
    assert float(noise.sd[0]) == pytest.approx(best, rel=0.01)
    assert best == pytest.approx(1.0, abs=0.1)
    assert float(noise.weights[7]) < 0.05
