"""What a closed loop achieved, in numbers, and its log as a data set."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nsde_torch.control.loop import Flight
from nsde_torch.rotation import rotation_between
from nsde_torch.systems import System

PERCENTILES = (50.0, 90.0, 99.0, 99.9)


def summarise(flights: Sequence[Flight]) -> dict[str, Any]:
    """Numbers of flights along one reference, with units in the keys."""
    rows = [row for flight in flights for row in _machines(flight)]
    kept = [r for r in rows if r["lost_s"] is None]

    def over(key: str, how: Any) -> float | None:
        return float(how([r[key] for r in kept])) if kept else None

    out: dict[str, Any] = {
        "machines": len(rows),
        "lost": len(rows) - len(kept),
        "rmse_m": over("rmse_m", np.mean),
        "rmse_worst_m": over("rmse_m", np.max),
        "position_error_max_m": over("position_error_max_m", np.max),
        "altitude_rmse_m": over("altitude_rmse_m", np.mean),
        "altitude_error_max_m": over("altitude_error_max_m", np.max),
        "attitude_rmse_deg": over("attitude_rmse_deg", np.mean),
        "speed_max_m_s": over("speed_max_m_s", np.max),
        "roll_pitch_max_deg": over("tilt_max_deg", np.max),
        "status": dict(Counter(s for f in flights for d in f.decisions for s in d.status)),
        "flights": rows,
    }
    solves = [d for f in flights for d in f.decisions[1:] if d.cost is not None]
    if solves:
        out["solve_ms"] = _percentiles([d.solve_ms for d in solves])
        out["iterations_mean"] = float(np.mean([d.iterations for d in solves]))
        gaps = torch.cat([d.gap for d in solves if d.gap is not None])
        gaps = gaps[torch.isfinite(gaps)]
        out["gap_p99"] = float(gaps.double().quantile(0.99)) if len(gaps) else None
    out["command_ms"] = _percentiles([d.total_ms for f in flights for d in f.decisions[1:]])
    return out


def _machines(flight: Flight) -> list[dict[str, Any]]:
    ref = flight.ref[:, None].expand_as(flight.x)
    error = flight.x[..., :3] - ref[..., :3]
    turn = torch.rad2deg(rotation_between(ref[..., 6:10], flight.x[..., 6:10]))
    speed = flight.x[..., 3:6].norm(dim=-1)
    tilt = torch.rad2deg(torch.arccos((1 - 2 * (flight.x[..., 7] ** 2 + flight.x[..., 8] ** 2)).clamp(-1, 1)))
    out = []
    for n in range(flight.x.shape[1]):
        gone = float(flight.lost[n])
        out.append(
            {
                "rmse_m": _plain(error[:, n].square().sum(-1).mean().sqrt()),
                "rmse_axes_m": [_plain(v) for v in error[:, n].square().mean(0).sqrt()],
                "position_error_max_m": _plain(error[:, n].norm(dim=-1).max()),
                "altitude_rmse_m": _plain(error[:, n, 2].square().mean().sqrt()),
                "altitude_error_max_m": _plain(error[:, n, 2].abs().max()),
                "attitude_rmse_deg": _plain(turn[:, n].square().sum(-1).mean().sqrt()),
                "speed_max_m_s": _plain(speed[:, n].max()),
                "tilt_max_deg": _plain(tilt[:, n].max()),
                "lost_s": gone if np.isfinite(gone) else None,
            }
        )
    return out


def _plain(value: torch.Tensor) -> float | None:
    number = float(value)
    return number if np.isfinite(number) else None


def _percentiles(values: Sequence[float]) -> dict[str, float]:
    if not values:
        return {}
    found = {f"p{p:g}": float(np.percentile(values, p)) for p in PERCENTILES}
    return {**found, "max": float(np.max(values)), "mean": float(np.mean(values))}


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
