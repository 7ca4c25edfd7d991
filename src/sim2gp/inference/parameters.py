"""Physical parameters as random variables: prior, bounds, unit and meaning on one line.

Every Gaussian lives on an unconstrained *virtual* value ``tt`` (the paper's theta
tilde), mapped one by one onto the physical parameter ``theta``
(`sim2gp.inference.bijections`).
"""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sim2gp import checks
from sim2gp.errors import InputError, error, nearest
from sim2gp.inference import bijections
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.linalg import library
from sim2gp.inference.linear_measurements import LinearMeasurement, residuals
from sim2gp.types import AnyArray, AnyScalar

#: Standard deviation of a boxed parameter's virtual value: the box is nearly uniform
#: and the sigmoid stays out of saturation.
BOX_SD = 1.5


@dataclass(frozen=True)
class Parameter:
    """One parameter: its name, unit, meaning, map, bounds, and virtual prior.

    ``mean`` and ``sd`` describe the virtual value; ``nominal`` is the published
    physical value, where there is one. Those of one ``group`` are weights of one
    function, whose prior sd the data scale (`sim2gp.inference.relevance`); but for its
    ``shape``, in which it is not linear, and which no scale turns off.

    Raises `InputError` E141 for an unknown map and for bounds that the map cannot have,
    E144 for a prior's mean or sd that cannot be, E148 for a nominal value that is not
    finite.
    """

    name: str
    unit: str
    meaning: str
    map: str = "bounded"
    low: float = -math.inf
    high: float = math.inf
    mean: float = 0.0
    sd: float = BOX_SD
    nominal: float | None = None
    group: str = ""
    shape: bool = False

    def __post_init__(self) -> None:
        if self.map not in bijections.MAPS:
            known = ", ".join(bijections.MAPS)
            raise error("unknown_map", got=self.map, name=self.name, known=known)
        boxed = self.map in ("bounded", "log_bounded")
        where = self.name or "a parameter"
        checks.bounds(where, self.low, self.high, unbounded=not boxed)
        if self.map == "softplus" and not math.isfinite(self.low):
            raise error("no_bound_to_be_above", got=f"{self.low:g}", name=where)
        if self.map == "log_bounded" and self.low <= 0.0:
            raise error("no_positive_bound", got=f"{self.low:g}", name=self.name)
        checks.moments(f"the prior of {where}", self.mean, self.sd)
        checks.finite(where, nominal=self.nominal)

    def constrain(self, tt: float) -> float:
        """Physical value of a virtual one (host-side scalar)."""
        return float(Parameters((self,)).constrain(np.asarray([tt], float))[0])

    def unconstrain(self, theta: float) -> float:
        """Virtual value of a physical one (host-side scalar)."""
        with jax.enable_x64(True):
            table = Parameters((self,))
            return float(table.unconstrain(jnp.asarray([theta], float))[0])

    def quantile(self, q: float) -> float:
        """Physical prior quantile; the maps are monotone, so they commute with it."""
        return self.constrain(self.mean + self.sd * NormalDist().inv_cdf(q))


def bounded(
    low: float, high: float, unit: str, meaning: str, *, nominal: float | None = None
) -> Any:
    """Field of a record: a parameter in the box ``[low, high]``, nearly uniform."""
    return _field(Parameter("", unit, meaning, "bounded", low, high, nominal=nominal))


def log_bounded(
    low: float, high: float, unit: str, meaning: str, *, nominal: float | None = None
) -> Any:
    """Field of a record: a parameter whose logarithm is nearly uniform in a box."""
    return _field(
        Parameter("", unit, meaning, "log_bounded", low, high, nominal=nominal)
    )


def positive(
    mean: float, sd: float, unit: str, meaning: str, *, nominal: float | None = None
) -> Any:
    """Field of a record: a log-normal parameter of the given physical mean and sd."""
    blank = Parameter("", unit, meaning, "log", 0.0, nominal=nominal)
    return _field(prior_from_moments(blank, mean, sd))


