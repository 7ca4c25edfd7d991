"""Machines of one kind, against dense Gaussians and simulated fleets."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from sim2gp.identification import fleet as fl
from sim2gp.inference.gaussian import Gaussian

P, R = 3, 4


def random_root(rng: np.random.Generator, size: float = 1.0) -> np.ndarray:
    root = np.tril(rng.normal(size=(P, P))) * 0.3 + np.eye(P)
    return size * root


def gaussian(mean: np.ndarray, covariance: np.ndarray) -> Gaussian:
    return Gaussian(jnp.asarray(mean), jnp.asarray(np.linalg.cholesky(covariance)))


class Known:
    """A fleet whose data are exact: ``y_r = H_r (m + d_r) + noise of sd 1``."""

    def __init__(self, rows: int = 5, machines: int = R, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        root = random_root(rng, 0.7)
        self.mu, self.S = rng.normal(size=P), root @ root.T
        self.H = rng.normal(size=(machines, rows, P))
        self.y = rng.normal(size=(machines, rows)) * 2.0
        self.prior = gaussian(self.mu, self.S)

    def posterior(self, r: int, prior: Gaussian) -> Gaussian:
        precision = np.linalg.inv(prior.covariance()) + self.H[r].T @ self.H[r]
        C = np.linalg.inv(precision)
        b = np.linalg.solve(np.asarray(prior.covariance()), np.asarray(prior.mean))
        return gaussian(C @ (b + self.H[r].T @ self.y[r]), 0.5 * (C + C.T))

    def alone(self) -> list[Gaussian]:
        return [self.posterior(r, self.prior) for r in range(len(self.H))]

    def jointly(self, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Mean and covariance of m and all machines, and the log evidence; dense."""
        n = len(self.H)
        lift = np.zeros((n + 1, P, (n + 1) * P))  # m and d_r -> m, m + d_r
        for r in range(n + 1):
            lift[r, :, :P] = np.eye(P)
            if r:
                lift[r, :, r * P : (r + 1) * P] = np.eye(P)
        G = np.concatenate([self.H[r] @ lift[r + 1] for r in range(n)])
        C0 = np.kron(np.eye(n + 1), np.diag(tau**2))
        C0[:P, :P] = self.S
        mean = np.concatenate([self.mu, np.zeros(n * P)])
        y = self.y.ravel()
        of_y = G @ C0 @ G.T + np.eye(y.size)
        gain = np.linalg.solve(of_y, G @ C0).T
        about = lift.reshape(-1, (n + 1) * P)
        posterior = C0 - gain @ G @ C0
        evidence = scipy.stats.multivariate_normal(G @ mean, of_y).logpdf(y)
        found = mean + gain @ (y - G @ mean)
        return about @ found, about @ posterior @ about.T, float(evidence)


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("rows", [1, 5])
@pytest.mark.parametrize("zero", [False, True])
def test_given_spreads_all_is_a_dense_gaussian(
    rows: int, zero: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of data that leave directions open, and of parameters without spread."""
    known = Known(rows)
    sd = np.sqrt(np.diag(known.S))
    tau = np.asarray([0.0 if zero else 0.4, 0.05, 1.3]) * sd
    monkeypatch.setattr(fl, "_spreads", lambda data, rng: np.stack([tau / sd] * 2))
    monkeypatch.setattr(fl, "_agreement", lambda draws: 1.0)
    found = fl.fit_fleet(
        known.prior, [known.posterior(r, known.prior) for r in range(R)]
    )
    mean, covariance, _ = known.jointly(tau)
    for k, one in enumerate((found.kind, *found.machines)):
        of = slice(k * P, (k + 1) * P)
        np.testing.assert_allclose(one.mean, mean[of], rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(
            one.covariance(), covariance[of, of], rtol=1e-6, atol=1e-8
        )
    wider = covariance[:P, :P] + np.diag(tau**2)
    np.testing.assert_allclose(found.another.covariance(), wider, rtol=1e-6, atol=1e-8)


@pytest.mark.usefixtures("float64")
def test_evidence_of_spreads_is_that_of_the_data(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Up to a constant: differences between spreads are those of dense densities."""
    known, seen = Known(), []
    monkeypatch.setattr(
        fl, "_spreads", lambda data, rng: seen.append(data) or np.ones((2, P))
    )
    monkeypatch.setattr(fl, "_agreement", lambda draws: 1.0)
    fl.fit_fleet(known.prior, known.alone())
    sd = np.sqrt(np.diag(known.S))
    spreads = np.random.default_rng(1).uniform(0.0, 2.0, size=(6, P))
    ours = [fl._given(seen[0], t).log_evidence for t in spreads]
    dense = [known.jointly(t * sd)[2] for t in spreads]
    np.testing.assert_allclose(np.diff(ours), np.diff(dense), rtol=1e-7)


@pytest.mark.usefixtures("float64")
def test_other_priors_of_the_fits_change_nothing() -> None:
    """What a fit began with is divided out again."""
    known = Known()
    rng = np.random.default_rng(5)
    given = [
        gaussian(rng.normal(size=P), (root := random_root(rng)) @ root.T)
        for _ in range(R)
    ]
    usual = fl.fit_fleet(known.prior, known.alone())
    other = fl.fit_fleet(
        known.prior, [known.posterior(r, g) for r, g in enumerate(given)], given
    )
    for one, two in zip(usual.machines, other.machines, strict=True):
        np.testing.assert_allclose(one.mean, two.mean, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(one.covariance(), two.covariance(), rtol=1e-4)


@pytest.mark.usefixtures("float64")
def test_spreads_are_drawn_from_their_posterior() -> None:
    """One parameter: against the density on a grid."""
    L, h = np.full((5, 1, 1), 4.0), np.asarray([[3.0], [-1.0], [2.0], [5.0], [-3.0]])
    data = fl._Data(L, h, np.eye(1))
    draws = fl._spreads(data, np.random.default_rng(0))[:, 0]
    t = np.linspace(1e-5, 6.0, 4001)
    log = np.asarray([fl._given(data, np.asarray([x])).log_evidence for x in t])
    density = np.exp(log - log.max() - 0.5 * t**2)
    below = np.cumsum(density) / density.sum()
    for q in (0.1, 0.5, 0.9):
        x = np.quantile(draws, q)
        # 500 draws that depend on each other: three sd of a share of 250.
        assert float(np.interp(x, t, below)) == pytest.approx(q, abs=0.08)


@pytest.mark.nightly  # 200 s: 60 fleets
@pytest.mark.usefixtures("float64")
def test_simulated_fleets_are_covered() -> None:
    """Of 60 fleets of six machines: the kind, its machines and the next machine."""
    rng = np.random.default_rng(2)
    prior = gaussian(np.zeros(P), np.eye(P))
    tau = np.asarray([0.0, 0.1, 0.4])
    inside = {"kind": [], "machines": [], "another": []}
    for fleet in range(60):
        m, one_more = rng.normal(size=P), tau * rng.normal(size=P)
        own = m + tau * rng.normal(size=(6, P))
        H = rng.normal(size=(6, 12, P)) * 3.0
        y = np.einsum("rij,rj->ri", H, own) + rng.normal(size=(6, 12))
        precision = np.eye(P) + np.einsum("rij,rik->rjk", H, H)
        C = np.linalg.inv(precision)
        x = np.einsum("rij,rkj,rk->ri", C, H, y)
        alone = [gaussian(*pair) for pair in zip(x, C, strict=True)]
        found = fl.fit_fleet(prior, alone, seed=fleet)
        assert found.agreement < 1.3
        for name, of, truth in (
            ("kind", [found.kind], [m]),
            ("machines", found.machines, own),
            ("another", [found.another], [m + one_more]),
        ):
            for g, value in zip(of, truth, strict=True):
                away = np.abs(np.asarray(g.mean) - value) / np.asarray(g.sd())
                inside[name].append(away < 1.96)
    for name, each in inside.items():
        share = np.mean(each, axis=0)
        # .95 +- three sd of 60 fleets; machines of one fleet share its errors.
        assert np.all(share > 0.86), (name, share)
