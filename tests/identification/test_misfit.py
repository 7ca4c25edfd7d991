"""Four misfit tests: against other computations, at their level, and with power."""

import numpy as np
import pytest
from scipy import signal, stats

from misfit_pendulum import alarms
from sim2gp.errors import NotFinite
from sim2gp.identification.misfit.projection import ProjectedResiduals
from sim2gp.identification.misfit.tests import (
    LAGS,
    Misfit,
    ljung_box,
    ljung_box_tail,
    misfit,
)

NO_HAT = 0  # columns of a fit that could move nothing


def linear(seed: int, N: int = 120, d: int = 1, p: int = 4) -> dict[str, np.ndarray]:
    """Smooth inputs, a Jacobian that depends on them, and noise of sd 1."""
    rng = np.random.default_rng(seed)
    x = signal.lfilter([0.3], [1.0, -0.95], rng.standard_normal((N, 3)), axis=0)
    J = 5.0 * np.tanh(x @ rng.standard_normal((3, d * p))).reshape(N, d, p)
    r = rng.standard_normal((N, d)) + J @ rng.standard_normal(p)
    return {"residuals": r, "inputs": x, "jacobian": J}


def p_values(test: str, found: list[Misfit]) -> np.ndarray:
    return np.asarray([one.tests[test].p for one in found])


def uniform(p: np.ndarray) -> bool:
    return bool(stats.kstest(p, "uniform").pvalue > 1e-3)


def test_chi_squared_and_f_are_exact_in_a_linear_model() -> None:
    """Whatever the constants are: what the fit could move is projected out."""
    found = [misfit(**linear(seed), noise_known=True) for seed in range(500)]
    F, ratio = (
        np.asarray([one.tests[name].statistic for one in found])
        for name in ("f_test", "chi2")
    )
    q = found[0].tests["f_test"].freedom
    assert q == 3 + 8 + 1  # 116 degrees of freedom leave room for 8 random features
    assert stats.kstest(F, stats.f(q, 120 - 4 - q).cdf).pvalue > 1e-3
    assert stats.kstest(116.0 * ratio, stats.chi2(116).cdf).pvalue > 1e-3
    assert uniform(p_values("f_test", found))
    assert uniform(p_values("chi2", found))


def halves(seed: int) -> tuple[Misfit, float]:
    """Split in time alone (the input is one number), and two separate fits."""
    data = linear(seed)
    constant = np.ones((120, 1))
    found = misfit(data["residuals"], constant, jacobian=data["jacobian"])
    r, J = data["residuals"][:, 0], data["jacobian"][:, 0]
    fits = [
        np.linalg.lstsq(J[i], r[i], rcond=None)[0] for i in (slice(60), slice(60, 120))
    ]
    S = [np.linalg.inv(J[i].T @ J[i]) for i in (slice(60), slice(60, 120))]
    away = fits[0] - fits[1]
    return found, float(away @ np.linalg.solve(S[0] + S[1], away))


def test_split_half_is_the_mahalanobis_distance_of_two_fits() -> None:
    """Its square is chi-squared, and F when divided by the estimated noise."""
    found, distances = zip(*(halves(seed) for seed in range(500)), strict=True)
    assert stats.kstest(distances, stats.chi2(4).cdf).pvalue > 1e-3
    assert uniform(p_values("split_half", list(found)))
    data = linear(3)
    r, J = data["residuals"][:, 0], data["jacobian"][:, 0]
    rest = sum(
        np.linalg.lstsq(J[i], r[i], rcond=None)[1][0]
        for i in (slice(60), slice(60, 120))
    )
    ours = found[3].tests["split_half"]
    assert ours.statistic == pytest.approx(distances[3] / (rest / 112.0), rel=1e-9)
    assert ours.freedom == 4


def textbook(e: np.ndarray) -> float:
    """Ljung and Box (1978) of one series, term by term."""
    N, Q = len(e), 0.0
    for k in range(1, 21):
        rho = sum(e[t] * e[t + k] for t in range(N - k)) / sum(x * x for x in e)
        Q += rho**2 / (N - k)
    return N * (N + 2) * Q


def test_ljung_box_is_the_textbook_statistic() -> None:
    e = np.random.default_rng(0).standard_normal(300)
    e[1:] += 0.3 * e[:-1]
    hat = np.zeros((300, NO_HAT))
    Q, lags, _ = ljung_box(e, np.zeros(300, int), np.ones(300, bool), hat)
    assert lags == LAGS
    assert textbook(e) == pytest.approx(Q, rel=1e-12)


