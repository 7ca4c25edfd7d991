"""What the data determine: moments, verdicts, conflicts, words."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from beliefs import believe, named, study, words_of
from sim2gp.identification import diagnose, words
from sim2gp.identification.identifiability import conflicts
from sim2gp.identification.identifiability.table import physical_moments
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.parameters import Parameter, Parameters

# --- Moments -------------------------------------------------------------------------


def test_moments_agree_with_monte_carlo():
    low, high = 0.5, 2.0
    table = Parameters(
        (
            Parameter("bounded", "", "", "bounded", low, high),
            Parameter("log_bounded", "", "", "log_bounded", low, high),
            Parameter("softplus", "", "", "softplus", low),
            Parameter("log", "", "", "log", 0.0),
        )
    )
    mean, sd = np.array([1.0, -2.0, 0.3, 0.2]), np.array([1.2, 0.8, 1.5, 0.4])
    got = physical_moments(table, mean, sd)
    n = 200_000
    t = mean + sd * np.random.default_rng(1).standard_normal((n, 4))
    sig = 1.0 / (1.0 + np.exp(-t))
    theta = np.stack(
        [
            low + (high - low) * sig[:, 0],
            low * (high / low) ** sig[:, 1],
            low + np.log1p(np.exp(t[:, 2])),
            np.exp(t[:, 3]),
        ],
        axis=1,
    )
    error = (theta.mean(0) - got["mean"]) / (theta.std(0) / math.sqrt(n))
    assert np.all(np.abs(error) < 4.0)
    squares = (theta - theta.mean(0)) ** 2
    error = (squares.mean(0) - got["sd"] ** 2) / (squares.std(0) / math.sqrt(n))
    assert np.all(np.abs(error) < 4.0)
    inside = np.mean((theta > got["q025"]) & (theta < got["q975"]), axis=0)
    assert np.all(np.abs(inside - 0.95) < 4.0 * math.sqrt(0.95 * 0.05 / n))


@pytest.mark.parametrize("sd", [1e-6, 0.3, 6.0])
def test_moments_in_closed_form(sd):
    free = (Parameter("a", "", "", "identity"), Parameter("b", "", "", "log"))
    mean, spread = np.array([1e3, -1.0]), np.array([1e4 * sd, sd])
    got = physical_moments(Parameters(free), mean, spread)
    log_normal = math.exp(-1.0 + 0.5 * sd**2)
    assert got["mean"] == pytest.approx(np.array([1e3, log_normal]), rel=1e-10)
    want = np.array([1e4 * sd, log_normal * math.sqrt(math.expm1(sd**2))])
    assert got["sd"] == pytest.approx(want, rel=1e-8)
    for key, q in (("q025", 0.025), ("q975", 0.975)):
        z = scipy.stats.norm.ppf(q)
        ends = np.array([1e3 + z * 1e4 * sd, math.exp(-1.0 + z * sd)])
        assert got[key] == pytest.approx(ends, rel=1e-10)


# --- Verdicts ------------------------------------------------------------------------


def test_well_posed_problem_is_identified():
    A = np.random.default_rng(0).standard_normal((40, 4)) * 10.0
    out = study(*believe(named("a b c d"), A))
    assert {e["verdict"] for e in out["parameters"].values()} == {"identified"}
    assert out["rank"] == 4
    assert out["base_parameters"] == out["prior_conflicts"] == []
    assert not any(d["flat"] for d in out["directions"])
    nats = sum(d["information"] for d in out["directions"])
    logdet = np.linalg.slogdet(np.eye(4) + A.T @ A)[1]
    assert nats == pytest.approx(0.5 * logdet, rel=1e-12)
    entry = out["parameters"]["b"]
    sd = math.sqrt(np.linalg.inv(np.eye(4) + A.T @ A)[1, 1])
    assert entry["sd"] == pytest.approx(sd, rel=1e-10)
    assert (entry["prior_mean"], entry["mean"]) == pytest.approx((0.0, 0.0), abs=1e-12)
    assert entry["prior_sd"] == pytest.approx(1.0, rel=1e-10)
    assert entry["low"] is None
    assert entry["high"] is None


@pytest.mark.parametrize(
    ("l", "verdict"),
    [
        (0.0, "dead"),
        (1e-12, "prior_dominated"),
        (2.99, "prior_dominated"),  # sd = .5 prior sd at l = 3
        (3.01, "weak"),
        (23.9, "weak"),  # sd = .2 prior sd at l = 24
        (24.1, "identified"),
    ],
)
def test_thresholds_of_a_lone_parameter(l, verdict):
    belief = believe(named("a b"), np.diag([math.sqrt(l), 100.0]))
    assert words_of(*belief) == [verdict, "identified"]


@pytest.mark.parametrize(
    "kind", ["bounded", "log_bounded", "log", "identity", "softplus"]
)
@pytest.mark.parametrize("tt", [-4.01, -3.99, 3.99, 4.01])
def test_only_boxes_have_ends(kind, tt):
    table = named("a", kind, sd=2.0, low=0.5, high=2.0)
    got = words_of(*believe(table, [[100.0]], [tt]))
    bound = kind in ("bounded", "log_bounded") and abs(tt) > 4.0
    assert got == ["at_bound" if bound else "identified"]
    note = study(*believe(table, [[100.0]], [tt]))["parameters"]["a"]["note"]
    end = "upper bound of 2 kg" if tt > 0 else "lower bound of 0.5 kg"
    assert (end in note) == bound
    # dead comes first, and at_bound before what is flat
    assert words_of(*believe(table, [[0.0]], [tt])) == ["dead"]
    flat = words_of(*believe(table, [[1e-3]], [tt]))
    assert flat == ["at_bound" if bound else "prior_dominated"]


@pytest.mark.parametrize(
    ("share", "expected"),
    [
        (0.051, ["traded_off", "traded_off"]),
        (0.049, ["prior_dominated", "weak"]),  # neither: no partner, no share
        (0.0101, ["prior_dominated", "weak"]),
    ],
)
def test_shares_of_a_flat_direction(share, expected):
    """One direction with l = .5, the other sharp; exact null ones are tested below."""
    v = np.array([math.sqrt(1.0 - share), math.sqrt(share)])
    V = np.stack([v, [-v[1], v[0]]])
    belief = believe(named("a b"), np.diag([math.sqrt(0.5), 1e3]) @ V)
    assert words_of(*belief) == expected


def test_a_direction_is_flat_below_one():
    v = np.array([0.8, 0.6])
    V = np.stack([v, [-0.6, 0.8]])
    for l, verdict in ((0.99, "traded_off"), (1.01, "prior_dominated")):
        belief = believe(named("a b"), np.diag([math.sqrt(l), 1e3]) @ V)
        assert words_of(*belief)[0] == verdict
        # least known first; a : b is a move, 0.8 to 0.6
        first = study(*belief)["directions"][0]
        assert first["flat"] == (l < 1.0)
        assert first["information"] == pytest.approx(0.5 * math.log1p(l))
        answer = (
            "a : b = 1 kg : 0.75 kg" if l < 1 else "0.8 a + 0.6 b (each in prior sd)"
        )
        assert first["combination"] == answer


def test_small_null_share_is_never_identified():
    """A sharp prior of b makes a narrow, but data without end would not."""
    v = np.array([0.06, math.sqrt(1.0 - 0.06**2)])
    null = np.array([[v[1], -v[0]]]) * 1e6
    out = study(*believe(named("a b"), null))["parameters"]["a"]
    assert out["verdict"] == "weak"
    assert out["note"].endswith("only through the prior of b")
    # the same sd from the data themselves
    almost = np.diag([1.0 / 0.06, 100.0])
    assert words_of(*believe(named("a b"), almost))[0] == "identified"


def test_two_trade_offs_do_not_name_each_other():
    """Both are exactly flat, so the decomposition may mix them; the words must not."""
    blind = np.array([[1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -2.0]]) * 1e3
    out = study(*believe(named("a b c d e"), np.pad(blind, ((0, 0), (0, 1)))))
    partners = {n: e.get("partners") for n, e in out["parameters"].items()}
    assert partners == {"a": ["b"], "b": ["a"], "c": ["d"], "d": ["c"], "e": None}
    assert out["parameters"]["e"]["verdict"] == "dead"
    answer = [d["combination"] for d in out["directions"] if d["flat"]]
    assert answer == ["e", "a : b = 1 kg : -1 kg", "c : d = 1 kg : 0.5 kg"]
    assert out["directions"][0]["text"] == "e has no effect on these data."


def test_no_data_is_said():
    with jax.enable_x64(True):
        prior = named("a b").prior()
    out = study(named("a b"), prior, prior, jnp.zeros((2, 2)))
    assert [e["verdict"] for e in out["parameters"].values()] == ["dead", "dead"]
    assert out["rank"] == 0
    assert out["base_parameters"] == []


def test_rank_counts_from_the_largest():
    for small, rank in ((1.1e-8, 2), (0.9e-8, 1)):
        belief = believe(named("a b"), np.diag([1e6, 1e6 * small]))
        assert study(*belief)["rank"] == rank


def test_correlated_prior_keeps_the_meaning():
    """With tt = mu + L z, a dead parameter's column of A is not zero, its effect is."""
    rng = np.random.default_rng(3)
    L = np.tril(rng.standard_normal((3, 3))) + 2.0 * np.eye(3)
    with jax.enable_x64(True):
        prior = Gaussian(jnp.zeros(3), jnp.asarray(L))
    J = np.array([[5.0, 0.0, -1.0], [2.0, 0.0, 7.0]]) * 1e2
    belief = believe(named("a b c"), J @ L, prior=prior)
    assert words_of(*belief) == ["identified", "dead", "identified"]
    assert study(*belief)["rank"] == 2
    spec = diagnose.spectrum(*belief)
    assert np.diag(spec.projection(np.ones(3, bool))) == pytest.approx(np.ones(3))


