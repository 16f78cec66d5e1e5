"""Predicted rollouts against what was measured: median and central intervals of the particles."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from nsde_torch.arrays import Array
from nsde_torch.errors import ShapeError
from nsde_torch.plots.euler import with_angles
from nsde_torch.plots.style import BLACK, BLUE, few_ticks, key, label, panels, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BANDS = ((0.95, "#d6e6f2"), (0.90, "#a9cde6"), (0.50, "#66a9d4"))
"""Central intervals and their colours, widest first."""


@styled
def rollout_bands(
    t: ArrayLike,
    measured: ArrayLike,
    samples: ArrayLike,
    *,
    names: Sequence[str],
    units: Sequence[str],
    title: str,
    quaternion: slice | None = None,
    starts: Sequence[str] | None = None,
) -> Figure:
    """Bands of sampled rollouts and the measured states: one row per channel, one column per start.

    Args:
        t: Time from the start [s], (T + 1,).
        measured: Measured states (T + 1, nx), or (E, T + 1, nx) for E starts.
        samples: Sampled states (P, T + 1, nx), or (E, P, T + 1, nx).
        names: Names of the states.
        units: Units of the states.
        title: What is shown; say here what the inputs see of the future, if anything.
        quaternion: Columns of a quaternion, drawn as roll, pitch and yaw in degrees.
        starts: A heading for each start, for example the run and time.

    Returns:
        A figure of (channels, starts) panels.

    Raises:
        ShapeError: the arrays do not fit together.
    """
    t = np.asarray(t, dtype=float)
    true, drawn = np.asarray(measured, dtype=float), np.asarray(samples, dtype=float)
    if true.ndim == 2 and drawn.ndim == 3:
        true, drawn = true[None], drawn[None]
    fits = true.ndim == 3 and drawn.ndim == 4 and true.shape == (drawn.shape[0], *drawn.shape[2:])
    if not fits or t.shape != true.shape[1:2] or len(names) != true.shape[2] or len(units) != len(names):
        raise ShapeError(
            "`measured` must be (E, T+1, nx), `samples` (E, P, T+1, nx), `t` (T+1,), `names` and `units` nx; "
            f"got {true.shape}, {drawn.shape}, {t.shape}, {len(names)} and {len(units)}."
        )
    headings = list(starts) if starts is not None else [f"start {k + 1}" for k in range(len(true))]
    if len(headings) != len(true):
        raise ShapeError(f"`starts` must hold {len(true)} headings; got {len(headings)}.")
    columns = [(heading, t, m, s) for heading, m, s in zip(headings, true, drawn, strict=True)]
    return grid_of_bands(
        columns, names, units, quaternion, title=title, named=len(columns) > 1 or starts is not None
    )


def grid_of_bands(
    columns: Sequence[tuple[str, Array, Array, Array]],
    names: Sequence[str],
    units: Sequence[str],
    quaternion: slice | None,
    *,
    title: str,
    named: bool = True,
    limits: Callable[[Sequence[tuple[Array, Array]]], tuple[float, float]] | None = None,
) -> Figure:
    """One row of panels per channel, one column per heading, times, measured states and samples.

    `limits` makes the axis that the panels of a row share, from what is measured and sampled in each.
    """
    parts = []
    for heading, t, m, s in columns:
        shown = (m, s, list(names), list(units))
        parts.append((heading, t, *(shown if quaternion is None else with_angles(*shown, quaternion))))
    rows = parts[0][2].shape[1]
    height = 1.0 + rows * (2.0 if rows <= 2 else 1.45 if rows <= 6 else 1.05)
    shared: bool | str = False if limits is None else "row"
    figure, axes = panels(rows, len(parts), height=height, title=title, sharex=True, sharey=shared)
    for column, (heading, t, m, s, channels, channel_units) in enumerate(parts):
        for k in range(rows):
            ax = axes[k, column]
            for level, colour in BANDS:
                low, high = np.quantile(s[..., k], [(1 - level) / 2, (1 + level) / 2], axis=0)
                ax.fill_between(t, low, high, color=colour, linewidth=0, label=f"{100 * level:.0f} %")
            ax.plot(t, np.median(s[..., k], axis=0), color=BLUE, label="median")
            ax.plot(t, m[:, k], color=BLACK, linewidth=1.2, linestyle=(0, (4, 1.5)), label="measured")
            if column == 0 or limits is None:
                ax.set_xlim(t[0], t[-1])
                few_ticks(ax, y=4)
            if column == 0:
                ax.set_ylabel(label(channels[k], channel_units[k]))
                if limits is not None:
                    ax.set_ylim(*limits([(part[2][:, k], part[3][..., k]) for part in parts]))
        if named:
            axes[0, column].set_title(heading)
        axes[-1, column].set_xlabel("time from the start [s]")
    figure.align_ylabels(list(axes[:, 0]))
    key(figure, axes[0, 0])
    return figure
