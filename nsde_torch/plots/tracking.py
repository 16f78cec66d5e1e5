"""Closed loops along a reference: the supplement's Figures 17 and 18, times of solves, and a film."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.plots.data_figure import roll_pitch_yaw, turns_nearest
from nsde_torch.plots.style import BLACK, BLUE, GREY, VERMILLION, key, model_look, panels, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_FRAMES, _TAIL = 20, 3.0  # of a film in a second, and length of the path behind the machine [s]


@styled
def tracking(t: Array, reference: Array, flights: Mapping[str, Array], *, title: str) -> Figure:
    """Speed, roll, pitch, yaw, altitude and error over time, and the path from above.

    Of times (T,) [s], states of the reference (T, 13), and by controller states of its machines (T, N, 13), the first
    of which is drawn boldest.
    """
    figure, axes = panels(4, 2, height=8.4, title=title)
    left = axes[:, 0]
    wanted = roll_pitch_yaw(reference[:, 6:10])
    altitude, error, path, ground = axes[:, 1]

    def curves(x: Array, angles: Array) -> list[Array]:
        return [np.linalg.norm(x[..., 3:6], axis=-1), *angles.T]

    names = ("speed [m/s]", "roll [°]", "pitch [°]", "yaw [°]")
    for ax, name, y in zip(left, names, curves(reference, wanted), strict=True):
        ax.plot(t, y, color=BLACK, linestyle="--", label="reference")
        ax.set_ylabel(name)
    altitude.plot(t, reference[:, 2], color=BLACK, linestyle="--")
    path.plot(reference[:, 0], reference[:, 1], color=BLACK, linestyle="--")
    for k, (name, x) in enumerate(flights.items()):
        colour = model_look(k)["color"]
        for n in range(min(x.shape[1], 20)):
            faint = {"color": colour, "alpha": 1.0 if n == 0 else 0.15, "linewidth": 1.2 if n == 0 else 0.7}
            angles = turns_nearest(roll_pitch_yaw(x[:, n, 6:10]), wanted)
            for ax, y in zip(left, curves(x[:, n], angles), strict=True):
                ax.plot(t, y, label=name if n == 0 else None, zorder=3 - k, **faint)
            altitude.plot(t, x[:, n, 2], zorder=3 - k, **faint)
            off = np.linalg.norm(x[:, n, :3] - reference[:, :3], axis=1)
            error.plot(t, 100.0 * off, zorder=3 - k, **faint)
            path.plot(x[:, n, 0], x[:, n, 1], zorder=3 - k, **faint)
        rms = np.sqrt(np.square(x[..., :3] - reference[:, None, :3]).sum(-1).mean(0))
        mean = 100.0 * float(np.nanmean(rms))
        ground.barh(k, mean, color=colour)
        ground.text(mean, k, f" {mean:.1f} cm", va="center")
    altitude.set_ylabel("altitude [m]")
    error.set_ylabel("position error [cm]")
    path.set(xlabel="p_x [m]", ylabel="p_y [m]")
    path.set_aspect("equal", adjustable="datalim")
    ground.set_yticks(range(len(flights)), list(flights))
    ground.invert_yaxis()
    ground.margins(x=0.25)
    ground.set_xlabel("RMSE of the position [cm]")
    for ax in (left[3], error):
        ax.set_xlabel("time [s]")
    key(figure, left[0])
    return figure


@styled
def states_over_time(
    t: Array,
    reference: Array,
    runs: Mapping[str, Array],
    inputs: Mapping[str, Array],
    columns: Mapping[str, str],
    *,
    title: str,
) -> Figure:
    """States and inputs of any machine over time, beside the reference.

    Of times (T,) [s], states of the reference (T, nx), by controller states (T, N, nx) and inputs (T, N, nu) of its
    machines, and units of the `columns` by name.
    """
    nx, count = reference.shape[1], len(columns)
    rows = -(-count // 2)
    figure, axes = panels(rows, 2, height=1.8 * rows + 1.0, title=title)
    axes = axes.T.reshape(-1)
    for k, (ax, (name, unit)) in enumerate(zip(axes, columns.items(), strict=False)):
        ax.set_ylabel(f"{name} [{unit}]")
        if k < nx:
            ax.plot(t, reference[:, k], color=BLACK, linestyle="--", label="reference")
        for number, label in enumerate(runs):
            y = runs[label][:, :, k] if k < nx else inputs[label][:, :, k - nx]
            for n in range(min(y.shape[1], 20)):
                look: dict[str, Any] = {"color": model_look(number)["color"], "label": label}
                if n:
                    look |= {"label": None, "alpha": 0.15}
                ax.plot(t, y[:, n], linewidth=0.7 if n else 1.2, **look)
    for ax in axes[count:]:
        ax.set_axis_off()
    for ax in (axes[rows - 1], axes[count - 1]):
        ax.set_xlabel("time [s]")
    key(figure, axes[0])
    return figure


@styled
def solve_times(solve_ms: Mapping[str, Array], *, title: str) -> Figure:
    """Histogram of the times of solves [ms] by the name of the controller."""
    figure, axes = panels(1, 1, height=3.2, title=title)
    ax = axes[0, 0]
    positive = {k: v[v > 0] for k, v in solve_ms.items() if (v > 0).any()}
    if positive:
        low = min(float(v.min()) for v in positive.values())
        high = max(float(v.max()) for v in positive.values())
        bins = np.geomspace(low, max(high, 1.01 * low), 60)
        for k, (name, v) in enumerate(positive.items()):
            colour = model_look(k)["color"]
            middle, late = np.percentile(v, [50, 99])
            text = f"{name}: p50 {middle:.2f}, p99 {late:.2f} ms"
            ax.hist(v, bins=bins, histtype="step", color=colour, label=text)
        ax.set_xscale("log")
        ax.legend()
    ax.set(xlabel="time of a solve [ms]", ylabel="solves")
    return figure


@styled
def film(t: Array, reference: Array, x: Array, file: Path) -> Path:
    """A film of one flight from above and from the side, as GIF or (with ffmpeg) MP4, as the file ends.

    Of times (T,) [s] and states (T, 13) of the reference and the machine.
    """
    from matplotlib.animation import FFMpegWriter, PillowWriter
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure, axes = panels(1, 2, height=4.6, title="")
    FigureCanvasAgg(figure)
    top, side = axes[0]
    for ax, column, name in ((top, 1, "p_y [m]"), (side, 2, "p_z [m]")):
        ax.plot(reference[:, 0], reference[:, column], color=GREY, linestyle="--", linewidth=0.8)
        ax.set_xlabel("p_x [m]")
        ax.set_ylabel(name)
        ax.set_aspect("equal", adjustable="datalim")
    middle = float(reference[:, 2].mean())
    side.set_ylim(middle - 1.5, middle + 1.5)
    moving = [
        (ax, column, ax.plot([], [], color=BLUE)[0], ax.plot([], [], "o", color=VERMILLION)[0])
        for ax, column in ((top, 1), (side, 2))
    ]
    dt = float(t[1] - t[0])
    step, back = max(1, round(1.0 / (_FRAMES * dt))), round(_TAIL / dt)
    writer = (FFMpegWriter if file.suffix == ".mp4" else PillowWriter)(fps=_FRAMES)
    with writer.saving(figure, str(file), dpi=70):
        for k in range(0, len(t), step):
            for _, column, line, dot in moving:
                line.set_data(x[max(0, k - back) : k + 1, 0], x[max(0, k - back) : k + 1, column])
                dot.set_data(x[k : k + 1, 0], x[k : k + 1, column])
            off = 100.0 * float(np.linalg.norm(x[k, :3] - reference[k, :3]))
            figure.suptitle(f"{t[k]:.1f} s, {np.linalg.norm(x[k, 3:6]):.1f} m/s, {off:.0f} cm off")
            writer.grab_frame()
    return file
