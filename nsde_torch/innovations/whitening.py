"""The whitening filters of ARMA noise models as one linear map of torch, for gradients through it.

    e = (1 + a_1 B + ... + a_p B^p) / (1 - c B) r / std

Each filter is its impulse response, applied to all stretches at once by fast Fourier transforms. The error before the
first row of a stretch is unknown: its trace, c^k through the autoregression, is taken out of every stretch with unit
prior, as `identify.noise` does.
"""

from collections.abc import Sequence
from typing import final

import numpy as np
import torch
from scipy.fft import next_fast_len
from scipy.signal import lfilter
from torch import Tensor

from nsde_torch.sysid.noise import Noise
from nsde_torch.sysid.series import Series

_NOTHING = 1e-7  # of the first tap: below that an impulse response has ended


@final
class Whitening:
    """Whitening filters of some channels.

    Args:
        noises: Noise model of each channel.
        series: Stretches of the rows.
    """

    def __init__(self, noises: Sequence[Noise], series: Series) -> None:
        longest = max(b - a for a, b in series.edges)
        responses, traces = [], []
        for noise in noises:
            impulse = np.zeros(longest)
            impulse[0] = 1.0
            a = noise.polynomial
            response = lfilter(a, [1.0, -noise.carry], impulse) / noise.std
            responses.append(response)
            start = lfilter(a, [1.0], noise.carry ** np.arange(1, longest + 1)) / noise.std
            traces.append(start if noise.carry > 0 else np.zeros(longest))
        table = np.stack(responses)
        live = np.flatnonzero((np.abs(table) > _NOTHING * np.abs(table[:, :1])).any(0))
        taps = int(live[-1]) + 1
        # stretches are laid out with gaps as long as the filters, so that none reaches into the next
        place, at = np.empty(len(series), dtype=np.int64), 0
        for a0, b0 in series.edges:
            place[a0:b0] = at + np.arange(b0 - a0)
            at += b0 - a0 + taps
        at = int(next_fast_len(at, real=True))
        self._size, self._place = at, torch.from_numpy(place)
        self._response = torch.fft.rfft(torch.from_numpy(table[:, :taps]).float(), n=at)
        trace = np.concatenate([np.stack([t[: b0 - a0] for t in traces]) for a0, b0 in series.edges], 1)
        self._trace = torch.from_numpy(trace).float()
        owner = np.repeat(np.arange(len(series.edges)), [b0 - a0 for a0, b0 in series.edges])
        self._owner, self._stretches = torch.from_numpy(owner), len(series.edges)
        self._strength = self._per_stretch(self._trace.square()) + 1.0

    def _per_stretch(self, rows: Tensor) -> Tensor:
        """Sums over stretches (..., channels, stretches) of rows (..., channels, N)."""
        return rows.new_zeros(*rows.shape[:-1], self._stretches).index_add(-1, self._owner, rows)

    def __call__(self, rows: Tensor) -> Tensor:
        """Whitened rows (..., channels, N) of rows (..., channels, N), in standard deviations."""
        laid = rows.new_zeros(*rows.shape[:-1], self._size).index_copy(-1, self._place, rows)
        filtered = torch.fft.irfft(torch.fft.rfft(laid) * self._response, n=self._size)[..., self._place]
        before = self._per_stretch(filtered * self._trace) / self._strength
        return filtered - self._trace * before[..., self._owner]
