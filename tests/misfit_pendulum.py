"""Reliability's section 3.4 anew: one-step regression of a pendulum, right and wrong.

    dv/dt = -w sin q - b v - c tanh(v / 0.05) + k u(t - delay),    v noisy, sd 0.04

Period 0.05 s, noise 0.04 rad/s in each step, inputs that change every 4 periods with
a size drawn for each episode of 250; ``w``, ``b`` (0.05 to 1) and ``k`` are drawn for
each machine and fitted without friction and delay. The noise was chosen so that
friction 0.3 raises the reduced chi-squared by 2 to 4 %, as in 3.4.

    python tests/misfit_pendulum.py     the table of docs/misfit.md (four minutes)
"""

from typing import Any, NamedTuple

import numpy as np

from sim2gp.identification.misfit.tests import Misfit, misfit

DT, SUBSTEPS, HOLD, LENGTH, NOISE = 0.05, 5, 4, 250, 0.04


class Rows(NamedTuple):
    """One machine's data."""

    q: np.ndarray
    v: np.ndarray
    u: np.ndarray
    change: np.ndarray
    episode: np.ndarray


def step(
    w: np.ndarray, b: np.ndarray, k: np.ndarray, q: np.ndarray, v: np.ndarray,
    u: np.ndarray, friction: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """One period by semi-implicit Euler; elementwise."""
    h = DT / SUBSTEPS
    for _ in range(SUBSTEPS):
        dry = friction * np.tanh(v / 0.05)
        v = v + h * (k * u - w * np.sin(q) - b * v - dry)
        q = q + h * v
    return q, v


def machines(
    count: int, N: int, *, friction: float = 0.0, delay: int = 0, seed: int = 0
) -> list[Rows]:
    """So many machines, each run for ``N`` steps."""
    rng = np.random.default_rng([seed, N, int(10 * friction), delay])
    shape = (count, N // LENGTH)
    w, b, k = (
        rng.uniform(low, high, (count, 1))
        for low, high in ((5, 15), (0.05, 1), (0.5, 2))
    )
    size = rng.uniform(1.0, 4.0, shape)[..., None]
    u = size * rng.standard_normal((*shape, -(-LENGTH // HOLD)))
    u = np.repeat(u, HOLD, axis=2)[..., :LENGTH]
    acts = np.concatenate([np.zeros((*shape, delay)), u], axis=2)
    q = v = np.zeros(shape)
    rows = []
    for t in range(LENGTH):
        after, faster = step(w, b, k, q, v, acts[..., t], friction)
        faster = faster + NOISE * rng.standard_normal(shape)
        rows.append(np.stack([q, v, u[..., t], faster - v], axis=-1))
        q, v = after, faster
    table = np.stack(rows, axis=2).reshape(count, N, 4)
    episode = np.arange(N) // LENGTH
    return [Rows(*one.T, episode) for one in table]


def fit_and_test(rows: Rows, *, known: bool = True) -> Misfit:
    """Least squares of the three constants, and the four tests of its residuals."""
    theta = np.asarray([10.0, 0.5, 1.0])

    def f(theta: np.ndarray) -> np.ndarray:
        return step(*theta, rows.q, rows.v, rows.u)[1] - rows.v - rows.change

    for _ in range(6):
        sides = [(theta + e, theta - e) for e in 1e-4 * np.eye(3)]
        J = np.stack([f(a) - f(b) for a, b in sides], axis=1) / 2e-4
        r = f(theta)
        theta = theta - np.linalg.lstsq(J, r, rcond=None)[0]
    sd = NOISE if known else float(np.std(r))
    earlier = np.arange(len(r))[:, None] - np.arange(1, 4)
    start = rows.episode * LENGTH
    past = rows.u[np.maximum(earlier, start[:, None])]
    return misfit(
        r[:, None] / sd,
        np.stack([np.sin(rows.q), np.cos(rows.q), rows.v, rows.u], axis=1),
        jacobian=J[:, None] / sd,
        past=past,
        group=rows.episode,
        noise_known=known,
    )


def alarms(
    count: int, N: int, *, friction: float = 0.0, delay: int = 0, known: bool = True
) -> dict[str, float]:
    """How often each test, and any of them, raises the alarm."""
    data = machines(count, N, friction=friction, delay=delay)
    each = [fit_and_test(rows, known=known) for rows in data]
    share = {
        name: float(np.mean([m.tests[name].alarm for m in each]))
        for name in each[0].tests
    }
    return share | {"any": float(np.mean([m.alarm for m in each]))}


CASES: dict[str, tuple[int, dict[str, Any]]] = {
    "correct, N = 500": (500, {}),
    "friction 0.3, N = 500": (500, {"friction": 0.3}),
    "friction 0.3, N = 2000": (2000, {"friction": 0.3}),
    "friction 1.0, N = 500": (500, {"friction": 1.0}),
    "delay 2 samples, N = 500": (500, {"delay": 2}),
}


def main(count: int = 1000) -> None:
    """Print how often each test raises the alarm."""
    for known in (True, False):
        print("the noise is", "known" if known else "estimated")
        for name, (N, missing) in CASES.items():
            share = alarms(count, N, known=known, **missing)
            print(f"{name:25}", " ".join(f"{k} {v:.3f}" for k, v in share.items()))


if __name__ == "__main__":
    main()
