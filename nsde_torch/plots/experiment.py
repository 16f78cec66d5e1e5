"""Picture of a planned experiment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from nsde_torch.arrays import Array
from nsde_torch.plots import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@style.styled
def experiment_figure(
    given: tuple[Array, Mapping[str, Array]],
    seen: tuple[Array, Mapping[str, Sequence[tuple[Array, Array, Array]]]],
    names: Sequence[str],
    nats: Mapping[str, Sequence[Mapping[str, float]]] | None,
    *,
    title: str,
) -> Figure:
    """Figure of a plan.

    What is `given` over times (N,), by label; what is `seen` under each member: times (M,), and by the label of a state
    (low, middle, high) of each member, (M,) each; and the expected evidence of each plan for each member, None without
    a tie.
    """
    (t, inputs), (times, states) = given, seen
    rows = len(inputs) + len(states) + (nats is not None)
    figure, grid = style.panels(rows, 1, height=0.9 + 1.7 * rows, title=title)
    axes = list(grid.flat)
    colours = [style.COLOURS[i % len(style.COLOURS)] for i in range(len(names))]
    for ax, (label, values) in zip(axes, inputs.items(), strict=False):
        ax.step(t, values, where="post", color=style.BLACK, linewidth=1.0)
        ax.set_ylabel(label)
    over_time = axes[: len(inputs) + len(states)]
    for ax, (label, bands) in zip(over_time[len(inputs) :], states.items(), strict=True):
        for (low, middle, high), colour, name in zip(bands, colours, names, strict=True):
            ax.fill_between(times, low, high, color=colour, alpha=0.25, linewidth=0)
            ax.plot(times, middle, color=colour, linewidth=1.0, label=f"if {name} is true")
        ax.set_ylabel(label)
    over_time[-1].set_xlabel("time [s]")
    if states:
        words = {"title": "median and 90 % of rehearsals", "title_fontsize": "small"}
        axes[len(inputs)].legend(fontsize="small", **words)
    for ax in over_time[1:]:
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
