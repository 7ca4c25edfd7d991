"""Whether inputs arrive late: a delay, which forces imitate.

A controller's inputs depend on the states that a force depends on, so that a force can
follow the input of the step before. Such a force is wrong for any other policy. What it
leaves over still depends on earlier inputs; where inputs act at once, nothing does.
"""

import numpy as np
from jaxtyping import Float
from scipy.special import fdtrc

from sim2gp.data.one_step import OneStepLikelihood, compiled_rows
from sim2gp.data.transitions import earlier_inputs, episode_numbers
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.linalg import sine_to

LEVEL = 1e-4
#: Of a channel's residual variance, by earlier inputs: .15 to .5 under delays of 10 to
#: 20 ms, at most .04 where forces are what is missing (`docs/decisions.md`).
SHARE = 0.1


def arrive_late(
    likelihood: OneStepLikelihood, prior: Gaussian, posterior: Gaussian
) -> bool:
    """Whether earlier inputs explain residuals that no parameter can.

    An F test of each channel at the MAP, given all columns of its Jacobian.
    """
    data = likelihood.data
    N = data.count
    found = compiled_rows(likelihood, posterior.mean, prior.scale)
    r, J = (np.asarray(x)[:N] for x in found)
    s, a, s2 = data.held
    past = earlier_inputs(a, episode_numbers(s, s2))
    d = r.shape[1]
    return any(_explain(past, r[:, c], J[:, c], LEVEL / d) for c in range(d))


def _explain(
    past: Float[np.ndarray, "N l"],
    r: Float[np.ndarray, " N"],
    J: Float[np.ndarray, "N p"],
    level: float,
) -> bool:
    """Whether further columns take a share of a channel's squares, beyond chance."""
    both = np.concatenate([J, past], axis=1)
    less, more = (r @ r * sine_to(A, r)[0] ** 2 for A in (J, both))
    q, rest = past.shape[1], len(r) - J.shape[1] - past.shape[1]
    if rest < 1 or not less > 0.0:
        return False
    ratio = (less - more) / q / (more / rest)
    return bool(less - more > SHARE * less and fdtrc(q, rest, ratio) < level)
