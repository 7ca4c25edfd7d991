"""The search for missing physics: its parts against closed forms, and its answers."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import planted_effects as study
from descents import estimate_of
from sim2gp import systems as sy
from sim2gp.identification.missing_physics.data import OneStepData
from sim2gp.identification.missing_physics.explain import find_missing_physics
from sim2gp.identification.missing_physics.score import (
    ScoredCandidate,
    sandwich_inflation,
    score_candidates,
    sd_widening,
    tempered_gain,
)
from sim2gp.identification.missing_physics.search import (
    CandidateSearch,
    FittedCandidate,
    search_candidates,
)
from sim2gp.identification.missing_physics.words import (
    candidate_rows,
    candidate_table,
    missing_physics_headline,
)
from sim2gp.inference.arrowhead import Noise
from sim2gp.planning.tasks import MACHINES
from sim2gp.types import in_float64


def some(*names: str) -> list[sy.Candidate]:
    """Part of the library: each effect that is fitted costs a compilation."""
    known = {c.name: c for c in sy.candidates(sy.Furuta())}
    return [known[name] for name in names]


FEW = some("theta.spring", "theta.viscous")


def rollout(planted: Any, seed: int = 5) -> OneStepData:
    return study.data_of("furuta", planted, jax.random.key(seed))


@pytest.mark.nightly
def test_an_effect_is_found() -> None:
    """The study in small, on machines with constants of their own."""
    spring = find_missing_physics(rollout(sy.Spring("theta", 4.5e-3), 6), FEW)
    assert (spring.answer, spring.effect) == ("missing", "theta.spring")
    best = spring.search.refitted[0]
    assert abs(best.value - 4.5e-3) < 4.0 * best.sd
    assert "stiffness of a cable (theta.spring = 0.0" in missing_physics_headline(
        spring
    )
    rows = candidate_rows(spring)
    assert (rows[0]["effect"], rows[0]["verdict"]) == ("spring", "missing")
    assert rows[-1]["parameter"] == "theta.viscous"
    assert rows[-1]["evidence_gain"] is None
    assert rows[-1]["verdict"] == "not distinguishable from arm_damping"
    assert candidate_table(spring, rows)["rows"][0][0] == "theta.spring"


@pytest.mark.nightly
def test_nothing_and_none_of_these() -> None:
    """The other two answers."""
    nothing = find_missing_physics(rollout(None), FEW)
    assert nothing.answer == "nothing missing"
    assert nothing.effect is None
    assert "Nothing is missing" in missing_physics_headline(nothing)

    other = find_missing_physics(rollout(sy.Spring("theta", -1e-3), 7), FEW)
    assert other.answer == "none of these"  # it would fit, but no cable pushes
    assert candidate_rows(other)[0]["verdict"] == "impossible sign"

    outside = find_missing_physics(
        rollout(study.OUTSIDE["furuta"]["saturation"], 8), FEW
    )
    assert outside.answer == "none of these"
    assert outside.effect is None
    assert missing_physics_headline(outside).startswith("None of these")


@pytest.mark.nightly  # `test_explain_run` finds what a score ranks first
def test_a_score_is_the_evidence_of_a_weak_effect() -> None:
    """Close to nothing one linearisation is as good as a fit; far away it ranks."""
    data = rollout(sy.Spring("theta", 1e-4), 6)
    found = search_candidates(data, FEW)
    scored = {s.candidate.name: s for s in found.scored}
    (refit,) = found.refitted
    assert refit.scored is scored["theta.spring"]
    assert refit.scored.gain == pytest.approx(refit.gain, abs=0.3)
    assert 2.0 < refit.gain < 100.0
    assert not scored["theta.spring"].alias
    assert scored["theta.viscous"].sine < 1e-9
    assert scored["theta.viscous"].partners == ("arm_damping",)


@pytest.mark.nightly
def test_a_dead_zone_is_found_though_its_slope_at_nothing_is_not() -> None:
    data = rollout(sy.DeadZone("voltage", 0.9), 9)
    bare = data.fit()
    (one,) = score_candidates(data, bare, some("voltage.dead_zone"))
    assert one.gain > 50.0
    assert one.starts.shape == (6, 9)


@pytest.mark.nightly
def test_payload_of_a_cartpole_is_a_pole_of_another_size() -> None:
    data = study.data_of("cartpole", None, jax.random.key(3))
    kinds = ("theta.payload", "theta.geometry", "x.spring")
    few = [c for c in sy.candidates(sy.CartPole()) if c.name in kinds]
    bare = data.fit()
    found = {s.candidate.name: s for s in score_candidates(data, bare, few)}
    assert not found["x.spring"].alias
    for name in ("theta.payload", "theta.geometry"):
        assert found[name].alias
        assert {*found[name].partners} & {"pole_half_length", "pole_mass"}


def test_repeated_rows_of_a_cluster_say_nothing_new() -> None:
    rng = np.random.default_rng(0)
    scores, cluster = rng.standard_normal((40, 3)), np.arange(40) // 2
    row = np.array([0.01, -0.02, 0.5])
    once = sandwich_inflation(20.0 * scores, cluster, row, 2)
    assert once > 1.0
    for m in (2, 5):
        more = np.repeat(20.0 * scores, m, axis=0)
        same = sandwich_inflation(more, np.repeat(cluster, m), row / m, 2)
        assert same == pytest.approx(m * once)
    # The scores sum to the prior's pull, which is no error of any cluster.
    pulled = sandwich_inflation(20.0 * scores + 3.0, cluster, row, 2)
    assert pulled == pytest.approx(once)
    assert sandwich_inflation(scores, np.zeros(40, int), row, 2) == 1.0
    assert sandwich_inflation(1e-3 * scores, cluster, row, 2) == 1.0  # never below 1


def test_independent_scores_are_not_inflated() -> None:
    """Of the mean of many rows: the sandwich agrees with the model's variance."""
    rng = np.random.default_rng(1)
    scores = rng.standard_normal((4000, 1))
    found = sandwich_inflation(scores, np.arange(4000) // 10, np.array([1.0 / 4000]), 0)
    assert found == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("k", [1.0, 3.0, 50.0, 1e4])
@pytest.mark.parametrize("m", [0.0, 0.1, 2.0])
def test_tempered_gain_is_that_of_so_many_rows(m: float, k: float) -> None:
    """Conjugate: N rows of unit noise around x ~ N(0, 1), with mean m."""

    def gain(N: float) -> float:
        return 0.5 * (m * N) ** 2 / (N + 1.0) - 0.5 * math.log(N + 1.0)

    N = 300.0
    sd = 1.0 / math.sqrt(N + 1.0)
    assert tempered_gain(gain(N), k, sd) == pytest.approx(gain(N / k), rel=1e-12)
    assert sd_widening(k, sd) * sd == pytest.approx(1.0 / math.sqrt(N / k + 1.0))
    assert tempered_gain(math.nan, k, sd) == -math.inf


@in_float64
def found_with(*refits: tuple[str, float, float, int]) -> CandidateSearch:
    """A search that ended with (channel, gain, value, sign) of springs."""
    system = sy.Furuta()
    prior = system.parameters.prior()
    noise = Noise(jnp.ones(4), jnp.ones(1))
    bare = estimate_of(prior, prior, noise, jnp.zeros((1, 0)))
    made = []
    for where, gain, value, sign in refits:
        candidate = sy.Candidate(sy.Spring(where, 1.0), sign=sign)
        scored = ScoredCandidate(candidate, system, gain, 1.0, (), np.zeros((1, 8)))
        made.append(FittedCandidate(scored, bare, gain, value, 0.1, 1.0))
    return CandidateSearch(bare, tuple(r.scored for r in made), tuple(made))


def test_who_is_best_and_who_is_tied() -> None:
    near = found_with(("a", 50.0, 1.0, 1), ("b", 49.0, 1.0, 1))
    assert near.best is near.refitted[0]
    assert near.tied == (near.refitted[1],)
    assert found_with(("a", 50.0, 1.0, 1), ("b", 40.0, 1.0, 1)).tied == ()
    weak = found_with(*((c, 5.0, 1.0, 1) for c in "abcdefgh"))
    assert weak.threshold == pytest.approx(math.log(19 * 8))
    assert weak.best is None
    assert weak.tied == ()
    signs = found_with(("a", 90.0, -1.0, 1), ("b", 60.0, -1.0, 0))
    assert signs.best is signs.refitted[1]


@pytest.mark.nightly
def test_a_fit_that_fails_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    from sim2gp.errors import NotConverged

    data = rollout(sy.Spring("theta", 4.5e-3), 6)

    def refused(*args: Any) -> None:
        raise NotConverged("E201", "no")

    monkeypatch.setattr(data, "refit", refused)
    found = find_missing_physics(data, FEW, refits=1)
    assert found.search.failed == ("theta.spring",)
    assert found.answer == "none of these"
    assert candidate_rows(found)[0]["verdict"] == "no fit"


def test_claims_count_what_was_answered() -> None:
    spring = "theta.spring"
    blank = {"machine": "furuta", "ranked": [spring], "effect": "", "truth": ""}
    sound, planted = {"planted": "nothing"}, {"planted": "spring", "truth": spring}
    cells: list[dict[str, Any]] = [
        blank | sound | {"answer": "nothing missing"},
        blank | sound | {"answer": "missing", "effect": spring},
        blank | planted | {"answer": "missing", "effect": spring},
        blank | planted | {"answer": "none of these"},
        blank | {"planted": "cogging", "answer": "none of these"},
    ]
    found = study.claims(cells)
    assert found["nothing"]["share"] == 0.5
    assert not found["nothing"]["holds"]
    assert found["effect"]["share"] == 0.5
    assert found["effect ranked first"]["share"] == 1.0
    assert found["none of these"]["holds"]


@pytest.mark.parametrize(("machine", "name"), [("furuta", "tilt"), ("cartpole", "lag")])
def test_the_study_plants_what_it_says(machine: str, name: str) -> None:
    """The same hidden constants and noise: without the effect the motion differs."""
    key, planted = jax.random.key(4), study.PLANTED[machine][name]
    (S0, A0), (S1, _) = study.episodes_in(machine, None, key)
    assert S0.shape == (251, 4)
    assert A0.shape == (250, 1)
    assert not np.allclose(S0, S1)
    (S, _), _ = study.episodes_in(machine, planted, key)
    assert np.all(np.isfinite(S))
    np.testing.assert_array_equal(S[0], S0[0])
    assert np.max(np.abs(S[:50] - S0[:50])) > 1e-3
    same = study.planted_task(machine, None, key)
    other = study.planted_task(machine, planted, key)
    for constant, value in same.truth.items():
        assert float(value) == float(other.truth[constant])


@pytest.mark.parametrize("machine", MACHINES)
def test_the_library_holds_what_is_planted_and_not_the_others(machine: str) -> None:
    library = {c.name for c in sy.candidates(MACHINES[machine][0]())}
    for planted in study.PLANTED[machine].values():
        assert sy.Candidate(planted).name in library
        half = study.scaled(planted, 0.5)
        assert half.magnitude == 0.5 * planted.magnitude
    assert not {sy.Candidate(p).name for p in study.OUTSIDE[machine].values()} & library
    assert len([*study.cells(machine, 10)]) == 130
