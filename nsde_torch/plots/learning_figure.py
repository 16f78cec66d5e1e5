"""Learning curves: the loss and its terms step by step, and the score on held-out windows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.errors import ShapeError
from nsde_torch.plots.style import (
    BLACK,
    BLUE,
    COLOURS,
    DASHES,
    GREY,
    VERMILLION,
    panels,
    plain_logarithm,
    styled,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_NOT_TERMS = ("step", "loss", "validation", "lr", "seconds", "grad_norm")


def _column(history: Sequence[Mapping[str, float | None]], name: str) -> tuple[Array, Array]:
    rows = [(r["step"], r[name]) for r in history if r.get(name) is not None]
    table = np.array(rows, dtype=float).reshape(-1, 2)
    table = table[np.isfinite(table[:, 1])]
    return table[:, 0], table[:, 1]


def _scale(axes: Axes, values: Sequence[Array]) -> None:
    """Logarithmic if all values are positive and span more than a factor of five; linear otherwise."""
    both = np.concatenate(list(values)) if values else np.zeros(0)
    if len(both) and both.min() > 0 and both.max() > 5 * both.min():
        plain_logarithm(axes)


def _smooth(y: Array) -> Array:
    """Running median over about a fiftieth of the curve: single batches jump."""
    width = max(len(y) // 50, 1) | 1
    if width < 3:
        return y
    padded = np.pad(y, width // 2, mode="edge")
    median: Array = np.median(np.lib.stride_tricks.sliding_window_view(padded, width), axis=1)
    return median


@styled
def learning_curves(
    history: Sequence[Mapping[str, float | None]],
    *,
    kept: int | None = None,
    terms: Sequence[str] | None = None,
    title: str = "Loss on training batches and held-out windows",
) -> Figure:
    """Loss and validation score on the left, the terms of the loss on the right.

    Args:
        history: One row per step with `step` and any of `loss`, `validation` and the terms; a missing or
            None entry is a step at which that was not computed.
        kept: Step of the model that was kept; default: that of the smallest validation score.
        terms: Names of the terms; default: every key but the known ones, in the order of appearance.
        title: Title.

    Returns:
        A figure with two panels, or one where there are no terms.

    Raises:
        ShapeError: the history is empty, or a row has no `step`.

    Example:
        >>> figure = learning_curves([{"step": 0, "loss": 2.0}, {"step": 1, "loss": 1.0}])
    """
    if not history or any("step" not in row for row in history):
        raise ShapeError("`history` must hold at least one row, each with the key `step`.")
    if terms is None:
        terms = [k for k in dict.fromkeys(k for row in history for k in row) if k not in _NOT_TERMS]
    drawn = [name for name in terms if len(_column(history, name)[0])]
    figure, axes = panels(1, 2 if drawn else 1, height=3.6, title=title)
    left: Axes = axes[0, 0]
    shown = []
    step, loss = _column(history, "loss")
    if len(step):
        if len(step) >= 150:
            left.plot(step, loss, color=BLUE, alpha=0.25, linewidth=0.7)
        left.plot(step, _smooth(loss), color=BLUE, label="training batch")
        shown.append(loss)
    step, score = _column(history, "validation")
    if len(step):
        left.plot(step, score, color=VERMILLION, marker="o", markersize=3.5, label="held-out windows")
        shown.append(score)
        if kept is None:
            kept = int(step[score.argmin()])
    _scale(left, shown)
    left.set_ylabel("loss [–]")
    sizes = []
    for k, name in enumerate(drawn):
        step, value = _column(history, name)
        negative = bool((value <= 0).all() and (value < 0).any())  # a reward: drawn by its size
        value = -value if negative else value
        axes[0, 1].plot(
            step,
            _smooth(value),
            color=COLOURS[k % 6],
            linestyle=DASHES[k % 6],
            label=f"−{name}" if negative else name,
        )
        sizes.append(value[value != 0])
    if drawn:
        _scale(axes[0, 1], sizes)
        axes[0, 1].set_ylabel("term of the loss [–]")
    for ax in axes.flat:
        if kept is not None:
            ax.axvline(kept, color=BLACK, linestyle=":", linewidth=1.2, label=f"kept: step {kept}")
        ax.set_xlabel("gradient step")
        ax.set_xlim(min(float(r["step"] or 0) for r in history), None)
        ax.legend(labelcolor=BLACK, loc="best")
        ax.tick_params(color=GREY)
    return figure
