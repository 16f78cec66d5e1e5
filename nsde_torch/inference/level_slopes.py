"""What the noise levels do to a pass: the gradient of its log likelihood, and the slopes of its innovations.

The gradient takes one pass backwards over the rows. With the gain G, v = S^-1 e, w = 1 where the row counts, and the
adjoints a and A of the mean and covariance that a row's update leaves (all of what later rows say), those of what was
predicted for the row are

    a- = (I - G H)' a + w H' v
    A- = (I - G H)' A (I - G H) + sym[(I - G H)' a v' H] + w/2 H' (v v' - S^-1) H

and those of the row before F' a- and F' A- F. The noise of the sensors is reached by G' A G - sym[G' a v'] +
w/2 (v v' - S^-1), that of a step by A-, its transition by a- m' + 2 A- F P.

The slopes are those of one recursion forwards. With the closed loop B = F (I - G H), m and P predicted for a row, and
a prime before a name for the slope in one level,

    'P -> B 'P B^T + F G 'R G^T F^T + 'F P F^T + F P 'F^T + 'Q,      'm -> B ('m + 'P H^T v) - F G 'R v + 'F m
"""

import torch
from torch import Tensor

from nsde_torch.inference import kernels
from nsde_torch.inference.filtering import Linearisation, Pass
from nsde_torch.inference.levels import Levels
from nsde_torch.inference.state_space import StateSpace


@torch.no_grad()
def score(space: StateSpace, levels: Levels, about: Linearisation, at: Pass, live: Tensor) -> Tensor:
    """Gradient of the log likelihood of a pass with covariances, by chunk (C, m + 3 d), of the `live` rows (T, C)."""
    h, keep = space.h, levels.keep(space.h)
    count, m, d = at.errors.shape[1], len(space.observed), space.nd
    sensors, struck, gusts, begun, kept = (at.errors.new_empty(count, k) for k in (m, d, d, d, d))
    read, filled = _of_pass(space, levels, about, at), (sensors, struck, gusts, begun, kept)
    kernels.in_parts(kernels.adjoints, *at.errors.shape[:2], *read, live, *filled)
    gust = torch.exp(2.0 * levels.gust)
    slopes = (
        2.0 * torch.exp(2.0 * levels.sensor) * sensors,
        2.0 * torch.exp(2.0 * levels.white) / h * struck,
        2.0 * gust * (gusts * (1.0 - keep.square()) + begun),
        _in_time_constant(levels, h) * (kept - 2.0 * keep * gust * gusts),
    )
    return torch.cat(slopes, -1)


@torch.no_grad()
def level_slopes(
    space: StateSpace, levels: Levels, about: Linearisation, at: Pass, *, spreads: bool = False
) -> tuple[Tensor, Tensor | None]:
    """Slopes of the whitened innovations (T, C, m, p) in each level, and of their whitened covariances (T, C, p, m, m).

    The latter with `spreads` alone; the pass has its covariances.
    """
    rows, count, m = at.errors.shape
    p = m + 3 * space.nd
    z = at.errors.new_empty(rows, count, m, p)
    turned = at.errors.new_empty((rows, count, p, m, m) if spreads else (0,) * 5)
    white, gust, sensor = (torch.exp(2.0 * size) for size in (levels.white, levels.gust, levels.sensor))
    noise = (_in_time_constant(levels, space.h), white / space.h, gust, sensor)
    read = _of_pass(space, levels, about, at)
    kernels.in_parts(kernels.slopes_in_levels, rows, count, *read, *noise, z, turned)
    return z, turned if spreads else None


def _of_pass(space: StateSpace, levels: Levels, about: Linearisation, at: Pass) -> list[Tensor | list[int]]:
    """What both kernels take of a pass."""
    assert at.covariance is not None
    found = (at.whitening, at.gain, at.white, at.delta, at.covariance[..., -space.nd :])
    return [about.slopes, levels.keep(space.h), space.observed, *found]


def _in_time_constant(levels: Levels, h: float) -> Tensor:
    """Slope of the decay of a disturbance over a step in the logarithm of its time constant (d,)."""
    return levels.keep(h) * h / torch.exp(levels.lasts)