# --- Conflicts -----------------------------------------------------------------------


def test_widening_gain_is_a_ratio_of_evidences():
    """y = u + noise, u ~ N(0, t^2): the marginal likelihoods in closed form."""
    for y, noise in ((4.0, 0.1), (0.2, 0.5), (5.0, 2.0)):
        s2 = 1.0 / (1.0 + noise**-2)
        m = s2 * y / noise**2
        wide = scipy.stats.norm(0.0, math.hypot(3.0, noise)).logpdf(y)
        narrow = scipy.stats.norm(0.0, math.hypot(1.0, noise)).logpdf(y)
        gain = conflicts.widening_gain(m, math.sqrt(s2), 3.0)
        assert gain == pytest.approx(wide - narrow, rel=1e-12)


@pytest.mark.parametrize(("tt", "said"), [(2.9, False), (3.1, True), (-3.1, True)])
def test_a_far_map_is_a_conflict(tt, said):
    table = named("a b", sd=2.0)
    belief = believe(table, np.diag([50.0, 50.0]), [2.0 * tt, 0.0])
    out = study(*belief)
    assert bool(out["prior_conflicts"]) == said
    assert ("against its prior" in out["parameters"]["a"]["note"]) == said
    if said:
        side = "above" if tt > 0 else "below"
        assert out["prior_conflicts"][0].startswith(f"a lies 3.1 prior sd {side} its")
    assert "against" not in out["parameters"]["b"]["note"]


