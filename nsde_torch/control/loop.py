"""Closed loops: plants under an autopilot, with latencies, all machines of a batch at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor

from nsde_torch.control.autopilots import Autopilot, Decision
from nsde_torch.control.reference import Reference
from nsde_torch.errors import ConfigError

LOST = 3.0
"""Distance from the reference at which a machine counts as lost [m]."""


class SteppedMachine(Protocol):
    """What is flown: a `Plant`, or anything like it."""

    dt: float

    @property
    def state(self) -> Tensor:
        """True states (N, nx)."""

    def reset(self, x0: Tensor, u0: Tensor) -> Tensor:
        """Put into states; returns what is measured."""

    def step(self, u: Tensor) -> Tensor:
        """Advance by a sample; returns what is measured."""


Fault = Callable[[float, Tensor], Tensor]
"""Changes measured states (N, nx) at a time [s] before the autopilot sees them."""


@dataclass(frozen=True)
class Flight:
    """What happened in a closed loop.

    Args:
        t: Times of the samples (T,) [s].
        x: True states (T, N, nx).
        measured: Measured states (T, N, nx).
        u: Commands given at the samples (T, N, nu).
        ref: Reference (T, nx).
        decisions: One per command.
        period: Time between commands [s].
        lost: When each machine was lost [s], infinite if never (N,).
    """

    t: Tensor
    x: Tensor
    measured: Tensor
    u: Tensor
    ref: Tensor
    decisions: tuple[Decision, ...] = field(repr=False)
    period: float
    lost: Tensor


def fly(
    autopilot: Autopilot,
    plant: SteppedMachine,
    reference: Reference,
    *,
    machines: int = 1,
    state_latency: float = 0.0,
    duration: float | None = None,
    start: Tensor | None = None,
    faults: Sequence[Fault] = (),
    progress: Callable[[float], None] | None = None,
) -> Flight:
    """Fly machines along a reference.

    Args:
        autopilot: What flies.
        plant: What is flown; it should not raise when a machine is lost.
        reference: Where to fly.
        machines: Machines at a time.
        state_latency: Age of a measured state when the autopilot gets it [s], a multiple of the plant's sample.
        duration: How long [s]; None: as long as the reference.
        start: First true states (N, nx); None: those of the reference.
        faults: What happens to measurements on their way.
        progress: Called with the time [s] now and then.

    Raises:
        ConfigError: times that are no multiples of the plant's sample.
    """
    dt = plant.dt
    every, late = (
        _multiple(n, v, dt) for n, v in (("period", autopilot.period), ("state_latency", state_latency))
    )
    length = reference.duration if duration is None else duration
    samples = round(length / dt)
    times = dt * torch.arange(samples + 1, dtype=torch.float64)
    wanted = reference.at(times)
    x0 = wanted[:1].repeat(machines, 1) if start is None else start.double()
    u = autopilot.reset(x0)
    measured = plant.reset(x0, u)
    lost = torch.full((machines,), torch.inf, dtype=torch.float64)
    true, seen, commands, decisions = [plant.state.clone()], [measured], [], []
    for k in range(samples + 1):
        if k % every == 0:
            newest = seen[max(k - late, 0)]
            for fault in faults:
                newest = fault(k * dt, newest)
            decision = autopilot.command(k * dt, newest)
            decisions.append(decision)
            u = decision.u
            if progress is not None:
                progress(k * dt)
        commands.append(u.double())
        away = (plant.state[:, :3] - wanted[k, :3]).norm(dim=1)
        gone = ~(away <= LOST) & torch.isinf(lost)
        lost = torch.where(gone, torch.full_like(lost, k * dt), lost)
        if k < samples:
            measured = plant.step(u.double())
            true.append(plant.state.clone())
            seen.append(measured)
    return Flight(
        t=times,
        x=torch.stack(true),
        measured=torch.stack(seen),
        u=torch.stack(commands),
        ref=wanted,
        decisions=tuple(decisions),
        period=autopilot.period,
        lost=lost,
    )


def _multiple(name: str, time: float, dt: float) -> int:
    steps = round(time / dt)
    if steps < 0 or abs(steps * dt - time) > 1e-6 or (name == "period" and steps < 1):
        raise ConfigError(
            f"`{name}` must be a multiple of {dt:g} s, the sample of the plant; got {time:g} s."
        )
    return steps
