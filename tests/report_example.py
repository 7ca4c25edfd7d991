"""A made-up run that has everything a report can show."""

from typing import Any

import numpy as np

Run = tuple[dict[str, Any], dict[str, np.ndarray]]

NAMES = ("motor_resistance", "arm_damping", "pendulum_mass", "m1r1", "I1", "m2")
BOXES = ((4.2, 16.8), (1e-6, 3e-3), (0.012, 0.048), (0.0, 1.2), (0.0, 0.4), (0.1, 1.0))
UNITS = ("ohm", "N m s/rad", "kg", "kg m", "kg m^2", "kg")
WORDS = (
    "identified", "prior_dominated", "at_bound", "traded_off", "weak", "dead"
)  # fmt: skip


def draws(rng: np.random.Generator, mean: float, sd: float, index: int) -> np.ndarray:
    """Draws of a parameter: normal in the virtual space of its box or log box."""
    low, high = BOXES[index]
    share = 1 / (1 + np.exp(-(mean + sd * rng.standard_normal(1500))))
    if low > 0 and high / low > 100:
        return low * (high / low) ** share
    return low + (high - low) * share


def parameters(rng: np.random.Generator) -> Run:
    """Six parameters, one for each verdict."""
    spread = (0.05, 1.2, 0.3, 0.8, 0.5, 1.5)
    centre = (-0.6, 0.3, 3.5, 0.2, -0.4, 0.0)
    prior = np.stack([draws(rng, 0.0, 1.5, i) for i in range(6)], axis=1)
    after = np.stack([draws(rng, centre[i], spread[i], i) for i in range(6)], axis=1)
    table = {
        name: {
            "unit": UNITS[i],
            "meaning": f"meaning of {name}",
            "prior_mean": float(prior[:, i].mean()),
            "prior_sd": float(prior[:, i].std()),
            "mean": float(after[:, i].mean()),
            "sd": float(after[:, i].std()),
            "q025": float(np.quantile(after[:, i], 0.025)),
            "q975": float(np.quantile(after[:, i], 0.975)),
            "low": BOXES[i][0],
            "high": BOXES[i][1],
            "verdict": WORDS[i],
            "note": "with I1 and m2" if WORDS[i] == "traded_off" else "",
            "truth": float(np.median(after[:, i])) if i < 3 else None,
        }
        for i, name in enumerate(NAMES)
    }
    factor = rng.standard_normal((6, 3))
    cov = factor @ factor.T + 0.2 * np.eye(6)
    sd = np.sqrt(np.diag(cov))
    summary = {
        "parameters": table,
        "directions": [
            {"text": "m2 + 2.1 m1r1 - 0.4 I1 is fixed", "combination": "m2 + 2.1 m1r1",
             "information": 812.0, "flat": False},
            {"text": "m1r1 rises while I1 falls", "combination": "m1r1 - 0.8 I1",
             "information": 0.2, "flat": True},
        ],
        "base_parameters": [
            {"text": "I1 + m2 l1^2", "value": 0.0312, "sd": 0.0004, "unit": "kg m^2",
             "verdict": "identified"},
        ],
    }  # fmt: skip
    arrays = {
        "parameters/prior_samples": prior,
        "parameters/samples": after,
        "parameters/correlation": cov / np.outer(sd, sd),
    }
    return summary, arrays


