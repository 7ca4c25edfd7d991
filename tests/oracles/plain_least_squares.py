"""The fits a newcomer would write: plain least squares on logs, numpy and scipy only.

No prior, no noise model, no actuator. Windows of a given length follow each other
without overlap from the recorded start angle and the causal start velocity of
`log_protocol`; the sum of squared angle errors inside them is minimised over the
parameters (scipy's trust region, Jacobian by central differences). Windows and
perturbed parameters run together as one numpy batch.

Arm: nine numbers (m1 r1, I1, m2, m2 r2, I2, b1, b2, cf1, cf2), the rotor inertia
fixed. For a fixed base m2, m1 r1 and I1 are collinear, so the nine are not unique;
their predictions are. Qube: seven numbers (A, B, C, G, Da, Dp, cf), the volt-to-torque
factor fixed, since voltage in and angles out leave the scale of the rest free.

Figures, fitted with one log left out and tested on it (rad, pooled): arm at 0.2 s
.0255/.0318; Qube at 0.1 s .0156/.0211, held angle .147/.111, regression .011/.008.

Beside them two predictors without mechanics: the angle held, and a linear regression.
"""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.optimize import least_squares

from .log_protocol import (
    Acceleration,
    Array,
    Gridded,
    rollout,
    steps_of,
    window_inputs,
    window_starts,
)

WINDOW = 0.2  # s
GRAVITY = 9.81
ARM_LENGTH1 = 0.2  # m
ARM_GEAR = 6.0
ARM_ROTOR = 6.287203962819607e-05  # kg m^2, of published model 2.0
ARM_START = (0.1517, 0.0421, 0.3369, 0.1578, 0.0510, 0.0037, 0.0006, 0.1747, 0.1100)
QUBE_TORQUE_PER_VOLT = 0.042 / 8.4  # N m / V, of the nominal motor
QUBE_START = (2.3e-4, -1.3e-4, 1.33e-4, 0.0152, 4.8e-4, 5e-5, 1e-3)
FRICTION_SLOPE = 100.0  # s/rad

Model = Callable[[Array, Array, Array, Array], Array]
"""(parameters (p, B or 1), angle (B, d), velocity (B, d), input (B, m)) -> (B, d)."""


def solve2(m11: Array, m12: Array, m22: Array, f1: Array, f2: Array) -> Array:
    """The accelerations of two degrees of freedom, M^-1 f, closed form."""
    det = m11 * m22 - m12**2
    return np.stack([(m22 * f1 - m12 * f2) / det, (m11 * f2 - m12 * f1) / det], axis=1)


def arm_acceleration(p: Array, q: Array, v: Array, u: Array) -> Array:
    """The vertical arm, both angles zero when hanging, the second relative.

    M q'' + C = G + u - b q' - cf atan(100 q'), inertias about the joints, rotor terms
    in M as published. `p` holds the nine numbers and optionally a tenth, the rotor.
    """
    mr1, i1, m2, mr2, i2, b1, b2, cf1, cf2 = p[:9]
    rotor = p[9] if len(p) > 9 else ARM_ROTOR
    sin1, sin12 = np.sin(q[:, 0]), np.sin(q[:, 0] + q[:, 1])
    coupling = ARM_LENGTH1 * mr2 * np.cos(q[:, 1])
    m11 = i1 + i2 + m2 * ARM_LENGTH1**2 + 2 * coupling + (ARM_GEAR**2 + 1) * rotor
    m12 = i2 + coupling - ARM_GEAR * rotor
    m22 = i2 + ARM_GEAR**2 * rotor
    coriolis = ARM_LENGTH1 * mr2 * np.sin(q[:, 1])
    v1, v2 = v[:, 0], v[:, 1]
    friction1 = b1 * v1 + cf1 * np.arctan(FRICTION_SLOPE * v1)
    friction2 = b2 * v2 + cf2 * np.arctan(FRICTION_SLOPE * v2)
    weight1 = (mr1 + m2 * ARM_LENGTH1) * sin1 + mr2 * sin12
    f1 = u[:, 0] + coriolis * (2 * v1 * v2 + v2**2) - GRAVITY * weight1 - friction1
    f2 = u[:, 1] - coriolis * v1**2 - GRAVITY * mr2 * sin12 - friction2
    return solve2(m11, m12, m22, f1, f2)


def qube_acceleration(p: Array, q: Array, v: Array, u: Array) -> Array:
    """The Furuta pendulum with alpha = 0 upright, in its seven base numbers.

    A, C: inertias of arm and pendulum about their axes, B: coupling, all in kg m^2 (B
    is negative where the two angles are counted in opposite senses, as in these logs);
    G: weight torque in N m; Da: viscous and motor damping, Dp: pendulum damping, in
    N m s/rad; cf: Coulomb friction of the arm (atan form) in N m. C also stands for
    the second moment in the centrifugal terms, negligible near upright.
    """
    a, b, c, weight, damping, pendulum_damping, cf = p
    sin, cos = np.sin(q[:, 1]), np.cos(q[:, 1])
    arm, pendulum = v[:, 0], v[:, 1]
    torque = QUBE_TORQUE_PER_VOLT * u[:, 0]
    f1 = torque - damping * arm - cf * np.arctan(FRICTION_SLOPE * arm)
    f1 = f1 - 2 * c * sin * cos * arm * pendulum - b * sin * pendulum**2
    f2 = weight * sin + c * sin * cos * arm**2 - pendulum_damping * pendulum
    return solve2(a + c * sin**2, -b * cos, c + 0 * cos, f1, f2)


