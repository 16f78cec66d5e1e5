"""Closed loops: plants under an autopilot, with latencies, all machines of a batch at once."""

import csv
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from nsde_torch.control.autopilots import Autopilot, Decision, whole_samples
from nsde_torch.control.reference import Reference, StateReference
from nsde_torch.models import Model
from nsde_torch.models.run_directory import load
from nsde_torch.rotation import rotation_between
from nsde_torch.systems import Multirotor, System, make_plant_system
from nsde_torch.systems.machines import Effects

DECLARED = "declared"  # stands for the declared physics in the place of a run directory


def knowledge(run: str, system: str, *, effects: Effects = ()) -> Model | System:
    """A model by its run directory, or the declared physics of a machine by its name.

    `effects` are those beside the declared ones, with their values (see `make_plant_system`). CheckpointError: no
    such run directory, or a damaged one. ConfigError: no plant of that name, or an effect that it cannot have.
    """
    if run == DECLARED:
        return make_plant_system(system, effects=effects, declared_only=True)
    return load(run)


def system_of(known: Model | System) -> System:
    return known if isinstance(known, System) else known.system


LOST = 3.0
"""Distance from the reference at which a multirotor counts as lost [m]; others are lost where numbers end."""
_LAST_S = 1.0  # end of a run, whose errors are those that stay


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


@dataclass(frozen=True)
class Flight:
    """What happened in a closed loop."""

    t: Tensor  # times of the samples (T,) [s]
    x: Tensor  # true states (T, N, nx)
    measured: Tensor  # measured states (T, N, nx)
    u: Tensor  # commands given at the samples (T, N, nu)
    ref: Tensor  # reference (T, nx)
    decisions: tuple[Decision, ...] = field(repr=False)  # one per command
    lost: Tensor  # when each machine was lost [s], infinite if never (N,)


def fly(
    autopilot: Autopilot,
    plant: SteppedMachine,
    reference: StateReference,
    *,
    machines: int = 1,
    start: Tensor | None = None,
    state_latency: float = 0.0,
    duration: float | None = None,
) -> Flight:
    """Fly machines along a reference, from its first state or another.

    Args:
        plant: What is flown; it should not raise when a machine is lost.
        start: First state (nx,); None: that of the reference.
        state_latency: Age of a measured state when the autopilot gets it [s], a multiple of the plant's sample.
        duration: How long [s]; None: as long as the reference.

    Raises:
        ConfigError: times that are no multiples of the plant's sample.
    """
    dt = plant.dt
    every = whole_samples("period", autopilot.period, dt)
    late = whole_samples("state_latency", state_latency, dt)
    samples = round((reference.duration if duration is None else duration) / dt)
    times = dt * torch.arange(samples + 1, dtype=torch.float64)
    wanted = reference.at(times)
    x0 = (wanted[0] if start is None else start.to(wanted)).repeat(machines, 1)
    u = autopilot.reset(x0)
    measured = plant.reset(x0, u)
    lost = torch.full((machines,), torch.inf, dtype=torch.float64)
    true, seen, commands, decisions = [plant.state.clone()], [measured], [], []
    for k in range(samples + 1):
        if k % every == 0:
            decisions.append(autopilot.command(k * dt, seen[max(k - late, 0)]))
            u = decisions[-1].u
        commands.append(u.double())
        off = plant.state - wanted[k]
        away = off[:, :3].norm(dim=1) if isinstance(reference, Reference) else 0.0 * off.sum(1)
        gone = ~(away <= LOST) & torch.isinf(lost)
        lost = torch.where(gone, torch.full_like(lost, k * dt), lost)
        if k < samples:
            measured = plant.step(u.double())
            true.append(plant.state.clone())
            seen.append(measured)
    x, measured, u = map(torch.stack, (true, seen, commands))
    return Flight(times, x, measured, u, wanted, tuple(decisions), lost)


def summarise(flights: Sequence[Flight], system: System) -> dict[str, Any]:
    """Numbers of flights along one reference, with units in the keys; of another machine, of its error groups."""
    flies = isinstance(system, Multirotor)
    rows = [row for flight in flights for row in (_machines(flight) if flies else _runs(flight, system))]
    kept = [r for r in rows if r["lost_s"] is None]
    out: dict[str, Any] = {"machines": len(rows), "lost": len(rows) - len(kept)}
    if flies:
        out |= {k: float(how([r[own] for r in kept])) if kept else None for k, (own, how) in _FLOWN.items()}
    else:
        out |= {
            key: {g.name: float(np.mean([r[key][g.name] for r in kept])) for g in system.error_groups}
            for key in ("rmse", "rmse_last_s")
            if kept
        }
        out["units"] = {g.name: g.unit for g in system.error_groups}
    out["status"] = dict(Counter(s for f in flights for d in f.decisions for s in d.status))
    out["flights"] = rows
    solves = [d for f in flights for d in f.decisions[1:] if d.cost is not None]
    if solves:
        out["solve_ms"] = _times([d.solve_ms for d in solves])
        out["iterations_mean"] = float(np.mean([d.iterations for d in solves]))
        gaps = torch.cat([d.gap for d in solves if d.gap is not None])
        gaps = gaps[torch.isfinite(gaps)]
        out["gap_p99"] = float(gaps.double().quantile(0.99)) if len(gaps) else None
    out["command_ms"] = _times([d.total_ms for f in flights for d in f.decisions[1:]])
    return out


