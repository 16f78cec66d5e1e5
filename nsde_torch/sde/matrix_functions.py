"""Functions of small matrices, one after another, compiled: a batched product takes longer to call than to do.

Imported where it is run: Numba takes half a second to import.
"""

from math import ceil, log2

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.jit import compiled

TERMS = 10
"""Of the series of phi_3, of matrices of a norm of at most 1/2: to 1e-12."""
_MOST = 14  # doublings: of norms beyond 8,000 nobody asks, as of a friction that ends at no speed at all


@compiled
def _times(a: Array, b: Array, out: Array) -> None:
    for i in range(a.shape[0]):
        for j in range(a.shape[0]):
            total = 0.0
            for k in range(a.shape[0]):
                total += a[i, k] * b[k, j]
            out[i, j] = total


@compiled
def phi(a: Array, one: Array, two: Array, three: Array) -> None:
    """Fills phi_1, phi_2 and phi_3 of matrices (N, n, n); see `nsde_torch.sde.exponential.exponentials`."""
    n = a.shape[1]
    part, turn, first, second, third = np.empty((5, n, n))
    for r in range(a.shape[0]):
        largest = 0.0
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += abs(a[r, i, j])
            largest = max(largest, total) if total == total else np.inf
        doubled = ceil(log2(2.0 * largest)) if 0.5 < largest < np.inf else 0
        if doubled > _MOST or largest == np.inf:
            one[r], two[r], three[r] = np.nan, np.nan, np.nan
            continue
        for i in range(n):
            for j in range(n):
                part[i, j] = a[r, i, j] / 2.0**doubled
                third[i, j] = 0.0
        for term in range(TERMS - 1, -1, -1):
            _times(part, third, turn)
            for i in range(n):
                for j in range(n):
                    third[i, j] = turn[i, j] / (term + 4.0) + (1.0 if i == j else 0.0)
        for i in range(n):
            for j in range(n):
                third[i, j] /= 6.0
        _times(part, third, second)
        for i in range(n):
            second[i, i] += 0.5
        _times(part, second, first)
        for i in range(n):
            first[i, i] += 1.0
        for _ in range(doubled):
            _times(first, second, turn)
            for i in range(n):
                for j in range(n):
                    third[i, j] = 0.125 * (turn[i, j] + second[i, j] + 2.0 * third[i, j])
            _times(first, first, turn)
            for i in range(n):
                for j in range(n):
                    second[i, j] = 0.25 * (turn[i, j] + 2.0 * second[i, j])
            _times(part, turn, one[r])  # part first first, as all are functions of one matrix
            for i in range(n):
                for j in range(n):
                    first[i, j] += 0.5 * one[r, i, j]
                    part[i, j] *= 2.0
        for i in range(n):
            for j in range(n):
                one[r, i, j], two[r, i, j], three[r, i, j] = first[i, j], second[i, j], third[i, j]
