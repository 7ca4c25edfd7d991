"""Figure 1: its data, its posteriors, its claims, and its picture from the store."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2gp import reports as report
from sim2gp.errors import NotConverged
from sim2gp.runs import Progress, load_run
from sim2gp.studies import figure1, two_link
from sim2gp.studies.figure1 import TwoLinkArm
from sim2gp.studies.study import run_cells
from sim2gp.studies.two_link import DT, NOISE, LearnedArm
from sim2gp.systems import UniformRodArm

QUIET = Progress(quiet=True)
LENGTH2 = 0.4
#: Boxes of (m2, b2), and the constants of the nominal arm.
LOW, HIGH = np.array([0.32, 0.02]), np.array([1.6, 0.3])


@pytest.fixture(scope="module")
def study() -> LearnedArm:
    return two_link.learn(two_link.nominal_truth(), key=jax.random.key(3))


def rod(tt, s, t):
    """Angle and velocity of a single damped rod after one period, in closed form."""
    m, b = LOW + (HIGH - LOW) / (1.0 + np.exp(-tt))
    inertia = m * LENGTH2**2 / 3.0
    fade = np.exp(-b * DT / inertia)
    ahead = s[:, 3] * inertia / b * (1.0 - fade)
    q = s[:, 1] + ahead + t / b * (DT - inertia / b * (1.0 - fade))
    return np.stack([q, s[:, 3] * fade + t / b * (1.0 - fade)], axis=1)


def test_a_locked_joint_neither_moves_nor_is_driven(study):
    state, action = np.asarray(study.first.state), np.asarray(study.first.action)
    assert not state[:, [0, 2]].any()
    assert not action[:, 0].any()
    assert np.ptp(state[:, 1]) > 1.0
    both = np.asarray(study.second.state)
    assert (np.ptp(both, axis=0) > 0.5).all()


def test_excitation_is_coloured_and_limited(study):
    t = np.asarray(study.second.action)
    assert np.abs(t).max() == 1.0  # the limit is reached, never passed
    for column in t.T:
        r = np.corrcoef(column[1:], column[:-1])[0, 1]
        assert 0.7 < r < 1.0


def test_data_set_1_is_a_damped_rod_with_the_stated_noise(study):
    state, action = np.asarray(study.first.state), np.asarray(study.first.action)
    predicted = rod(np.asarray(study.truth)[2:], state[:-1], action[:, 1])
    residual = (state[1:, [1, 3]] - predicted) / np.array(NOISE)[[1, 3]]
    # 150 draws: the sd of a sample sd is 6 %.
    np.testing.assert_allclose(residual.std(axis=0), 1.0, atol=0.25)


def test_posterior_1_is_the_plain_one_of_the_rod(study):
    """Gauss-Newton with closed-form steps and difference Jacobians; noise given."""
    state, action = np.asarray(study.first.state), np.asarray(study.first.action)
    noise = np.asarray(study.posterior1.noise)[[1, 3]]

    def residual(tt):
        rows = (rod(tt, state[:-1], action[:, 1]) - state[1:, [1, 3]]) / noise
        return np.concatenate([rows.ravel(), tt / 1.5])

    tt = np.asarray(study.truth)[2:].copy()
    for _ in range(8):
        J = np.stack(
            [(residual(tt + e) - residual(tt - e)) / 2e-5 for e in 1e-5 * np.eye(2)], 1
        )
        tt -= np.linalg.lstsq(J, residual(tt), rcond=None)[0]
    sd = 1.0 / np.linalg.svd(J, compute_uv=False)  # of the principal directions
    mean, scale = (np.asarray(x) for x in jax.tree.leaves(study.posterior1.posterior))
    cov = scale @ scale.T
    own = np.sqrt(np.linalg.eigvalsh(cov[2:, 2:])[::-1])
    np.testing.assert_allclose(np.sort(own), np.sort(sd), rtol=1e-5)
    assert np.abs(mean[2:] - tt).max() < 1e-4 * sd.min()
    # Link 1 is not in these data at all: not a digit of its prior may change.
    np.testing.assert_allclose(mean[:2], 0.0, atol=1e-12)
    np.testing.assert_allclose(cov[:2, :2], 1.5**2 * np.eye(2), atol=1e-12)


def test_the_second_prior_is_the_first_posterior(study):
    for before, after in (
        (study.posterior1.posterior, study.middle.prior),
        (study.middle.posterior, study.posterior2.prior),
    ):
        assert np.array_equal(before.mean, after.mean)
        assert np.array_equal(before.scale, after.scale)


def test_information_of_both_data_sets_is_what_the_posterior_gained(study):
    A = np.asarray(figure1.information_of(study))
    S0 = np.asarray(study.prior.prior.scale)
    W = np.linalg.solve(np.asarray(study.posterior2.posterior.scale), S0)
    gained = W.T @ W - np.eye(4)
    np.testing.assert_allclose(A.T @ A, gained, rtol=1e-6, atol=1e-6 * gained.max())


def test_truth_is_not_the_prior_mean():
    truth = np.asarray(two_link.nominal_truth())
    assert (np.abs(truth) > 0.3).all()


@pytest.mark.parametrize(
    ("level", "expected"),
    [(50, (0.385, 0.615)), (90, (0.825, 0.960)), (95, (0.895, 0.990))],
)
def test_bands_at_200_are_the_stated_ones(level, expected):
    assert two_link.coverage_band(level, 200) == pytest.approx(expected, abs=1e-9)


def test_covered_counts_the_central_interval():
    z = np.array([[0.0, 0.7], [-0.6, 1.7], [1.6, -np.inf], [-1.9, 0.1]])
    assert two_link.coverage(z, 50).tolist() == [0.5, 0.25]
    assert two_link.coverage(z, 90).tolist() == [0.75, 0.5]
    assert two_link.coverage(z, 95).tolist() == [1.0, 0.75]


def test_a_failed_fit_is_counted_and_covers_nothing(monkeypatch, study, tmp_path):
    calls = []

    def learn(truth, *, key):
        calls.append(truth)
        if len(calls) == 2:
            raise NotConverged("E201", "the MAP did not converge")
        return study

    monkeypatch.setattr(two_link, "learn", learn)
    whole = TwoLinkArm("fig1", seeds=3)
    whole.learned = study
    values, about = run_cells(whole.rows(), tmp_path, workers=1, progress=QUIET)
    assert len(about["fits_not_converged"]) == 1
    found = whole.arrays(values)
    assert np.isinf(found["coverage/z"]).all(axis=1).tolist() == [False, True, False]
    assert len({tuple(row) for row in found["coverage/truth"]}) == 3
    claim = whole.summary(found, values)["claims"]["intervals_cover"]
    assert "1 fits not converged" in claim["text"]


def test_other_recordings_are_counted(study):
    claims = figure1.arm_claims(study.sd, study.z)
    wide = figure1.arm_claims(10.0 * study.sd, study.z)
    found = figure1.with_others(claims, [claims, wide, wide])
    assert found["link_2_is_learned_first"]["other_recordings"] == "1 of 3"
    assert found["truth_is_near"]["other_recordings"] == "3 of 3"


def test_claims_bite(study):
    """Each claim falls with what it claims, and no other does."""

    def widened(name, rows, factor):
        factors = np.ones((4, 1))
        factors[rows] = factor
        where = lambda s: getattr(s, name).posterior.scale  # noqa: E731
        with jax.enable_x64(True):
            return eqx.tree_at(where, study, where(study) * jnp.asarray(factors))

    def fallen(changed):
        claims = figure1.arm_claims(changed.sd, changed.z)
        return {name for name, claim in claims.items() if not claim["holds"]}

    sane = fallen(study)
    assert "link_1_stays_at_the_prior" not in sane
    assert fallen(widened("posterior1", [0], 0.85)) - sane == {
        "link_1_stays_at_the_prior"
    }
    assert fallen(widened("posterior1", [3], 10.0)) - sane == {
        "link_2_is_learned_first"
    }
    assert "both_links_are_learned" in fallen(widened("posterior2", [0], 10.0))
    assert "truth_is_near" in fallen(widened("posterior2", [0, 1, 2, 3], 0.01))


def test_coverage_claim_falls_with_an_sd_that_is_half_or_double():
    z = np.random.default_rng(0).standard_normal((200, 4))
    assert figure1.coverage_claim(z, 0)["holds"]
    assert not figure1.coverage_claim(2.0 * z, 0)["holds"]
    assert not figure1.coverage_claim(0.5 * z, 0)["holds"]


def test_draws_start_at_rest_and_respect_the_lock(study):
    arrays = figure1.figure_arrays(study, key=jax.random.key(1))
    assert {key for key in arrays if "draws" in key} == {
        "figure1/data1/draws/prior",
        "figure1/data1/draws/posterior1",
        "figure1/data2/draws/posterior1",
        "figure1/data2/draws/posterior2",
    }
    for key, value in arrays.items():
        if "draws" in key:
            assert value.shape == (figure1.DRAWS, two_link.STEPS + 1, 4)
            assert np.isfinite(value).all()
            assert not value[:, 0].any()
    locked = arrays["figure1/data1/draws/prior"]
    assert not locked[:, :, [0, 2]].any()
    for data, wide, narrow in (
        ("data1", "prior", "posterior1"),
        ("data2", "posterior1", "posterior2"),
    ):
        spread = [
            arrays[f"figure1/{data}/draws/{name}"][:, -1, 1].std()
            for name in (wide, narrow)
        ]
        assert spread[1] < 0.5 * spread[0]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A small run of the command's function."""
    out = tmp_path_factory.mktemp("runs") / "fig1"
    small = TwoLinkArm("fig1", seed=1, seeds=2, quick=True)
    return out, small.run(out, workers=1, progress=QUIET)


