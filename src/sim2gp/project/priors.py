"""What the file says of a parameter, turned into a prior or a fixed value.

``value`` fixes; ``mean, sd`` are physical moments, inside ``low, high`` where these
are given too; ``relative_sd`` is an sd as a share of the mean. An sd alone is about the
machine's own number: the published one, the model file's, none for an effect. ``low,
high`` alone make a nearly uniform box (logarithmic where the system's own prior is).
"""

import math
from collections.abc import Mapping
from dataclasses import replace

from sim2gp.errors import InputError, error
from sim2gp.inference.parameters import BOX_SD, Parameter, prior_from_moments
from sim2gp.project.schema import PriorSpec

_MATTER = {"kg": "mass", "kg m^2": "inertia"}
_BOXED = "bounded or log_bounded, with low and high"


def with_location(error: InputError, where: str) -> InputError:
    """The same error with its place in the file."""
    return InputError(
        error.code,
        error.what,
        where=where,
        got=error.got,
        expected=error.expected,
        fix=error.fix.rstrip("?") or "correct the value",
        key=error.key,
    )


def prior(
    spec: PriorSpec | float, base: Parameter, where: str, own: float | None = None
) -> Parameter | float:
    """The prior, or the fixed value, that a table of the file states (E141 to E144).

    ``own`` is the machine's own number, where it is not the prior's nominal one.
    """
    own = base.nominal if own is None else own
    if not isinstance(spec, PriorSpec):
        _check_matter(float(spec), base, where)
        return float(spec)
    if spec.relative_sd is not None:
        spec = _absolute(spec, spec.relative_sd, own, where)
    given = spec.model_dump(exclude_none=True, include=set(PriorSpec.model_fields))
    if spec.value is not None:
        if len(given) > 1:
            raise _incomplete_prior(where, "value", given, "value alone, or a prior")
        _check_matter(spec.value, base, where)
        return spec.value
    _check_bounds(spec, base, where)
    _check_matter(spec.low, base, where)
    try:
        if spec.mean is None and spec.sd is None:
            return _with_bounds(spec, base, where)
        mean = own if spec.mean is None else spec.mean
        if mean is None or spec.sd is None:
            raise _incomplete_prior(where, "mean and sd", given, "both of them")
        if spec.map in ("log", "identity") and {"low", "high"} & set(given):
            raise _incomplete_prior(where, f"map = {spec.map}", given, _BOXED)
        return _moments(spec, mean, spec.sd, base)
    except InputError as error:
        raise with_location(error, where) from error


def _check_matter(least: float | None, base: Parameter, where: str) -> None:
    """A mass or an inertia is not negative (E147), unless it is a correction of one."""
    if least is None or least >= 0.0 or base.unit not in _MATTER or base.low < 0.0:
        return
    got, what = f"{least:g} {base.unit}", _MATTER[base.unit]
    raise error("negative_matter", where=where, got=got, what=what, name=base.name)


def _absolute(
    spec: PriorSpec, share: float, own: float | None, where: str
) -> PriorSpec:
    """``relative_sd`` as an sd, about the stated mean or the machine's own number."""
    mean = own if spec.mean is None else spec.mean
    if mean is None or mean == 0.0 or spec.sd is not None:
        given = spec.model_dump(exclude_none=True)
        raise _incomplete_prior(
            where, "relative_sd", given, "a mean that is not 0, and no sd"
        )
    changes = {"mean": mean, "sd": share * abs(mean), "relative_sd": None}
    return spec.model_copy(update=changes)


def _incomplete_prior(
    where: str, what: str, given: Mapping[str, object], expected: str
) -> InputError:
    got = ", ".join(given) or "an empty table"
    return error("incomplete_prior", where=where, got=got, expected=expected, what=what)


def _check_bounds(spec: PriorSpec, base: Parameter, where: str) -> None:
    low = base.low if spec.low is None else spec.low
    high = base.high if spec.high is None else spec.high
    if low < high:
        return
    name, got = base.name, f"low = {low:g}, high = {high:g}"
    if low == high:
        value = f"{low:g}"
        raise error("bounds_without_room", where=where, got=got, name=name, value=value)
    raise error("bounds_reversed", where=where, got=got, name=name)


def _with_bounds(spec: PriorSpec, base: Parameter, where: str) -> Parameter:
    if spec.low is None and spec.high is None:
        if spec.map is None:
            raise _incomplete_prior(where, "nothing stated", {}, "a prior or a value")
        if spec.map != base.map and spec.map not in ("bounded", "log_bounded"):
            expected = "mean and sd, whose logarithm or value is Gaussian"
            raise _incomplete_prior(
                where, f"map = {spec.map}", {"map": spec.map}, expected
            )
        return replace(base, map=spec.map)
    low = base.low if spec.low is None else spec.low
    high = base.high if spec.high is None else spec.high
    if not (math.isfinite(low) and math.isfinite(high)):
        got = f"low = {low:g}, high = {high:g}"
        raise error("half_a_box", got=got, name=base.name)
    logarithmic = base.map in ("log", "log_bounded") and low > 0
    kind = spec.map or ("log_bounded" if logarithmic else "bounded")
    if kind not in ("bounded", "log_bounded"):
        given = {"low": low, "high": high, "map": kind}
        raise _incomplete_prior(where, f"map = {kind}", given, _BOXED)
    return replace(base, map=kind, low=low, high=high, mean=0.0, sd=BOX_SD)


def _moments(spec: PriorSpec, mean: float, sd: float, base: Parameter) -> Parameter:
    low, high = spec.low, spec.high
    if spec.map in ("bounded", "log_bounded"):
        low = base.low if low is None else low
        high = base.high if high is None else high
        # The map decides in which box the moments are matched.
        base = replace(base, map=spec.map, low=low, high=high)
    elif spec.map == "identity":
        base = replace(base, map="identity", low=-math.inf, high=math.inf)
    elif spec.map == "log":
        base = replace(base, map="log", low=0.0, high=math.inf)
    return prior_from_moments(base, mean, sd, low, high)
