"""What a model predicts along one run, beside what was measured."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from nsde_torch.arrays import Array
from nsde_torch.data import Run, Windows
from nsde_torch.errors import ConfigError, ShapeError
from nsde_torch.models.before import sampled
from nsde_torch.plots.euler import with_angles
from nsde_torch.shown import data_frame, preformatted

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from nsde_torch.models.model import Model

_BATCH = 64  # starts that are sampled at once


@dataclass(frozen=True, eq=False)
class RunPrediction:
    """Predictions from one start after the other along a run; each begins at the measured state.

    Args:
        run: Name of the run.
        horizon: Longest time from a start [s].
        level: Share of the measurements that the intervals should hold.
        names: Names of the channels: the states, a quaternion as roll, pitch and yaw.
        units: Units of the channels; angles of a quaternion are in degrees.
        t: Logged times [s] (n,).
        ahead: Times since the start [s] (n,); 0 where the next prediction begins.
        measured: What was measured (n, channels).
        median: Median of the sampled paths (n, channels).
        low, high: Ends of the central interval (n, channels).
    """

    run: str
    horizon: float
    level: float
    names: tuple[str, ...]
    units: tuple[str, ...]
    t: Array
    ahead: Array
    measured: Array
    median: Array
    low: Array
    high: Array

    @property
    def coverage(self) -> dict[str, float] | None:
        """Share of the measurements after a start inside the interval, by channel; None for a model without noise."""
        if np.array_equal(self.low, self.high):
            return None
        inside = ((self.low <= self.measured) & (self.measured <= self.high))[self.ahead > 0].mean(0)
        return dict(zip(self.names, inside.tolist(), strict=True))

    def __repr__(self) -> str:
        starts, level = int((self.ahead == 0).sum()), f"{100 * self.level:.4g} %"
        return (
            f"<RunPrediction of {self.run!r}: {starts} starts, {self.horizon:.4g} s each, {level} intervals>"
        )

    def __str__(self) -> str:
        if self.coverage is None:
            return f"{self!r}\nno intervals: the model has no noise"
        inside = ", ".join(f"{name} {share:.0%}" for name, share in self.coverage.items())
        return f"{self!r}\nmeasurements inside: {inside}"

    def _repr_html_(self) -> str:
        return preformatted(str(self))

    def to_frame(self) -> Any:
        """A `pandas.DataFrame` by time: `t`, `ahead`, and NAME, NAME_median, NAME_low, NAME_high of each channel."""
        columns: dict[str, Array] = {"t": self.t, "ahead": self.ahead}
        for k, name in enumerate(self.names):
            for end, table in (
                ("", self.measured),
                ("_median", self.median),
                ("_low", self.low),
                ("_high", self.high),
            ):
                columns[name + end] = table[:, k]
        return data_frame(columns)

    def plot(self) -> Figure:
        """A matplotlib figure with one panel per channel: what was measured, the median and the interval."""
        from nsde_torch.plots.evolution import PredictionBand, evolution

        start = self.ahead[:, None] == 0  # a line ends before the next one begins
        band = PredictionBand(
            "predicted", *(np.where(start, np.nan, v) for v in (self.median, self.low, self.high))
        )
        return evolution(
            self.t,
            self.measured,
            [band],
            names=self.names,
            units=self.units,
            title=f"Run {self.run}: predicted {self.horizon:.4g} s ahead from each start, under the logged inputs",
            truth_name="measured",
            interval=f"{100 * self.level:.4g} %",
            columns=1 if len(self.names) < 5 else 2,
        )


@torch.no_grad()
def predict(
    model: Model, run: Run, *, horizon: float, level: float, particles: int, seed: int
) -> RunPrediction:
    """See `Model.predict`."""
    system, dt, like = model.system, model.spec.dt, model.clock_scale
    if not isinstance(run, Run):
        raise ConfigError(f"`run` must be one run of a data set, such as data[0]; got {type(run).__name__}.")
    if run.x.shape[1] != system.nx:
        raise ShapeError(
            f"`run` must be of the model's system, {system.name!r}, with {system.nx} states; got {run!r}."
        )
    if not 0 < level < 1:
        raise ConfigError(f"`level` must lie between 0 and 1; got {level!r}.")
    if not horizon >= dt:
        raise ConfigError(f"`horizon` must be at least the model's step of {dt:.4g} s; got {horizon!r}.")
    windows = Windows([run], dt, round(horizon / dt), dtype=like.dtype, device=like.device)
    generator = torch.Generator().manual_seed(seed)
    ahead = dt * np.arange(windows.horizon + 1)
    names, units = list(system.state_names), list(system.state_units)
    parts = []
    for indices in windows.starts(windows.span * windows.dt).split(_BATCH):
        x, samples, t0 = sampled(model, windows, indices, particles=particles, generator=generator)
        for k, first in enumerate(t0.tolist()):
            shown = (x[k].cpu().numpy(), samples[:, k].cpu().numpy(), system.state_names, system.state_units)
            if system.quaternion is not None:
                measured, paths, names, units = with_angles(*shown, system.quaternion)
            else:
                measured, paths = shown[:2]
            # a new path lies below each of the `particles` with the same probability, as where models are scored
            ends = np.quantile(paths, ((1 - level) / 2, 0.5, (1 + level) / 2), axis=0, method="weibull")
            parts.append((first + ahead, ahead, measured, *ends))
    t, since, measured, low, median, high = (
        np.concatenate(p).astype(float) for p in zip(*parts, strict=True)
    )
    length = windows.horizon * dt
    return RunPrediction(
        run.name, length, level, tuple(names), tuple(units), t, since, measured, median, low, high
    )
