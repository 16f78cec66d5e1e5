"""The learned distance eta over two features at a time, with the data that it was learned from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import ceil
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from nsde_torch.arrays import Array
from nsde_torch.errors import ShapeError
from nsde_torch.plots.style import BLACK, VERMILLION, key, panels, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TRAIN_SHOWN, HELD_OUT_SHOWN = 400, 150
"""Data points drawn; more hide the map and each other."""


@dataclass(frozen=True)
class DistanceSlice:
    """eta on a grid over two features.

    Args:
        x: First feature on the grid (n,).
        y: Second feature on the grid (m,).
        eta: Distance (m, n), rows along y.
        x_label: Name and unit of the first feature.
        y_label: Name and unit of the second feature.
        train: Training data in the two features (N, 2).
        held_out: Held-out data in the two features (M, 2).
    """

    x: ArrayLike
    y: ArrayLike
    eta: ArrayLike
    x_label: str
    y_label: str
    train: ArrayLike
    held_out: ArrayLike = field(default_factory=lambda: np.zeros((0, 2)))


def slice_grid(
    features: ArrayLike, pair: tuple[int, int], *, size: int = 80, margin: float = 1.0
) -> tuple[Array, Array, Array]:
    """Points at which eta is to be evaluated: a grid over two features, the others at their median.

    Args:
        features: Training features (N, nf).
        pair: Columns of the two features.
        size: Points along each axis.
        margin: Room on each side of the data, in widths of the data.

    Returns:
        Points (size * size, nf), x (size,), y (size,); `eta.reshape(size, size)` fits `DistanceSlice`.

    Raises:
        ShapeError: `features` has another number of axes, or `pair` is outside of it.
    """
    rows = np.asarray(features, dtype=float)
    if rows.ndim != 2 or not all(0 <= k < rows.shape[1] for k in pair):
        raise ShapeError(f"`features` must be (N, nf) with the columns {pair}; got {rows.shape}.")
    axes = []
    for k in pair:
        low, high = float(rows[:, k].min()), float(rows[:, k].max())
        room = margin * max(high - low, 1e-6)
        axes.append(np.linspace(low - room, high + room, size))
    points = np.tile(np.median(rows, axis=0), (size * size, 1))
    grid_x, grid_y = np.meshgrid(axes[0], axes[1])
    points[:, pair[0]], points[:, pair[1]] = grid_x.ravel(), grid_y.ravel()
    return points, axes[0], axes[1]


def _some(points: ArrayLike, limit: int) -> Array:
    """At most so many rows, evenly spread over the order of recording."""
    rows = np.asarray(points, dtype=float).reshape(-1, 2)
    if len(rows) <= limit:
        return rows
    return rows[np.linspace(0, len(rows) - 1, limit).round().astype(int)]


@styled
def distance_map(
    slices: Sequence[DistanceSlice],
    *,
    title: str = "Distance η from the training data (other features at their median)",
) -> Figure:
    """Maps of eta, with contours at 0.1, 0.5 and 0.9 and a part of the data on them.

    Args:
        slices: One map per panel.
        title: Title.

    Returns:
        A figure with one panel per slice and one colour bar.

    Raises:
        ShapeError: there is no slice, or eta does not fit its axes.
    """
    if not slices:
        raise ShapeError("`slices` must hold at least one slice.")
    columns = min(len(slices), 3)
    rows = ceil(len(slices) / columns)
    figure, axes = panels(rows, columns, height=0.9 + rows * (4.6 if columns == 1 else 3.2), title=title)
    image = None
    for ax, part in zip(axes.flat, slices, strict=False):
        x, y, eta = (np.asarray(v, dtype=float) for v in (part.x, part.y, part.eta))
        if eta.shape != (len(y), len(x)):
            raise ShapeError(f"`eta` must be (len(y), len(x)) = {(len(y), len(x))}; got {eta.shape}.")
        image = ax.pcolormesh(x, y, eta, cmap="cividis", vmin=0, vmax=1, shading="gouraud", rasterized=True)
        crossed = [v for v in (0.1, 0.5, 0.9) if eta.min() < v < eta.max()]
        if crossed:
            lines = ax.contour(x, y, eta, levels=crossed, colors="white", linewidths=0.9)
            ax.clabel(lines, fmt="%g", fontsize=8)
        train, held = _some(part.train, TRAIN_SHOWN), _some(part.held_out, HELD_OUT_SHOWN)
        ax.scatter(*train.T, s=5, color="white", edgecolors=BLACK, linewidths=0.3, label="training")
        if len(held):
            ax.scatter(*held.T, s=14, marker="x", color=VERMILLION, linewidths=0.8, label="held out")
        ax.set(xlabel=part.x_label, ylabel=part.y_label, xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
        ax.grid(visible=False)
    for ax in axes.flat[len(slices) :]:
        ax.set_axis_off()
    assert image is not None
    figure.colorbar(image, ax=list(axes.flat), label="η [–]: 0 on the data, 1 far away", pad=0.02)
    key(figure, axes.flat[0])
    return figure
