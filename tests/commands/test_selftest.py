"""The selftest passes here, and each of its checks notices what it is there for."""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from sim2gp.commands import selftest
from sim2gp.commands import selftest_checks as checks
from sim2gp.commands.selftest import CHECKS, Check
from sim2gp.errors import NotConverged
from sim2gp.runs import Progress

QUIET = Progress(quiet=True)


def figure(name, seed=0):
    """The figure of one check, on the stream that the command gives it."""
    number = list(CHECKS).index(name)
    return CHECKS[name].measure(np.random.default_rng([seed, number]))


def by_day() -> list[Any]:
    """Derivatives and the arm's fit have tests of their own elsewhere."""
    late = ("jacobians", "arm")
    night = pytest.mark.nightly
    return [pytest.param(n, marks=night) if n in late else n for n in CHECKS]


@pytest.mark.parametrize("name", by_day())
def test_each_check_passes_here(name):
    assert figure(name) <= CHECKS[name].limit


def test_rational_arithmetic_by_hand():
    """One observation of one constant: everything is known on paper."""
    one = np.ones((1, 1, 1))
    mean, cov, evidence = checks._rational(
        one, np.array([[3.0]]), np.array([[2.0]]), np.array([1.0]), np.array([[4.0]])
    )
    # Prior N(1, 16), noise 4: gain 16 / 20.
    assert mean[0] == 1 + 2 * checks.Fraction(16, 20)
    assert cov[0, 0] == 16 - checks.Fraction(256, 20)
    expected = -0.5 * (2.0**2 / 20 + math.log(2 * math.pi * 20))
    assert evidence == pytest.approx(expected, rel=1e-15)


def spoilt(mean=1.0, scale=1.0, evidence=0.0):
    """A solver whose answers are off by a little."""
    solve = checks._solve_batch

    def wrong(*problems):
        m, S, e = solve(*problems)
        return m * mean, S * scale, e + evidence

    return wrong


@pytest.mark.parametrize(
    ("name", "fault"),
    [
        ("exactness", {"mean": 1.0 + 1e-8}),
        ("exactness", {"scale": 1.0 + 1e-8}),
        ("exactness", {"evidence": 1e-5}),
        ("degenerate", {"mean": 1.0 + 1e-8}),
        ("degenerate", {"scale": 1.0 - 1e-8}),
        ("degenerate", {"mean": math.nan}),
        ("calibration", {"scale": 1.1}),
        ("calibration", {"scale": 0.9}),
    ],
)
def test_a_wrong_posterior_is_noticed(monkeypatch, name, fault):
    monkeypatch.setattr(checks, "_solve_batch", spoilt(**fault))
    assert not figure(name) <= CHECKS[name].limit


def test_jitter_is_noticed_by_the_units(monkeypatch):
    solve = checks._solve_batch
    monkeypatch.setattr(
        checks, "_solve_batch", lambda *p: (solve(*p)[0], solve(*p)[1] + 1e-6, 0.0)
    )
    assert figure("units") > CHECKS["units"].limit


@pytest.mark.nightly
def test_wrong_derivatives_are_noticed(monkeypatch):
    right = checks.jax.jacfwd
    monkeypatch.setattr(
        checks.jax, "jacfwd", lambda f: lambda x: right(f)(x) * jnp.asarray(1.00001)
    )
    assert figure("jacobians") > CHECKS["jacobians"].limit


def test_friction_is_noticed_by_the_energy(monkeypatch):
    rows = [(m, z.replace("b1 ", ""), V) for m, z, V in checks._CONSERVATIVE]
    monkeypatch.setattr(checks, "_CONSERVATIVE", rows[2:])
    assert figure("energy") > CHECKS["energy"].limit


@pytest.mark.nightly
def test_intervals_too_narrow_are_noticed_by_the_arm(monkeypatch):
    right = checks.coverage
    monkeypatch.setattr(checks, "coverage", lambda z, level: right(3.0 * z, level))
    assert figure("arm") > CHECKS["arm"].limit


def test_arms_that_do_not_converge_count_as_missed(monkeypatch):
    def fit(self, belief, data, *, key):
        raise NotConverged("E201", "the MAP did not converge")

    monkeypatch.setattr(checks.Sim2GP, "fit", fit)
    assert figure("arm") > CHECKS["arm"].limit


def test_bounds_that_leak_are_noticed(monkeypatch):
    right = checks.Furuta().parameters.constrain.__func__
    monkeypatch.setattr(
        "sim2gp.inference.parameters.Parameters.constrain",
        lambda self, tt: right(self, tt) * jnp.asarray(1.0 + 1e-9),
    )
    assert figure("bounds") > CHECKS["bounds"].limit


def test_a_store_that_overlooks_damage_is_noticed(monkeypatch):
    class Kept:
        summary = {"kept": 1}  # noqa: RUF012

    monkeypatch.setattr(checks, "load_run", lambda path: Kept)
    assert figure("store") > 0


def broken(rng):
    raise RuntimeError("no device")


def test_a_check_that_breaks_fails_and_the_others_run(monkeypatch, capsys):
    table = {
        "good": Check("a number", lambda rng: 0.5, 1.0),
        "bad": Check("a number", lambda rng: 1.5, 1.0),
        "nan": Check("not a number", lambda rng: math.nan, 1.0),
        "broken": Check("an error", broken, 1.0),
    }
    monkeypatch.setattr(selftest, "CHECKS", table)
    summary = selftest.selftest(progress=Progress()).summary
    results = {name: row["result"] for name, row in summary["checks"].items()}
    assert results == {"good": "PASS", "bad": "FAIL", "nan": "FAIL", "broken": "FAIL"}
    assert summary["passed"] is False
    assert summary["checks"]["broken"]["error"] == "RuntimeError: no device"
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("PASS good")
    assert lines[3].startswith("FAIL broken")
    assert lines[-1].startswith("FAIL: bad, nan, broken; 1 of 4 checks")
    assert f"jax {summary['versions']['jax']}" in lines[-1]


def test_passed_when_all_hold(monkeypatch):
    good = {"good": Check("a number", lambda rng: 0.5, 1.0)}
    monkeypatch.setattr(selftest, "CHECKS", good)
    summary = selftest.selftest(progress=QUIET).summary
    assert summary["passed"] is True
    assert summary["headline"].startswith("PASS; 1 of 1 checks")
    assert summary["device"]