def logs(rng: np.random.Generator) -> Run:
    """Two recordings of 12 s and 2 s in windows, with bands on the first."""
    arrays: dict[str, np.ndarray] = {}
    for log, length, every in (("logs/excite_1.csv", 6000, 200), ("b.csv", 1000, 250)):
        time = np.arange(length) * 2e-3
        for k, channel in enumerate(("q1", "q2")):
            true = np.sin(2 * time + k) * np.exp(-time / 9) + 0.2 * np.sin(11 * time)
            off = 0.1 * np.sin(40 * time) * ((time > 7) & (time < 8.2)) + 0.01
            simulated = true + off
            simulated[every::every] = np.nan
            base = f"trace/{log}"
            arrays[f"{base}/time"] = time
            arrays[f"{base}/measured/{channel}"] = true + 0.004 * rng.standard_normal(
                length
            )
            arrays[f"{base}/predicted/{channel}"] = simulated
            if log.startswith("logs"):
                arrays[f"{base}/low/{channel}"] = simulated - 0.06
                arrays[f"{base}/high/{channel}"] = simulated + 0.06
    summary = {
        "units": {"q1": "rad", "q2": "rad"},
        "noise": {"q1": {"sd": 0.0041, "unit": "rad"}, "q2": {"sd": 0.0038}},
        "misfit": {
            "verdict": "The residuals are correlated from row to row.",
            "alarm": True,
            "tests": {
                "chi2": {
                    "statistic": None, "p": None, "freedom": 0, "alarm": False,
                    "text": "Not tested: the noise was estimated.",
                },
                "ljung_box": {
                    "statistic": 61.2, "p": 2e-5, "freedom": 20, "alarm": True,
                    "text": "The residuals of q2 are correlated from row to row.",
                },
                "f_test": {
                    "statistic": 1.1, "p": 0.34, "freedom": 17, "alarm": False,
                    "text": "The residuals follow neither the state nor the input.",
                },
            },
            "noise": ["The noise of q2 is 12 times the rounding of its sensor."],
        },
    }  # fmt: skip
    return summary, arrays


def evaluation() -> Run:
    """Error against horizon for two joints and three methods."""
    horizon = np.linspace(0.1, 1.0, 10)
    arrays = {"curve/horizon": horizon}
    for i, method in enumerate(("sim2gp", "least squares", "hold")):
        for k, channel in enumerate(("q1", "q2")):
            arrays[f"curve/{method}/{channel}"] = (0.01 + 0.02 * i + 0.01 * k) * (
                0.4 + horizon ** (1 + 0.3 * i)
            )
    summary = {
        "open_loop_rmse": {"q1": 0.0242, "q2": 0.0324},
        "one_step_rmse": {"q1": 3.1e-4, "q2": 4.2e-4},
        "coverage90": {"q1": 0.913, "q2": 0.887},
        "coverage95": {"q1": 0.951, "q2": 0.94},
        "nll": -3.21,
        "windows": 1423,
        "horizon": 1.0,
        "calibration": {
            "horizon": 1.0, "windows": 1423, "independent": 12,
            "blocks": "12 recordings",
            "text": "q2: the 30 to 70 % bands hold too few measurements.",
        },
    }  # fmt: skip
    level = np.linspace(0.05, 0.99, 20)
    arrays |= {
        "calibration/level": level,
        "calibration/share/q1": level**0.9,
        "calibration/share/q2": level**1.3,
    }
    for channel in ("q1", "q2"):
        for end, sign in (("low", -1), ("high", 1)):
            zone = level + sign * 0.1 * np.sqrt(level * (1 - level))
            arrays[f"calibration/{end}/{channel}"] = zone
    return summary, arrays


def swing_up(episodes: int = 3) -> Run:
    """A pendulum that is swung up better each time, and the returns of three models."""
    time = np.arange(250) * 0.02
    states, actions = [], []
    for episode in range(episodes):
        rise = 1 / (1 + np.exp(-(time - 3.2 + 0.5 * episode) * 3.5))
        alpha = (np.pi if episode else 0.4) * rise
        alpha = alpha + 1.1 * np.sin(8.5 * time) * np.exp(-(((time - 1.4) / 0.9) ** 2))
        theta = 0.7 * np.sin(4.2 * time) * np.exp(-time / 2.2)
        rates = np.gradient(theta, time), np.gradient(alpha, time)
        states.append(np.stack([theta, alpha, *rates], axis=1))
        actions.append(
            np.clip(4 * np.sin(8.5 * time + 1) * (1.02 - rise), -5, 5)[:, None]
        )
    rng = np.random.default_rng(7)
    learned = np.minimum(40 + 90 * np.arange(4), 168) + 4 * rng.standard_normal((10, 4))
    summary = {
        "animation": {
            "system": "furuta",
            "dt": 0.02,
            "params": {"arm_length": 0.085, "pendulum_length": 0.129},
            "title": "Three episodes of the demo",
            "marks": [
                {"time": 5.0 * k, "text": f"episode {k + 1}"} for k in range(episodes)
            ],
        },
        "oracle_return": 171.3,
        "hang_return": 33.0,
        "episodes_to_95": {
            "posterior_sampling": [2, 2, 2, 3, 2, 2, 2, 2, 2, 3],
            "point_estimate": [2, 2, 2, 2, 2, None, 2, 2, 2, 2],
            "prior_mean": [None] * 10,
        },
        "interaction_seconds": 10.0,
    }
    arrays = {
        "animation/state": np.concatenate(states),
        "animation/action": np.concatenate(actions),
        "returns/posterior_sampling": learned,
        "returns/point_estimate": learned - 3 + rng.standard_normal((10, 4)),
        "returns/prior_mean": 60 + 9 * rng.standard_normal((10, 4)),
    }
    return summary, arrays


