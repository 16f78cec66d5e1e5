"""Runs of a plan: inputs that `nsde design` or anyone wrote into a CSV file, from the state that it begins in."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from nsde_torch.data.raw import RawRun
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.simulation.make import Making, make_plant, plant_options
from nsde_torch.simulation.recorder import record
from nsde_torch.systems.machines import Effects

Array = NDArray[np.float64]
PLAN, DESIGN = "plan.csv", "design.json"


def planned_runs(
    name: str,
    *,
    durations: Sequence[float] | None = None,
    seed: int,
    effects: Effects = (),
    process_noise: float = 1.0,
    sensor_noise: float = 1.0,
    making: Making | None = None,
    plan: str,
    start: Mapping[str, float] | None = None,
) -> list[RawRun]:
    """One run of a plan for each duration, which the plan is held to the end of.

    Args:
        name: System.
        durations: Length of each run [s]; default: one of the plan's.
        seed: Seed of the noise.
        effects: Effects that the plant has beyond its own.
        process_noise: Factor on the gusts.
        sensor_noise: Factor on the sensor noise.
        making: How the plant is made.
        plan: CSV file of `t` and the inputs, or the folder that `nsde design` wrote.
        start: First values of states; default: those of `design.json` beside the plan, else 0.

    Raises:
        ConfigError: a name that is no state, or an unknown effect.
        DataError: no plan, or one that does not fit the system.
    """
    plant = make_plant(
        name,
        generator=torch.Generator().manual_seed(int(np.random.default_rng([seed, 1]).integers(2**62))),
        effects=effects,
        process_noise=process_noise,
        sensor_noise=sensor_noise,
        **plant_options(making),
    )
    names = plant.system.state_names
    t, table = read_plan(plan, plant.system.input_names)
    first = _first_state(Path(plan), names, start)
    lengths = [float(t[-1])] if durations is None else list(durations)

    def control(at: float, x: torch.Tensor) -> torch.Tensor:
        row = int(np.searchsorted(t, at + 1e-6 * plant.dt, side="right")) - 1
        return torch.as_tensor(table[row]).expand(len(x), -1)

    return record(plant, np.tile(first, (len(lengths), 1)), control, durations=lengths, prefix="experiment")


def read_plan(plan: str | Path, names: Sequence[str]) -> tuple[Array, Array]:
    """Times (N,) [s] and inputs (N, nu) of a plan, each held to the next.

    Args:
        plan: The file, or the folder that holds it.
        names: Columns of the inputs.

    Raises:
        DataError: the file or a column is missing, something is no number, or times do not increase.
    """
    path = Path(plan)
    path = path / PLAN if path.is_dir() else path
    try:
        with path.open(encoding="utf-8", newline="") as opened:
            rows = list(csv.DictReader(opened))
    except OSError as error:
        raise DataError(f"plan {path}: {error.strerror}. `nsde design` writes {PLAN}.") from error
    have = list(rows[0]) if rows else []
    missing = [n for n in ("t", *names) if n not in have]
    if missing:
        raise DataError(
            f"plan {path} has no column {', '.join(missing)}; it has: {', '.join(have) or 'none'}."
        )
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
