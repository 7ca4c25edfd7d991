"""A trained policy in NumPy alone: what a control computer needs, and nothing more."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sim2gp.errors import NotFinite, error
from sim2gp.robot.format import (
    LARGEST,
    check_shapes,
    check_values,
    header,
    not_a_policy,
)
from sim2gp.runs.archive import declarations, load_arrays
from sim2gp.runs.store import read_run


@dataclass(frozen=True)
class NumpyPolicy:
    """``a = middle + half tanh(mean(o(s)))``, as `sim2gp.planning.Policy`, in float32.

    states, actions: names of the channels, in the order of the arrays.
    angle: the state whose turns do not count, or None.
    """

    states: tuple[str, ...]
    actions: tuple[str, ...]
    weights: tuple[Float[np.ndarray, "_ _"], ...]
    biases: tuple[Float[np.ndarray, " _"], ...]
    scale: Float[np.ndarray, " n"]
    low: Float[np.ndarray, " m"]
    high: Float[np.ndarray, " m"]
    angle: int | None

    def __call__(self, state: Float[np.ndarray, " n"]) -> Float[np.ndarray, " m"]:
        """The action at a state, in the units of the channels, inside the box.

        Raises `NotFinite` E203 for a state that is not finite, ValueError for one of
        another length.
        """
        s = np.asarray(state, np.float32)
        if s.shape != self.scale.shape:
            raise ValueError(f"state of shape {s.shape}, expected {self.scale.shape}")
        with np.errstate(all="ignore"):
            mean = self._mean(s)
            # Infinity would be a full action: it is judged before it is squashed.
            if not (np.isfinite(s).all() and np.isfinite(mean).all()):
                got = s.tolist()
                raise error("no_action", NotFinite, where="a policy", got=got)
        middle, half = 0.5 * (self.high + self.low), 0.5 * (self.high - self.low)
        return np.clip(middle + half * np.tanh(mean), self.low, self.high)

    def _mean(self, s: Float[np.ndarray, " n"]) -> Float[np.ndarray, " m"]:
        x = self._observed(s)
        for W, b in zip(self.weights[:-1], self.biases[:-1], strict=True):
            x = x @ W
            x += b
            np.maximum(x, 0.0, out=x)
        return (x @ self.weights[-1] + self.biases[-1])[: self.low.size]

    def _observed(self, s: Float[np.ndarray, " n"]) -> Float[np.ndarray, " o"]:
        scaled = s / self.scale
        if self.angle is None:
            return scaled
        turn = s[self.angle]
        ends = np.sin(turn), np.cos(turn)
        return np.concatenate([scaled[: self.angle], scaled[self.angle + 1 :], ends])


def load_policy(folder: Path | str) -> NumpyPolicy:
    """Read what `export_policy` wrote.

    Everything is checked first (`sim2gp.robot.format`), sizes before the first array is
    built. Raises `InputError` E133 for a run that is no policy, E181 for numbers that
    are not finite, E185 for a newer format, and what `load_run` raises: a damaged file
    is never half used.
    """
    run = read_run(folder)
    about = header(run.summary, where=str(run.path))
    content = run.arrays if run.arrays is not None else b""
    try:
        check_shapes(about, declarations(content, LARGEST), where=str(run.path))
        x = load_arrays(content)
    except ValueError as error:
        raise not_a_policy(str(run.path), str(error)) from error
    check_values(x, where=str(run.path))
    layers = range(about["layers"])
    return NumpyPolicy(
        states=tuple(about["states"]),
        actions=tuple(about["actions"]),
        weights=tuple(x[f"weights/{i}"] for i in layers),
        biases=tuple(x[f"biases/{i}"] for i in layers),
        scale=x["scale"],
        low=x["low"],
        high=x["high"],
        angle=about["angle"],
    )
