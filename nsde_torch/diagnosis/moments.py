"""The moment at which a channel is pushed most: bumps in time, all over every stretch.

With M bumps the chance of the largest is M times that of one (Bonferroni).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from nsde_torch.diagnosis.decisions import DECISIONS, Decisions
from nsde_torch.diagnosis.dependence import Dependence
from nsde_torch.sysid.regression import Regression
from nsde_torch.sysid.series import Series

Array = NDArray[np.float64]

_BUMPS_S = (0.25, 1.0)  # widths of bumps


def bumps(regression: Regression) -> tuple[list[tuple[int, int]], list[Array]]:
    """Bumps in time, a second and a quarter long, all over every stretch: rows of their ends, and their shapes."""
    spans, shapes_ = [], []
    for width_s in _BUMPS_S:
        n = max(4, round(width_s / regression.dt))
        shape = np.hanning(n + 2)[1:-1]
        for a, b in regression.series.edges:
            spans += [(s, s + n) for s in range(a, b - n, max(1, n // 2))]
            shapes_ += [shape for _ in range(a, b - n, max(1, n // 2))]
    return spans, shapes_


def largest_moment(
    regression: Regression,
    i: int,
    spans: Sequence[tuple[int, int]],
    moments: Sequence[Array],
    decisions: Decisions = DECISIONS,
) -> Dependence | None:
    """The moment at which a channel is pushed most, if that is more than all other moments let expect."""
    noise, white = regression.noises[i], regression.white[i]
    offset = regression.whitened_rows(np.arange(len(regression.series)))
    place = np.searchsorted(offset, np.arange(len(regression.series)), side="right") - 1
    z = []
    known: dict[int, Array] = {}
    for (a, _), shape in zip(spans, moments, strict=True):
        n = len(shape)
        if n not in known:  # what the filter of the noise makes of a bump, and of what follows it
            line = Series(((0, 2 * n),))
            padded = np.concatenate((shape, np.zeros(n)))[:, None]
            known[n] = noise.whiten(padded, line)[1:, 0]
        start = int(place[a])
        stop = min(start + 2 * n, len(white))
        template = known[n][: stop - start]
        z.append(float(template @ white[start:stop]) / max(float(np.linalg.norm(template)), 1e-300))
    if len(z) < decisions.moments_fewest:
        return None
    size = np.abs(np.array(z))
    scale = max(1.0, float(np.median(size)) / 0.6745)
    k = int(size.argmax())
    largest = size[k] / scale
    t = float(
        regression.physics.steps.t[min(spans[k][0] * regression.box, len(regression.physics.steps) - 1)]
    )
    return Dependence(
        channel=regression.physics.names[regression.rows[i]],
        variable="time",
        p=min(1.0, 2.0 * float(ndtr(-largest)) * len(z)),
        share=max(largest**2 - 1.0, 0.0) / len(white),
        odd=0.0,
        gain=0.5 * largest**2,
        functions=1,
        run=int(regression.owners[spans[k][0]]),
        moment=t,
    )
