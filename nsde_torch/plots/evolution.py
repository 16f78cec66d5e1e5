"""The evolution of a state over time as several models predict it, against the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from nsde_torch.arrays import Array
from nsde_torch.errors import ShapeError
from nsde_torch.plots.style import BLACK, COLOURS, DASHES, few_ticks, key, label, panels, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class PredictionBand:
    """What a model predicts; not-a-number where it has diverged.

    Args:
        name: Name of the model.
        mean: Mean (T + 1, n).
        low, high: Ends of its interval (T + 1, n); None for a model without intervals.
    """

    name: str
    mean: Array
    low: Array | None = None
    high: Array | None = None


@styled
def evolution(
    t: Array,
    truth: Array,
    predictions: Sequence[PredictionBand],
    *,
    names: Sequence[str],
    units: Sequence[str],
    title: str,
    truth_name: str = "truth",
    interval: str = "95 %",
    columns: int = 1,
) -> Figure:
    """One panel per channel: the truth, and mean and interval of every model; one scale for channels of one unit.

    Args:
        t: Time [s] (T + 1,).
        truth: True or measured states (T + 1, n).
        predictions: What the models predict; the first lies on top.
        names: Names of the channels.
        units: Units of the channels.
        title: What is shown.
        truth_name: Name of the truth in the legend.
        interval: Level of the intervals, for the legend.
        columns: Columns of panels.

    Raises:
        ShapeError: the arrays do not fit together.
    """
    for p in predictions:
        if p.mean.shape != truth.shape:
            raise ShapeError(f"{p.name}: `mean` must be {truth.shape} as the truth; got {p.mean.shape}.")
    n = truth.shape[1]
    rows = -(-n // columns)
    figure, axes = panels(
        rows, columns, height=1.0 + rows * (2.2 if columns == 1 else 1.7), title=title, sharex=True
    )
    order = list(enumerate(predictions))[::-1]
    ranges = truth.max(0) - truth.min(0)
    # channels of one unit share their span: one that hardly moves is shown to hardly move
    spans = [max(r for r, other in zip(ranges, units, strict=True) if other == unit) for unit in units]
    for k, ax in enumerate(axes.T.flat):
        if k >= n:
            ax.set_axis_off()
            continue
        for i, p in order:
            colour = COLOURS[i % len(COLOURS)]
            if p.low is not None and p.high is not None:
                ax.fill_between(
                    t,
                    p.low[:, k],
                    p.high[:, k],
                    color=colour,
                    alpha=0.22,
                    linewidth=0,
                    label=f"{interval} {p.name}",
                )
            ax.plot(t, p.mean[:, k], color=colour, linestyle=DASHES[i % len(DASHES)], label=p.name)
        ax.plot(t, truth[:, k], color=BLACK, linewidth=1.2, linestyle=(0, (4, 1.5)), label=truth_name)
        centre = 0.5 * float(truth[:, k].min() + truth[:, k].max())
        room = 0.95 * max(float(spans[k]), 1e-9)
        ax.set_ylim(centre - room, centre + room)  # a model that diverges leaves the panel
        ax.set_xlim(t[0], t[-1])
        ax.set_ylabel(label(names[k], units[k]))
        few_ticks(ax, y=5)
    for ax in axes[-1]:
        ax.set_xlabel("time [s]")
    key(figure, axes[0, 0], columns=4)
    return figure
