"""A trained policy in NumPy alone: what a control computer needs, and nothing more."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sim2gp.errors import InputError, NotFinite
from sim2gp.runs import Run, load_run

FORMAT = 1


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
                raise NotFinite("E203", "no action", where="a policy", got=s.tolist())
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

    Raises `InputError` E133 for a run that is no policy, or one of another format, E181
    for numbers that are not finite, and what `load_run` raises: a damaged file is never
    half used.
    """
    run = load_run(folder)
    about, arrays = run.summary.get("policy"), run.arrays
    if not isinstance(about, dict) or about.get("format") != FORMAT:
        raise _refused(run, "another run" if about is None else "another format")
    layers = range(int(about["layers"]))
    try:
        scale, low, high = (arrays[name] for name in ("scale", "low", "high"))
        weights = tuple(arrays[f"weights/{i}"] for i in layers)
        biases = tuple(arrays[f"biases/{i}"] for i in layers)
    except KeyError as error:
        raise _refused(run, f"no array {error}") from error
    for x in (scale, low, high, *weights, *biases):
        if x.dtype != np.float32:
            raise _refused(run, f"numbers of {x.dtype}")
    _check_finite(run)
    states, actions = tuple(about["states"]), tuple(about["actions"])
    angle = about["angle"]
    return NumpyPolicy(states, actions, weights, biases, scale, low, high, angle)


def _check_finite(run: Run) -> None:
    for name, x in run.arrays.items():
        bad = int(np.size(x) - np.isfinite(x).sum())
        if bad:
            raise InputError(
                "E181",
                "policy with numbers that are not finite",
                where=f"{run.path}, array {name}",
                got=f"{bad} of {np.size(x)}",
                expected="finite numbers",
                fix="train it again: its training diverged",
            )


def _refused(run: Run, got: str) -> InputError:
    return InputError(
        "E133",
        "not a policy that can be run",
        where=str(run.path),
        got=got,
        expected=f"a policy that was exported, of format {FORMAT}",
        fix="export it again with sim2gp.robot.export",
    )
