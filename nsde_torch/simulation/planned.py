"""Runs of a plan that `nsde design` or anyone wrote into a CSV file: inputs from the state that the plan begins in, or,
of multirotors, a path through points that a cascade flies."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from nsde_torch.arrays import Array
from nsde_torch.control.shapes import from_csv
from nsde_torch.data.csv_folder import csv_rows
from nsde_torch.data.raw import RawRun
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.simulation.battery import battery_column
from nsde_torch.simulation.flights import Path as Wanted
from nsde_torch.simulation.flights import fly
from nsde_torch.simulation.make import Making, noise_generator, record, simulated_run

PLAN, DESIGN = "plan.csv", "design.json"


def planned_runs(
    name: str,
    *,
    durations: Sequence[float],
    seed: int,
    making: Making,
    plan: str,
    start: Mapping[str, float] | None = None,
) -> list[RawRun]:
    """One run of a plan for each duration [s], which the plan is held to the end of.

    The plan is a CSV file of `t` and the inputs, or the folder that `nsde design` wrote. `start` are first values of
    states; default: those of `design.json` beside the plan, else 0. For the rest see `excited_runs`. A ConfigError
    where a name is no state, or an effect unknown; a DataError where there is no plan, or it does not fit the system.
    """
    plant = making.plant(name, generator=noise_generator(seed, 1))
    names = plant.system.state_names
    t, table = read_plan(plan, plant.system.input_names)
    first = _first_state(Path(plan), names, start)

    def control(at: float, x: torch.Tensor) -> torch.Tensor:
        row = int(np.searchsorted(t, at + 1e-6 * plant.dt, side="right")) - 1
        return torch.as_tensor(table[row]).expand(len(x), -1)

    start_of_all = np.tile(first, (len(durations), 1))
    return record(plant, start_of_all, control, durations=durations, prefix="experiment")


def planned_flights(
    name: str, *, durations: Sequence[float], seed: int, making: Making, plan: str
) -> list[RawRun]:
    """One flight of a plan for each duration, along a path through points (`nsde_torch.control.shapes.from_csv`).

    Arguments and errors are those of `planned_runs`; there is no start, because a flight begins at its first point.
    """
    dt = making.sample(name)
    path = from_csv(plan_file(plan))
    grid = path.dt * np.arange(len(path.p))
    wanted = []
    for duration in durations:
        t = np.minimum(dt * np.arange(round(duration / dt) + 1), grid[-1])
        p, v, a = (np.stack([np.interp(t, grid, c) for c in part.T], 1) for part in (path.p, path.v, path.a))
        wanted.append(
            Wanted(p, v, a, np.interp(t, grid, path.yaw), np.interp(t, grid, np.gradient(path.yaw, path.dt)))
        )
    flown = fly(name, wanted, generator=noise_generator(seed, 1), making=making, durations=durations)
    parts = (flown.one(len(one.p), i) for i, one in enumerate(wanted))
    return [
        simulated_run(f"experiment_{i}", dt, part.x, part.u, battery_column(part.voltage))
        for i, part in enumerate(parts)
    ]


def plan_file(plan: str | Path) -> Path:
    """The CSV file of a plan: itself, or that of the folder that `nsde design` wrote."""
    path = Path(plan)
    return path / PLAN if path.is_dir() else path


def read_plan(plan: str | Path, names: Sequence[str]) -> tuple[Array, Array]:
    """Times (N,) [s] and inputs (N, nu) of a plan, a file or the folder that holds it, each held to the next.

    A DataError where the file or a column is missing, something is no number, or times do not increase.
    """
    path = plan_file(plan)
    rows = csv_rows(path, ("t", *names), what="plan", remedy=f"`nsde design` writes {PLAN}.")
    try:
        table = np.array([[float(row[n]) for n in ("t", *names)] for row in rows])
    except (TypeError, ValueError) as error:
        raise DataError(f"plan {path} holds something that is no number ({error}).") from error
    if len(table) < 2 or not np.isfinite(table).all() or (np.diff(table[:, 0]) <= 0).any():
        raise DataError(f"plan {path} needs two rows or more of finite numbers whose times increase.")
    return table[:, 0] - table[0, 0], table[:, 1:]


def _first_state(plan: Path, names: Sequence[str], start: Mapping[str, float] | None) -> Array:
    beside = (plan if plan.is_dir() else plan.parent) / DESIGN
    given = start
    if given is None and beside.is_file():
        given = json.loads(beside.read_text(encoding="utf-8"))["plan"]["start"]
    out = np.zeros(len(names))
    for name, value in (given or {}).items():
        if name not in names:
            raise ConfigError(f"`options.start` names {name!r}; the states are {', '.join(names)}.")
        out[list(names).index(name)] = float(value)
    return out
