"""Restores inputs that were smoothed by a centred moving average before they were logged.

    u_applied(t) = u(t) + sum_j w_j u(t + j dt),   j = -reach ... reach,   sum_j w_j = 0

The weights are learned with the rest; their sum is zero, so gains keep their meaning. The filter looks
`reach * dt` into the future of the log, as does the average that it undoes. It models the recording, not
for the machine: a controller, which knows what it applies, does not use it.
"""

import torch
from torch import Tensor, nn


class InputFilter(nn.Module):
    """One filter for all inputs, of `reach` taps on each side, `dt` [s] apart."""

    def __init__(self, reach: int, dt: float) -> None:
        super().__init__()
        self.reach, self.dt = reach, dt
        self.weights = nn.Parameter(torch.zeros(2 * reach + 1))

    def forward(self, u: Tensor, dt: float) -> Tensor:
        """Applied inputs (B, T, nu) from logged ones on a grid of step `dt` [s]; ends are held."""
        horizon = u.shape[1]
        lags = torch.arange(-self.reach, self.reach + 1, device=u.device, dtype=u.dtype) * (self.dt / dt)
        at = (torch.arange(horizon, device=u.device, dtype=u.dtype)[:, None] + lags).clamp(0, horizon - 1)
        low = at.floor()
        share = at - low
        w = self.weights - self.weights.mean()
        rows = torch.arange(horizon, device=u.device)[:, None].expand_as(low)
        low_at = low.long()
        high_at = (low_at + 1).clamp_max(horizon - 1)
        matrix = torch.eye(horizon, device=u.device, dtype=u.dtype)
        matrix = matrix.index_put((rows, low_at), w * (1 - share), accumulate=True)
        matrix = matrix.index_put((rows, high_at), w * share, accumulate=True)
        return torch.einsum("st,btn->bsn", matrix, u)
