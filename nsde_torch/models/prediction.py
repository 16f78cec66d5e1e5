"""What a model predicts along one run, beside what was measured."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from nsde_torch.arrays import Array
from nsde_torch.data import Run, Windows
from nsde_torch.errors import ConfigError, DataError, ShapeError
from nsde_torch.models.model import sampled
from nsde_torch.plots.data_figure import with_angles
from nsde_torch.plots.evaluation import PredictionBand, evolution
from nsde_torch.shown import data_frame, preformatted

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from nsde_torch.models.model import Model

_BATCH = 64  # starts that are sampled at once


@dataclass(frozen=True, eq=False)
class RunPrediction:
    """Predictions from one start after the other along a run; each begins at the measured state."""

    run: str  # name of the run
    horizon: float  # longest time from a start [s]
    level: float  # share of the measurements that the intervals should hold
    names: tuple[str, ...]  # names of the channels: the states, a quaternion as roll, pitch and yaw
    units: tuple[str, ...]  # units of the channels; angles of a quaternion are in degrees
    t: Array  # logged times [s] (n,)
    ahead: Array  # times since the start [s] (n,); 0 where the next prediction begins
    measured: Array  # what was measured (n, channels)
    low: Array  # lower ends of the central intervals of the sampled paths (n, channels)
    median: Array  # their middle (n, channels)
    high: Array  # their upper ends (n, channels)

    @property
    def coverage(self) -> dict[str, float] | None:
        """Share of the measurements after a start inside the interval, by channel; None for a model without noise."""
        if np.array_equal(self.low, self.high):
            return None
        inside = ((self.low <= self.measured) & (self.measured <= self.high))[self.ahead > 0].mean(0)
        return dict(zip(self.names, inside.tolist(), strict=True))

    def __repr__(self) -> str:
        size = f"{int((self.ahead == 0).sum())} starts, {self.horizon:.4g} s each"
        return f"<RunPrediction of {self.run!r}: {size}, {100 * self.level:.4g} % intervals>"

    def __str__(self) -> str:
        inside = ", ".join(f"{name} {share:.0%}" for name, share in (self.coverage or {}).items())
        return f"{self!r}\nmeasurements inside: {inside or 'no intervals, as the model has no noise'}"

    def _repr_html_(self) -> str:
        return preformatted(str(self))

    def to_frame(self) -> Any:
        """A `pandas.DataFrame` by time: `t`, `ahead`, and NAME, NAME_low, NAME_median, NAME_high of each channel."""
        tables = {"": self.measured, "_low": self.low, "_median": self.median, "_high": self.high}
        channels = {f"{n}{end}": t[:, k] for k, n in enumerate(self.names) for end, t in tables.items()}
        return data_frame({"t": self.t, "ahead": self.ahead, **channels})

    def plot(self) -> Figure:
        """A matplotlib figure with one panel per channel: what was measured, the median and the interval."""
        start = self.ahead[:, None] == 0  # a line ends before the next one begins
        drawn = [np.where(start, np.nan, table) for table in (self.median, self.low, self.high)]
        return evolution(
            self.t,
            self.measured,
            [PredictionBand("predicted", *drawn)],
            names=self.names,
            units=self.units,
            title=f"Run {self.run}: predicted {self.horizon:.4g} s ahead from each start, under the logged inputs",
            truth_name="measured",
            interval=f"{100 * self.level:.4g} %",
            columns=1 if len(self.names) < 5 else 2,
        )


@torch.no_grad()
def predict(
    model: Model, run: Run, *, horizon: float, level: float, particles: int, seed: int, inputs: str
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
    if inputs not in ("logged", "replayed", "set"):
        raise ConfigError(f"`inputs` must be logged, replayed or set; got {inputs!r}.")
    if not horizon >= dt:
        raise ConfigError(f"`horizon` must be at least the model's step of {dt:.4g} s; got {horizon!r}.")
    windows = Windows([run], dt, round(horizon / dt), dtype=like.dtype, device=like.device)
    generator, ahead = torch.Generator().manual_seed(seed), dt * np.arange(windows.horizon + 1)
    further = {} if inputs == "logged" else {"replayed": inputs == "replayed"}
    names, units, parts = list(system.state_names), list(system.state_units), []
    for indices in windows.starts(windows.span * windows.dt).split(_BATCH):
        x, samples, t0 = sampled(model, windows, indices, particles=particles, generator=generator, **further)
        for k, first in enumerate(t0.tolist()):
            measured, paths = x[k].cpu().numpy(), samples[:, k].cpu().numpy()
            if (q := system.quaternion) is not None:
                shown = with_angles(measured, paths, system.state_names, system.state_units, q)
                measured, paths, names, units = shown
            # a new path lies between any two of the others with the same probability, as where models are scored
            ends = np.quantile(paths, ((1 - level) / 2, 0.5, (1 + level) / 2), axis=0, method="weibull")
            parts.append((first + ahead, ahead, measured, *ends))
    if not parts:
        raise DataError(
            f"run {run.name!r}: no start has {horizon:.4g} s without a gap after it; shorten `horizon`."
        )
    columns = (np.concatenate(part).astype(float) for part in zip(*parts, strict=True))
    return RunPrediction(run.name, windows.horizon * dt, level, tuple(names), tuple(units), *columns)
