"""Manual flights: a pilot's wishes, flown by a cascade on a plant, logged as an autopilot logs them.

The pilot flies many variants at once (a batch costs little more than one); the variant whose figures are
nearest to the supplement's Figure 15 is the one that is kept. Where the nearest is still far, the aim is
moved by what flying added to or took from the wanted figures, and all is flown once more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from nsde_torch.arrays import Array
from nsde_torch.control.cascade import Cascade
from nsde_torch.data.quaternion import euler_zyx
from nsde_torch.data.raw import RawRun
from nsde_torch.errors import ConfigError
from nsde_torch.simulation.battery import battery_column, battery_of
from nsde_torch.simulation.make import Making, noise_generator, simulated_run
from nsde_torch.simulation.pilot import Path, Pilot, Sticks, figures
from nsde_torch.systems import Multirotor
from nsde_torch.systems.machines import make_plant_system

DURATIONS = (73.0, 66.0, 64.0)  # lengths of the flights of the supplement [s]
RESPONSE = (1.07, 1.06, 1.36, 1.36, 1.27, 1.33, 1.02, 1.03)
"""Figures flown over figures wanted, measured on the default plants (the loops overshoot)."""
VARIANTS = 48
NEAR = 0.07  # largest relative departure from the figures with which a flight is kept at once
ROUNDS = 2
ROOM, FLOOR = 4.0, 0.2
"""Flights stay within this distance of the middle of the room and above this height [m]."""


@dataclass(frozen=True)
class Flown:
    """Flights, time first; rows of a batch in between where there are several."""

    x: Array  # measured states (n, ..., 13)
    u: Array  # commands given at them (n, ..., nu)
    voltage: Array  # of the battery (n, ..., 1), or (n, ..., 0) where none is logged
    z: Array
    """True states with the memory of the effects (n, ..., nz), or (n, ..., 0) where they are not kept."""

    def one(self, rows: int, index: int) -> Flown:
        """The first rows of one flight of a batch, copied."""
        return Flown(*(a[:rows, index].copy() for a in (self.x, self.u, self.voltage, self.z)))


def fly(
    name: str,
    paths: Sequence[Path],
    *,
    generator: torch.Generator,
    making: Making = Making(),
    durations: Sequence[float] = (),
    keep_truth: bool = False,
) -> Flown:
    """Fly wanted paths of a multirotor at once (n, B, ...), with its battery's voltage; shorter ones hold their end.

    `durations` are lengths of the runs that take turns on one battery [s]; row i is run i modulo their number. With
    `keep_truth`, true states are kept too. A NonFiniteError where the flight left the finite numbers.
    """
    plant = making.plant(name, generator=generator)
    logged = battery_of(plant, making, durations or [len(paths[0].p) * plant.dt], rows=len(paths))
    pilot_knows = make_plant_system(name, declared_only=True)
    assert isinstance(pilot_knows, Multirotor)
    cascade = Cascade(pilot_knows, dt=plant.dt, device=generator.device)
    n = max(len(path.p) for path in paths)

    def stacked(part: str) -> torch.Tensor:
        """One part of all paths, (n, B, ...), the last row held."""
        rows = [getattr(path, part) for path in paths]
        held = [np.concatenate([r, np.repeat(r[-1:], n - len(r), axis=0)]) for r in rows]
        return torch.as_tensor(np.stack(held, axis=1), device=generator.device)

    p, v, a, yaw, yaw_rate = (stacked(part) for part in ("p", "v", "a", "yaw", "yaw_rate"))
    start = p.new_zeros(len(paths), 13)
    start[:, :3], start[:, 3:6] = p[0], v[0]
    start[:, 6], start[:, 9] = torch.cos(0.5 * yaw[0]), torch.sin(0.5 * yaw[0])
    hover = cascade.hover(len(paths))
    x = plant.reset(start, logged.seen_by(plant, hover, logged.voltage(hover)))
    states, commands, voltages, truths = [], [], [], []
    for k in range(n):
        u = cascade(x, p[k], v[k], a[k], yaw[k], yaw_rate[k])
        voltage = logged.voltage(u)
        states.append(x)
        commands.append(u)
        voltages.append(voltage)
        truths.append(plant.whole_state if keep_truth else x[:, :0])
        if k + 1 < n:
            x = plant.step(logged.seen_by(plant, u, voltage))
            logged.use(u)
    parts = (states, commands, voltages, truths)
    return Flown(*(np.asarray(torch.stack(rows).cpu().numpy(), dtype=np.float64) for rows in parts))


def flown(x: Array) -> Array:
    """Speed [m/s] and |roll|, |pitch|, |yaw| [deg] of states (n, 13), as (4, n)."""
    angles = np.degrees(np.abs(euler_zyx(x[:, 6:10]))).T
    return np.concatenate([np.linalg.norm(x[:, 3:6], axis=1)[None], angles])


def _choose(takes: Sequence[Sequence[Array]], targets: Array) -> tuple[float, list[int]]:
    """For each run one of its takes (n, 13), so that all together come nearest to the figures (8,): the departure left,
    and the index of each run's take; infinite where a run has no take in the room."""

    def inside(x: Array) -> bool:
        return bool(np.abs(x[:, :3]).max() < ROOM and x[:, 2].min() > FLOOR)

    values = [[flown(x) if inside(x) else None for x in run] for run in takes]
    common = [k for k in range(len(takes[0])) if all(run[k] is not None for run in values)]
    free = [[k for k, v in enumerate(run) if v is not None] for run in values]
    if not all(free):
        return float("inf"), []

    def miss(choice: Sequence[int]) -> float:
        """Largest relative departure (log) from the figures of runs (4, n_i) together."""
        runs = [v for run, k in zip(values, choice, strict=True) if (v := run[k]) is not None]
        return float(np.abs(np.log(figures(np.concatenate(runs, axis=1)) / targets)).max())

    starts = [[k] * len(takes) for k in common] or [[run[0] for run in free]]
    best = min(starts, key=miss)
    left = miss(best)
    for i in [*range(len(takes))] * 2:  # one run after another takes its best, twice
        for k in free[i]:
            trial = [*best[:i], k, *best[i + 1 :]]
            if (now := miss(trial)) < left:
                best, left = trial, now
    return left, best


