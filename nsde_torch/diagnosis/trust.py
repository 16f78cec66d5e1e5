"""How far a function that was fitted to data may be trusted at a place: eta, 0 among the data and 1 far from them.

    eta(z) = sqrt(1 - k(z)^T (K + e I)^-1 k(z)),        k(z, z') = exp(-|z - z'|^2 / 2 l^2)

the standard deviation of a Gaussian process at z given its values at the data, over that before (Rasmussen and
Williams, Gaussian Processes for Machine Learning, 2006, equation 2.26), with variables scaled to [-1, 1] over the range
of the data. It knows distance and nothing of the function, as the eta of a trained model does.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_LENGTH = 0.2  # l, of the half range of the data
_POINTS = 300  # of the data that are looked at
_ERROR = 1e-2  # e
FAR = 0.5
"""eta above which a place is far from the data."""


def distance_from_data(data: Array, places: Array) -> Array:
    """eta of places.

    Args:
        data: Data (n, d).
        places: Places (m, d).

    Returns:
        eta (m,), between 0 and 1.
    """
    low, high = data.min(0), data.max(0)
    half = np.maximum(0.5 * (high - low), 1e-300)
    some = data[np.linspace(0, len(data) - 1, min(len(data), _POINTS)).round().astype(int)]
    first, second = ((part - 0.5 * (low + high)) / half / _LENGTH for part in (some, places))
    among = np.exp(-0.5 * _squares(first, first)) + _ERROR * np.eye(len(first))
    towards = np.exp(-0.5 * _squares(first, second))
    known = np.einsum("nm,nm->m", towards, np.linalg.solve(among, towards))
    return np.asarray(np.sqrt(np.clip(1.0 - known, 0.0, 1.0)))


def _squares(one: Array, other: Array) -> Array:
    return np.asarray(np.square(one[:, None, :] - other[None, :, :]).sum(2))