def test_a_vague_posterior_hides_no_conflict():
    """Data 5.5 prior sd away, known to one prior sd: the MAP is only 2.75 away."""
    out = study(*believe(named("a"), [[1.0]], [2.75]))
    (text,) = out["prior_conflicts"]
    assert "three times as wide" in text


def test_a_conflict_spread_over_parameters_is_found():
    direction = np.ones((1, 4)) / 2.0
    tt = 3.2 * direction[0]  # 1.6 prior sd each, 3.2 together
    (text,) = study(*believe(named("a b c d"), 1e3 * direction, tt))["prior_conflicts"]
    assert text.startswith(
        "0.5 a + 0.5 b + 0.5 c + 0.5 d (each in prior sd) lies 3.2 prior sd above"
    )
    assert "no parameter alone" in text
    assert not study(*believe(named("a b c d"), 1e3 * direction, 0.5 * tt))[
        "prior_conflicts"
    ]


# --- Arrays and words ----------------------------------------------------------------


def test_arrays_are_draws_in_physical_units():
    table = named("a b", "bounded", low=0.5, high=2.0)
    A = np.array([[3.0, 1.0], [0.0, 2.0]])
    parameters, prior, posterior, _ = believe(table, A)
    got = diagnose.arrays(
        parameters, prior, posterior, key=jax.random.key(1), count=4000
    )
    cov = np.linalg.inv(np.eye(2) + A.T @ A)
    r = cov[0, 1] / math.sqrt(cov[0, 0] * cov[1, 1])
    assert got["parameters/correlation"] == pytest.approx(
        np.array([[1.0, r], [r, 1.0]])
    )
    for which, gaussian in (("prior_samples", prior), ("samples", posterior)):
        draws = got[f"parameters/{which}"]
        assert draws.dtype == np.float64
        mean = np.asarray(gaussian.mean)
        sd = np.linalg.norm(np.asarray(gaussian.scale), axis=1)
        want = physical_moments(parameters, mean, sd)
        error = (draws.mean(0) - want["mean"]) / (want["sd"] / math.sqrt(4000))
        assert np.all(np.abs(error) < 4.0)
        assert draws.std(0) == pytest.approx(want["sd"], rel=0.1)