def signed(
    mean: float, sd: float, unit: str, meaning: str, *, nominal: float | None = None
) -> Any:
    """Field of a record: a Gaussian parameter of any sign."""
    return _field(
        Parameter("", unit, meaning, "identity", mean=mean, sd=sd, nominal=nominal)
    )


def _field(parameter: Parameter) -> Any:
    return eqx.field(metadata={"parameter": parameter})


def prior_from_moments(
    parameter: Parameter,
    mean: float,
    sd: float,
    low: float | None = None,
    high: float | None = None,
) -> Parameter:
    """The parameter with a prior of the given *physical* mean and sd.

    With bounds, the virtual prior is matched in that box's map by quadrature; without,
    it is log-normal where the parameter is positive and Gaussian where it has a sign.
    Raises `InputError` E142 where no such prior exists, E144 for a sd that is not
    positive.
    """
    checks.moments(f"the prior of {parameter.name or 'a parameter'}", mean, sd)
    if low is not None or high is not None:
        low = parameter.low if low is None else low
        high = parameter.high if high is None else high
        logarithmic = parameter.map in ("log", "log_bounded") and low > 0.0
        kind = "log_bounded" if logarithmic else "bounded"
        boxed = dataclasses.replace(parameter, map=kind, low=low, high=high)
        return _match_in_box(boxed, mean, sd)
    if parameter.low >= 0.0:
        if mean <= 0.0:
            raise _impossible(parameter, mean, sd, "a positive mean")
        variance = math.log1p((sd / mean) ** 2)
        return dataclasses.replace(
            parameter,
            map="log",
            low=0.0,
            high=math.inf,
            mean=math.log(mean) - 0.5 * variance,
            sd=math.sqrt(variance),
        )
    return dataclasses.replace(
        parameter, map="identity", low=-math.inf, high=math.inf, mean=mean, sd=sd
    )


def _match_in_box(boxed: Parameter, mean: float, sd: float) -> Parameter:
    """Virtual mean and sd whose push-forward has the given physical moments."""
    import scipy.optimize  # an eighth of the time that a command takes to start

    low, high = boxed.low, boxed.high
    # No distribution in a box has more spread than the two-point one at its ends.
    if not low < mean < high or sd**2 >= (mean - low) * (high - mean):
        raise _impossible(boxed, mean, sd, f"moments that fit into [{low:g}, {high:g}]")
    z = np.linspace(-9.0, 9.0, 4001)
    weight = np.exp(-0.5 * z**2)
    weight /= weight.sum()
    table = Parameters((boxed,))

    @jax.jit
    def physical(tt: Array) -> Array:
        return jax.vmap(lambda t: table.constrain(t[None])[0])(tt)

    def moments(guess: np.ndarray) -> np.ndarray:
        theta = np.asarray(physical(jnp.asarray(guess[0] + math.exp(guess[1]) * z)))
        m = weight @ theta
        s = math.sqrt(weight @ (theta - m) ** 2)
        return np.array([(m - mean) / sd, math.log(s / sd)])

    with jax.enable_x64(True):
        centre = boxed.unconstrain(mean)
        step = 0.1 * min(mean - low, high - mean)
        slope = boxed.unconstrain(mean + step) - boxed.unconstrain(mean - step)
        start = [centre, math.log(sd * slope / (2.0 * step))]
        fit = scipy.optimize.least_squares(moments, start, xtol=1e-14, ftol=1e-14)
    if float(np.abs(fit.fun).max()) > 1e-6:
        raise _impossible(boxed, mean, sd, "moments that this map can reach")
    mean, sd = float(fit.x[0]), math.exp(fit.x[1])
    return dataclasses.replace(boxed, mean=mean, sd=sd)


def _impossible(p: Parameter, mean: float, sd: float, expected: str) -> InputError:
    got, name = f"mean = {mean:g}, sd = {sd:g}", p.name or "a parameter"
    return error("impossible_prior", got=got, expected=expected, name=name)


