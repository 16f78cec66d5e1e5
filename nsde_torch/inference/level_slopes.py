"""What the noise levels do to a pass: the gradient of its log likelihood, and the slopes of its innovations.

The gradient takes one pass backwards over the rows. With the gain G, v = S^-1 e, w = 1 where the row counts, and the
adjoints a and A of the mean and covariance that a row's update leaves (all of what later rows say), those of what was
predicted for the row are

    a- = (I - G H)' a + w H' v
    A- = (I - G H)' A (I - G H) + sym[(I - G H)' a v' H] + w/2 H' (v v' - S^-1) H

and those of the row before F' a- and F' A- F. The noise of the sensors is reached by G' A G - sym[G' a v'] +
w/2 (v v' - S^-1), that of a step by A-, its transition by a- m' + 2 A- F P.

The slopes are those of one recursion forwards. With the closed loop B = F (I - G H), m and P predicted for a row, and
a prime before the name of what is a slope in one level,

    'P -> B 'P B^T + F G 'R G^T F^T + 'F P F^T + F P 'F^T + 'Q,      'm -> B ('m + 'P H^T v) - F G 'R v + 'F m

All levels are columns of one product of matrices.
"""

import torch
from torch import Tensor

from nsde_torch.inference.filtering import Linearisation, Pass, transitions
from nsde_torch.inference.levels import Levels
from nsde_torch.inference.state_space import StateSpace

_NUMBERS = 3_000_000  # of the slopes that are worked out at once


@torch.no_grad()
def score(space: StateSpace, levels: Levels, about: Linearisation, at: Pass, live: Tensor) -> Tensor:
    """Gradient of the log likelihood of a pass by chunk (C, m + 3 d).

    Args:
        space: The machine.
        levels: Noise levels of the pass.
        about: What the pass is linearised about.
        at: The pass, with its covariances.
        live: Whether a row counts (T, C).
    """
    assert at.covariance is not None
    observed, ne, n, h = space.observed, space.ne, space.n, space.h
    whitening, gain, errors = at.whitening, at.gain, at.errors
    after, left = at.covariance, at.delta
    rows, count, _ = errors.shape
    weight = live.to(errors.dtype)
    inverse = whitening.transpose(-1, -2) @ whitening
    v = (inverse @ errors[..., None])[..., 0]
    own = 0.5 * weight[..., None, None] * (v[..., :, None] * v[..., None, :] - inverse)
    forward = transitions(space, levels, about.slopes)[0]
    # before each row's update: I - G H
    kept = torch.eye(n, dtype=errors.dtype).expand(rows, count, n, n).clone()
    kept[..., observed] -= gain
    kept_t, forward_t = kept.transpose(-1, -2).contiguous(), forward.transpose(-1, -2).contiguous()
    mean, spread = errors.new_zeros(count, n), errors.new_zeros(count, n, n)
    means, spreads = errors.new_zeros(rows, count, n), errors.new_zeros(rows, count, n, n)  # a-, A-
    of_mean, of_spread = errors.new_zeros(rows, count, n), errors.new_zeros(rows, count, n, n)  # a, A
    for k in range(rows - 1, 0, -1):
        of_mean[k], of_spread[k] = mean, spread
        mean = (kept_t[k] @ mean[..., None])[..., 0]
        spread = kept_t[k] @ spread @ kept[k]
        cross = 0.5 * mean[..., None] * v[k][:, None, :]
        spread[..., observed] += cross
        spread[:, observed] += cross.transpose(-1, -2)
        mean[:, observed] += weight[k][:, None] * v[k]
        seen = spread[:, observed]
        seen[..., observed] += own[k]
        spread[:, observed] = seen
        means[k], spreads[k] = mean, spread
        mean = (forward_t[k - 1] @ mean[..., None])[..., 0]
        spread = forward_t[k - 1] @ spread @ forward[k - 1]
    pulled = torch.einsum("tcim,tci->tcm", gain, of_mean)
    sensors = torch.einsum("tcim,tcij,tcjm->tcm", gain, of_spread, gain) - pulled * v
    sensors += torch.diagonal(own, dim1=-2, dim2=-1)
    sensors = sensors[1:].sum(0)
    # the start is as uncertain as its sensors and gusts
    sensors += torch.diagonal(spread, dim1=-2, dim2=-1)[:, observed]
    push = about.slopes[:-1, ..., ne:]
    struck = torch.einsum("tcid,tcij,tcjd->tcd", push, spreads[1:, :, :ne, :ne], push).sum(0)
    gusts = torch.diagonal(spreads[1:], dim1=-2, dim2=-1)[..., ne:].sum(0)
    begun = torch.diagonal(spread, dim1=-2, dim2=-1)[:, ne:]
    carried = (forward[:-1] @ after[:-1])[..., ne:]  # F P, columns of the disturbances
    moved = (means[1:, :, ne:] * left[:-1, :, ne:]).sum(0)
    moved = moved + 2.0 * torch.einsum("tcdj,tcjd->cd", spreads[1:, :, ne:], carried)
    keep, gust, white = levels.keep(h), torch.exp(2.0 * levels.gust), torch.exp(2.0 * levels.white)
    slope = keep * h / torch.exp(levels.lasts)  # of keep in the logarithm of the time constant
    return torch.cat(
        (
            2.0 * torch.exp(2.0 * levels.sensor) * sensors,
            2.0 * white / h * struck,
            2.0 * gust * (gusts * (1.0 - keep.square()) + begun),
            slope * (moved - 2.0 * keep * gust * gusts),
        ),
        -1,
    )


