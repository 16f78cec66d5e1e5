"""One look for all figures: 9 inches wide (read at 900 px), colours of Okabe and Ito (2008), no pyplot."""

from __future__ import annotations

import functools
import textwrap
from collections.abc import Callable, Sequence
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nsde_torch.arrays import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

LINE = 95  # characters of a title in one line
WIDTH = 9.0  # width of every figure [in]
DPI = 130
_BINS = 1500  # of a curve that is thinned
BLUE, VERMILLION, GREEN = "#0072B2", "#D55E00", "#009E73"
PURPLE, ORANGE, SKY = "#CC79A7", "#E69F00", "#56B4E9"
BLACK, GREY = "#1a1a1a", "#767676"
RED = "#c00000"
"""For words that warn; no curve has it."""
COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY)
DASHES = ("-", "--", "-.", ":", (0, (6, 1, 1, 1, 1, 1)), (0, (1, 1)))
MARKS = ("o", "s", "^", "D", "v", "P")

_LOOK: dict[Any, Any] = {
    "font.size": 9.5,
    "axes.titlesize": 10.0,
    "axes.labelsize": 9.5,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "legend.fontsize": 8.5,
    "figure.titlesize": 11.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": GREY,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.4,
    "legend.frameon": False,
    "figure.facecolor": "white",
    "axes.formatter.useoffset": False,
    "mathtext.fontset": "dejavusans",
}

P = ParamSpec("P")
R = TypeVar("R")


def styled(function: Callable[P, R]) -> Callable[P, R]:
    """Runs a function that makes a figure under the common look; matplotlib's settings return afterwards."""

    @functools.wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
        import matplotlib

        with matplotlib.rc_context(_LOOK):
            return function(*args, **kwargs)

    return wrapped


def panels(
    rows: int, columns: int, *, height: float, title: str, sharex: Any = False, sharey: Any = False
) -> tuple[Figure, NDArray[Any]]:
    """A figure of some height [in] and its axes (rows, columns)."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    figure.suptitle(textwrap.fill(title, LINE))
    return figure, figure.subplots(rows, columns, squeeze=False, sharex=sharex, sharey=sharey)


def grid(count: int, *, columns: int, row: float, spare: float, title: str) -> tuple[Figure, list[Any]]:
    """A figure of `count` panels in at most so many columns, rows of a height [in] and some spare, and its axes."""
    columns = min(count, columns)
    rows = ceil(count / columns)
    figure, axes = panels(rows, columns, height=spare + row * rows, title=title)
    for ax in axes.flat[count:]:
        ax.set_axis_off()
    return figure, list(axes.flat[:count])


def key(figure: Figure, axes: Axes, *, columns: int = 5) -> None:
    """One legend for the whole figure, under the panels, from the labels of one of them."""
    handles, labels = axes.get_legend_handles_labels()
    legend_below(figure, handles, labels, columns=columns)


def legend_below(figure: Figure, handles: Sequence[Any], labels: Sequence[str], *, columns: int = 5) -> None:
    """A legend under the panels, in as many columns as its labels leave room for."""
    if handles:
        room = 118 // (max(len(text) for text in labels) + 7)
        ncols = max(1, min(columns, room, len(handles)))
        figure.legend(list(handles), list(labels), loc="outside lower center", ncols=ncols)


def plain_logarithm(axes: Axes) -> None:
    """A logarithmic y axis with 0.02 instead of a power of ten, at 1, 2 and 5 of each decade."""
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    subs = (1.0, 2.0, 5.0) if high < 1000 * low else (1.0,)
    plain_decades(axes.yaxis, subs)


def plain_decades(axis: Axis, subs: Sequence[float] = (1.0, 2.0, 5.0)) -> None:
    """Plain numbers at these multiples of the powers of ten."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=tuple(subs)))
    axis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    axis.set_minor_formatter(NullFormatter())


def few_ticks(axes: Axes, *, y: int) -> None:
    """At most so many ticks on the linear y axis of a small panel."""
    from matplotlib.ticker import MaxNLocator

    axes.yaxis.set_major_locator(MaxNLocator(y, min_n_ticks=2))


def seconds_axis(axes: Axes, horizons: ArrayLike) -> None:
    """A logarithmic axis of horizons with a plain number at each of them."""
    values = np.asarray(horizons, dtype=float).ravel()
    if len(values) > 1 and (values > 0).all():
        axes.set_xscale("log")
    axes.set_xticks(values, [f"{v:g}" for v in values])
    axes.set_xticks([], minor=True)
    axes.set_xlabel("horizon [s]")


def model_look(k: int) -> dict[str, Any]:
    """Colour, line and mark of the k-th model of a figure; orange and grey are those of baselines."""
    colours = (BLUE, VERMILLION, GREEN, PURPLE, SKY, BLACK)
    return {"color": colours[k % 6], "linestyle": DASHES[(k // 6) % 6], "marker": MARKS[k % 6]}


def warn(figure: Figure, text: str, names: Sequence[str] = ()) -> None:
    """Words in red under the title of a figure, and these names in red where its legends or panels have them."""
    figure.suptitle(f"{figure.get_suptitle()}\n{textwrap.fill(text, LINE)}", color=RED)
    words = [t for legend in figure.legends for t in legend.get_texts()]
    words += [axes.title for axes in figure.axes]
    for word in words:
        if word.get_text() in names:
            word.set_color(RED)


def label(name: str, unit: str) -> str:
    """`v_x [m/s]`; a pure number has the unit 1 and needs none."""
    return f"{name} [{pretty(unit)}]" if unit not in ("", "1") else f"{name} [–]"


def pretty(unit: str) -> str:
    """Units as people write them."""
    return unit.replace("deg", "°").replace("s2", "s²").replace("m2", "m²")


def thin(t: Array, y: Array) -> tuple[Array, Array]:
    """At most about 3000 points of a curve (n,): the extremes of each bin, so that no peak is lost."""
    n = len(t)
    if n <= 2 * _BINS:
        return t, y
    keep = {0, n - 1}
    for block in np.array_split(np.arange(n), _BINS):
        keep |= {int(block[y[block].argmin()]), int(block[y[block].argmax()])}
    rows = np.array(sorted(keep))
    return t[rows], y[rows]


def some(points: ArrayLike, most: int) -> Array:
    """At most so many rows, evenly spread."""
    rows = np.asarray(points, dtype=float)
    return rows[np.linspace(0, len(rows) - 1, min(len(rows), most)).round().astype(int)]


def save(figure: Figure, path: str | Path) -> Path:
    """Write a figure to a file, which is returned; the ending says the format (`.png`, `.pdf`, `.svg`)."""
    import matplotlib

    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with matplotlib.rc_context(_LOOK):
        figure.savefig(path, dpi=DPI)
    return path
