"""Unidentified truth is said: flat directions named, base parameters offered."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from beliefs import believe, named, rows_of, study
from sim2gp.identification import diagnose
from sim2gp.inference.parameters import Parameter, Parameters, parameters_of
from sim2gp.systems.plants.two_link import TwoLink, UniformRodArm, UniformRodParams

# --- Unidentified truth is said: 50 degenerate systems -------------------------------


def value_of(text, values):
    """A sum or product as the report prints it, evaluated."""
    text = text.removesuffix(" (locally)")
    if " + " in text:
        terms = [term.split() for term in text.split(" + ")]
        return sum(float(c[0]) * values[n] if c else values[n] for *c, n in terms)
    above, _, below = text.partition(" / ")
    total = 1.0
    for side, part in ((1.0, above), (-1.0, below.strip("()"))):
        for name, _, power in (word.partition("^") for word in part.split()):
            total *= values[name] ** (side * float(power or 1))
    return total


def move_of(direction, names):
    """The physical move that a direction's combination prints."""
    which, _, amounts = direction["combination"].partition(" = ")
    move = dict.fromkeys(names, 0.0)
    for name, amount in zip(which.split(" : "), amounts.split(" : "), strict=True):
        move[name] = float((amount or "1").split()[0])
    return np.asarray(list(move.values()))


def mass_gravity_length():
    """A pendulum's torque: mass, gravity and length act as one product."""
    table = named("mass gravity length damping", "log", sd=0.5, low=0.0)
    q = np.linspace(-3.0, 3.0, 30)

    def rows(v):
        weight = v["mass"] * v["gravity"] * v["length"] * jnp.sin(q)
        return 100.0 * (weight + v["damping"] * jnp.cos(3.0 * q))

    def same(v):
        return (
            v
            | {"mass": 6 * v["mass"], "gravity": v["gravity"] / 2}
            | {"length": v["length"] / 3}
        )

    return table, rows, 2, {"mass", "gravity", "length"}, 1, same


def accelerations(system, scale):
    rng = np.random.default_rng(7)
    S = rng.standard_normal((40, 4)) * np.array([2.0, 2.0, 5.0, 5.0])
    A = rng.standard_normal((40, 2))

    def rows(values):
        params = system.record(values)
        out = jax.vmap(lambda s, a: system.ode(params, s, a)[2:])(S, A)
        return scale * out.ravel()

    return rows


def blind_to_link_1():
    system = UniformRodArm(locked=(True, False))
    rows = accelerations(system, 10.0)
    return system.parameters, rows, 2, {"m1", "b1"}, 0, dict


def mass_against_length():
    """Without knowing a length: l -> c l, m -> m / c^2 leaves the motion as it is."""
    table = parameters_of(UniformRodParams)
    rows = accelerations(UniformRodArm(table), 10.0)

    def same(v):
        lengths = {n: 2.0 * v[n] for n in ("l1", "l2")}
        return v | lengths | {n: v[n] / 4.0 for n in ("m1", "m2")}

    return table, rows, 5, {"m1", "m2", "l1", "l2"}, 3, same


def collinear_arm():
    system = TwoLink(gravity=9.81, length1=0.2)
    rows = accelerations(system, 20.0)

    def same(v):
        return v | {"m2": v["m2"] + 5, "m1r1": v["m1r1"] - 1, "I1": v["I1"] - 0.2}

    return system.parameters, rows, 9, {"m1r1", "I1", "m2"}, 2, same


