"""Figures of a diagnosis: the residual against what explains it, runs left out, and the residual's spectrum."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from nsde_torch.arrays import Array
from nsde_torch.plots import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_HALF = 1.645  # standard errors of a 90 % interval
_CURVE_POINTS = 400  # of the data that are drawn
_VEIL = "#d9d9d9"


@dataclass(frozen=True)
class Surface:
    """What functions add over one variable or two."""

    # what it is added to, and its unit
    row: str
    unit: str
    variables: tuple[tuple[str, str], ...]  # names and units of the variables
    axes: tuple[Array, ...]  # values of each variable (n,), (m,)
    # what is added and its standard error (n,), or (m, n) with rows along the second variable
    mean: Array
    error: Array
    far: NDArray[np.bool_]  # where no data are near (like `mean`)
    data: Array  # logged values of the variables (N, 1 or 2)


@style.styled
def flexible_surface(surface: Surface, *, title: str) -> Figure:
    """What functions add over one variable, or a map over two, and the 90 % interval; grey where no data are near."""
    from matplotlib.colors import ListedColormap

    if len(surface.axes) == 1:
        return _curve(surface, title)
    figure, axes = style.panels(1, 2, height=4.2, title=title)
    shown = np.abs(surface.mean[~surface.far])
    largest = float(shown.max()) if shown.size else 1.0
    added = axes[0, 0], surface.mean, "RdBu_r", (-largest, largest), "what is added"
    error = _HALF * surface.error
    seen = error[~surface.far]
    sure = axes[0, 1], error, "viridis", (0.0, float(seen.max()) if seen.size else 1.0), "+- of it (90 %)"
    for ax, values, colours, (low, high), name in (added, sure):
        mesh = ax.pcolormesh(*surface.axes, values, cmap=colours, vmin=low, vmax=high, rasterized=True)
        figure.colorbar(mesh, ax=ax, label=style.label(f"{surface.row}: {name}", surface.unit))
        veil = np.where(surface.far, 1.0, np.nan)
        ax.pcolormesh(*surface.axes, veil, cmap=ListedColormap([_VEIL]), vmin=0.0, vmax=1.0, rasterized=True)
        some = style.some(surface.data, _CURVE_POINTS)
        ax.plot(some[:, 0], some[:, 1], ".", color="black", markersize=2, alpha=0.4, label="data")
        ax.plot([], [], "s", color=_VEIL, label="no data near: not to be trusted")
        ax.grid(visible=False)
        ax.set(xlabel=style.label(*surface.variables[0]), ylabel=style.label(*surface.variables[1]))
    style.key(figure, axes[0, 0])
    return figure


def _curve(surface: Surface, title: str) -> Figure:
    figure, axes = style.panels(1, 1, height=3.6, title=title)
    ax, x, near = axes[0, 0], surface.axes[0], ~surface.far
    half = _HALF * surface.error
    ax.axhline(0.0, color=style.GREY, linewidth=0.8)
    for where, colour, name in (
        (near, style.BLUE, "90 % interval"),
        (surface.far, _VEIL, "no data near: not to be trusted"),
    ):
        mean = np.where(where, surface.mean, np.nan)
        ax.fill_between(
            x, mean - half, mean + half, color=colour, alpha=0.25 if colour == style.BLUE else 0.8, label=name
        )
    ax.plot(x, np.where(near, surface.mean, np.nan), color=style.BLUE, label="what is added")
    low, high = ax.get_ylim()
    some = style.some(surface.data, _CURVE_POINTS)[:, 0]
    ax.plot(some, np.full(len(some), low), "|", color="black", alpha=0.4, label="data")
    ax.set_ylim(low, high)
    ax.set(xlabel=style.label(*surface.variables[0]), ylabel=style.label(surface.row, surface.unit))
    style.key(figure, ax)
    return figure


BEFORE, AFTER = style.VERMILLION, style.BLUE
_MARKED: dict[str, Any] = {"color": AFTER, "marker": "s", "markersize": 4.5, "capsize": 3, "elinewidth": 1.1}
_POINTS = 1500
_SEED = 0  # of the points that are drawn


@dataclass(frozen=True)
class Cloud:
    """A residual against a variable: points, and their means in bins."""

    # points (M,)
    x: Array
    y: Array
    # of each bin (B,); `error` is a standard error
    centre: Array
    mean: Array
    error: Array


@dataclass(frozen=True)
class Panel:
    """One channel against one variable."""

    # of the residual rate
    channel: str
    unit: str
    # of the horizontal axis
    variable: str
    variable_unit: str
    # by name, at most two: `before` and `after`, one run and the others, or the residual alone
    clouds: Mapping[str, Cloud]
    note: str = ""  # words above the panel


@dataclass(frozen=True)
class ResidualSpectrum:
    """Spectra of one channel."""

    # of the residual rate
    channel: str
    unit: str
    frequency: Array  # frequencies (M,) [Hz]
    curves: Mapping[str, Array]  # by name: amplitude density (M,) [unit/sqrt(Hz)]; `floor` is drawn dashed


_LOOKS = {
    "before": (BEFORE, "o"),
    "after": (AFTER, "s"),
    "residual": (BEFORE, "o"),
    "other runs": (AFTER, "s"),
    "without it": (BEFORE, "o"),
    "with it": (AFTER, "s"),
}


@style.styled
def residual_views(views: Sequence[Panel], *, title: str) -> Figure:
    """Residual rates against variables: means in bins with 90 % intervals over a light scatter."""
    figure, axes = style.grid(len(views), columns=2, row=3.0, spare=0.8, title=title)
    rng = np.random.default_rng(_SEED)
    for ax, view in zip(axes, views, strict=True):
        _draw(ax, view, rng)
    pairs = (pair for ax in axes for pair in zip(*ax.get_legend_handles_labels(), strict=True))
    marks = {text: mark for mark, text in pairs}
    style.legend_below(figure, list(marks.values()), list(marks))
    return figure


def _draw(ax: Axes, view: Panel, rng: np.random.Generator) -> None:
    ax.axhline(0.0, color=style.GREY, linewidth=0.8)
    reach = 0.0
    left, right = np.inf, -np.inf
    for name, cloud in view.clouds.items():
        colour, mark = _LOOKS.get(name, (BEFORE, "o"))
        some = np.arange(len(cloud.x))
        if len(some) > _POINTS:
            some = rng.choice(len(cloud.x), _POINTS, replace=False)
        ax.scatter(cloud.x[some], cloud.y[some], s=4, color=colour, alpha=0.12, linewidths=0, rasterized=True)
        look: dict[str, Any] = {"color": colour, "marker": mark, "markersize": 4, "linewidth": 1.2}
        look |= {"elinewidth": 1.0, "capsize": 2, "label": f"{name}, mean and 90 % interval"}
        ax.errorbar(cloud.centre, cloud.mean, _HALF * cloud.error, **look)
        if len(cloud.mean):
            reach = max(reach, float(np.abs(cloud.mean).max() + _HALF * cloud.error.max()))
        if len(cloud.y):
            reach = max(reach, float(np.quantile(np.abs(cloud.y), 0.97)))
            low, high = np.quantile(cloud.x, [0.005, 0.995])
            left, right = min(left, float(low)), max(right, float(high))
    if reach > 0:
        ax.set_ylim(-1.1 * reach, 1.1 * reach)
    if right > left:
        ax.set_xlim(left, right)
    ax.set_xlabel(style.label(view.variable, view.variable_unit))
    ax.set_ylabel(f"left over of d {view.channel}/dt [{style.pretty(view.unit)}]")
    if view.note:
        ax.set_title(view.note)
    style.few_ticks(ax, y=6)


@style.styled
def before_after(
    ratios: Mapping[str, tuple[float, float | None, float | None]],
    nats: Mapping[str, tuple[float, float | None, float | None]],
    *,
    title: str,
) -> Figure:
    """Residual on runs left out, after over before, and gain in log-likelihood of one-step predictions [nat].

    Both by channel: the value and the ends of its interval, None where there is none.
    """
    figure, axes = style.panels(1, 2, height=1.3 + 0.32 * len(ratios), title=title)
    words = ("residual of mean rates, after / before", "gain in one-step log-likelihood [nat]")
    for ax, table, nothing, word in zip(axes.flat, (ratios, nats), (1.0, 0.0), words, strict=True):
        place = np.arange(len(table))[::-1]
        value = np.array([v for v, _, _ in table.values()])
        low, high = (
            np.array([row[0] if row[k] is None else row[k] for row in table.values()], dtype=float)
            for k in (1, 2)
        )
        ax.axvline(nothing, color=style.GREY, linewidth=0.8)
        reach = np.stack((np.clip(value - low, 0.0, None), np.clip(high - value, 0.0, None)))
        ax.errorbar(value, place, xerr=reach, linestyle="none", **_MARKED)
        ax.set_yticks(place, list(table))
        ax.set_ylim(-0.6, len(table) - 0.4)
        ax.set_xlabel(word)
        left, right = min(float(low.min()), nothing), max(float(high.max()), nothing)
        ax.set_xlim(left - 0.08 * (right - left + 1e-9), right + 0.08 * (right - left + 1e-9))
    return figure


@style.styled
def errors_before_after(
    horizons: Sequence[float],
    before: Mapping[str, Sequence[float | None]],
    after: Mapping[str, Sequence[float | None]],
    low: Mapping[str, Sequence[float | None]],
    high: Mapping[str, Sequence[float | None]],
    units: Mapping[str, str],
    *,
    title: str,
) -> Figure:
    """Errors of predictions under replayed inputs by horizon, with the 90 % interval of the difference on the later.

    By quantity: errors at the horizons (h,) [s], None where a prediction did not stay finite, and the ends of the
    interval of after less before (h,).
    """
    figure, axes = style.grid(len(units), columns=2, row=2.5, spare=0.9, title=title)
    for ax, (name, unit) in zip(axes, units.items(), strict=True):
        first, second, least, most = (
            np.array([np.nan if v is None else v for v in curves[name]], dtype=float)
            for curves in (before, after, low, high)
        )
        ax.plot(horizons, first, color=BEFORE, marker="o", markersize=4.5, label="before")
        # the interval of the difference, standing on the error before
        down = np.clip(second - (first + least), 0.0, None)
        up = np.clip(first + most - second, 0.0, None)
        name_of = "after, with the 90 % interval of the difference"
        ax.errorbar(horizons, second, np.nan_to_num(np.stack((down, up))), label=name_of, **_MARKED)
        both = np.concatenate((first, second))
        both = both[np.isfinite(both)]
        if len(both) and both.min() > 0:
            ax.set_ylim(0.6 * both.min(), 1.6 * both.max())
            style.plain_logarithm(ax)
        style.seconds_axis(ax, horizons)
        ax.set_ylabel(f"{name} error [{style.pretty(unit)}]\n(inputs replayed)")
    style.key(figure, axes[0])
    return figure


@style.styled
def residual_spectra(spectra: Sequence[ResidualSpectrum], *, title: str) -> Figure:
    """Amplitude densities of residual rates against the floor of white noise."""
    figure, axes = style.grid(len(spectra), columns=2, row=2.8, spare=0.9, title=title)
    for ax, s in zip(axes, spectra, strict=True):
        for name, curve in s.curves.items():
            look = {"color": style.GREY, "linestyle": "--"} if name == "floor" else {"color": _LOOKS[name][0]}
            ax.plot(s.frequency, curve, label=name, **look)
        ax.set_xscale("log")
        style.plain_logarithm(ax)
        style.plain_decades(ax.xaxis)
        ax.set_xlabel("frequency [Hz]")
        ax.set_ylabel(f"left over of d {s.channel}/dt\n[{style.pretty(s.unit)}/√Hz]")
    style.key(figure, axes[0])
    return figure