def two_data_sets() -> Run:
    """The beliefs of figure 1 and what their draws predict."""
    rng = np.random.default_rng(3)
    time = np.arange(150) * 0.02
    q2 = 1.2 * np.sin(2.1 * time) + 0.5 * time
    q1 = 0.8 * np.sin(1.6 * time + 0.3)
    first = np.stack([0 * time, q2, 0 * time, np.gradient(q2, time)], axis=1)
    second = np.stack([q1, 0.6 * q2, np.gradient(q1, time), q2], axis=1)
    sds = {
        "prior": np.full(4, 1.5),
        "posterior1": np.array([1.5, 1.5, 0.019, 0.018]),
        "posterior2": np.array([0.029, 0.094, 0.013, 0.008]),
    }
    truth = np.array([-0.8, 0.4, 0.7, -0.3])
    arrays = {"figure1/data1/state": first, "figure1/data2/state": second}
    for name, sd in sds.items():
        pull = (sd < 0.5) * truth + 0.5 * sd * (sd < 0.5)
        arrays[f"figure1/{name}/mean"] = pull
        arrays[f"figure1/{name}/scale"] = np.diag(sd) @ (
            np.eye(4) + 0.3 * np.tri(4, k=-1)
        )
    arrays["figure1/truth"] = truth
    for data, state, pair in (
        ("data1", first, {"prior": 0.5, "posterior1": 0.02}),
        ("data2", second, {"posterior1": 0.4, "posterior2": 0.03}),
    ):
        for stage, size in pair.items():
            factor = 1 + size * rng.standard_normal((40, 1, 1))
            arrays[f"figure1/{data}/draws/{stage}"] = state * factor
    names = ["mass1", "damping1", "mass2", "damping2"]
    summary = {
        "figure1": {"names": names, "lengths": [0.5, 0.4], "dt": 0.02},
        "claims": {
            "link_1_stays_at_the_prior": {"holds": True, "figure": 0.99,
                                          "text": "sd after data set 1 over prior sd"},
            "coverage": {"holds": False, "figure": "181 of 200", "text": ""},
        },
    }  # fmt: skip
    return summary, arrays


def planned() -> Run:
    """An experiment of five seconds, near a limit of one joint."""
    time = 0.02 * np.arange(251)
    sweep = np.sin(time**1.5)
    arrays = {"design/time": time, "design/command/voltage": 3 * sweep[:-1]}
    for name, size in (("theta", 0.8), ("theta.velocity", 6.0)):
        arrays[f"design/state/{name}"] = size * sweep
        arrays[f"design/low/{name}"] = size * (sweep - 0.1 * time / 5)
        arrays[f"design/high/{name}"] = size * (sweep + 0.1 * time / 5)
    arrays["design/limit/theta"] = np.array([-1.0, 1.0])
    arrays["design/limit/voltage"] = np.array([-5.0, 5.0])
    units = {"voltage": "V", "theta": "rad", "theta.velocity": "rad/s"}
    return {"units": units, "violations": 0.012, "draws_checked": 500}, arrays


