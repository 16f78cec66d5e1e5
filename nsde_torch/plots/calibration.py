"""Calibration: the share of measurements that lie in central intervals of a nominal probability."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from nsde_torch.errors import ShapeError
from nsde_torch.plots.style import BLACK, COLOURS, DASHES, GREY, MARKS, key, panels, seconds_axis, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TARGET = (0.90, 0.85, 0.95)
"""Nominal level and the range in which its empirical share should lie."""


@styled
def calibration_curve(
    nominal: ArrayLike,
    empirical: Mapping[str, ArrayLike],
    *,
    horizons: Sequence[float] | None = None,
    per_horizon: Mapping[str, ArrayLike] | None = None,
    title: str = "Share of held-out measurements inside predicted intervals",
) -> Figure:
    """Empirical against nominal coverage, and where given the coverage of 90 % intervals at each horizon.

    Args:
        nominal: Probabilities of the central intervals (k,), in (0, 1).
        empirical: Share of the measurements inside them (k,), by group.
        horizons: Horizons (h,) [s].
        per_horizon: Coverage of the 90 % interval at each horizon (h,), by group.
        title: Title.

    Returns:
        A figure with one panel, or two with horizons. The shaded range is 85 to 95 % at 90 %.

    Raises:
        ShapeError: a curve does not have one value for each level or horizon.
    """
    levels = np.asarray(nominal, dtype=float)
    two = horizons is not None and per_horizon is not None
    curves = {g: np.asarray(v, dtype=float) for g, v in empirical.items()}
    later = {g: np.asarray(v, dtype=float) for g, v in (per_horizon or {}).items()} if two else {}
    for name, many, n in (
        ("empirical", curves, len(levels)),
        ("per_horizon", later, len(horizons or ())),
    ):
        for group, curve in many.items():
            if curve.shape != (n,):
                raise ShapeError(f"`{name}[{group!r}]` must be ({n},); got {curve.shape}.")
    figure, axes = panels(1, 2 if two else 1, height=4.6, title=title)
    groups = list(dict.fromkeys([*curves, *later]))
    looks = {
        g: {"color": COLOURS[k % 6], "linestyle": DASHES[k % 6], "marker": MARKS[k % 6], "markersize": 4.5}
        for k, g in enumerate(groups)
    }
    level, low, high = TARGET
    ax = axes[0, 0]
    ax.plot([0, 1], [0, 1], color=GREY, linewidth=1.0, label="ideal")
    ax.fill_between(
        [level - 0.02, level + 0.02], low, high, color=BLACK, alpha=0.15, linewidth=0, label="85–95 % at 90 %"
    )
    for group, curve in curves.items():
        order = np.argsort(levels)
        ax.plot(levels[order], curve[order], label=group, **looks[group])
    ax.set(xlim=(0, 1), ylim=(0, 1), xlabel="nominal probability [–]", ylabel="empirical share [–]")
    ax.set_aspect("equal")
    key(figure, ax, columns=6)
    if two:
        ax = axes[0, 1]
        ax.axhspan(low, high, color=BLACK, alpha=0.12, linewidth=0)
        ax.axhline(level, color=GREY, linewidth=1.0)
        for group, curve in later.items():
            ax.plot(np.asarray(horizons, dtype=float), curve, **looks[group])
        seconds_axis(ax, horizons or ())
        ax.set(ylim=(0, 1.02), ylabel="share inside 90 % intervals [–]")
    return figure
