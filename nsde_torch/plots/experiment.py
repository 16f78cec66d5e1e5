"""Picture of a planned experiment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from nsde_torch.arrays import Array
from nsde_torch.plots import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Course:
    """Something over time: label, times (N,) and values (N,)."""

    label: str
    t: Array
    values: Array


@dataclass(frozen=True)
class Seen:
    """A state over time under each member: label, times (N,), and (low, middle, high) of each member, (N,) each."""

    label: str
    t: Array
    bands: tuple[tuple[Array, Array, Array], ...]


@style.styled
def experiment_figure(
    given: Sequence[Course],
    seen: Sequence[Seen],
    names: Sequence[str],
    nats: Mapping[str, Sequence[Mapping[str, float]]] | None,
    *,
    title: str,
) -> Figure:
    """Figure of a plan; `nats` is the expected evidence of each plan for each member, None without a tie."""
    rows = len(given) + len(seen) + (nats is not None)
    figure, grid = style.panels(rows, 1, height=0.9 + 1.7 * rows, title=title)
    axes = list(grid.flat)
    colours = [style.COLOURS[i % len(style.COLOURS)] for i in range(len(names))]
    for ax, course in zip(axes, given, strict=False):
        ax.step(course.t, course.values, where="post", color=style.BLACK, linewidth=1.0)
        ax.set_ylabel(course.label)
    for ax, state in zip(axes[len(given) :], seen, strict=False):
        for (low, middle, high), colour, name in zip(state.bands, colours, names, strict=True):
            ax.fill_between(state.t, low, high, color=colour, alpha=0.25, linewidth=0)
            ax.plot(state.t, middle, color=colour, linewidth=1.0, label=f"if {name} is true")
        ax.set_ylabel(state.label)
    last = axes[len(given) + len(seen) - 1]
    last.set_xlabel("time [s]")
    if seen:
        axes[len(given)].legend(
            fontsize="small", title="median and 90 % of rehearsals", title_fontsize="small"
        )
    for ax in axes[1 : len(given) + len(seen)]:
        ax.sharex(axes[0])
    if nats is not None:
        _evidence(axes[-1], nats, colours)
    return figure


def _evidence(ax: Axes, nats: Mapping[str, Sequence[Mapping[str, float]]], colours: Sequence[str]) -> None:
    for row, values in enumerate(nats.values()):
        for i, expected in enumerate(values):
            y = row + 0.25 * (i - 0.5 * (len(colours) - 1))
            ends = [expected["low_90"], expected["high_90"]]
            ax.plot(ends, [y, y], color=colours[i], linewidth=3.0, alpha=0.5)
            ax.plot([expected["mean"]], [y], "o", color=colours[i], markersize=4)
    ax.axvline(0.0, color=style.BLACK, linewidth=0.8)
    ax.set_yticks(range(len(nats)), list(nats))
    ax.invert_yaxis()
    ax.set_xscale("symlog", linthresh=3.0)
    ax.set_xlabel(
        "evidence for what is true against the others [nats]: mean, and where 90 % of experiments lie"
    )