def test_signed_parameters_move_in_their_units():
    free = (
        Parameter("offset", "rad", "", "identity", sd=0.1),
        Parameter("mass", "kg", "", "log", 0.0),
    )
    out = study(*believe(Parameters(free), [[1e3, -1e3]]))
    (open_,) = (d for d in out["directions"] if d["flat"])
    answer = (
        "Raise mass by 1 %, raise offset by 0.000667 rad",
        "Raise offset by 0.001 rad, raise mass by 1.5 %",
    )
    assert open_["text"].removesuffix(": the data stay the same.") in answer


def test_units_of_products_cancel():
    assert words.unit_product([(1.0, "N m s/rad"), (-1.0, "N m")]) == "s rad^-1"
    assert words.unit_product([(2.0, "kg m^2"), (-1.0, "kg m/s^2")]) == "kg m^3 s^2"
    assert words.unit_product([(1.0, "kg"), (-1.0, "kg")]) == ""
    assert words.product([(2.0, "k"), (-1.0, "R"), (-0.5, "J")]) == "k^2 / (R J^0.5)"
    assert words.product([(-1.0, "R")]) == "1 / R"
    assert words.linear_sum([(1.0, "a"), (-0.2, "b")]) == "a - 0.2 b"
    assert words.linear_sum([(-1.0, "a"), (25.0, "b")]) == "-a + 25 b"
    assert [words.digits(x) for x in (0.0, 0.2, 12.0, 1234.5, 1e-7)] == [
        "0", "0.2", "12", "1234", "1e-07"
    ]  # fmt: skip


def test_the_prior_of_the_belief_counts_not_the_table():
    """Data sets in sequence: the prior is what the first one left."""
    table = named("a")
    with jax.enable_x64(True):
        prior = Gaussian(jnp.asarray([1.0], float), jnp.asarray([[0.1]], float))
    entry = study(*believe(table, [[1.0]], prior=prior))["parameters"]["a"]
    assert entry["prior_mean"] == pytest.approx(1.0)
    assert entry["prior_sd"] == pytest.approx(0.1)
    assert entry["verdict"] == "prior_dominated"
    assert dataclasses.asdict(table.free[0])["sd"] == 1.0
