"""Interventions on a plant: a state of a flight, and commands of another time.

    x(0), m(0)   true state and memory of the effects at a time t of a flight, which a pilot flew in gusts
    u(s)         commands of a flight at t' + s, 0 <= s < duration, with t' drawn independently of t
    gusts        drawn anew from their stationary law at s = 0

States and commands are those of the flights, one by one, and independent of each other and of the gusts, so that an
error of a prediction shows what an input does, and not how a pilot answers (see `data.interventions`).

Each intervention is logged from `before` seconds before its start on, as the flight was: measured states and commands,
then `intervention` turns from 0 to 1. `t` is the clock of the flight. Those of one flight that do not overlap share a
run; the gaps between them split it into segments.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from nsde_torch.arrays import Array
from nsde_torch.data.interventions import COLUMN
from nsde_torch.data.raw import RawRun
from nsde_torch.errors import ConfigError
from nsde_torch.simulation.battery import Battery, battery_column, used_of
from nsde_torch.simulation.flights import Flown, chosen_flights
from nsde_torch.simulation.make import Making, noise_generator
from nsde_torch.simulation.options import Replay
from nsde_torch.simulation.plant import Plant

GAP_ROWS = 10  # rows that lie between two interventions of one run, at least; a reader splits it there


def replayed_flights(
    name: str,
    *,
    replay: Replay,
    seed: int,
    durations: Sequence[float] | None = None,
    making: Making = Making(),
    **options: Any,
) -> list[list[RawRun]]:
    """Interventions on the machine of `manual_flights`, from states of its flights, whose arguments these are.

    Gives for each run its interventions in the order of time, each with the column `intervention`. A ConfigError is
    that of `manual_flights`, or refuses flights that are too short.
    """
    flights = chosen_flights(name, durations=durations, seed=seed, making=making, keep_truth=True, **options)
    dt = making.sample(name)
    before, after = replay.rows(dt)
    starts, sources = _drawn(flights, replay.starts, before, after, np.random.default_rng([seed, 4]))
    plant = making.plant(name, generator=noise_generator(seed, 5))
    commands = np.stack([flights[f].u[k : k + after + 1] for f, k in sources], axis=1)
    x, voltage = _flown(plant, flights, starts, commands, before)
    pieces = []
    for i, (f, k) in enumerate(starts):
        flight = flights[f]
        earlier = slice(k - before, k)
        on = np.concatenate([np.zeros(before), np.ones(after + 1)])
        pieces.append(
            RawRun(
                f"flight_{f}",
                dt * np.arange(k - before, k + after + 1, dtype=np.float64),
                # the row of the start is the flight's own measurement
                np.concatenate([flight.x[k - before : k + 1], x[1:, i]]),
                np.concatenate([flight.u[earlier], commands[:, i]]),
                source="simulated",
                extra={
                    **battery_column(np.concatenate([flight.voltage[earlier], voltage[:, i]])),
                    COLUMN: on,
                },
            )
        )
    return _packed(pieces, GAP_ROWS * dt)


def joined(pieces: Sequence[RawRun], name: str) -> RawRun:
    """Recordings that follow one another, as one run with gaps."""
    t, x, u = (np.concatenate([getattr(p, part) for p in pieces]) for part in ("t", "x", "u"))
    extra = {k: np.concatenate([p.extra[k] for p in pieces]) for k in pieces[0].extra}
    return RawRun(name, t, x, u, source=pieces[0].source, extra=extra)


def _drawn(
    flights: Sequence[Flown], count: int, before: int, after: int, rng: np.random.Generator
) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Flight and row of each start and, independently, of the first of its commands; all rows are equally likely."""
    lengths = [len(flight.x) for flight in flights]
    if min(lengths) < before + after + 2:
        raise ConfigError(
            f"`replay`: a flight of {min(lengths)} rows is too short for {before} rows before a start and {after} "
            "of commands. Make `durations` longer, or `replay.before` and `replay.duration` shorter."
        )
    fit_start = [(f, k) for f, n in enumerate(lengths) for k in range(before, n)]
    fit_source = [(f, k) for f, n in enumerate(lengths) for k in range(n - after)]
    starts = sorted(fit_start[i] for i in rng.integers(len(fit_start), size=count))
    return starts, [fit_source[i] for i in rng.integers(len(fit_source), size=count)]


def _flown(
    plant: Plant, flights: Sequence[Flown], starts: Sequence[tuple[int, int]], commands: Array, before: int
) -> tuple[Array, Array]:
    """Measured states (after + 1, B, nx) and voltages (after + 1, B, 1 or 0) under commands (after + 1, B, nu)."""

    def at(part: str, offset: int) -> Array:
        return np.stack([getattr(flights[f], part)[k + offset] for f, k in starts])

    logged = at("voltage", 0).shape[1] > 0
    used = used_of(at("voltage", 0), at("u", 0)) if logged else np.zeros(len(starts))
    battery = Battery(used.tolist(), dt=plant.dt, logged=logged)
    wide = plant.system.exogenous
    earlier = [
        np.concatenate([at("u", -j), at("voltage", -j)] if wide else [at("u", -j)], 1)
        for j in range(before, 0, -1)
    ]
    t0 = torch.tensor([k * plant.dt for _, k in starts], dtype=torch.float64)
    x = plant.resume(torch.from_numpy(at("z", 0)), torch.from_numpy(np.stack(earlier, 1)), t0=t0)
    states, voltages = [x], []
    for k, row in enumerate(commands):
        u = torch.from_numpy(row)
        voltage = battery.voltage(u)
        voltages.append(voltage)
        if k + 1 < len(commands):
            states.append(plant.step(battery.seen_by(plant, u, voltage)))
            battery.use(u)
    return torch.stack(states).numpy(), torch.stack(voltages).numpy()


def _packed(pieces: Sequence[RawRun], gap: float) -> list[list[RawRun]]:
    """Pieces in lists of those that do not overlap: each goes, in the order of time, to the shortest list with room."""
    lists: list[list[RawRun]] = []
    for piece in pieces:
        free = [held for held in lists if held[-1].name == piece.name and piece.t[0] - held[-1].t[-1] > gap]
        if free:
            min(free, key=len).append(piece)
        else:
            lists.append([piece])
    return lists