def chosen_flights(
    name: str,
    *,
    durations: Sequence[float] | None = None,
    seed: int,
    making: Making = Making(),
    variants: int = VARIANTS,
    rounds: int = ROUNDS,
    keep_truth: bool = False,
) -> list[Flown]:
    """Flights by hand whose envelope, over all of them, is that of the supplement's Figure 15.

    Of a `hexacopter` or `quadrotor`, with lengths [s] (default: the supplement's three). Of fewer `variants` to choose
    from, and of much shorter flights, they meet the figures less well; `rounds` is how often the aim may be moved at
    most. With `keep_truth`, true states are kept too. A ConfigError where a system or effect is unknown, a number out
    of range, or the cascade cannot fly with these effects.
    """
    if min(variants, rounds) < 1:
        raise ConfigError(f"`variants` and `rounds` must be 1 or more; got {variants!r} and {rounds!r}.")
    dt = making.sample(name)
    lengths = DURATIONS if durations is None else tuple(durations)
    pilot = Pilot(lengths, dt=dt, seed=seed)
    generator = noise_generator(seed, 2)
    aim, sticks = pilot.targets / np.array(RESPONSE), Sticks()
    best: tuple[float, list[Flown]] = (float("inf"), [])
    for _ in range(rounds):
        sticks = pilot.rehearse(sticks, aim)
        tried = pilot.variants(sticks, variants, 0.1)
        paths = [path for variant in tried for path in pilot.paths(variant)]
        made = fly(name, paths, generator=generator, making=making, durations=lengths, keep_truth=keep_truth)
        x, count = made.x, len(pilot.rows)
        takes = [[x[:n, k * count + i] for k in range(len(tried))] for i, n in enumerate(pilot.rows)]
        miss, choice = _choose(takes, pilot.targets)
        if miss < best[0]:
            rows = [k * count + i for i, k in enumerate(choice)]
            best = (miss, [made.one(n, r) for n, r in zip(pilot.rows, rows, strict=True)])
        if best[0] < NEAR:
            break
        got = figures(np.concatenate([flown(x[:n, i]) for i, n in enumerate(pilot.rows)], axis=1))
        aim = np.clip(aim * pilot.targets / got, 0.4 * pilot.targets, 1.7 * pilot.targets)
    if not best[1]:
        raise ConfigError(
            f"no flight of the {name} stayed in its room of {2 * ROOM:g} m and above {FLOOR:g} m: `effects` "
            "or `process_noise` are too strong for the pilot. Make them weaker, or the flights shorter."
        )
    return best[1]


def manual_flights(name: str, *, making: Making = Making(), **options: Any) -> list[RawRun]:
    """Flights by hand, at 100 Hz (or on the step of `making`): measured states, commands in [0, 1].

    Arguments and errors are those of `chosen_flights`.
    """
    flights = chosen_flights(name, making=making, **options)
    dt, digits = making.sample(name), len(str(len(flights) - 1))
    return [
        simulated_run(f"flight_{i:0{digits}d}", dt, flight.x, flight.u, battery_column(flight.voltage))
        for i, flight in enumerate(flights)
    ]