@pytest.mark.parametrize(
    ("case", "count"),
    [
        (mass_gravity_length, 15),
        (blind_to_link_1, 10),
        (mass_against_length, 10),
        (collinear_arm, 15),
    ],
)
def test_unidentified_truth_is_said(case, count):
    table, rows, rank, flat, count_of_base, same = case()
    fisher_at = rows_of(rows, table)
    mean = np.asarray([p.mean for p in table.free])
    sd = np.asarray([p.sd for p in table.free])
    for seed in range(count):
        eps = np.random.default_rng(seed).standard_normal(len(table))
        tt = mean + 0.5 * sd * np.clip(eps, -2.0, 2.0)
        belief = believe(table, fisher_at(tt), tt)
        out = study(*belief, fisher_at=fisher_at if seed < 3 else None)
        spec = diagnose.spectrum(*belief)
        assert out["rank"] == rank
        open_ = [d for d in out["directions"] if d["flat"] and d["information"] == 0.0]
        assert len(open_) == len(table) - rank
        assert len(out["directions"]) == len(table)
        for name in flat:
            assert out["parameters"][name]["verdict"] != "identified"
            assert any(name in d["combination"].split() for d in open_)
        answer = {
            n for d in open_ for n in table.names if n in d["combination"].split()
        }
        assert answer == flat
        found = {b["text"]: b for b in out["base_parameters"]}
        assert len(found) == count_of_base
        assert all(b["verdict"] == "identified" for b in found.values())
        for text, entry in found.items():
            assert text.endswith(" (locally)") == (seed >= 3)
            moved = same(dict(zip(table.names, spec.theta.tolist(), strict=True)))
            assert entry["value"] == pytest.approx(value_of(text, moved), rel=1e-9)
        # The moves that are printed are invisible, up to their four digits.
        for direction in open_:
            dz = move_of(direction, table.names) / (spec.slope * spec.prior_sd)
            seen = np.linalg.norm(spec.factor @ dz)
            assert seen <= 1e-3 * np.sum(np.linalg.norm(spec.factor, axis=0) * abs(dz))
        # What the data leave open keeps the prior's sd.
        kept = spec.directions.T @ spec.whitened()[1]
        kept = np.sqrt(np.sum(kept**2, axis=1))[spec.null]
        assert kept == pytest.approx(np.ones(len(kept)), rel=0.01)


def test_the_arm_in_words():
    table, rows, *_ = collinear_arm()
    fisher_at = rows_of(rows, table)
    nominal = table.nominal()
    with jax.enable_x64(True):
        tt = table.unconstrain(jnp.asarray([nominal[n] for n in table.names]))
    out = study(*believe(table, fisher_at(tt), tt))
    (open_,) = (d for d in out["directions"] if d["flat"])
    assert open_["combination"] == "m2 : m1r1 : I1 = 1 kg : -0.2 kg m : -0.04 kg m^2"
    per = nominal["m2"] / 100.0
    first = 100.0 * 0.2 * per / nominal["m1r1"]
    second = 100.0 * 0.04 * per / nominal["I1"]
    assert open_["text"] == (
        f"Raise m2 by 1 %, lower m1r1 by {first:.3g} %, lower I1 by {second:.3g} %: "
        "the data stay the same."
    )
    assert out["parameters"]["m2"]["partners"] == ["m1r1"] or out["parameters"]["m2"][
        "partners"
    ] == ["m1r1", "I1"]
    units = {b["text"]: (b["unit"], b["verdict"]) for b in out["base_parameters"]}
    assert units == {
        "m1r1 + 0.2 m2 (locally)": ("kg m", "identified"),
        "I1 + 0.04 m2 (locally)": ("kg m^2", "identified"),
    }


# --- Base parameters -----------------------------------------------------------------


def test_base_parameter_is_the_sum_of_the_posterior():
    table = named("a b c", low=-10.0)
    visible = np.array([[1.0, 3.0, 0.0], [0.0, 0.0, 1.0]]) * 20.0
    belief = believe(table, visible, [2.0, 5.0, 0.0])
    (base,) = study(*belief)["base_parameters"]
    w = {"a + 3 b": [1.0, 3.0, 0.0], "b + 0.333 a": [1 / 3, 1.0, 0.0]}
    weights = np.asarray(w[base["text"].removesuffix(" (locally)")])
    cov = np.linalg.inv(np.eye(3) + visible.T @ visible)
    assert base["value"] == pytest.approx(weights @ [2.0, 5.0, 0.0], rel=1e-10)
    assert base["sd"] == pytest.approx(math.sqrt(weights @ cov @ weights), rel=1e-8)
    assert base["prior_sd"] == pytest.approx(np.linalg.norm(weights), rel=1e-10)
    assert base["unit"] == "kg"
    for strength, verdict in (
        (0.1, "prior_dominated"),
        (2.0, "weak"),
        (9.0, "identified"),
    ):
        belief = believe(table, [[strength, strength, 0.0]])
        assert study(*belief)["base_parameters"][0]["verdict"] == verdict


