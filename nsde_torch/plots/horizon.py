"""Prediction error against the horizon, beside the baselines that need no model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import ceil
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from nsde_torch.errors import ShapeError
from nsde_torch.plots.style import (
    GREY,
    ORANGE,
    key,
    model_look,
    panels,
    plain_logarithm,
    pretty,
    seconds_axis,
    styled,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_BASELINES: dict[str, dict[str, Any]] = {
    "hold": {"color": GREY, "linestyle": "--", "marker": "x", "label": "hold the last state"},
    "constant_velocity": {
        "color": ORANGE,
        "linestyle": "-.",
        "marker": "^",
        "label": "constant velocity",
    },
}


@styled
def horizon_errors(
    horizons: Sequence[float],
    errors: Mapping[str, Mapping[str, ArrayLike]],
    units: Mapping[str, str],
    *,
    title: str = "Error on held-out runs (RMSE)",
) -> Figure:
    """Error at each horizon: one panel per group, one curve per model.

    Args:
        horizons: Horizons (h,) [s].
        errors: Model -> group -> error (h,); the names `hold` and `constant_velocity` are drawn as baselines.
        units: Unit of each group.
        title: Title.

    Returns:
        A figure with one panel per group.

    Raises:
        ShapeError: a curve does not have one value per horizon.
    """
    groups = list(dict.fromkeys(g for curves in errors.values() for g in curves))
    columns = min(len(groups), 2)
    rows = ceil(len(groups) / columns)
    figure, axes = panels(rows, columns, height=0.9 + 2.5 * rows, title=title, sharex=False)
    models = [m for m in errors if m not in _BASELINES]
    looks: dict[str, dict[str, Any]] = dict(_BASELINES)
    for k, name in enumerate(models):
        looks[name] = {**model_look(k), "label": name}
    for ax, group in zip(axes.flat, groups, strict=False):
        drawn = []
        for name in [*models, *(m for m in errors if m in _BASELINES)]:
            if group not in errors[name]:
                continue
            curve = np.asarray(errors[name][group], dtype=float)
            if curve.shape != (len(horizons),):
                raise ShapeError(
                    f"`errors[{name!r}][{group!r}]` must be ({len(horizons)},); got {curve.shape}."
                )
            ax.plot(horizons, curve, markersize=4.5, **looks[name])
            drawn.append(curve)
        both = np.concatenate(drawn)
        both = both[np.isfinite(both)]
        if len(both) and both.min() > 0:
            plain_logarithm(ax)
        seconds_axis(ax, horizons)
        ax.set_ylabel(f"{group} error [{pretty(units[group])}]")
    for ax in axes.flat[len(groups) :]:
        ax.set_axis_off()
    key(figure, axes.flat[0])
    return figure
