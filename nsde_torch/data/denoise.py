"""States with the white noise of the sensors taken out, for where a path of a training window starts.

A path that starts at a noisy measurement is an error in a variable: the best prediction from it shrinks towards
the mean of the data, and a fit to such paths calls that damping (0.64 1/s for 0.5 on the supplement's spring).
A cubic smoothing spline knows no physics and follows any smooth motion. Its penalty lambda, one per channel for all
runs, has the least generalised cross-validation score (Craven and Wahba, Numerische Mathematik 31 (1979))

    GCV(lambda) = mean |x - smooth|^2 / (1 - h)^2,    h = lambda^(-1/4) / (2 sqrt 2)

h is the weight of a measurement in its own smooth value, by the equivalent kernel of the spline on a unit grid
(Silverman, Annals of Statistics 12 (1984)); the smooth value has the variance h s^2 under sensor noise s^2.
"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import solveh_banded

from nsde_torch.arrays import Array
from nsde_torch.data.run import Run

_PIECE, _OVERLAP, _FEWEST = 1000, 50, 10
_SAMPLE_PIECES = 50  # pieces that lambda is chosen on, at most
_LAMBDAS = 10.0 ** np.arange(-0.5, 8.1, 0.5)


def denoised(runs: Sequence[Run]) -> tuple[list[Array], Array]:
    """States (n, nx) of runs without white sensor noise, and what is left of it as a share of its deviation (nx,).

    Gaps are not smoothed over; segments of fewer than ten rows are as measured.
    """
    pieces = [p for run in runs for p in _pieces(run)]
    nx = runs[0].x.shape[1]
    best = [_choose([x[:, channel] for x, _ in pieces]) for channel in range(nx)]
    out = []
    for run in runs:
        smooth = np.array(run.x, dtype=np.float64)
        for x, (low, first, last) in _pieces(run):
            for channel, penalty in enumerate(best):
                if penalty is not None:
                    smooth[first:last, channel] = _spline(x[:, channel], penalty)[first - low : last - low]
        out.append(smooth)
    return out, np.array([1.0 if penalty is None else _leverage(penalty) ** 0.5 for penalty in best])


def _pieces(run: Run) -> list[tuple[Array, tuple[int, int, int]]]:
    """Rows to smooth together, with their first row and the rows whose smooth values are kept."""
    out = []
    for a, b in run.segments:
        for first in range(a, b, _PIECE):
            last = min(first + _PIECE, b)
            low, high = max(a, first - _OVERLAP), min(b, last + _OVERLAP)
            if high - low >= _FEWEST:
                out.append((np.asarray(run.x[low:high], dtype=np.float64), (low, first, last)))
    return out


def _choose(columns: Sequence[Array]) -> float | None:
    """The penalty of least pooled GCV score; None where nothing is to be smoothed."""
    if len(columns) > _SAMPLE_PIECES:
        columns = [columns[i] for i in np.linspace(0, len(columns) - 1, _SAMPLE_PIECES).round().astype(int)]
    columns = [c for c in columns if c.std() > 0]
    if not columns:
        return None
    scores = []
    for penalty in _LAMBDAS:
        squares = sum(float(((c - _spline(c, penalty)) ** 2).sum()) for c in columns)
        scores.append(squares / (1 - _leverage(penalty)) ** 2)
    best = int(np.argmin(scores))
    return None if best == 0 else float(_LAMBDAS[best])


def _leverage(penalty: float) -> float:
    return float(penalty**-0.25 / (2 * 2**0.5))


def _spline(column: Array, penalty: float) -> Array:
    """Natural cubic smoothing spline on a unit grid, x - lambda Q (R + lambda Q'Q)^-1 Q'x (Reinsch, 1967)."""
    bend = np.diff(column, 2)
    banded = np.empty((3, len(bend)))  # upper bands of R + lambda Q'Q
    banded[0], banded[1], banded[2] = penalty, 1 / 6 - 4 * penalty, 2 / 3 + 6 * penalty
    force = penalty * solveh_banded(banded, bend)
    smooth = column.copy()
    smooth[:-2] -= force
    smooth[1:-1] += 2 * force
    smooth[2:] -= force
    return smooth