def test_base_parameter_is_the_product_of_the_posterior():
    table = Parameters(
        (
            Parameter("k", "V s", "", "log_bounded", 0.1, 10.0),
            Parameter("R", "ohm", "", "log_bounded", 0.1, 10.0),
        )
    )
    fisher_at = rows_of(lambda v: 1e3 * (v["k"] ** 2 / v["R"])[None], table)
    tt = np.array([0.3, -0.4])
    (base,) = study(*believe(table, fisher_at(tt), tt), fisher_at=fisher_at)[
        "base_parameters"
    ]
    assert base["text"] in ("k / R^0.5", "R / k^2")
    assert base["everywhere"]
    with jax.enable_x64(True):
        k, R = np.asarray(table.constrain(jnp.asarray(tt, float)))
        draws = diagnose.arrays(
            *believe(table, fisher_at(tt), tt)[:3], key=jax.random.key(0)
        )
    value = k / R**0.5 if base["text"] == "k / R^0.5" else R / k**2
    assert base["value"] == pytest.approx(value, rel=1e-12)
    assert (
        base["unit"]
        == {"k / R^0.5": "V s ohm^-0.5", "R / k^2": "ohm V^-2 s^-2"}[base["text"]]
    )
    # By differences through the map: the sd of a product is not that of its logarithm.
    powers = {"k / R^0.5": (1.0, -0.5), "R / k^2": (-2.0, 1.0)}[base["text"]]
    gradient = []
    for step in 1e-5 * np.eye(2):
        with jax.enable_x64(True):
            up, down = (table.constrain(jnp.asarray(tt + d)) for d in (step, -step))
        change = [
            float(np.prod(np.asarray(x) ** np.asarray(powers))) for x in (up, down)
        ]
        gradient.append((change[0] - change[1]) / 2e-5)
    belief = believe(table, fisher_at(tt), tt)
    for key, gaussian in (("prior_sd", belief[1]), ("sd", belief[2])):
        want = np.linalg.norm(np.asarray(gradient) @ np.asarray(gaussian.scale))
        assert base[key] == pytest.approx(want, rel=1e-4)
    assert base["sd"] < 1e-2 * base["prior_sd"]
    assert base["verdict"] == "identified"
    assert draws["parameters/samples"].shape == (2000, 2)


def test_curved_trade_off_holds_locally():
    """a + b^2 is neither a sum nor a product; said of the MAP only."""
    table = named("a b", "log_bounded", low=0.1, high=10.0)
    fisher_at = rows_of(lambda v: 1e3 * (v["a"] + v["b"] ** 2)[None], table)
    tt = np.array([0.31, -0.42])
    (base,) = study(*believe(table, fisher_at(tt), tt), fisher_at=fisher_at)[
        "base_parameters"
    ]
    assert base["text"].endswith("(locally)")
    assert not base["everywhere"]
    assert base["verdict"] == "identified"


def test_partly_curved_trade_offs_keep_what_holds():
    """c / d is a ratio everywhere; with a beside c only near the MAP."""
    table = named("a b c d", "log_bounded", low=0.1, high=10.0)

    def rows(v):
        s = v["c"] + v["a"] ** 2 * v["d"]
        return 1e3 * jnp.stack([v["b"] / v["d"], s / v["d"]])

    fisher_at = rows_of(rows, table)
    tt = np.array([0.31, -0.42, 0.2, 0.1])
    found = study(*believe(table, fisher_at(tt), tt), fisher_at=fisher_at)[
        "base_parameters"
    ]
    assert [b["everywhere"] for b in found] == [True, False]
    assert set(found[0]["text"].split(" / ")) == {"b", "d"}
    assert {b["verdict"] for b in found} == {"identified"}


def test_points_that_diverge_are_left_out():
    table = named("a b", "log_bounded", low=0.1, high=10.0)
    fisher_at = rows_of(lambda v: 1e3 * (v["a"] + 2.0 * v["b"])[None], table)
    tt = np.array([0.31, -0.42])
    belief = believe(table, fisher_at(tt), tt)
    (base,) = study(*belief, fisher_at=lambda t: jnp.full((2, 2), jnp.nan))[
        "base_parameters"
    ]
    assert base["text"] == "a + 2 b (locally)" or base["text"] == "b + 0.5 a (locally)"
    (base,) = study(*belief, fisher_at=fisher_at)["base_parameters"]
    assert base["everywhere"]
