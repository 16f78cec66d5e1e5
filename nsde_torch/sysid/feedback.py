"""What the past of other channels says of the noise of a channel, where inputs react to measurements.

The rate of a gyro reveals its error only slowly; the attitude, which is its integral, knows part of it at once, and so
does an input that a controller made from the attitude. What a channel's own law (`noise`) calls new is then not new to
the input, and the estimate bends (a motor's lag by 3 %). So the part of a whitened residual that the past of kinematic
residuals foretells is taken out of it:

    s = measured minus integrated change of the states that no parameter moves,   S_j = sum_i c_j^i s_{k-1-i}
    e_k <- e_k - S_k b,    b by least squares (multivariate prediction errors: Ljung, 1999, section 7.2)

A gentle flight in gusts has little in its inputs but answers to what struck it. There the kinematic residuals are not
enough: a channel's own law was fitted without them, and beside them its past says something else. With `channels` the
past of the residuals of the channels themselves is taken out too, all in one regression. What is left is new to inputs
that were made from the log, and the slopes that it is compared with were known before it: the estimate is right
whatever the laws are (an instrumental variable; Soderstrom and Stoica, 1983), at the price of wider intervals.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from nsde_torch.sysid.noise import extended
from nsde_torch.sysid.series import Series

Array = NDArray[np.float64]

_FADING = (0.0, 0.5, 0.8, 0.9, 0.95)
_FEWEST_ROWS = 200  # per column: what is taken out is lost to the parameters, and short data cannot afford it
_FADING_OF_ALL = (0.0, 0.8, 0.95)
_FEWEST_ROWS_OF_ALL = 5  # per column: without it, short data in a closed loop are wrong and not only vague


def past(residuals: Array, series: Series, *, channels: bool = False) -> Array:
    """Orthonormal columns (N + stretches, p) that span what is known before each whitened row; none for short data.

    Residuals (N, m) are kinematic ones, with `channels` those of all channels.
    """
    out = faded(residuals, series, channels=channels)
    if len(out) < _fewest(channels) * out.shape[1]:
        return out[:, :0]
    length = np.linalg.norm(out, axis=0)
    if not length.any():
        return out[:, :0]
    basis, values, _ = np.linalg.svd(out[:, length > 0] / length[length > 0], full_matrices=False)
    return np.asarray(basis[:, values > 1e-6 * values[0]])


def faded(residuals: Array, series: Series, *, channels: bool = False) -> Array:
    """What is known before each whitened row: fading sums S of earlier residuals (N + stretches, p), see `past`.

    Columns are those of the residuals with the first c, then with the second, and so on.
    """
    fading = _FADING_OF_ALL if channels else _FADING
    out = np.zeros((len(residuals) + len(series.edges), residuals.shape[1] * len(fading)))
    for (a, b), (first, last) in zip(series.edges, extended(series).edges, strict=True):
        parts = [lfilter([1.0], [1.0, -c], residuals[a:b], axis=0) for c in fading]
        out[first + 2 : last] = np.concatenate(parts, 1)[:-1]
    return out


def _fewest(channels: bool) -> int:
    return _FEWEST_ROWS_OF_ALL if channels else _FEWEST_ROWS
