"""What a data set holds: for multirotors speed and Euler angles (supplement, Figure 15), else all channels.

Thin lines: the 95 % quantile and the largest magnitude over all runs. Gaps break the curves and are marked.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data.quaternion import euler_zyx
from nsde_torch.plots import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from nsde_torch.data import DataSet, Run
    from nsde_torch.systems import System

# Roll, pitch, yaw of quaternions for people's eyes: q = q_z(yaw) q_y(pitch) q_x(roll), in degrees.
#
# Yaw and roll are continuous in time (no jump at 180 degrees). At a pitch of 90 degrees roll and yaw are not
# defined apart from each other.

ANGLES = ("roll", "pitch", "yaw")


def roll_pitch_yaw(q: Array) -> Array:
    """Angles (..., n, 3) [deg] of unit quaternions w x y z, body to world (..., n, 4), unwrapped along the times n."""
    angles = euler_zyx(np.asarray(q, dtype=float))
    angles[..., ::2] = np.unwrap(angles[..., ::2], axis=-2)
    degrees: Array = np.degrees(angles)
    return degrees


def turns_nearest(angles: Array, reference: Array) -> Array:
    """Angles (..., n, 3) [deg] moved by whole turns, so that they start nearest to the reference (n, 3)."""
    turns = np.round((angles[..., :1, :] - reference[..., :1, :]) / 360.0)
    moved: Array = angles - 360.0 * turns
    return moved


def with_angles(
    measured: Array, samples: Array, names: Sequence[str], units: Sequence[str], quaternion: slice
) -> tuple[Array, Array, list[str], list[str]]:
    """Measured (n, nx - 1) and sampled (P, n, nx - 1) states, names and units, with angles for the quaternion."""
    true = roll_pitch_yaw(measured[:, quaternion])
    drawn = turns_nearest(roll_pitch_yaw(samples[..., quaternion]), true)
    a, b = quaternion.start, quaternion.stop

    def joined(x: Array, angles: Array) -> Array:
        return np.concatenate([x[..., :a], angles, x[..., b:]], axis=-1)

    return (
        joined(measured, true),
        joined(samples, drawn),
        [*names[:a], *ANGLES, *names[b:]],
        [*units[:a], *("deg",) * 3, *units[b:]],
    )


COLUMNS = 4  # runs that have a column of their own; of more, the first ones are drawn


@style.styled
def data_summary(dataset: DataSet, system: System) -> Figure:
    """The data over time.

    For a system with velocity `v_x v_y v_z` and a quaternion: panels (speed, roll, pitch, yaw) by run. For others:
    states and inputs over time with all runs in one panel, and phase portraits.
    """
    runs = dataset.runs
    seconds = sum(float(r.t[b - 1] - r.t[a]) for r in runs for a, b in r.segments)
    title = f"{system.name}: {len(runs)} run{'s' * (len(runs) > 1)}, {seconds:.1f} s recorded"
    if system.quaternion is not None and {"v_x", "v_y", "v_z"} <= set(system.state_names):
        return _flights(runs, system, title)
    return _channels(dataset, system, title)


def speed_and_angles(x: Array, system: System) -> Array:
    """Speed [m/s], roll, pitch and yaw [deg] (n, 4) of states of a multirotor (n, nx)."""
    assert system.quaternion is not None
    v = [system.state_names.index(n) for n in ("v_x", "v_y", "v_z")]
    angles = roll_pitch_yaw(x[:, system.quaternion])
    angles[:, ::2] -= 360.0 * np.round(angles[:1, ::2] / 360.0)
    return np.column_stack([np.linalg.norm(x[:, v], axis=1), angles])


def _pieces(run: Run) -> list[tuple[Array, slice]]:
    """Time from the start of the run [s] and rows of each segment."""
    return [(run.t[a:b] - run.t[0], slice(a, b)) for a, b in run.segments]


def _mark_gaps(ax: Axes, run: Run) -> None:
    for (_, stop), (start, _) in zip(run.segments[:-1], run.segments[1:], strict=True):
        a, b = float(run.t[stop - 1] - run.t[0]), float(run.t[start] - run.t[0])
        ax.axvspan(a, b, color=style.VERMILLION, alpha=0.25, linewidth=0)
        ax.axvline(0.5 * (a + b), color=style.VERMILLION, linestyle=":", linewidth=1.2, gid="gap")


def _flights(runs: Sequence[Run], system: System, title: str) -> Figure:
    from matplotlib.lines import Line2D

    curves = [[speed_and_angles(run.x[rows], system) for _, rows in _pieces(run)] for run in runs]
    channels = (("speed", "m/s"), ("roll", "deg"), ("pitch", "deg"), ("yaw", "deg"))
    size = np.abs(np.concatenate([p for parts in curves for p in parts]))
    q95, top = np.quantile(size, 0.95, axis=0), size.max(axis=0)
    shown = min(len(runs), COLUMNS)
    if shown < len(runs):
        title += f"; the first {shown} drawn, lines over all"
    figure, axes = style.panels(4, shown, height=7.6, title=title, sharex="col", sharey="row")
    for c, run in enumerate(runs[:shown]):
        for k, (name, unit) in enumerate(channels):
            ax = axes[k, c]
            for (t, _), values in zip(_pieces(run), curves[c], strict=True):
                ax.plot(*style.thin(t, values[:, k]), color=style.BLUE, linewidth=0.9)
            for level, dash in ((q95[k], "--"), (top[k], "-")):
                for sign in (1,) if name == "speed" else (1, -1):
                    ax.axhline(sign * level, color=style.BLACK, linestyle=dash, linewidth=0.9)
            _mark_gaps(ax, run)
            low = 0.0 if name == "speed" else -1.15 * top[k]
            ax.set_ylim(low, max(1.15 * top[k], 1e-9))
            if c == 0:
                ax.set_ylabel(style.label(name, unit))
        axes[0, c].set_title(run.name, pad=18)
        axes[-1, c].set_xlabel("time [s]")
        axes[-1, c].set_xlim(0, float(run.t[-1] - run.t[0]))
    for k, (name, unit) in enumerate(channels):
        digits = 2 if unit == "m/s" else 0
        mark = "" if name == "speed" else "|"
        text = f"{mark}{name}{mark}: 95 % below {q95[k]:.{digits}f}, largest {top[k]:.{digits}f} {style.pretty(unit)}"
        axes[k, 0].annotate(text, (0.0, 1.02), xycoords="axes fraction", fontsize=8.5, color=style.BLACK)
    lines = {
        "measured": Line2D([], [], color=style.BLUE),
        "95 % of the magnitudes": Line2D([], [], color=style.BLACK, linestyle="--", linewidth=0.9),
        "largest magnitude": Line2D([], [], color=style.BLACK, linewidth=0.9),
    }
    if any(len(run.segments) > 1 for run in runs[:shown]):
        lines["gap in the recording"] = Line2D([], [], color=style.VERMILLION, linestyle=":")
    style.legend_below(figure, list(lines.values()), list(lines))
    figure.align_ylabels(list(axes[:, 0]))
    return figure


def _channels(dataset: DataSet, system: System, title: str) -> Figure:
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    runs = dataset.runs
    units: Mapping[str, str] = dict(zip(system.input_names, system.input_units, strict=True))
    names = [*system.state_names, *dataset.input_names]
    labels = [
        *(style.label(n, u) for n, u in zip(system.state_names, system.state_units, strict=True)),
        *(style.label(n, units.get(n, "")) for n in dataset.input_names),
    ]
    pairs = [(names.index(p), names.index(v)) for p, v, _ in system.position_derivatives]
    figure = Figure(figsize=(style.WIDTH, 1.2 + 1.35 * max(len(names), 2 * len(pairs))), layout="constrained")
    figure.suptitle(title)
    ratios = (1.7, 1.0) if pairs else (1.7,)
    parts = figure.subfigures(1, len(ratios), squeeze=False, width_ratios=ratios)
    few = len(runs) <= len(style.COLOURS)
    colours = list(style.COLOURS[: len(runs)]) if few else [style.BLUE] * len(runs)
    alpha = 0.9 if few else max(0.15, min(0.6, 12 / len(runs)))
    axes = parts[0, 0].subplots(len(names), 1, squeeze=False, sharex=True)[:, 0]
    mark = len(runs) <= COLUMNS
    for run, colour in zip(runs, colours, strict=True):
        table = np.concatenate([run.x, run.u], axis=1)
        for k, ax in enumerate(axes):
            for t, rows in _pieces(run):
                ax.plot(*style.thin(t, table[rows, k]), color=colour, alpha=alpha, linewidth=0.9)
            if mark:
                _mark_gaps(ax, run)
    for ax, text in zip(axes, labels, strict=True):
        ax.set_ylabel(text)
        style.few_ticks(ax, y=4)
    axes[0].set_xlim(0, max(float(r.t[-1] - r.t[0]) for r in runs))
    axes[-1].set_xlabel("time from the start of the run [s]")
    parts[0, 0].align_ylabels(list(axes))
    if pairs:
        portraits = parts[0, 1].subplots(len(pairs), 1, squeeze=False)[:, 0]
        for ax, (i, j) in zip(portraits, pairs, strict=True):
            _portrait(ax, runs, colours, alpha, i, j)
            ax.set(xlabel=labels[i], ylabel=labels[j])
    handles = [Line2D([], [], color=c) for c in colours] if few else []
    texts = [run.name for run in runs] if few else []
    if mark and any(len(run.segments) > 1 for run in runs):
        handles.append(Line2D([], [], color=style.VERMILLION, linestyle=":"))
        texts.append("gap in the recording")
    style.legend_below(figure, handles, texts)
    return figure


def _portrait(ax: Axes, runs: Sequence[Run], colours: Sequence[str], alpha: float, i: int, j: int) -> None:
    """Velocity against position, segment by segment; a dot marks each start."""
    for run, colour in zip(runs, colours, strict=True):
        for _, rows in _pieces(run):
            x = run.x[rows.start : rows.stop : max((rows.stop - rows.start) // 3000, 1)]
            ax.plot(x[:, i], x[:, j], color=colour, alpha=alpha, linewidth=0.8)
        ax.plot(run.x[0, i], run.x[0, j], "o", color=colour, markersize=3.0)
    ax.axhline(0, color=style.GREY, linewidth=0.6)
    ax.set_title("phase portrait (dot: start)")
