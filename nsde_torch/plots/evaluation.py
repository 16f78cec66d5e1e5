"""Figures of trained models against their data."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from nsde_torch.arrays import Array
from nsde_torch.plots import style
from nsde_torch.plots.data_figure import with_angles

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


TARGET = (0.90, 0.85, 0.95)  # nominal level and the range in which its empirical share should lie
Looks = Mapping[str, Mapping[str, Any]]


@style.styled
def calibration_curve(
    nominal: ArrayLike,
    empirical: Mapping[str, ArrayLike],
    *,
    horizons: Sequence[float] = (),
    per_horizon: Mapping[str, ArrayLike] | None = None,
    title: str = "Share of held-out measurements inside predicted intervals",
) -> Figure:
    """Empirical coverage by group against the probabilities of central intervals, (k,) each.

    Where given, also the coverage of 90 % intervals by group (h,) at each horizon (h,) [s].
    """
    later = per_horizon or {}
    figure, axes = style.panels(1, 2 if later else 1, height=4.6, title=title)
    groups = dict.fromkeys([*empirical, *later])
    marks = zip(groups, cycle(style.COLOURS), cycle(style.DASHES), cycle(style.MARKS), strict=False)
    looks = {g: {"color": c, "linestyle": line, "marker": m, "markersize": 4.5} for g, c, line, m in marks}
    _coverage(axes[0, 0], nominal, empirical, looks, target="85–95 % at 90 %")
    axes[0, 0].set(xlabel="nominal probability [–]", ylabel="empirical share [–]")
    style.key(figure, axes[0, 0], columns=6)
    if later:
        _coverage_later(axes[0, 1], horizons, later, looks)
        axes[0, 1].set_ylabel("share inside 90 % intervals [–]")
    return figure


@style.styled
def calibration_of_models(
    nominal: ArrayLike,
    empirical: Mapping[str, Mapping[str, ArrayLike]],
    *,
    horizons: Sequence[float],
    per_horizon: Mapping[str, Mapping[str, ArrayLike]],
    order: Sequence[str] | None = None,
    title: str = "Share of measurements inside predicted intervals",
) -> Figure:
    """The same by model and then by group: a column of panels for each group, a curve for each model.

    `order` has the names in the order of other figures, these among them, so that a model has one colour in all.
    """
    groups = list(dict.fromkeys(g for curves in empirical.values() for g in curves))
    figure, axes = style.panels(2, len(groups), height=5.6, title=title, sharey="row")
    places = list(order or empirical)
    looks = {name: {**style.model_look(places.index(name)), "markersize": 4} for name in empirical}
    for (top, bottom), group in zip(axes.T, groups, strict=True):
        _coverage(top, nominal, {name: by[group] for name, by in empirical.items()}, looks)
        top.set(title=group, xlabel="nominal probability [–]")
        _coverage_later(bottom, horizons, {name: by[group] for name, by in per_horizon.items()}, looks)
        if len(groups) > 2:
            bottom.tick_params(axis="x", labelsize=7)
    axes[0, 0].set_ylabel("empirical share [–]")
    axes[1, 0].set_ylabel("inside 90 % intervals [–]")
    style.key(figure, axes[0, 0])
    return figure


def _coverage(
    ax: Axes, nominal: ArrayLike, curves: Mapping[str, ArrayLike], looks: Looks, target: str | None = None
) -> None:
    levels, (level, low, high) = np.asarray(nominal, dtype=float), TARGET
    rising = np.argsort(levels)
    ax.plot([0, 1], [0, 1], color=style.GREY, linewidth=1.0, label="ideal")
    shade: dict[str, Any] = {"color": style.BLACK, "alpha": 0.15, "linewidth": 0, "label": target}
    ax.fill_between([level - 0.02, level + 0.02], low, high, **shade)
    for name, shares in curves.items():
        ax.plot(levels[rising], np.asarray(shares, dtype=float)[rising], label=name, **looks[name])
    ax.set(xlim=(0, 1), ylim=(0, 1))
    ax.set_aspect("equal")


def _coverage_later(
    ax: Axes, horizons: Sequence[float], curves: Mapping[str, ArrayLike], looks: Looks
) -> None:
    level, low, high = TARGET
    ax.axhspan(low, high, color=style.BLACK, alpha=0.12, linewidth=0)
    ax.axhline(level, color=style.GREY, linewidth=1.0)
    for name, shares in curves.items():
        ax.plot(horizons, np.asarray(shares, dtype=float), **looks[name])
    style.seconds_axis(ax, horizons)
    ax.set_ylim(0, 1.02)


BANDS = ((0.95, "#d6e6f2"), (0.90, "#a9cde6"), (0.50, "#66a9d4"))
"""Central intervals and their colours, widest first."""
_ROOM = 4.0  # how far a band may go beyond the measured range, in such ranges


@style.styled
def rollout_bands(
    columns: Mapping[str, tuple[Array, Array, Array]],
    *,
    names: Sequence[str],
    units: Sequence[str],
    title: str,
    quaternion: slice | None = None,
    shared: bool = False,
) -> Figure:
    """Bands of sampled rollouts and what was measured: a row of panels for each channel, a column for each heading.

    Args:
        columns: Heading, a start or a model -> times from the start (T + 1,) [s], measured states (T + 1, nx) and
            sampled ones (P, T + 1, nx).
        title: What is shown; say here what the inputs see of the future, if anything.
        quaternion: Columns of a quaternion, drawn as roll, pitch and yaw in degrees.
        shared: Whether the panels of a row share their axis, which a path that runs far from what was measured leaves.
    """
    parts = []
    for t, measured, samples in columns.values():
        shown = (measured, samples, list(names), list(units))
        parts.append((t, *(shown if quaternion is None else with_angles(*shown, quaternion))))
    rows = parts[0][1].shape[1]
    height = 1.0 + rows * (2.0 if rows <= 2 else 1.45 if rows <= 6 else 1.05)
    share = "row" if shared else False
    figure, axes = style.panels(rows, len(parts), height=height, title=title, sharex=True, sharey=share)
    for column, (heading, (t, m, s, channels, channel_units)) in enumerate(zip(columns, parts, strict=True)):
        for k, ax in enumerate(axes[:, column]):
            for level, colour in BANDS:
                low, high = np.quantile(s[..., k], [(1 - level) / 2, (1 + level) / 2], axis=0)
                ax.fill_between(t, low, high, color=colour, linewidth=0, label=f"{100 * level:.0f} %")
            ax.plot(t, np.median(s[..., k], axis=0), color=style.BLUE, label="median")
            ax.plot(t, m[:, k], color=style.BLACK, linewidth=1.2, linestyle=(0, (4, 1.5)), label="measured")
            style.few_ticks(ax, y=4)
            if column == 0 or not shared:
                ax.set_xlim(t[0], t[-1])
            if column == 0:
                ax.set_ylabel(style.label(channels[k], channel_units[k]))
        axes[0, column].set_title(heading)
        axes[-1, column].set_xlabel("time from the start [s]")
    for k in range(rows) if shared else ():
        axes[k, 0].set_ylim(*_limits([(part[1][:, k], part[2][..., k]) for part in parts]))
    figure.align_ylabels(list(axes[:, 0]))
    style.key(figure, axes[0, 0])
    return figure


def _limits(pairs: Sequence[tuple[Array, Array]]) -> tuple[float, float]:
    """Range of the measurements and of the widest bands, cut off where they go far beyond."""
    low, high = min(float(m.min()) for m, _ in pairs), max(float(m.max()) for m, _ in pairs)
    share = BANDS[0][0]
    ends = [np.quantile(s, [(1 - share) / 2, (1 + share) / 2], axis=0) for _, s in pairs]
    room = _ROOM * max(high - low, 1e-9)
    bottom = max(min(float(e[0].min()) for e in ends), low - room)
    top = min(max(float(e[1].max()) for e in ends), high + room)
    bottom, top = min(bottom, low), max(top, high)
    margin = 0.06 * max(top - bottom, 1e-9)
    return bottom - margin, top + margin


TRAIN_SHOWN, HELD_OUT_SHOWN = 400, 150  # data points drawn; more hide the map and each other


@dataclass(frozen=True)
class DistanceSlice:
    """eta on a grid over two features."""

    x: ArrayLike  # first feature on the grid (n,)
    y: ArrayLike  # second feature on the grid (m,)
    eta: ArrayLike  # distance (m, n), rows along y
    x_label: str  # name and unit of the first feature
    y_label: str  # name and unit of the second feature
    train: ArrayLike  # training data in the two features (N, 2)
    # held-out data in the two features (M, 2)
    held_out: ArrayLike = field(default_factory=lambda: np.zeros((0, 2)))


def slice_grid(
    features: ArrayLike, pair: tuple[int, int], *, size: int = 80, margin: float = 1.0
) -> tuple[Array, Array, Array]:
    """Points at which eta is to be evaluated: a grid over two features (N, nf), the others at their median.

    `margin` is the room on each side of the data, in widths of the data. Returns points (size * size, nf), x (size,)
    and y (size,); `eta.reshape(size, size)` fits `DistanceSlice`.
    """
    rows = np.asarray(features, dtype=float)
    axes = []
    for k in pair:
        low, high = float(rows[:, k].min()), float(rows[:, k].max())
        room = margin * max(high - low, 1e-6)
        axes.append(np.linspace(low - room, high + room, size))
    points = np.tile(np.median(rows, axis=0), (size * size, 1))
    grid_x, grid_y = np.meshgrid(axes[0], axes[1])
    points[:, pair[0]], points[:, pair[1]] = grid_x.ravel(), grid_y.ravel()
    return points, axes[0], axes[1]


@style.styled
def distance_map(
    slices: Sequence[DistanceSlice],
    *,
    title: str = "Distance η from the training data (other features at their median)",
) -> Figure:
    """Maps of eta, with contours at 0.1, 0.5 and 0.9 and a part of the data on them."""
    row = 4.6 if len(slices) == 1 else 3.2
    figure, axes = style.grid(len(slices), columns=3, row=row, spare=0.9, title=title)
    for ax, part in zip(axes, slices, strict=True):
        x, y, eta = (np.asarray(v, dtype=float) for v in (part.x, part.y, part.eta))
        image = ax.pcolormesh(x, y, eta, cmap="cividis", vmin=0, vmax=1, shading="gouraud", rasterized=True)
        crossed = [v for v in (0.1, 0.5, 0.9) if eta.min() < v < eta.max()]
        if crossed:
            lines = ax.contour(x, y, eta, levels=crossed, colors="white", linewidths=0.9)
            ax.clabel(lines, fmt="%g", fontsize=8)
        train, held = style.some(part.train, TRAIN_SHOWN), style.some(part.held_out, HELD_OUT_SHOWN)
        ax.scatter(*train.T, s=5, color="white", edgecolors=style.BLACK, linewidths=0.3, label="training")
        if len(held):
            ax.scatter(*held.T, s=14, marker="x", color=style.VERMILLION, linewidths=0.8, label="held out")
        ax.set(xlabel=part.x_label, ylabel=part.y_label, xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
        ax.grid(visible=False)
    figure.colorbar(image, ax=figure.axes, label="η [–]: 0 on the data, 1 far away", pad=0.02)
    style.key(figure, axes[0])
    return figure


@dataclass(frozen=True)
class PredictionBand:
    """What a model predicts; not-a-number where it has diverged."""

    name: str
    mean: Array  # mean (T + 1, n)
    # ends of its interval (T + 1, n); None for a model without intervals
    low: Array | None = None
    high: Array | None = None


@style.styled
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

    Of times (T,) [s] and true or measured states (T, n); the first prediction lies on top.
    """
    n = truth.shape[1]
    rows = -(-n // columns)
    figure, axes = style.panels(
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
            colour, dash = style.COLOURS[i % 6], style.DASHES[i % 6]
            if p.low is not None and p.high is not None:
                band = {"color": colour, "alpha": 0.22, "linewidth": 0, "label": f"{interval} {p.name}"}
                ax.fill_between(t, p.low[:, k], p.high[:, k], **band)
            ax.plot(t, p.mean[:, k], color=colour, linestyle=dash, label=p.name)
        ax.plot(t, truth[:, k], color=style.BLACK, linewidth=1.2, linestyle=(0, (4, 1.5)), label=truth_name)
        centre = 0.5 * float(truth[:, k].min() + truth[:, k].max())
        room = 0.95 * max(float(spans[k]), 1e-9)
        ax.set_ylim(centre - room, centre + room)  # a model that diverges leaves the panel
        ax.set_xlim(t[0], t[-1])
        ax.set_ylabel(style.label(names[k], units[k]))
        style.few_ticks(ax, y=5)
    for ax in axes[-1]:
        ax.set_xlabel("time [s]")
    style.key(figure, axes[0, 0], columns=4)
    return figure


_BASELINES: dict[str, dict[str, Any]] = {
    "hold": {"color": style.GREY, "linestyle": "--", "marker": "x", "label": "hold the last state"},
    "constant_velocity": {
        "color": style.ORANGE,
        "linestyle": "-.",
        "marker": "^",
        "label": "constant velocity",
    },
}


@style.styled
def horizon_errors(
    horizons: Sequence[float],
    errors: Mapping[str, Mapping[str, ArrayLike]],
    units: Mapping[str, str],
    *,
    title: str = "Error on held-out runs (RMSE)",
) -> Figure:
    """Error at each horizon (h,) [s] by model and then by group: one panel per group, one curve per model.

    The names `hold` and `constant_velocity` are drawn as baselines.
    """
    groups = list(dict.fromkeys(g for curves in errors.values() for g in curves))
    figure, axes = style.grid(len(groups), columns=2, row=2.5, spare=0.9, title=title)
    models = [m for m in errors if m not in _BASELINES]
    looks = {name: {**style.model_look(k), "label": name} for k, name in enumerate(models)}
    looks |= {name: look for name, look in _BASELINES.items() if name in errors}
    for ax, group in zip(axes, groups, strict=True):
        drawn = []
        for name, look in looks.items():
            if group in errors[name]:
                drawn.append(np.asarray(errors[name][group], dtype=float))
                ax.plot(horizons, drawn[-1], markersize=4.5, **look)
        both = np.concatenate(drawn)
        both = both[np.isfinite(both)]
        if len(both) and both.min() > 0:
            style.plain_logarithm(ax)
        style.seconds_axis(ax, horizons)
        ax.set_ylabel(f"{group} error [{style.pretty(units[group])}]")
    style.key(figure, axes[0])
    return figure


_NOT_TERMS = ("step", "loss", "validation")


def _column(history: Sequence[Mapping[str, float | None]], name: str) -> tuple[Array, Array]:
    rows = [(r["step"], r[name]) for r in history if r.get(name) is not None]
    table = np.array(rows, dtype=float).reshape(-1, 2)
    table = table[np.isfinite(table[:, 1])]
    return table[:, 0], table[:, 1]


def _scale(axes: Axes, values: Sequence[Array]) -> None:
    """Logarithmic if all values are positive and span more than a factor of five; linear otherwise."""
    both = np.concatenate([np.zeros(0), *values])
    if len(both) and both.min() > 0 and both.max() > 5 * both.min():
        style.plain_logarithm(axes)


def _smooth(y: Array) -> Array:
    """Running median over about a fiftieth of the curve: single batches jump."""
    from scipy.ndimage import median_filter

    return np.asarray(median_filter(y, max(len(y) // 50, 1) | 1, mode="nearest"))


@style.styled
def learning_curves(
    history: Sequence[Mapping[str, float | None]],
    *,
    kept: int | None = None,
    title: str = "Loss on training batches and held-out windows",
) -> Figure:
    """Loss and validation score on the left, the terms of the loss on the right.

    Args:
        history: One row per step with `step` and any of `loss`, `validation` and the terms; a missing or
            None entry is a step at which that was not computed.
        kept: Step of the model that was kept; default: that of the smallest validation score.

    Example:
        >>> figure = learning_curves([{"step": 0, "loss": 2.0}, {"step": 1, "loss": 1.0}])
    """
    terms = dict.fromkeys(k for row in history for k in row if k not in _NOT_TERMS)
    curves = {name: _column(history, name) for name in terms}
    drawn = {name: curve for name, curve in curves.items() if len(curve[0])}
    figure, axes = style.panels(1, 2 if drawn else 1, height=3.6, title=title)
    left: Axes = axes[0, 0]
    step, loss = _column(history, "loss")
    if len(step):
        if len(step) >= 150:
            left.plot(step, loss, color=style.BLUE, alpha=0.25, linewidth=0.7)
        left.plot(step, _smooth(loss), color=style.BLUE, label="training batch")
    step, score = _column(history, "validation")
    if len(step):
        left.plot(step, score, color=style.VERMILLION, marker="o", markersize=3.5, label="held-out windows")
        kept = int(step[score.argmin()]) if kept is None else kept
    _scale(left, [loss, score])
    left.set_ylabel("loss [–]")
    for k, (name, (step, value)) in enumerate(drawn.items()):
        look = {"color": style.COLOURS[k % 6], "linestyle": style.DASHES[k % 6]}
        axes[0, 1].plot(step, _smooth(value), label=name, **look)
    if drawn:
        _scale(axes[0, 1], [value[value != 0] for _, value in drawn.values()])
        axes[0, 1].set_ylabel("term of the loss [–]")
    for ax in axes.flat:
        if kept is not None:
            ax.axvline(kept, color=style.BLACK, linestyle=":", linewidth=1.2, label=f"kept: step {kept}")
        ax.set_xlabel("gradient step")
        ax.set_xlim(min(float(r["step"] or 0) for r in history), None)
        ax.legend(labelcolor=style.BLACK, loc="best")
        ax.tick_params(color=style.GREY)
    return figure


# --- reward of a policy while it learns -----------------------------------------------------------------------------

Curve = Sequence[Mapping[str, float]]

_TITLE = 14  # letters on a line above a panel


@style.styled
def policy_rewards(
    curves: Mapping[str, Sequence[Curve]],
    *,
    random: float | None = None,
    truth: float | None = None,
    limited: float | None = None,
    title: str = "Reward of policies while they learn",
) -> Figure:
    """Mean over seeds, and one standard deviation over seeds to each side, on the truth and where they learn.

    Curves are by the name of an environment, one per seed: rows with `interactions`, `truth_reward` and
    `environment_reward`. `limited` is the reward of policies that had no more of the truth than the
    models' training data.
    """
    figure, axes = style.panels(1, len(curves), height=3.8, title=title, sharey=True)
    most = max(map(len, curves.values()))
    handles: dict[str, object] = {}
    for ax, (name, runs) in zip(axes[0], curves.items(), strict=True):
        for column, colour, dash, label in (
            ("environment_reward", style.GREY, ":", "in the environment it learns in"),
            ("truth_reward", style.BLUE, "-", "on the truth"),
        ):
            n, mean, std = _over_seeds(runs, column)
            handles[label] = ax.plot(n / 1e3, mean, color=colour, linestyle=dash)[0]
            if len(runs) > 1:
                ax.fill_between(n / 1e3, mean - std, mean + std, color=colour, alpha=0.2, linewidth=0)
        for value, colour, label in (
            (truth, style.GREEN, "trained on the truth"),
            (limited, style.VERMILLION, "trained on as much of the truth as the models"),
            (random, style.BLACK, "random actions"),
        ):
            if value is not None:
                handles[label] = ax.axhline(value, color=colour, linestyle="--", linewidth=1.0)
        shown = textwrap.fill(name, _TITLE)
        ax.set_title(shown if most == 1 else f"{shown}\n{len(runs)} seed{'s' * (len(runs) > 1)}")
        ax.set_xlabel("interactions / 1000")
    axes[0, 0].set_ylabel("reward per episode" + ("\nmean ± std over seeds" if most > 1 else ""))
    style.legend_below(figure, list(handles.values()), list(handles))
    return figure


def _over_seeds(runs: Sequence[Curve], column: str) -> tuple[Array, Array, Array]:
    """Mean and standard deviation over seeds at the interactions of the shortest curve."""
    shortest = min(runs, key=len)
    n = np.array([row["interactions"] for row in shortest], dtype=float)
    values = []
    for run in runs:
        at = np.array([row["interactions"] for row in run], dtype=float)
        values.append(np.interp(n, at, np.array([row[column] for row in run], dtype=float)))
    table = np.array(values)
    return n, table.mean(0), table.std(0)
