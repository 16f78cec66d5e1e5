"""State at the time from which the next command acts, and what pushes the machine that the model does not know.

A measurement is old by the state's latency when it arrives, and a command acts only after the actuator's: between the
two, the commands that are on their way already decide. The model predicts the state forward over them:

    z(t + t_a) = F(... F(z(t - t_s), u_{-L}) ..., u_{-1}),      L = (t_s + t_a) / dt

Pushes d on the force ports (accelerations) follow from how wrong the prediction of the last measurement was,

    d' = d + (e_v in body axes, e_omega) / tau,                e = measured - predicted

which removes the lasting part of any error of the model (Pannocchia and Rawlings, AIChE J. 49, 2003).
"""

from __future__ import annotations

from typing import Protocol, final

import torch
from torch import Tensor, nn

from nsde_torch.control.options import EstimatorOptions
from nsde_torch.control.predictor import Predictor
from nsde_torch.effects import Port
from nsde_torch.errors import ConfigError
from nsde_torch.rotation import rotate_back


class Foresight(Protocol):
    """What predicts the state over one step of the fine grid: a `Predictor`, or a file that was made of one."""

    dt: float
    nx: int
    nz: int
    nd: int
    ports: dict[Port, int]

    def __call__(self, z: Tensor, u: Tensor, d: Tensor) -> Tensor:
        """States after a step (N, nz), from states (N, nz), inputs (N, nu) and pushes (N, nd)."""

    def augment(self, x: Tensor, u: Tensor) -> Tensor:
        """States (N, nx) with the memory that is stationary under inputs (N, nu): (N, nz)."""


@final
class Estimator(nn.Module):
    """One update, `forward`: plain tensors in and out.

    Args:
        predictor: Model with a step of the fine grid of time.
        options: What is known of times.
        period: Time between updates [s], a multiple of the step.

    Attributes:
        past, ahead: Steps between updates, and those to predict over.
    """

    def __init__(self, predictor: Foresight, options: EstimatorOptions, *, period: float) -> None:
        super().__init__()
        self.predictor, self.options = predictor, options
        self.past, self.ahead = (
            _multiple(name, time, predictor.dt)
            for name, time in (("period", period), ("latency", options.latency))
        )
        if min(options.force_time, options.moment_time) < 0:
            raise ConfigError(
                "`force_time` and `moment_time` must be times of 0 s or more; got "
                f"{options.force_time!r}, {options.moment_time!r}."
            )

    @property
    def structure(self) -> str:
        """Every setting that is not a tensor, in words."""
        assert isinstance(self.predictor, Predictor)
        return f"{self.past} {self.ahead} {self.options} {self.predictor.structure}"

    def forward(self, x: Tensor, z: Tensor, d: Tensor, commands: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Take a measurement.

        Args:
            x: Measured states (N, nx).
            z: States with memory at the measurement before (N, nz).
            d: Pushes (N, nd).
            commands: Inputs by the step, (N, past + ahead, nu): those that acted since the measurement before, then
                those that act until the next command does.

        Returns:
            States with memory at this measurement (N, nz), pushes (N, nd), states when the next command acts (N, nz).
        """
        p = self.predictor
        for k in range(self.past):
            z = p(z, commands[:, k], d)
        d = self._pushes(x, z, d)
        now = torch.cat((x, z[:, p.nx :]), 1) if p.nz > p.nx else x
        z = now
        for k in range(self.past, self.past + self.ahead):
            z = p(z, commands[:, k], d)
        return now.clone(), d, z.clone()

    def _pushes(self, x: Tensor, z: Tensor, d: Tensor) -> Tensor:
        o, parts, start = self.options, [], 0
        for port, width in self.predictor.ports.items():
            own = d[:, start : start + width]
            start += width
            if port is Port.BODY_FORCE and o.force_time > 0:
                error = rotate_back(x[:, 6:10], x[:, 3:6] - z[:, 3:6])
                own = (own + error / o.force_time).clamp(-o.force_limit, o.force_limit)
            elif port is Port.BODY_MOMENT and o.moment_time > 0:
                error = x[:, 10:13] - z[:, 10:13]
                own = (own + error / o.moment_time).clamp(-o.moment_limit, o.moment_limit)
            parts.append(own)
        return torch.cat(parts, 1) if parts else d


def _multiple(name: str, time: float, dt: float) -> int:
    steps = round(time / dt)
    if steps < 0 or abs(steps * dt - time) > 1e-6:
        raise ConfigError(
            f"`{name}` must be a multiple of {dt:g} s, the sample of the plant; got {time:g} s."
        )
    return steps
