"""Figures of functions: what they add over one variable or two, how surely, and where the data are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from nsde_torch.arrays import Array
from nsde_torch.plots.style import BLUE, GREY, key, label, panels, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_HALF = 1.645  # standard errors of a 90 % interval
_POINTS = 400  # of the data that are drawn
_VEIL = "#d9d9d9"


@dataclass(frozen=True)
class Surface:
    """What functions add over one variable or two.

    Args:
        row, unit: What it is added to, and its unit.
        variables: Names and units of the variables.
        axes: Values of each variable (n,), (m,).
        mean, error: What is added and its standard error (n,), or (m, n) with rows along the second variable.
        far: Where no data are near (like `mean`).
        data: Logged values of the variables (N, 1 or 2).
    """

    row: str
    unit: str
    variables: tuple[tuple[str, str], ...]
    axes: tuple[Array, ...]
    mean: Array
    error: Array
    far: NDArray[np.bool_]
    data: Array


@styled
def flexible_surface(surface: Surface, *, title: str) -> Figure:
    """What functions add, and the 90 % interval; grey where no data are near.

    Args:
        surface: What is drawn.
        title: What is shown.

    Returns:
        A curve over one variable; over two, a map and a map of the half width of its interval.
    """
    if len(surface.axes) == 1:
        return _curve(surface, title)
    figure, axes = panels(1, 2, height=4.2, title=title)
    shown = np.abs(surface.mean[~surface.far])
    largest = float(shown.max()) if shown.size else 1.0
    added = axes[0, 0], surface.mean, "RdBu_r", (-largest, largest), "what is added"
    error = _HALF * surface.error
    seen = error[~surface.far]
    sure = axes[0, 1], error, "viridis", (0.0, float(seen.max()) if seen.size else 1.0), "+- of it (90 %)"
    for ax, values, colours, (low, high), name in (added, sure):
        mesh = ax.pcolormesh(*surface.axes, values, cmap=colours, vmin=low, vmax=high, rasterized=True)
        figure.colorbar(mesh, ax=ax, label=label(f"{surface.row}: {name}", surface.unit))
        veil = np.where(surface.far, 1.0, np.nan)
        ax.pcolormesh(*surface.axes, veil, cmap=_grey(), vmin=0.0, vmax=1.0, rasterized=True)
        some = _some(surface.data)
        ax.plot(some[:, 0], some[:, 1], ".", color="black", markersize=2, alpha=0.4, label="data")
        ax.plot([], [], "s", color=_VEIL, label="no data near: not to be trusted")
        _frame(ax, surface)
    key(figure, axes[0, 0])
    return figure


def _curve(surface: Surface, title: str) -> Figure:
    figure, axes = panels(1, 1, height=3.6, title=title)
    ax, x, near = axes[0, 0], surface.axes[0], ~surface.far
    half = _HALF * surface.error
    ax.axhline(0.0, color=GREY, linewidth=0.8)
    for where, colour, name in (
        (near, BLUE, "90 % interval"),
        (surface.far, _VEIL, "no data near: not to be trusted"),
    ):
        mean = np.where(where, surface.mean, np.nan)
        ax.fill_between(
            x, mean - half, mean + half, color=colour, alpha=0.25 if colour == BLUE else 0.8, label=name
        )
    ax.plot(x, np.where(near, surface.mean, np.nan), color=BLUE, label="what is added")
    low, high = ax.get_ylim()
    some = _some(surface.data)[:, 0]
    ax.plot(some, np.full(len(some), low), "|", color="black", alpha=0.4, label="data")
    ax.set_ylim(low, high)
    ax.set_xlabel(label(*surface.variables[0]))
    ax.set_ylabel(label(surface.row, surface.unit))
    key(figure, ax)
    return figure


def _frame(ax: Axes, surface: Surface) -> None:
    ax.grid(visible=False)
    ax.set_xlabel(label(*surface.variables[0]))
    ax.set_ylabel(label(*surface.variables[1]))


def _some(data: Array) -> Array:
    return np.asarray(data[np.linspace(0, len(data) - 1, min(len(data), _POINTS)).round().astype(int)])


def _grey() -> object:
    from matplotlib.colors import ListedColormap

    return ListedColormap([_VEIL])