def full_run() -> Run:
    """A run that has everything a report can show."""
    rng = np.random.default_rng(0)
    summary: dict[str, Any] = {
        "command": "identify",
        "command_line": ["sim2gp", "identify", "arm.toml", "--out", "runs/my arm"],
        "headline": "Six logs determine 3 of 6 constants; one combination stays open.",
        "versions": {"sim2gp": "0.1.0", "jax": "0.8.1", "python": "3.11.2"},
        "converged": True,
        "status": "ok",
        "wall_seconds": 21.37,
        "n_transitions": 30124,
        "log_evidence": 81234.5,
        "seed": 0,
        "warnings": [{"code": "W110", "text": "the period varies by 8 %"}],
        "prior_conflicts": ["pendulum_mass lies 3.4 prior sd from its mean."],
        "tables": [
            {"title": "Leave one log out", "columns": ["log", "joint", "ratio"],
             "rows": [["excite_1.csv", "q1", 0.874], ["excite_1.csv", "q2", 0.913]],
             "note": "Error over that of plain least squares."},
            {"title": "By horizon", "rows": [["0.1", *["0.0123"] * 9]],
             "columns": ["horizon, s", *(f"joint {k}, held" for k in range(9))]},
        ],
    }  # fmt: skip
    arrays: dict[str, np.ndarray] = {}
    parts = [parameters(rng), logs(rng), evaluation(), swing_up(), two_data_sets()]
    for part in (*parts, planned()):
        units = summary.get("units", {}) | part[0].get("units", {})
        summary |= part[0] | {"units": units}
        arrays |= part[1]
    return summary, arrays


def a_film(pictures: bool = True) -> Run:
    """A stick figure of two links: its forecast over what was recorded, in two pieces.

    With pictures, as MuJoCo renders them, of another colour each.
    """
    import io

    from PIL import Image

    t = 0.01 * np.arange(100)
    recorded = np.stack([np.sin(3 * t), np.cos(5 * t)], axis=1)
    state = recorded + 0.2 * (t % 0.5)[:, None]

    def points(q: np.ndarray) -> np.ndarray:
        first, second = q[:, 0], q.sum(axis=1)
        zero = np.zeros_like(first)
        elbow = 0.4 * np.stack([np.sin(first), zero, -np.cos(first)], axis=1)
        tip = elbow + 0.3 * np.stack([np.sin(second), zero, -np.cos(second)], axis=1)
        return np.stack([np.zeros_like(elbow), elbow, tip], axis=1)

    figure = {
        "fixed": [[0.0, 0.0, 0.0]],
        "rods": [[1, 2, "link"], [2, 3, "tip"]],
        "balls": [[0, "base"], [1, "link"], [2, "link"], [3, "tip"]],
    }
    about: dict[str, Any] = {
        "system": "figure", "figure": figure, "dt": 0.01, "title": "Forecasts",
        "marks": [{"time": 0.0, "text": "run, from 0.1 s"},
                  {"time": 0.5, "text": "run, from 0.6 s"}],
        "strips": [[0, "shoulder", "deg", 57.3], [1, "elbow", "deg", 57.3]],
        "inputs": [["shoulder_motor", ""]],
    }  # fmt: skip
    arrays = {
        "animation/state": state,
        "animation/recorded": recorded,
        "animation/points": points(state),
        "animation/recorded_points": points(recorded),
        "animation/action": np.sign(np.sin(9 * t))[:, None],
    }
    if pictures:
        files = []
        for k in range(4):
            image = Image.new("RGB", (480, 315), (60 * k, 200 - 40 * k, 90))
            file = io.BytesIO()
            image.save(file, format="WEBP")
            files.append(file.getvalue())
        about["frames"] = {"every": 25, "width": 480, "height": 315}
        arrays["animation/frames"] = np.frombuffer(b"".join(files), np.uint8)
        arrays["animation/frame_ends"] = np.cumsum([len(file) for file in files])
    summary = {
        "command": "identify", "title": "arm: what one log determines",
        "headline": "6 of 6 constants are identified.", "animation": about,
        "command_line": "sim2gp identify arm.toml", "versions": {"sim2gp": "0.1.0"},
    }  # fmt: skip
    return summary, arrays
