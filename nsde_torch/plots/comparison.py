"""Several models in one figure: their calibration, and their bands from one start."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from nsde_torch.arrays import Array
from nsde_torch.errors import ShapeError
from nsde_torch.plots.calibration import TARGET
from nsde_torch.plots.rollouts import BANDS, grid_of_bands
from nsde_torch.plots.style import (
    BLACK,
    GREY,
    key,
    model_look,
    panels,
    seconds_axis,
    styled,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_ROOM = 4.0  # how far a band may go beyond the range of what was measured, in such ranges


@styled
def calibration_of_models(
    nominal: ArrayLike,
    empirical: Mapping[str, Mapping[str, ArrayLike]],
    *,
    horizons: Sequence[float],
    per_horizon: Mapping[str, Mapping[str, ArrayLike]],
    order: Sequence[str] | None = None,
    title: str = "Share of measurements inside predicted intervals",
) -> Figure:
    """Empirical against nominal coverage (above) and coverage of 90 % intervals at each horizon (below).

    Args:
        nominal: Probabilities of the central intervals (k,), in (0, 1).
        empirical: Model -> group -> share of the measurements inside them (k,).
        horizons: Horizons (h,) [s].
        per_horizon: Model -> group -> coverage of the 90 % interval at each horizon (h,).
        order: Names in the order of other figures, these among them, so that a model has one colour in all.
        title: Title.

    Returns:
        A figure with two panels for each group and one curve for each model. Shaded is 85 to 95 % at 90 %.

    Raises:
        ShapeError: a curve does not have one value for each level or horizon.
    """
    levels = np.asarray(nominal, dtype=float)
    groups = list(dict.fromkeys(g for curves in empirical.values() for g in curves))
    figure, axes = panels(2, len(groups), height=5.6, title=title, sharey="row")
    level, low, high = TARGET
    rising = np.argsort(levels)
    for column, group in enumerate(groups):
        top, bottom = axes[0, column], axes[1, column]
        top.plot([0, 1], [0, 1], color=GREY, linewidth=1.0, label="ideal")
        top.fill_between([level - 0.02, level + 0.02], low, high, color=BLACK, alpha=0.15, linewidth=0)
        bottom.axhspan(low, high, color=BLACK, alpha=0.12, linewidth=0, label="85–95 %")
        bottom.axhline(level, color=GREY, linewidth=1.0)
        for name in empirical:
            k = (order or list(empirical)).index(name)
            share = _curve(f"empirical[{name!r}][{group!r}]", empirical[name][group], len(levels))
            later = _curve(f"per_horizon[{name!r}][{group!r}]", per_horizon[name][group], len(horizons))
            top.plot(levels[rising], share[rising], markersize=4, label=name, **model_look(k))
            bottom.plot(np.asarray(horizons, dtype=float), later, markersize=4, **model_look(k))
        top.set(xlim=(0, 1), ylim=(0, 1), title=group, xlabel="nominal probability [–]")
        top.set_aspect("equal")
        seconds_axis(bottom, horizons)
        bottom.set_ylim(0, 1.02)
        if len(groups) > 2:
            bottom.tick_params(axis="x", labelsize=7)
    axes[0, 0].set_ylabel("empirical share [–]")
    axes[1, 0].set_ylabel("inside 90 % intervals [–]")
    key(figure, axes[0, 0])
    return figure


def _curve(name: str, values: ArrayLike, n: int) -> Array:
    curve = np.asarray(values, dtype=float)
    if curve.shape != (n,):
        raise ShapeError(f"`{name}` must be ({n},); got {curve.shape}.")
    return curve


@styled
def rollouts_of_models(
    t: Mapping[str, ArrayLike],
    measured: Mapping[str, ArrayLike],
    samples: Mapping[str, ArrayLike],
    *,
    names: Sequence[str],
    units: Sequence[str],
    title: str,
    quaternion: slice | None = None,
) -> Figure:
    """Bands of several models from one start, and what was measured: one row per channel, one column per model.

    Args:
        t: Model -> time from the start [s], (T + 1,).
        measured: Model -> measured states at these times (T + 1, nx).
        samples: Model -> sampled states (P, T + 1, nx).
        names: Names of the states.
        units: Units of the states.
        title: What is shown.
        quaternion: Columns of a quaternion, drawn as roll, pitch and yaw in degrees.

    Returns:
        A figure of (channels, models) panels; the panels of a row share their axis, which a path that runs far away
        from what was measured leaves.

    Raises:
        ShapeError: the arrays do not fit together.
    """
    columns = []
    for model in t:
        times, m, s = (np.asarray(v[model], dtype=float) for v in (t, measured, samples))
        if s.ndim != 3 or m.shape != s.shape[1:] or times.shape != m.shape[:1] or len(names) != m.shape[1]:
            raise ShapeError(
                f"`measured[{model!r}]` must be (T+1, nx={len(names)}), `samples` (P, T+1, nx) and `t` (T+1,); got "
                f"{m.shape}, {s.shape} and {times.shape}."
            )
        columns.append((model, times, m, s))
    return grid_of_bands(columns, names, units, quaternion, title=title, limits=_limits)


def _limits(pairs: Sequence[tuple[Array, Array]]) -> tuple[float, float]:
    """Range of what was measured and of the widest bands, cut off where they go far beyond."""
    low, high = min(float(m.min()) for m, _ in pairs), max(float(m.max()) for m, _ in pairs)
    share = BANDS[0][0]
    ends = [np.quantile(s, [(1 - share) / 2, (1 + share) / 2], axis=0) for _, s in pairs]
    room = _ROOM * max(high - low, 1e-9)
    bottom = max(min(float(e[0].min()) for e in ends), low - room)
    top = min(max(float(e[1].max()) for e in ends), high + room)
    bottom, top = min(bottom, low), max(top, high)
    margin = 0.06 * max(top - bottom, 1e-9)
    return bottom - margin, top + margin
