"""Whether a channel depends on a variable in one run only: what broke, or was left on, in one recording.

The functions of the variable times the indicator of a run, free of what the parameters can do, of the same functions
in all runs, and of what is constant in a run, so that nothing is left for them of what is there in every run or of a
place that one run alone goes to. With g_r the squares that q of them explain in run r, and g those that all
n > q of all R runs explain, nothing special in a run gives

    g_r ~ chi2(q),        (g_r / q) / s ~ F(q, n - q + m),        s = (g - g_r + m) / (n - q + m),

the second whatever the noise model has missed in every run (its size s of 1 counts as m differences between
runs: Smyth, Statistical Applications in Genetics and Molecular Biology 3 (2004)), and coefficients within their
scatter over the blocks of time of the run. The largest of the three chances counts, times the number of runs. With
two runs nobody knows which of them is the odd one.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.special import chdtrc, fdtrc

from nsde_torch.diagnosis.decisions import BUDGETS, DECISIONS, Budgets, Decisions
from nsde_torch.diagnosis.p_values import enough, independent, jackknife, orthonormal

Array = NDArray[np.float64]
Labels = NDArray[np.int64]

_NEW = 1e-3  # of the square of a function: less is nothing that the others do not do


@dataclass(frozen=True)
class Alone:
    """What functions of a variable explain in one run."""

    run: int  # number of the run
    p: float  # chance of it where the run is like all others, times the number of runs
    columns: Array  # orthonormal columns (N, q), free of what the parameters can do
    kept: NDArray[np.int64]  # which functions they came from (q,)


def alone(
    whitened: Array,
    everywhere: Array,
    constant: Array,
    white: Array,
    own: Array,
    owners: Labels,
    dt: float,
    *,
    decisions: Decisions = DECISIONS,
    budgets: Budgets = BUDGETS,
) -> Alone | None:
    """The run in which functions explain most beyond what they explain in all runs; None where no run can be odd.

    Args:
        whitened: Functions, whitened (N, q).
        everywhere: What a place that every run may go to explains: functions in all runs, whitened (N, k).
        constant: The constant 1, whitened (N,).
        white: Whitened residual (N,).
        own: Orthonormal columns of what the parameters can do (N, r).
        owners: Number of the run of each row (N,).
        dt: Time between rows [s].
        decisions: Fewest runs, blocks of time, and m.
        budgets: From which chance on a closer look pays.
    """
    runs = np.unique(owners)
    if len(runs) < decisions.odd_run_fewest:
        return None
    rows = [owners == run for run in runs]
    whole = np.column_stack((own, everywhere, white, whitened))
    for inside in rows:  # free of what is constant in a run
        level = constant[inside] / max(float(np.linalg.norm(constant[inside])), 1e-300)
        whole[inside] -= np.outer(level, level @ whole[inside])
    nuisances = own.shape[1] + everywhere.shape[1]
    nothing, left, free = orthonormal(whole[:, :nuisances]), whole[:, nuisances], whole[:, nuisances + 1 :]
    left = left - nothing @ (nothing.T @ left)
    shadow = np.concatenate([nothing[inside].T @ free[inside] for inside in rows], 1)
    gram = block_diag(*(free[inside].T @ free[inside] for inside in rows)) - shadow.T @ shadow
    pull = np.concatenate([free[inside].T @ left[inside] for inside in rows])
    size, count = np.sqrt(np.maximum(np.diag(gram), 1e-300)), free.shape[1]
    gram, pull = gram / size / size[:, None], pull / size
    own_part = [slice(k * count, (k + 1) * count) for k in range(len(runs))]
    found = [_explained(gram[part, part], pull[part]) for part in own_part]
    most = int(np.argmax([ratio for ratio, _ in found]))
    (ratio, q), (in_all, n) = found[most], _explained(gram, pull)
    if not 0 < q < n:
        return None
    inside = rows[most]
    freedom = n - q + decisions.odd_run_prior
    rest = (max(in_all - ratio, 0.0) + decisions.odd_run_prior) / freedom
    ratio /= max(float(np.square(left[inside]).mean()), 1.0)
    p = len(runs) * max(float(chdtrc(q, ratio)), float(fdtrc(q, freedom, ratio / q / rest)))
    if p < budgets.closer_chance:
        own_rows = free[inside] - nothing[inside] @ shadow[:, own_part[most]]
        p = max(p, len(runs) * _by_blocks(own_rows, left[inside], dt, decisions))
    columns = -own @ (own[inside].T @ whitened[inside])
    columns[inside] += whitened[inside]
    z, kept = independent(columns)
    return Alone(int(runs[most]), min(1.0, p), z, kept) if z.shape[1] else None


def _explained(gram: Array, pull: Array) -> tuple[float, int]:
    """Squares that columns of length 1 with these products (q, q), (q,) explain, and how many directions they have."""
    values, vectors = np.linalg.eigh(gram)
    live = values > _NEW
    return float(np.square(vectors[:, live].T @ pull / np.sqrt(values[live])).sum()), int(live.sum())


def _by_blocks(z: Array, left: Array, dt: float, decisions: Decisions) -> float:
    """Chance of the coefficients of functions in a run (n, q) from leaving out blocks of time; 1 if it is too short."""
    columns, _ = independent(z)
    length = max(len(left) // decisions.odd_run_blocks, round(decisions.odd_run_shortest / dt), 1)
    block = np.arange(len(left)) // length
    if not columns.shape[1] or not enough(int(block[-1]) + 1, columns.shape[1], decisions):
        return 1.0
    return jackknife(columns, left, block, decisions)