def test_the_run_holds_what_the_command_promises(finished):
    out, summary = finished
    names = {p.name for p in out.iterdir()}
    expected = {"summary.json", "arrays.npz", "figure1.png", "report.html"}
    assert names == expected | {"manifest.json"}
    assert load_run(out).summary == summary
    assert len(summary["claims"]) == 5
    assert all(
        {"holds", "figure", "text"} <= c.keys() for c in summary["claims"].values()
    )
    assert summary["curves"]["sd_m2"][0] == 1.5
    table = UniformRodArm().parameters
    assert list(summary["parameters"]) == list(table.names)
    assert summary["parameters"]["m1"]["truth"] == pytest.approx(1.0)
    assert summary["wall_seconds"] > 0


def test_the_picture_is_redrawn_from_the_store_alone(finished):
    out, _ = finished
    run = load_run(out)
    png = report.figure_bytes(report.figure1(run.arrays, run.summary), "png")
    assert png == (out / "figure1.png").read_bytes()
    before = (out / "report.html").read_bytes()
    assert report.redraw(out).read_bytes() == before
    assert b'id="figure1"' in before
    assert b'id="claims"' in before


def test_the_same_seed_gives_the_same_data():
    truth, arm = two_link.nominal_truth(), UniformRodArm()
    with jax.enable_x64(True):
        one, two, other = (
            two_link.record(arm, truth, key=jax.random.key(k)) for k in (0, 0, 1)
        )
    assert np.array_equal(one.state, two.state)
    assert not np.array_equal(one.action, other.action)
