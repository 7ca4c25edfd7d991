"""Every direction of parameter space in words: what the data leave open, what they fix.

A flat direction is a *move* ``dtheta = diag(dtheta/dtt) L0 v`` that the data cannot
see; a determined one is a *measurement*, the covector ``L0^-T v``. Null directions are
reported one trade-off at a time (`null_space`), the others as in the decomposition.
"""

import math
from typing import Any

import numpy as np
from jaxtyping import Float

from sim2gp.identification.identifiability.base_parameters import best_reduction
from sim2gp.identification.identifiability.conflicts import combination
from sim2gp.identification.identifiability.null_space import blocks
from sim2gp.identification.identifiability.spectrum import Spectrum
from sim2gp.identification.words import descending_order, digits, quantity, weighted_sum

_MOSTLY = 0.1  # smaller terms of a flat direction are left out of its words
_FLAT = math.sqrt(0.5 + 1e-9)  # of the prior's sd: as much as data and prior know
_FAR = 20.0  # times the first move


def describe_directions(spec: Spectrum) -> list[dict[str, Any]]:
    """Text, combination, information (nats) and flatness; the least known first."""
    found = [_dead(spec, int(j)) for j in np.flatnonzero(spec.dead)]
    for block in blocks(spec):
        kind, reduced = best_reduction(block)
        theta = block.points[0].theta
        for column in range(len(reduced.pivots)):
            move = np.zeros(len(spec.mean))
            step = reduced.columns[:, column]
            move[block.index] = step if kind == "linear" else step * theta
            pivot = int(block.index[reduced.pivots[column]])
            found.append(_trade_off(spec, move, pivot))
    for k in reversed(range(spec.rank)):
        found.append(
            _weakly_seen(spec, k) if spec.flat[k] else _describe_fixed(spec, k)
        )
    return found


def _direction_entry(text: str, combination: str, l: float) -> dict[str, Any]:
    return {
        "text": text,
        "combination": combination,
        "information": 0.5 * math.log1p(l),
        "flat": bool(l < 1.0),
    }


def _dead(spec: Spectrum, j: int) -> dict[str, Any]:
    name = spec.names[j]
    return _direction_entry(f"{name} has no effect on these data.", name, 0.0)


def _trade_off(
    spec: Spectrum, move: Float[np.ndarray, " p"], pivot: int
) -> dict[str, Any]:
    others = [int(j) for j in np.flatnonzero(move) if j != pivot]
    sizes = np.asarray([abs(_in_prior_sd(spec, move, j)) for j in others])
    order = [pivot, *(others[n] for n in descending_order(sizes))]
    text = f"{_describe_move(spec, move, order)}: the data stay the same."
    return _direction_entry(text, _move_ratio(spec, move, order), 0.0)


def _weakly_seen(spec: Spectrum, k: int) -> dict[str, Any]:
    u, l = spec.standardised()[:, k], float(spec.eigenvalues[k])
    size = np.abs(u)
    order = [j for j in descending_order(size) if size[j] > _MOSTLY * size.max()]
    move = np.sign(u[order[0]]) * u * spec.prior_sd * spec.slope
    text = f"{_describe_move(spec, move, order)}: the data hardly change"
    text += f"; {_remaining_spread(spec, k)}."
    return _direction_entry(text, _move_ratio(spec, move, order), l)


def _describe_fixed(spec: Spectrum, k: int) -> dict[str, Any]:
    l = float(spec.eigenvalues[k])
    what = weighted_sum(combination(spec, k), spec.names)
    # With corrected spreads the data may inform and yet leave it open.
    verb = "determine" if _spread(spec, k) <= _FLAT else "hardly determine"
    return _direction_entry(
        f"The data {verb} {what}: {_remaining_spread(spec, k)}.", what, l
    )


def _remaining_spread(spec: Spectrum, k: int) -> str:
    """What the posterior keeps of the prior's sd along a direction, in words."""
    return f"{digits(100.0 * _spread(spec, k), 2)} % of the prior's spread is left"


def _spread(spec: Spectrum, k: int) -> float:
    return float(np.linalg.norm(spec.directions[:, k] @ spec.whitened()[1]))


def _in_prior_sd(spec: Spectrum, move: Float[np.ndarray, " p"], j: int) -> float:
    """A physical move of one live parameter in its prior sd, at the MAP's slope."""
    return float(move[j] / (spec.slope[j] * spec.prior_sd[j]))


def _describe_move(
    spec: Spectrum, move: Float[np.ndarray, " p"], order: list[int]
) -> str:
    """Raise a by 1 %, lower b by 0.4 %: relative moves; physical where signed."""

    def relative(j: int) -> bool:
        p = spec.parameters.free[j]
        return (p.low >= 0.0 or p.map == "log") and bool(spec.theta[j] > 0.0)

    def size(j: int) -> float:
        moved = move[j] / spec.theta[j] if relative(j) else _in_prior_sd(spec, move, j)
        return abs(float(moved))

    # The first moves by one per cent, unless another would then move out of sight.
    largest = max(size(j) for j in order) / size(order[0])
    step = 0.01 / size(order[0]) / (largest if largest > _FAR else 1.0)
    parts = []
    for j in order:
        verb = "raise" if move[j] * move[order[0]] > 0.0 else "lower"
        amount = (
            f"{digits(100.0 * step * size(j))} %"
            if relative(j)
            else quantity(step * abs(float(move[j])), spec.parameters.units[j])
        )
        parts.append(f"{verb} {spec.names[j]} by {amount}")
    text = ", ".join(parts)
    return text[0].upper() + text[1:]


def _move_ratio(spec: Spectrum, move: Float[np.ndarray, " p"], order: list[int]) -> str:
    """``a : b = 1 kg : -0.2 kg m``: the same move in physical units."""
    amounts = [
        quantity(move[j] / move[order[0]], spec.parameters.units[j]) for j in order
    ]
    names = " : ".join(spec.names[j] for j in order)
    return f"{names} = {' : '.join(amounts)}" if len(order) > 1 else names
