"""Noise of a plant: gusts that push it and errors of its sensors.

A port is pushed by g + w: g an Ornstein-Uhlenbeck process, dg = -g dt / tau + std sqrt(2 / tau) dW, sampled
exactly,

    g' = a g + std sqrt(1 - a^2) xi,   a = exp(-dt / tau),

and w white, white * xi / sqrt(dt); both are held over a sample, so that the integral of w over a time T has
the variance white^2 T whatever dt is. (Gillespie, Physical Review E 54, 1996, for the exact update.)
"""

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass
from math import exp, sqrt
from typing import final

import torch
from torch import Tensor

from nsde_torch.effects import Port
from nsde_torch.errors import ConfigError
from nsde_torch.rotation import turned
from nsde_torch.systems import System
from nsde_torch.systems.machine import Gust


@final
@dataclass(eq=False)
class Gusts:
    """The gusts of one plant, advanced a sample at a time.

    A ConfigError refuses a port that the system lacks, or a time constant or scale out of range.
    """

    spec: Mapping[Port, Gust]  # gust of each port that has one
    widths: Mapping[Port, int]  # number of axes of each port of the system
    _: KW_ONLY
    dt: float  # sample [s]
    scale: float  # factor on everything, >= 0
    generator: torch.Generator  # source of all randomness; it also sets the device
    dtype: torch.dtype = torch.float64

    def __post_init__(self) -> None:
        scale, widths = self.scale, self.widths
        if not scale >= 0:
            raise ConfigError(f"`process_noise` must be a factor of 0 or more; got {scale!r}.")
        self._like = torch.empty(0, dtype=self.dtype, device=self.generator.device)
        self._parts: list[tuple[Port, int, float, Tensor, Tensor]] = []
        for port, gust in self.spec.items():
            if port not in widths:
                known = ", ".join(p.value for p in widths)
                raise ConfigError(
                    f"gusts act on the port {port.value!r}, which the system lacks; it has: {known}."
                )
            if not gust.time_constant > 0:
                raise ConfigError(f"`time_constant` of a gust must be > 0 s; got {gust.time_constant!r}.")
            width, keep = widths[port], exp(-self.dt / gust.time_constant)
            std, white = (self._row(v, width, port) * scale for v in (gust.std, gust.white))
            if scale > 0:
                self._parts.append((port, width, keep, std, white / sqrt(self.dt)))
        self._width = sum(width for _, width, *_ in self._parts)
        self._state: list[Tensor] = []

    def _row(self, values: tuple[float, ...], width: int, port: Port) -> Tensor:
        row = self._like.new_tensor(values)
        if row.numel() not in (1, width):
            raise ConfigError(f"a gust on {port.value!r} takes 1 or {width} numbers; got {row.numel()}.")
        return row.expand(width)

    def _normal(self, batch: int, columns: int) -> Tensor:
        device = self.generator.device
        return torch.randn(batch, columns, generator=self.generator, dtype=self.dtype, device=device)

    def reset(self, batch: int) -> None:
        """Start from the stationary distribution, for `batch` rows."""
        self._state = self._stationary(batch)

    def restart(self, rows: Tensor) -> None:
        """Start some rows (K,) from the stationary distribution, independent of their values before."""
        fresh = self._stationary(len(rows))
        self._state = [old.index_copy(0, rows, new) for old, new in zip(self._state, fresh, strict=True)]

    def _stationary(self, batch: int) -> list[Tensor]:
        draws = self._normal(batch, self._width).split([w for _, w, *_ in self._parts], 1)
        return [xi * std for xi, (_, _, _, std, _) in zip(draws, self._parts, strict=True)]

    def draw(self) -> dict[Port, Tensor]:
        """Push of each port over the next sample, (B, width of the port) [unit of the port]."""
        if not self._parts:
            return {}
        xi = self._normal(self._state[0].shape[0], 2 * self._width)
        out, at = {}, 0
        for k, (port, width, keep, std, white) in enumerate(self._parts):
            out[port] = self._state[k] + white * xi[:, at : at + width]
            fresh = xi[:, at + width : at + 2 * width]
            self._state[k] = keep * self._state[k] + sqrt(1.0 - keep * keep) * std * fresh
            at += 2 * width
        return out


@final
@dataclass(eq=False)
class Sensor:
    """Measurement: state plus white noise, a quaternion turned by a small random rotation.

    A ConfigError refuses a wrong number of channels, or a negative value.
    """

    system: System
    std: tuple[float, ...]
    """Standard deviation of each error channel of the system [its unit; rad for the three of an attitude]."""
    _: KW_ONLY
    scale: float  # factor on all of them, >= 0; with 0 the state is returned as it is
    generator: torch.Generator
    dtype: torch.dtype = torch.float64

    def __post_init__(self) -> None:
        names, std, scale = self.system.error_names, self.std, self.scale
        if len(std) != len(names) or min(std) < 0:
            raise ConfigError(
                f"`sensor_std` takes {len(names)} numbers of 0 or more ({', '.join(names)}); got {std!r}."
            )
        if not scale >= 0:
            raise ConfigError(f"`sensor_noise` must be a factor of 0 or more; got {scale!r}.")
        self._quaternion = self.system.quaternion
        self._std = torch.tensor(std, dtype=self.dtype, device=self.generator.device) * scale
        self._silent = scale == 0 or not any(std)

    def __call__(self, x: Tensor) -> Tensor:
        """The state (B, nx) as measured, (B, nx)."""
        if self._silent:
            return x
        unit = self._std.new_empty(len(x), len(self._std)).normal_(generator=self.generator)
        noise = self._std * unit
        if self._quaternion is None:
            return x + noise
        start = self._quaternion.start
        before, turn, after = noise[:, :start], noise[:, start : start + 3], noise[:, start + 3 :]
        q = turned(x[:, self._quaternion], turn)
        return torch.cat((x[:, :start] + before, q, x[:, self._quaternion.stop :] + after), 1)