@torch.no_grad()
def level_slopes(
    space: StateSpace, levels: Levels, about: Linearisation, at: Pass, *, spreads: bool = False
) -> tuple[Tensor, Tensor | None]:
    """Slopes of the whitened innovations (T, C, m, p) in each level, and of their whitened covariances (T, C, p, m, m).

    Args:
        space: The machine.
        levels: Noise levels of the pass.
        about: What the pass is linearised about.
        at: The pass, with its covariances.
        spreads: Whether to return those of the covariances, too.
    """
    assert at.covariance is not None
    observed, ne, n, nd, h = space.observed, space.ne, space.n, space.nd, space.h
    m = len(observed)
    p = m + 3 * nd
    count = at.errors.shape[1]
    keep, gust, white = levels.keep(h), torch.exp(2.0 * levels.gust), torch.exp(2.0 * levels.white)
    slope = keep * h / torch.exp(levels.lasts)
    noise, disturbed = 2.0 * torch.exp(2.0 * levels.sensor), torch.arange(nd)
    ports = ne + disturbed
    whitening = at.whitening
    covariance, mean = noise.new_zeros(count, n, p, n), noise.new_zeros(count, n, p)
    covariance[:, observed, range(m), observed] = noise
    covariance[:, ports, m + nd + disturbed, ports] = 2.0 * gust
    slab = max(1, _NUMBERS // covariance.numel())
    z = [noise.new_zeros(1, count, m, p)]
    turned = [noise.new_zeros(1, count, p, m, m)]
    for first in range(0, len(whitening) - 1, slab):
        rows = slice(first, min(first + slab, len(whitening) - 1))
        forward = transitions(space, levels, about.slopes[rows])[0]
        back = forward @ at.gain[rows]
        closed = forward.clone()
        closed[..., observed] -= back
        v = whitening[rows].transpose(-1, -2) @ at.white[rows, ..., None]
        if first == 0:
            v[0] = 0.0  # where a chunk starts; no innovation
        struck = noise.new_zeros(*forward.shape[:2], n, p, n)
        struck[..., :m, :] = (noise * back)[..., None] * back.transpose(-1, -2)[..., None, :, :]
        push = about.slopes[rows, ..., ne:]
        pushed = (2.0 * white / h * push)[..., None] * push.transpose(-1, -2)[..., None, :, :]
        struck[..., :ne, m : m + nd, :ne] = pushed
        struck[..., ports, m + nd + disturbed, ports] = 2.0 * gust * (1.0 - keep.square())
        carried = slope * (forward @ at.covariance[rows])[..., ports]  # (..., n, d)
        struck[..., :, m + 2 * nd + disturbed, ports] += carried
        struck[..., ports, m + 2 * nd + disturbed, :] += carried.transpose(-1, -2)
        struck[..., ports, m + 2 * nd + disturbed, ports] -= 2.0 * keep * slope * gust
        moved = noise.new_zeros(*forward.shape[:2], n, p)
        moved[..., :m] = -noise * back * v[..., 0][..., None, :]
        moved[..., ports, m + 2 * nd + disturbed] = slope * at.delta[rows][..., ports]
        closed_t = closed.transpose(-1, -2).contiguous()
        seen, spread = [], []
        for k in range(len(closed)):
            answered = covariance.view(count, n * p, n)[..., observed] @ v[k]
            mean = closed[k] @ (mean + answered.view(count, n, p)) + moved[k]
            covariance = (closed[k] @ covariance.view(count, n, p * n)).view(count, n * p, n) @ closed_t[k]
            covariance = covariance.view(count, n, p, n) + struck[k]
            seen.append(mean[:, observed])
            if spreads:
                spread.append(covariance[:, observed][..., observed])
        after = whitening[rows.start + 1 : rows.stop + 1]
        z.append(-(after @ torch.stack(seen)))
        if spreads:
            whole = torch.stack(spread).transpose(2, 3).clone()  # (..., p, m, m)
            whole[..., range(m), range(m), range(m)] += noise
            turned.append(after[:, :, None] @ whole @ after.transpose(-1, -2)[:, :, None])
    return torch.cat(z), torch.cat(turned) if spreads else None
