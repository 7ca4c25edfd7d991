"""Blocks of long windows: their pulls add up to the windows', and scatter as theirs."""

from functools import partial

import jax
import numpy as np
import pytest

from linear_system import linear
from sim2gp.data.logs import Log
from sim2gp.data.split_log import cut
from sim2gp.data.windows_likelihood import WindowsLikelihood
from sim2gp.identification.fit import fit_windows
from sim2gp.identification.intervals import pulls
from sim2gp.identification.intervals import scatter as intervals

P, N, SIZE, BLOCKS, W = 3, 2, 8, 5, 2
L = SIZE * BLOCKS


def waves(rng: np.random.Generator) -> np.ndarray:
    """Sensitivities of a moving machine: slow sines."""
    t = np.arange(W * L)[:, None]
    period, phase = rng.uniform(15.0, 60.0, (3, 1, P)), rng.uniform(0, 6.3, (3, 1, P))
    return 0.3 * np.sin(2 * np.pi * t / period + phase).sum(axis=0).reshape(W, L, P)


@pytest.mark.parametrize("b", [1, 3])
def test_the_scatter_of_blocks_has_fishers_information_for_its_mean(b: int) -> None:
    """Exactly, with unknown starts of the windows: a quadratic form, entry by entry."""
    J = waves(np.random.default_rng(13))
    E = np.stack([np.ones((W, L)), 0.1 * np.tile(np.arange(L), (W, 1))], axis=2)
    starts = W * N
    whole = np.zeros((starts + W * L, starts + P))  # all rows, the starts' prior first
    whole[:starts, :starts] = np.eye(starts)
    for w in range(W):
        here = slice(starts + w * L, starts + (w + 1) * L)
        whole[here, w * N : (w + 1) * N], whole[here, starts:] = E[w], J[w]
    prior = np.eye(P, starts + P, starts)
    H = whole.T @ whole + prior.T @ prior
    F = np.linalg.inv(np.linalg.inv(H)[starts:, starts:]) - np.eye(P)
    R, total = np.linalg.cholesky(F + np.eye(P)).T, np.zeros((P, P))
    for source in np.eye(W * L + starts + P):  # noise, starts, truth
        noise, e, z = np.split(source, [W * L, W * L + starts])
        moved = partial(np.einsum, "wln,wn->wl", E)
        y = noise.reshape(W, L) + J @ z + moved(e.reshape(W, N))
        e, z = np.split(np.linalg.solve(H, whole[starts:].T @ y.ravel()), [starts])
        own = np.zeros((W, N, N + P + 1))
        own[..., :N], own[..., -1] = np.eye(N), e.reshape(W, N)
        r = J @ z + moved(e.reshape(W, N)) - y
        rows = np.concatenate([own, np.concatenate([E, J, r[..., None]], 2)], axis=1)
        blocks = pulls._in_blocks(rows, N, np.arange(W), SIZE)
        found = pulls.pulls_of_rows(blocks, np.zeros(W, int))
        assert len(found.scores) == W * BLOCKS
        scatter = intervals._scatter(*intervals._whitened(found, R), b) @ R
        total += scatter.T @ scatter
    np.testing.assert_allclose(found.fisher, F, rtol=1e-9)
    np.testing.assert_allclose(total, F, rtol=1e-9)


def test_blocks_add_up_to_their_windows(
    monkeypatch: pytest.MonkeyPatch, float64: None
) -> None:
    """Of a fit: information, scores and misfit; the last block is a short one."""
    rng, rows = np.random.default_rng(3), 130
    a = rng.standard_normal((rows, 2))
    x = np.cumsum(0.1 * a @ [0.7, -0.4]) + 0.02 * rng.standard_normal(rows)
    log = Log(
        name="log",
        source="log.csv",
        time=0.1 * np.arange(rows),
        channels={"x0": x},
        inputs={"a0": a[:, 0], "a1": a[:, 1]},
        mask={"x0": rng.random(rows) < 0.9},
    )
    system = linear(2, 1)
    windows, _ = cut([log], system, window=6.5)
    fitted = fit_windows(system, windows, key=jax.random.key(0))
    likelihood, group = WindowsLikelihood(system, windows), np.zeros(2, int)
    asked = likelihood, fitted, fitted.posterior.mean, group
    blocks = pulls.rows_of(*asked)
    monkeypatch.setattr(pulls, "BLOCKS", 0)
    whole = pulls.rows_of(*asked)
    assert whole.starts is None
    assert blocks.starts is not None
    assert blocks.first.tolist() == [0] * 5 + [1] * 5
    one, each = (pulls.pulls_of_rows(x, group) for x in (whole, blocks))
    np.testing.assert_allclose(each.fisher, one.fisher, rtol=1e-9)
    for w in range(2):
        own = blocks.first == w
        np.testing.assert_allclose(
            each.scores[own].sum(axis=0), one.scores[w], rtol=1e-7
        )
        assert blocks.costs[own].sum() == pytest.approx(whole.costs[w], rel=1e-9)
        D = blocks.starts.onto[own]
        assert np.abs(D.sum(axis=0)).max() < 1e-9 * np.abs(D).max()