class Parameters(eqx.Module):
    """The table of a system's parameters: those to be learned, and those held fixed.

    Measured sums of parameters, ``measurements``, are part of every fit. Raises
    `InputError` E148 for a value held fixed that is not finite.
    """

    free: tuple[Parameter, ...] = eqx.field(static=True)
    fixed: tuple[tuple[str, float], ...] = eqx.field(static=True, default=())
    measurements: tuple[LinearMeasurement, ...] = eqx.field(static=True, default=())

    def __check_init__(self) -> None:
        checks.finite("the parameters held fixed", **dict(self.fixed))

    def __len__(self) -> int:
        return len(self.free)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters, in the order of the virtual vector."""
        return tuple(p.name for p in self.free)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the free parameters."""
        return tuple(p.unit for p in self.free)

    @property
    def groups(self) -> dict[str, np.ndarray]:
        """Places of the weights of each group."""
        names = dict.fromkeys(p.group for p in self.free if p.group)
        each = np.asarray(["" if p.shape else p.group for p in self.free])
        return {name: np.flatnonzero(each == name) for name in names}

    def without_groups(self) -> "Parameters":
        """The same parameters in no group: no data choose their prior's scale."""
        same = (dataclasses.replace(p, group="") for p in self.free)
        return dataclasses.replace(self, free=tuple(same))

    def ungrouped(self) -> "Parameters":
        """The table without the parameters of functions."""
        own = tuple(p for p in self.free if not p.group)
        return dataclasses.replace(self, free=own)

    def __getitem__(self, name: str) -> Parameter:
        return self.free[self.names.index(name)]

    def constrain(self, tt: Float[AnyArray, "*n p"]) -> Float[AnyArray, "*n p"]:
        """Physical values of virtual ones, always inside the bounds."""
        out = []
        for kind, index, low, high in self._groups(tt.dtype):
            out.append(bijections.constrain(kind, tt[..., index], low, high))
        return bijections.scatter(out, self._groups(tt.dtype), tt)

    def unconstrain(self, theta: Float[Array, " p"]) -> Float[Array, " p"]:
        """Virtual values of physical ones; a value on a bound maps just inside it."""
        out = []
        for kind, index, low, high in self._groups(theta.dtype):
            out.append(bijections.unconstrain(kind, theta[index], low, high))
        return bijections.scatter(out, self._groups(theta.dtype), theta)

    def slopes(
        self, tt: Float[AnyArray, " p"]
    ) -> tuple[Float[AnyArray, " p"], Float[AnyArray, " p"]]:
        """First derivatives of `constrain`, and second ones over the first."""
        groups = self._groups(tt.dtype)
        both = [bijections.slopes(kind, tt[i], a, b) for kind, i, a, b in groups]
        first, second = ([x[k] for x in both] for k in (0, 1))
        place = bijections.scatter
        return place(first, groups, tt), place(second, groups, tt)

    def moved(
        self, tt: Float[AnyArray, " p"], step: Float[AnyArray, " p"]
    ) -> Float[AnyArray, " p"]:
        """The virtual values after a step that begins as ``step``.

        Positive parameters step along products of powers (`bijections.along_powers`),
        as long as they stay in their bounds; other steps are straight.
        """
        xp, theta, (first, _) = library(tt), self.constrain(tt), self.slopes(tt)
        low = np.asarray([p.low for p in self.free])
        high = np.asarray([p.high for p in self.free])
        new, inside = bijections.along_powers(theta, first * step, low, high)
        curved = self.unconstrain(xp.where(inside, new, theta))
        return xp.where(inside, curved, tt + step)

    def curvature(
        self,
        prior: Gaussian,
        z: Float[AnyArray, " p"],
        gradient: Float[AnyArray, " p"],
    ) -> Float[AnyArray, "p p"]:
        """What the bounded maps add to the Hessian of a function of ``theta``.

        At ``tt = mu0 + L0 z``, with the function's ``gradient`` in ``z``. Each map
        contributes ``dF/dtt map''/map'``: at a bound, as much as it takes to push the
        parameter there.
        """
        xp = library(z)
        mean, scale = xp.asarray(prior.mean), xp.asarray(prior.scale)
        first, over = self.slopes(mean + scale @ z)
        bend = xp.where(first > 0.0, over, 0.0)
        by_tt = xp.linalg.solve(scale.T, gradient)
        return scale.T @ ((by_tt * bend)[:, None] * scale)

    def values(self, tt: Float[AnyArray, " p"]) -> dict[str, AnyScalar]:
        """Every parameter by name, in physical units: the free ones and the fixed."""
        theta = self.constrain(tt)
        values = {name: library(tt).asarray(v, tt.dtype) for name, v in self.fixed}
        return values | {p.name: theta[i] for i, p in enumerate(self.free)}

    def measurement_rows(
        self, prior: Gaussian, z: Float[Array, " p"]
    ) -> Float[Array, "q p1"]:
        """Rows ``[K r]`` of the measured sums, in their sd, at ``tt = mu0 + L0 z``."""

        def r(z: Array) -> Array:
            values = self.values(prior.mean + prior.scale @ z)
            return residuals(self.measurements, values, z)

        return jnp.concatenate([jax.jacfwd(r)(z), r(z)[:, None]], axis=1)

    def prior(self) -> Gaussian:
        """The independent Gaussian over virtual values; call it under `in_float64`."""
        mean = np.asarray([p.mean for p in self.free], float)
        sd = np.asarray([p.sd for p in self.free], float)
        # Put on the device as it is: to convert or to make it, JAX would compile.
        prior: Gaussian = jax.device_put(Gaussian(mean, np.diag(sd)))
        return prior

    def nominal(self) -> dict[str, float]:
        """Published values; the prior median where none was published."""
        given = {p.name: p.nominal for p in self.free}
        nominal = {
            p.name: p.constrain(p.mean) if given[p.name] is None else given[p.name]
            for p in self.free
        }
        return dict(self.fixed) | nominal  # type: ignore[return-value]

    def replace(self, **changes: "Parameter | float") -> "Parameters":
        """Give some parameters another prior, or fix them at a number.

        Raises `InputError` E145 for a name that the system does not have.
        """
        known = {p.name for p in self.free} | {name for name, _ in self.fixed}
        for name in changes:
            if name not in known:
                raise unknown_parameter(name, known)
        free, fixed = [], []
        specs: Mapping[str, Parameter | float] = dict(self.fixed) | {
            p.name: p for p in self.free
        }
        order = [*self.names, *(name for name, _ in self.fixed)]
        for name in order:
            value = changes.get(name, specs[name])
            if isinstance(value, Parameter):
                free.append(dataclasses.replace(value, name=name))
            else:
                fixed.append((name, float(value)))
        return dataclasses.replace(self, free=tuple(free), fixed=tuple(fixed))

    def merge(self, other: "Parameters") -> "Parameters":
        """Both tables as one, this one's parameters first."""
        mine, more = ((x.free, x.fixed, x.measurements) for x in (self, other))
        return Parameters(*(a + b for a, b in zip(mine, more, strict=True)))  # type: ignore[arg-type]

    def _groups(self, dtype: Any) -> list[tuple[str, np.ndarray, Any, Any]]:
        """Free parameters grouped by map, so that each map is one vector operation."""
        groups = []
        for kind in bijections.MAPS:
            index = [i for i, p in enumerate(self.free) if p.map == kind]
            if index:
                low = np.asarray([self.free[i].low for i in index], dtype)
                high = np.asarray([self.free[i].high for i in index], dtype)
                groups.append((kind, np.asarray(index), low, high))
        return groups


def parameters_of(record: type) -> Parameters:
    """The table declared by a record's fields."""
    free = []
    for field in dataclasses.fields(record):
        if "parameter" in field.metadata:
            parameter = field.metadata["parameter"]
            free.append(dataclasses.replace(parameter, name=field.name))
    return Parameters(tuple(free))


def unknown_parameter(name: str, known: Any) -> InputError:
    """E145, with the name that was probably meant."""
    close = nearest(name, known)
    expected = f"one of {', '.join(sorted(known))}"
    fix = f"did you mean {close}?" if close else ""
    return error("unknown_parameter", got=name, expected=expected, fix=fix)
