"""Distance-aware diffusion: sigma_i = sigma_max_i h_i(eta), h_i monotone in eta, channel by channel.

    h_i(eta) = sigmoid(softplus(w_i) eta + b_i)

sigma is a density per root second: a step of dt adds a standard deviation of sigma sqrt(dt).
`sigma_max` is fixed where the user or the supplement states it, and learned otherwise; `h` starts at a
quarter on the data and 0.95 far away, so that the spread grows about fourfold where the model is ignorant.
"""

import math

import torch
from torch import Tensor, nn

START_SHARE, FAR_SHARE = 0.25, 0.95
_HALVINGS = 60


class Diffusion(nn.Module):
    """h_phi and sigma_max.

    Args:
        sigma_max: Largest diffusion (nx,) [state unit per root second], > 0.
        learned: Whether sigma_max is optimised with the rest.
        tied: Channels of a quaternion, which share one sigma: equal noise on all four, projected to the sphere,
            is the same rotation noise at every attitude, and noise along the quaternion alone cannot be seen.
    """

    def __init__(self, sigma_max: Tensor, *, learned: bool, tied: slice | None = None) -> None:
        super().__init__()
        n = len(sigma_max)
        channel = torch.arange(n)
        if tied is not None:
            channel[tied] = tied.start + 1
        self.channel: Tensor
        self.register_buffer("channel", channel, persistent=False)
        offset = math.log(START_SHARE / (1 - START_SHARE))
        slope = math.log(FAR_SHARE / (1 - FAR_SHARE)) - offset
        self.log_sigma_max = nn.Parameter(sigma_max.clamp_min(1e-12).log(), requires_grad=learned)
        self.slope = nn.Parameter(torch.full((n,), slope + math.log(-math.expm1(-slope))))
        self.offset = nn.Parameter(torch.full((n,), offset))

    def share(self, eta: Tensor) -> Tensor:
        """h (N, nx) of eta (N,)."""
        gain = nn.functional.softplus(self.slope)[self.channel]
        return torch.sigmoid(gain[:, None] * eta + self.offset[self.channel, None]).T

    @torch.no_grad()
    def through(self, eta: Tensor, sigma: Tensor, far: Tensor) -> None:
        """Set sigma_max and h so that sigma has a given size on the data and grows away from them.

        Args:
            eta: Distance of the data (N,).
            sigma: Root mean square of sigma over them (nx,), > 0; where that is less than `START_SHARE` of `far`, it is
                taken to be as much.
            far: Least sigma where eta is 1 (nx,); it is at least `FAR_SHARE` / `START_SHARE` times `sigma`.
        """
        sigma = torch.maximum(sigma, START_SHARE * far)
        largest = torch.maximum(sigma / START_SHARE, far / FAR_SHARE).double()
        wanted, eta = (sigma / largest).double(), eta.double()
        top = math.log(FAR_SHARE / (1 - FAR_SHARE))
        low, high = torch.full_like(wanted, -40.0), torch.full_like(wanted, top - 1e-3)
        for _ in range(_HALVINGS):  # the share grows with the offset, as h(1) stays
            offset = 0.5 * (low + high)
            share = torch.sigmoid((top - offset)[:, None] * eta + offset[:, None]).square().mean(1).sqrt()
            low, high = torch.where(share < wanted, offset, low), torch.where(share < wanted, high, offset)
        slope = top - offset
        self.log_sigma_max.copy_(largest.log())
        self.offset.copy_(offset)
        self.slope.copy_(slope + torch.log(-torch.expm1(-slope)))

    def forward(self, eta: Tensor) -> Tensor:
        """sigma (N, nx) of eta (N,)."""
        return self.log_sigma_max.exp()[self.channel] * self.share(eta)
