"""Least squares with nuisance unknowns, which are eliminated window by window.

Windows ``w`` of data share the whitened unknowns ``z`` (p); each has its own ``e_w``
(n, possibly none) with a standard normal prior; each channel has its noise. All that is
needed of the data at a point are the triangular factors of every window's and channel's
``[J_e J_z r]`` (`Blocks`): noise and weights only scale them. The nuisances are the
arrows of the arrowhead,

    [ J_e  J_z  r ]       [ R11  R12  c1 ]
    [ I    0    e ]  = Q  [ 0    R22  c2 ]

and the ``[R22 c2]`` of all windows stack into the factor of ``z`` alone: exactly the
Schur complement, without forming it.
"""

import equinox as eqx
from jaxtyping import Float

from sim2gp.inference.least_squares import Factor
from sim2gp.inference.linalg import (
    each_window,
    library,
    solve_triangular,
    trapezoidal,
    triangular,
)
from sim2gp.types import AnyArray, AnyScalar

#: Factors of ``[J_e J_z r]`` per window and channel; k = n + p + 1, and at most k rows.
Blocks = Float[AnyArray, "W c b k"]


class Noise(eqx.Module):
    """What a descent holds fixed: each channel's sd, and each window's weight."""

    sd: Float[AnyArray, " c"]
    weights: Float[AnyArray, " W"]

    def scale(self, blocks: Blocks) -> Blocks:
        """The blocks of whitened residuals."""
        return (
            blocks
            * library(self.weights).sqrt(self.weights)[:, None, None, None]
            / self.sd[None, :, None, None]
        )


class Elimination(eqx.Module):
    """What remains without the nuisances; ``slope`` is ``R11^-1 [R12 c1]``."""

    data: Factor
    R11: Float[AnyArray, "W n n"]
    slope: Float[AnyArray, "W n p1"]


def eliminate(
    blocks: Blocks,
    e: Float[AnyArray, "W n"],
    noise: Noise,
    damping: AnyScalar = 0.0,
) -> Elimination:
    """The QR of the module's equation in every window; all ``R22`` stacked."""
    n, k = e.shape[1], blocks.shape[-1]

    xp = library(blocks, e)

    def one(block: AnyArray, e: AnyArray) -> AnyArray:
        identity = xp.eye(n, k, dtype=block.dtype)
        prior = xp.concatenate([identity[:, :-1], e[:, None]], axis=1)
        damped = xp.sqrt(damping) * identity
        return trapezoidal(xp.concatenate([block.reshape(-1, k), prior, damped]))

    R = each_window(one, noise.scale(blocks), e)
    R11 = R[:, :n, :n]
    data = triangular(R[:, n:, n:].reshape(-1, k - n))
    return Elimination(data, R11, each_window(solve_triangular, R11, R[:, :n, n:]))