class Windows:
    """Non-overlapping windows of several logs, run as one batch."""

    def __init__(self, logs: Sequence[Gridded], steps: int):
        starts = [window_starts(len(log.angle), steps, spacing=steps) for log in logs]
        pairs = list(zip(logs, starts, strict=True))
        times = np.arange(steps + 1)[:, None]
        self.q = np.concatenate([log.angle[s] for log, s in pairs])
        self.v = np.concatenate([log.velocity[s] for log, s in pairs])
        self.input = np.concatenate(
            [window_inputs(log, s, steps) for log, s in pairs], axis=1
        )
        self.target = np.concatenate(
            [log.angle[s[None, :] + times] for log, s in pairs], axis=1
        )

    def predict(self, model: Model, parameters: Array) -> Array:
        """Angles (steps + 1, K, W, d) for K parameter vectors (K, p)."""
        count, width = len(parameters), len(self.q)
        columns = np.repeat(parameters.T, width, axis=1)
        angles = rollout(
            lambda q, v, u: model(columns, q, v, u),
            np.tile(self.q, (count, 1)),
            np.tile(self.v, (count, 1)),
            np.tile(self.input, (1, count, 1)),
        )
        return angles.reshape(len(angles), count, width, -1)


def fit(
    model: Model,
    start: Sequence[float],
    logs: Sequence[Gridded],
    window: float = WINDOW,
) -> Array:
    """The least-squares parameters (p,); `window` in s."""
    windows = Windows(logs, steps_of(window))
    origin = np.asarray(start)
    kept = slice(1, None, 2)  # every second sample: neighbours say the same

    # The parameters span five decades; the solver sees them relative to the start.
    def residual(x: Array) -> Array:
        predicted = windows.predict(model, (x * origin)[None])[kept, 0]
        return (predicted - windows.target[kept]).ravel()

    def jacobian(x: Array) -> Array:
        step = np.diag(1e-5 * np.maximum(np.abs(x), 0.1))
        moved = windows.predict(model, np.concatenate([x + step, x - step]) * origin)
        moved = moved[kept]
        up, down = np.split(moved, 2, axis=1)
        slope = (up - down) / (2 * np.diag(step)[None, :, None, None])
        return slope.transpose(0, 2, 3, 1).reshape(-1, len(x))

    solution = least_squares(
        residual, np.ones(len(origin)), jacobian, method="trf", max_nfev=60
    )
    return solution.x * origin


def bound(model: Model, parameters: Array) -> Acceleration:
    """The model with its parameters filled in, as `log_protocol.errors` takes it."""
    column = np.asarray(parameters)[:, None]
    return lambda q, v, u: model(column, q, v, u)


def fit_arm(logs: Sequence[Gridded], window: float = WINDOW) -> Array:
    """The nine numbers of the arm."""
    return fit(arm_acceleration, ARM_START, logs, window)


def fit_qube(logs: Sequence[Gridded], window: float = 0.1) -> Array:
    """The seven numbers of the Qube."""
    return fit(qube_acceleration, QUBE_START, logs, window)


def hold_errors(log: Gridded, horizon: float) -> Array:
    """Errors (W, d) in rad of predicting that the angles stay as they are."""
    steps = steps_of(horizon)
    starts = window_starts(len(log.angle), steps)
    return log.angle[starts] - log.angle[starts + steps]


def regression_features(log: Gridded, horizon: float) -> tuple[Array, Array]:
    """Start state, every input of the window and one (W, k); displacement (W, d)."""
    steps = steps_of(horizon)
    starts = window_starts(len(log.angle), steps)
    inputs = window_inputs(log, starts, steps).transpose(1, 0, 2)
    features = np.concatenate(
        [
            log.angle[starts],
            log.velocity[starts],
            inputs.reshape(len(starts), -1),
            np.ones((len(starts), 1)),
        ],
        axis=1,
    )
    return features, log.angle[starts + steps] - log.angle[starts]


def regression_errors(logs: Sequence[Gridded], test: Gridded, horizon: float) -> Array:
    """Errors (W, d) in rad on `test` of a linear regression on the other logs.

    It sees the inputs of the whole window. Recorded in closed loop these leak the
    future angle, which is why it can beat every simulator: a reference, not a model.
    """
    pairs = [regression_features(log, horizon) for log in logs]
    features = np.concatenate([pair[0] for pair in pairs])
    moved = np.concatenate([pair[1] for pair in pairs])
    weights = np.linalg.lstsq(features, moved, rcond=None)[0]
    features, moved = regression_features(test, horizon)
    return features @ weights - moved
