"""Sizes of the noise of sensors and of the disturbances on the ports, as logarithms."""

from dataclasses import dataclass

import torch
from torch import Tensor

_GUST_S = 0.2  # first guess of the time that a disturbance lasts [s]
FOURTH = 70.0  # C(8, 4): variance of a fourth difference of white noise
_OVER = 10  # steps over which the first guess looks for disturbances
_LEAST = 1e-9
_MOVES = 1e-3  # of the state that a disturbance moves most: one that it moves less says nothing of its size


@dataclass(frozen=True)
class Levels:
    """Logarithms of the noise levels."""

    sensor: Tensor  # standard deviation of each measured error channel (m,)
    white: Tensor  # density of the white disturbance on each column of the ports (d,) [its unit, root second]
    gust: Tensor  # standard deviation of the Ornstein-Uhlenbeck one (d,) [its unit]
    lasts: Tensor  # its time constant (d,) [s]

    def vector(self) -> Tensor:
        """All of them (m + 3 d,)."""
        return torch.cat((self.sensor, self.white, self.gust, self.lasts), -1)

    def like(self, vector: Tensor) -> "Levels":
        """Levels from a vector (m + 3 d,)."""
        d = self.white.shape[-1]
        return Levels(*vector.split([self.sensor.shape[-1], d, d, d], -1))

    def keep(self, h: float) -> Tensor:
        """Share of an Ornstein-Uhlenbeck disturbance that is left after a step [s] (d,)."""
        return torch.exp(-h / torch.exp(self.lasts))


def first_levels(
    fourth: Tensor, moved: Tensor, pushed: Tensor, h: float, pace: float, least: Tensor
) -> Levels:
    """Levels to start from.

    Args:
        fourth: Mean square of the fourth differences of the measured channels (m,).
        moved: What the physics leaves over ten steps (N, channels).
        pushed: What a unit of each disturbance does to these over one step (N, channels, d).
        h: The step [s].
        pace: That of the machine (`nsde_torch.data.pace`).
        least: Logarithms of the least noise of the measured channels (m,): what arithmetic leaves.
    """
    sensor = torch.maximum(fourth.div(FOURTH).sqrt(), torch.exp(least).clamp_max(_LEAST))
    # no disturbance is larger than what is left of any channel that it moves
    push, left = pushed.square().mean(0).sqrt(), moved.square().mean(0).sqrt()[:, None]
    most = torch.where(push > _MOVES * push.amax(0), left / push, torch.inf).amin(0)
    size = most.nan_to_num(0.0, 0.0, 0.0) / _OVER + _LEAST
    of_disturbances = 0.1 * size * h**0.5, 0.5 * size, torch.full_like(size, _GUST_S * pace)
    return Levels(torch.log(sensor), *map(torch.log, of_disturbances))