_FLOWN: dict[str, tuple[str, Any]] = {
    "rmse_m": ("rmse_m", np.mean),
    "rmse_worst_m": ("rmse_m", np.max),
    "position_error_max_m": ("position_error_max_m", np.max),
    "altitude_rmse_m": ("altitude_rmse_m", np.mean),
    "altitude_error_max_m": ("altitude_error_max_m", np.max),
    "attitude_rmse_deg": ("attitude_rmse_deg", np.mean),
    "speed_max_m_s": ("speed_max_m_s", np.max),
    "roll_pitch_max_deg": ("tilt_max_deg", np.max),
}
"""What all flights that were not lost have in common, of which number of each of them."""


def _runs(flight: Flight, system: System) -> list[dict[str, Any]]:
    """Errors by error group over the whole run and over its last second, in the units of the groups."""
    e = system.error(flight.x, flight.ref[:, None].expand_as(flight.x))
    squares = torch.stack([g.squares(e) for g in system.error_groups], -1)
    factor = torch.tensor([g.factor for g in system.error_groups])
    last = flight.t >= flight.t[-1] - _LAST_S
    out: list[dict[str, Any]] = []
    for n in range(flight.x.shape[1]):
        row: dict[str, Any] = {"lost_s": _plain(flight.lost[n])}
        for key, part in (("rmse", squares[:, n]), ("rmse_last_s", squares[last, n])):
            rms = factor * part.mean(0).sqrt()
            row[key] = {g.name: _plain(value) for g, value in zip(system.error_groups, rms, strict=True)}
            if None in row[key].values() and row["lost_s"] is None:  # finite, and its square is not
                row["lost_s"] = float(flight.t[-1])
        out.append(row)
    return out


def _times(values: Sequence[float]) -> dict[str, float]:
    return {**percentiles(values), "mean": float(np.mean(values))} if values else {}


def _machines(flight: Flight) -> list[dict[str, Any]]:
    ref = flight.ref[:, None].expand_as(flight.x)
    error = flight.x[..., :3] - ref[..., :3]
    turn = torch.rad2deg(rotation_between(ref[..., 6:10], flight.x[..., 6:10]))
    speed = flight.x[..., 3:6].norm(dim=-1)
    tilt = torch.rad2deg(torch.arccos((1 - 2 * (flight.x[..., 7] ** 2 + flight.x[..., 8] ** 2)).clamp(-1, 1)))
    return [
        {
            "rmse_m": _plain(error[:, n].square().sum(-1).mean().sqrt()),
            "rmse_axes_m": [_plain(v) for v in error[:, n].square().mean(0).sqrt()],
            "position_error_max_m": _plain(error[:, n].norm(dim=-1).max()),
            "altitude_rmse_m": _plain(error[:, n, 2].square().mean().sqrt()),
            "altitude_error_max_m": _plain(error[:, n, 2].abs().max()),
            "attitude_rmse_deg": _plain(turn[:, n].square().sum(-1).mean().sqrt()),
            "speed_max_m_s": _plain(speed[:, n].max()),
            "tilt_max_deg": _plain(tilt[:, n].max()),
            "lost_s": _plain(flight.lost[n]),
        }
        for n in range(flight.x.shape[1])
    ]


def _plain(value: Tensor) -> float | None:
    return float(value) if bool(torch.isfinite(value)) else None


def percentiles(values: Sequence[float]) -> dict[str, float]:
    """p50, p90, p99, p99.9 and the largest."""
    if not values:
        return {}
    found = {f"p{p:g}": float(np.percentile(values, p)) for p in (50, 90, 99, 99.9)}
    return {**found, "max": float(max(values))}


def write_log(flights: Sequence[Flight], system: System, folder: Path) -> list[Path]:
    """Write what was measured and commanded, one CSV file per machine, as `nsde diagnose data=csv` reads it."""
    folder.mkdir(parents=True, exist_ok=True)
    header = ("t", *system.state_names, *system.input_names)
    runs = [(f, n) for f in flights for n in range(f.x.shape[1])]
    digits = len(str(len(runs) - 1))
    files = []
    for i, (flight, n) in enumerate(runs):
        table = torch.cat((flight.t[:, None].round(decimals=9), flight.measured[:, n], flight.u[:, n]), 1)
        file = folder / f"flight_{i:0{digits}d}.csv"
        with file.open("w", encoding="utf-8", newline="\n") as out:
            writer = csv.writer(out, lineterminator="\n")
            writer.writerow(header)
            writer.writerows(table.tolist())
        files.append(file)
    return files
