"""EM's noise of Student-t windows against the maximum that scipy finds."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from sim2gp.inference.arrowhead import Noise
from sim2gp.inference.laplace import expected_noise


@pytest.mark.nightly
def test_student_noise_of_long_windows_is_found_in_a_few_rounds():
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
    noise = Noise(jnp.full(1, 100.0), jnp.ones(412))
    found = jnp.asarray(np.append(squares, np.zeros(400))[:, None])
    floor = jnp.full(1, 1e-6)
    for _ in range(8):
        noise = expected_noise(noise, found, 0.0 * found, count, floor, 4.0)
    assert float(noise.sd[0]) == pytest.approx(best, rel=0.01)
    assert best == pytest.approx(1.0, abs=0.1)
    assert float(noise.weights[7]) < 0.05