def test_ljung_box_keeps_to_episodes_and_rows_that_exist() -> None:
    """Pair by pair, with a gap, against the sum over all pairs that may count."""
    rng = np.random.default_rng(1)
    e, run = rng.standard_normal(400), np.repeat([0, 1, 2], [100, 200, 100])
    e[100], e[300] = e[99], e[299]  # an echo across each boundary
    valid = rng.random(400) > 0.1
    Q, lags, first = ljung_box(e, run, valid, np.zeros((400, NO_HAT)))
    square = np.mean(e[valid] ** 2)
    expected = 0.0
    for k in range(1, 21):
        pairs = [
            (t, t + k)
            for t in range(400 - k)
            if run[t] == run[t + k] and valid[t] and valid[t + k]
        ]
        c = sum(e[i] * e[j] for i, j in pairs) / square
        expected += c**2 / len(pairs)
        if k == 1:
            assert first == pytest.approx(c / len(pairs), rel=1e-12)
    N = valid.sum()
    assert lags == 20
    assert pytest.approx(expected * (N + 2) / N, rel=1e-12) == Q


def test_ljung_box_has_its_level_with_very_many_short_windows() -> None:
    """Of 1e5 rows the start states take a tenth, which all lags would see."""
    N, L = 100_000, 20
    run, along = np.repeat(np.arange(N // L), L), np.tile(np.arange(L) / L, N // L)
    own = np.stack([np.ones(N), along], axis=1)[:, None]
    rng, found = np.random.default_rng(7), []
    for _ in range(10):
        r, J = rng.standard_normal((2, N, 1, 1))
        data = ProjectedResiduals(r, J, own, run, valid := np.ones((N, 1), bool))
        e, hat = data.e[:, 0] / data.rms(), data.hat[:, 0]
        found.append(ljung_box(e, run, valid[:, 0], hat)[:2])
    Q, lags = np.asarray(found).T
    assert set(lags) == {L - 1}
    # Ten chi-squared variables have a mean to within 4 sd of it.
    assert abs(Q.mean() - lags[0]) < 4.0 * np.sqrt(2.0 * lags[0] / 10)


@pytest.mark.nightly
def test_ljung_box_has_its_level_with_many_constants_and_few_rows() -> None:
    """Four channels, 12 constants, 250 rows: the projection alone correlates rows."""
    found = [misfit(**linear(seed, N=250, d=4, p=12)) for seed in range(250)]
    p = p_values("ljung_box", found)
    assert stats.binomtest(int((p < 0.05).sum()), 250, 0.05).pvalue > 1e-3
    assert (p < 1e-3).mean() <= 0.01
    e = np.random.default_rng(2).standard_normal((2000, 250))
    none = np.zeros(250, int), np.ones(250, bool), np.zeros((250, NO_HAT))
    tail = [ljung_box_tail(ljung_box(row, *none)[0], 20, 250) for row in e]
    assert np.mean(np.asarray(tail) < 1e-3) == pytest.approx(1e-3, abs=2e-3)
    assert np.mean(np.asarray(tail) < 1e-2) == pytest.approx(1e-2, abs=7e-3)


def test_ljung_box_has_its_level_with_slow_regressors() -> None:
    """What a fit takes out of slow motion makes neighbours differ: no fault."""
    phase = np.pi * np.linspace(0.0, 1.0, 250)[:, None] * np.arange(12)
    J = np.cos(phase)[:, None]
    rng = np.random.default_rng(4)
    found = [
        misfit(rng.standard_normal((250, 1)), phase[:, 1:2], jacobian=J)
        for _ in range(250)
    ]
    p = p_values("ljung_box", found)
    assert stats.binomtest(int((p < 0.05).sum()), 250, 0.05).pvalue > 1e-3


def windowed(seed: int) -> dict[str, np.ndarray]:
    """Forty windows of 20 rows, each with its own unknown start and drift."""
    rng = np.random.default_rng(seed)
    data = linear(seed, N=800, d=2, p=3)
    t = np.tile(np.linspace(0.0, 1.0, 20), 40)
    own = np.stack([np.stack([t**0, t], 1), np.stack([0 * t, t**0], 1)], axis=1)
    starts = np.repeat(100.0 * rng.standard_normal((40, 2)), 20, axis=0)
    r = data["residuals"] + np.einsum("ndi,ni->nd", own, starts)
    more = {"nuisance": own, "group": np.repeat(np.arange(40), 20)}
    return data | more | {"residuals": r}


def test_start_states_of_windows_are_projected_out() -> None:
    """The same as one dense Jacobian with columns for every window."""
    data = windowed(0)
    dense = np.zeros((800, 2, 80))
    for w in range(40):
        rows = slice(20 * w, 20 * w + 20)
        dense[rows, :, 2 * w : 2 * w + 2] = data["nuisance"][rows]
    J = np.concatenate([data["jacobian"], dense], axis=2)
    ours = misfit(**data, noise_known=True).tests
    theirs = misfit(
        data["residuals"], data["inputs"], jacobian=J, group=data["group"],
        noise_known=True,
    ).tests  # fmt: skip
    for name in ("chi2", "f_test", "ljung_box"):
        assert ours[name].statistic == pytest.approx(theirs[name].statistic, rel=1e-6)
        assert ours[name].p == pytest.approx(theirs[name].p, rel=1e-6)


@pytest.mark.nightly
def test_windows_raise_no_false_alarm() -> None:
    found = [misfit(**windowed(seed), noise_known=True) for seed in range(150)]
    assert sum(one.alarm for one in found) <= 2
    assert uniform(p_values("chi2", found))


def test_rows_that_do_not_exist_do_not_count() -> None:
    """At the end of a buffer they may hold anything."""
    data = linear(5, d=2)
    whole = misfit(**data, noise_known=True)
    padded = {
        name: np.concatenate([A, np.full((30, *A.shape[1:]), np.nan)])
        for name, A in data.items()
    }
    mask = np.arange(150) < 120
    found = misfit(**padded, mask=mask, noise_known=True)
    for name, finding in whole.tests.items():
        assert found.tests[name].statistic == pytest.approx(finding.statistic, rel=1e-9)
    assert found.rows == 120


def test_the_scale_of_the_noise_matters_to_chi_squared_alone() -> None:
    data = linear(6)
    scaled = data | {name: 3.0 * data[name] for name in ("residuals", "jacobian")}
    one, three = misfit(**data, noise_known=True), misfit(**scaled, noise_known=True)
    for name in ("ljung_box", "f_test", "split_half"):
        assert three.tests[name].p == pytest.approx(one.tests[name].p, rel=1e-9)
    assert not one.tests["chi2"].alarm
    assert three.tests["chi2"].alarm
    assert "3" in three.tests["chi2"].text


def test_an_estimated_noise_says_nothing_by_its_size() -> None:
    finding = misfit(**linear(6)).tests["chi2"]
    assert not finding.alarm
    assert "estimated from these same residuals" in finding.text
    assert finding.as_dict()["p"] is None


@pytest.mark.parametrize("name", ["residuals", "inputs", "jacobian"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_is_not_a_number_never_passes(name: str, value: float) -> None:
    data = linear(7)
    data[name][5] = value
    with pytest.raises(NotFinite):
        misfit(**data)


def test_too_few_rows_are_said() -> None:
    found = misfit(**linear(8, N=6))
    assert not found.alarm
    assert "too few" in found.verdict


def test_errors_far_below_the_noise_are_no_misfit() -> None:
    """The prior's pull and rounding have structure, and do no harm."""
    data = linear(9, N=500)
    quiet = data | {"residuals": 0.01 * np.sign(data["inputs"][:, :1])}
    assert not misfit(**quiet).alarm
    loud = data | {
        "residuals": data["residuals"] + 2.0 * np.sign(data["inputs"][:, :1])
    }
    assert misfit(**loud).tests["f_test"].alarm


def test_verdicts_say_what_to_do() -> None:
    data = linear(10, N=500)
    good = misfit(**data)
    assert good.verdict.startswith("Nothing in 500 transitions contradicts the model.")
    assert "dry friction would not show" in good.verdict
    r = data["residuals"] + 2.0 * np.sign(data["inputs"][:, 1:2])
    bad = misfit(r, data["inputs"], jacobian=data["jacobian"], channels=["theta"])
    assert bad.alarm
    for words in (
        "follow the state and the input",
        "F test, p",
        "too narrow",
        "explain",
    ):
        assert words in bad.verdict
    assert "theta" in bad.tests["f_test"].text


@pytest.mark.nightly
def test_the_pendulum_of_reliability_3_4() -> None:
    """S10 in small; see `misfit_pendulum` for the set-up."""
    fine = alarms(200, 500)
    assert fine["any"] <= 0.01
    estimated = alarms(100, 2000, friction=0.3, known=False)
    assert estimated["any"] >= 0.9
    assert estimated["chi2"] == 0.0
    assert alarms(100, 500, friction=1.0)["any"] >= 0.98
    late = alarms(100, 500, delay=2)
    assert late["any"] >= 0.99
    assert late["ljung_box"] >= 0.95


@pytest.mark.nightly
def test_misfit_alarms_hold_s10() -> None:
    """False alarms at most 1 %; power, with the noise known and estimated."""
    assert alarms(2000, 500)["any"] <= 0.01
    assert alarms(500, 2000)["any"] <= 0.01
    for known in (True, False):
        assert alarms(300, 2000, friction=0.3, known=known)["any"] >= 0.9
        assert alarms(1000, 500, friction=1.0, known=known)["any"] >= 0.99
        assert alarms(1000, 500, delay=2, known=known)["any"] >= 0.99
