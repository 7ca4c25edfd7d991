"""Base parameters: combinations that the data do determine where single ones fail.

Sums ``theta_i + sum c_j theta_j`` or products ``theta_i prod theta_j^c_j``: those that
have the same null space at every point tried; the rest hold at the MAP only and are
marked "locally". (The classical base parameters of robot identification are the linear
case: Gautier and Khalil, "Direct calculation of minimum set of inertial parameters of
serial robots", IEEE Trans. Robotics and Automation 6(3), 1990.)
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from sim2gp.identification.identifiability.null_space import (
    Block,
    Kind,
    Reduced,
    blocks,
    reduce,
)
from sim2gp.identification.identifiability.spectrum import (
    DOMINATED,
    IDENTIFIED,
    FisherAt,
    Spectrum,
)
from sim2gp.identification.words import linear_sum, product, unit_product


def base_parameters(
    spec: Spectrum, fisher_at: FisherAt | None = None
) -> list[dict[str, Any]]:
    """Text, value, sd (physical, linearised at the MAP), unit and verdict of each.

    Empty where the data's structure leaves nothing traded off. ``prior_sd`` is
    linearised at the MAP too, so that the verdict compares like with like.
    """
    found: list[dict[str, Any]] = []
    for block in blocks(spec, fisher_at):
        kind, exact, local = _combinations(block)
        found += [_combination_entry(spec, block, kind, row, True) for row in exact]
        found += [_combination_entry(spec, block, kind, row, False) for row in local]
    return found


def best_reduction(block: Block) -> tuple[Kind, Reduced]:
    """The trade-offs at the MAP, in the coordinates where they read best."""
    found: list[tuple[Kind, Reduced]] = [
        (
            kind,
            reduce(block.basis(kind, block.points[0]), kind, block.scale, block.share),
        )
        for kind in block.kinds
    ]
    return min(found, key=lambda item: item[1].unrecognised)


def _combinations(
    block: Block,
) -> tuple[Kind, list[Float[np.ndarray, " q"]], list[Float[np.ndarray, " q"]]]:
    """Coordinates, and the covectors that hold everywhere and at the MAP only."""
    q = len(block.index)
    if len(block.points) == 1:
        kind, reduced = best_reduction(block)
        return kind, [], list(reduced.covectors().values())
    unions = {kind: block.union(kind) for kind in block.kinds}
    kind = min(unions, key=lambda kind: unions[kind].shape[1])
    U, N = unions[kind], block.basis(kind, block.points[0])
    if U.shape[1] == q:
        kind, reduced = best_reduction(block)
        return kind, [], list(reduced.covectors().values())
    whole = reduce(U, kind, block.scale, block.share)
    exact = list(whole.covectors().values())
    if U.shape[1] == N.shape[1]:
        return kind, exact, []
    # Inside the pivots' own space the MAP leaves a few more, for small moves only.
    inside = np.asarray(whole.pivots)
    rows = np.linalg.qr(N[inside])[0]
    local = []
    part = reduce(rows, kind, block.scale[inside], block.share[inside])
    for row in part.covectors().values():
        full = np.zeros(q)
        full[inside] = row
        local.append(full)
    return kind, exact, local


def _combination_entry(
    spec: Spectrum,
    block: Block,
    kind: Kind,
    weights: Float[np.ndarray, " q"],
    everywhere: bool,
) -> dict[str, Any]:
    theta = block.points[0].theta
    used = [int(i) for i in np.flatnonzero(weights)]
    names = [spec.names[block.index[i]] for i in used]
    units = [spec.parameters.units[block.index[i]] for i in used]
    # The parameter that the combination replaces has weight one and goes first.
    order = sorted(range(len(used)), key=lambda n: weights[used[n]] != 1.0)
    terms = [(float(weights[used[n]]), names[n]) for n in order]
    if kind == "linear":
        text, unit = linear_sum(terms), units[order[0]]
        value, gradient = float(weights @ theta), weights
    else:
        text = product(terms)
        powers = weights[used].tolist()
        unit = unit_product(zip(powers, units, strict=True))
        value = float(np.exp(weights @ np.log(theta)))
        gradient = value * weights / theta
    row = gradient * spec.slope[block.index]
    sd = float(np.linalg.norm(row @ spec.scale[block.index]))
    prior_sd = float(np.linalg.norm(row @ spec.prior_scale[block.index]))
    verdict = "weak"
    if sd > DOMINATED * prior_sd:
        verdict = "prior_dominated"
    elif sd <= IDENTIFIED * prior_sd:
        verdict = "identified"
    return {
        "text": text if everywhere else f"{text} (locally)",
        "value": value,
        "sd": sd,
        "prior_sd": prior_sd,
        "unit": unit,
        "verdict": verdict,
        "everywhere": everywhere,
    }
