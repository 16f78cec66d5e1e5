"""Kernels that work on several chunks at once."""

import numpy as np
import pytest

from nsde_torch.arrays import Array
from nsde_torch.inference import kernels
from nsde_torch.inference.lanes import WIDTH, lanes, load, root, store
from nsde_torch.jit import compiled


@compiled
def _worked_out(a: Array, b: Array, number: float, out: Array) -> None:
    total = lanes(0.0)
    for k in range(len(a)):
        total += load(a[k]) * load(b[k])
        total -= number * load(a[k]) / load(b[k])
    store(out[0], root(total) - 1.0)
    store(out[1], number)


def test_lanes_are_numbers_of_their_own() -> None:
    random = np.random.default_rng(0)
    a, b = random.uniform(1.0, 2.0, (2, 5, WIDTH))
    out = np.zeros((2, WIDTH))
    _worked_out(a, b, 0.25, out)
    np.testing.assert_allclose(out[0], np.sqrt((a * b - 0.25 * a / b).sum(0)) - 1.0, rtol=1e-13)
    np.testing.assert_array_equal(out[1], 0.25)


@pytest.mark.parametrize("count", [1, WIDTH, WIDTH + 3])
def test_covariances_are_those_of_dense_matrices_however_many_chunks_there_are(count: int) -> None:
    random = np.random.default_rng(count)
    rows, ne, d, observed = 12, 3, 2, np.array([0, 2])
    n, m = ne + d, len(observed)
    slopes = 0.2 * random.standard_normal((rows, count, ne, n))
    slopes[..., :ne] += np.eye(ne)
    keep, white, gust = np.array([0.9, 0.7]), np.array([0.1, 0.2]), np.array([0.3, 0.1])
    sensor, begun = np.array([0.05, 0.02]), random.uniform(0.1, 1.0, n)
    measured = random.random((rows, count, m)) > 0.3
    whitening, gain = np.zeros((rows, count, m, m)), np.zeros((rows, count, n, m))
    left = np.zeros((rows, count, n, d))
    noise = (keep, white, gust, sensor, begun, observed)
    kernels.covariances(0, count, slopes, *noise, measured, whitening, gain, left)
    for c in range(count):
        p = np.diag(begun)
        for k in range(1, rows):
            step = np.zeros((n, n))
            step[:ne], step[ne:, ne:] = slopes[k - 1, c], np.diag(keep)
            ports = step[:, ne:].copy()
            ports[ne:] = 0.0
            p = step @ p @ step.T + ports @ np.diag(white) @ ports.T
            p[ne:, ne:] += np.diag(gust)
            some = measured[k, c]
            h, g = np.eye(n)[observed[some]], np.zeros((n, m))
            s = h @ p @ h.T + np.diag(sensor[some])
            g[:, some] = p @ h.T @ np.linalg.inv(s)
            p = p - g[:, some] @ h @ p
            np.testing.assert_allclose(gain[k, c], g, atol=1e-12)
            np.testing.assert_allclose(left[k, c], p[:, ne:], atol=1e-12)
            information = (whitening[k, c].T @ whitening[k, c])[np.ix_(some, some)]
            np.testing.assert_allclose(information, np.linalg.inv(s), atol=1e-10)
