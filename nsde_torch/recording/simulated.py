"""What a recording chain does to the runs of a plant before they are written.

states late:     x_log(t) = x(t - d), so that the log shows inputs a time d before they act
a late sensor:   x_log(t) = x(t - d) for some of the states
a filter:        T x_log' + x_log = x for some of the states
smoothed inputs: u_log(t) = mean of u over [t - w / 2, t + w / 2]
biased sensors:  x_log = x + b
a turned frame:  q_log = q (1, r / 2), omega_log = R(r)^T omega, for the rotation r from body to the log's frame
a wrong clock:   rows are `scale` times as far apart as their times say
dropped rows
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, isfinite, pi
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import convolve1d
from scipy.signal import lfilter

from nsde_torch.data.raw import RawRun
from nsde_torch.errors import ConfigError
from nsde_torch.recording.lateness import channel_columns, moved
from nsde_torch.recording.options import RecordingOptions
from nsde_torch.rotation import rotate_back, turned
from nsde_torch.systems import System

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Recording(RecordingOptions):
    """Faults of a recording chain, and what they do to runs; `RecordingOptions` lists them."""

    def check(self, system: System) -> None:
        """Refuse what this system cannot have.

        Raises:
            ConfigError: names the key, what it takes and what it was given.
        """
        numbers = (self.input_smoothing, self.input_delay, self.dropout)
        if not (all(isfinite(v) and v >= 0 for v in numbers) and self.dropout <= 0.5):
            raise ConfigError(
                "`input_smoothing` and `input_delay` take times of 0 s or more, `dropout` a share from 0 to 0.5; got "
                f"{numbers}."
            )
        if not 0.5 <= self.clock_scale <= 2.0:
            raise ConfigError(f"`clock_scale` must lie in 0.5 to 2; got {self.clock_scale!r}.")
        turned_names = () if system.quaternion is None else system.state_names[system.quaternion]
        free = [n for n in system.state_names if n not in turned_names]
        unknown = sorted(set(self.sensor_bias) - set(free))
        if unknown:
            raise ConfigError(
                f"`sensor_bias` takes {', '.join(free)} of system {system.name!r}; got {', '.join(unknown)}."
                + (" An attitude is turned with `frame_misalignment`." if turned_names else "")
            )
        for key, times in (("sensor_delay", self.sensor_delay), ("sensor_lag", self.sensor_lag)):
            for name, value in times.items():
                channel_columns(system, name)
                if not (isfinite(value) and value >= 0):
                    raise ConfigError(f"`{key}.{name}` must be a time of 0 s or more; got {value!r}.")
        if len(self.frame_misalignment) != 3:
            raise ConfigError(
                f"`frame_misalignment` takes three angles [deg]; got {list(self.frame_misalignment)}."
            )
        if system.quaternion is None and any(self.frame_misalignment):
            raise ConfigError(
                f"`frame_misalignment` needs an attitude, which system {system.name!r} has not. Use `sensor_bias`."
            )

    def rows_late(self, dt: float) -> int:
        """Rows by which some state is late, at a step `dt` [s] of the log."""
        return round(self.input_delay / dt) + ceil(max(self.sensor_delay.values(), default=0.0) / dt - 1e-9)

    def apply(self, run: RawRun, system: System, *, dt: float, rng: np.random.Generator) -> RawRun:
        """A run as the chain logs it.

        Args:
            run: As the plant made it, `rows_late` rows longer than what is wanted.
            system: The machine.
            dt: Step of the log [s].
            rng: Source of the missing rows.
        """
        late = self.rows_late(dt)
        n = len(run.t) - late
        u = _smoothed(run.u, round(self.input_smoothing / dt))[late:]
        extra = {k: np.asarray(v)[late:] for k, v in run.extra.items()}
        late_states = round(self.input_delay / dt)
        now = slice(late - late_states, late - late_states + n)
        x = run.x.copy()
        for name, lag in self.sensor_lag.items():
            columns = channel_columns(system, name)
            x[:, columns] = _filtered(x[:, columns], lag / dt)
        for name, delay in self.sensor_delay.items():
            columns = channel_columns(system, name)
            x[:, columns] = moved(x[:, columns], -delay / dt)
        if system.quaternion is not None and (self.sensor_delay or self.sensor_lag):
            x[:, system.quaternion] /= np.linalg.norm(x[:, system.quaternion], axis=1, keepdims=True)
        x = x[now]
        for name, bias in self.sensor_bias.items():
            x[:, system.state_names.index(name)] += bias
        if any(self.frame_misalignment):
            x = _turned(x, system, np.asarray(self.frame_misalignment) * (pi / 180.0))
        keep = rng.random(n) >= self.dropout
        keep[[0, -1]] = True
        made = RawRun(run.name, dt * np.arange(n, dtype=np.float64), x, u, extra=extra, source=run.source)
        made.rows(keep)
        return made

    def as_dict(self, dt: float) -> dict[str, Any]:
        """The faults as they were applied, with units in the keys; only those that there are."""
        out: dict[str, Any] = {}
        if round(self.input_smoothing / dt):
            out["input_smoothing_s"] = round(self.input_smoothing / dt) * dt
        if round(self.input_delay / dt):
            out["input_delay_s"] = round(self.input_delay / dt) * dt
        if self.clock_scale != 1.0:
            out["clock_scale"] = self.clock_scale
        if any(self.sensor_bias.values()):
            out["sensor_bias"] = {k: v for k, v in self.sensor_bias.items() if v}
        if any(self.sensor_delay.values()):
            out["sensor_delay_s"] = {k: v for k, v in self.sensor_delay.items() if v}
        if any(self.sensor_lag.values()):
            out["sensor_lag_s"] = {k: v for k, v in self.sensor_lag.items() if v}
        if any(self.frame_misalignment):
            out["frame_misalignment_deg"] = [float(v) for v in self.frame_misalignment]
        if self.dropout:
            out["dropout"] = self.dropout
        return out


def _smoothed(u: Array, steps: int) -> Array:
    """Mean over a window of `steps` rows about each row, the rows at its ends with half their weight."""
    if steps < 1:
        return u
    weights = np.full(steps + 1, 1.0 / steps)
    if steps % 2:  # an odd number of steps: the ends lie between rows
        return np.asarray(convolve1d(u, np.full(steps, 1.0 / steps), axis=0, mode="nearest"))
    weights[[0, -1]] *= 0.5
    return np.asarray(convolve1d(u, weights, axis=0, mode="nearest"))


def _filtered(x: Array, rows: float) -> Array:
    """A filter of first order with a time constant of `rows`, at rest at the first row, straight between rows."""
    if rows <= 0:
        return x
    keep = float(np.exp(-1.0 / rows))
    new, old = 1.0 - rows * (1.0 - keep), rows * (1.0 - keep) - keep
    return np.asarray(lfilter([new, old], [1.0, -keep], x, axis=0, zi=x[:1] * (keep + old))[0])


def _turned(x: Array, system: System, r: Array) -> Array:
    from nsde_torch.data.system_info import rate_columns

    assert system.quaternion is not None
    x = x.copy()
    q = torch.from_numpy(x[:, system.quaternion])
    angle = torch.from_numpy(r).expand(len(x), 3)
    identity = torch.zeros_like(q)
    identity[:, 0] = 1.0
    x[:, system.quaternion] = turned(q, angle).numpy()
    rates = rate_columns(system)
    if rates is not None:
        x[:, rates] = rotate_back(turned(identity, angle), torch.from_numpy(x[:, rates].copy())).numpy()
    return x
