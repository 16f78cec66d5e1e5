"""Nano-drone: a Crazyflie 2.1 Brushless under motion capture (Busetto et al., Control Engineering Practice 172, 2026).

States at 100 Hz and the measured speeds of the four motors. The package's quadrotor is the declared physics, with the
square of a motor's speed as its command; the motors of the set are 1 front right, 2 rear right, 3 rear left,
4 front left, and turn as those of quad-x. Physical terms that the rigid body lacks are added one after another, and
all parameters are fitted to rollouts over the horizon of the protocol by the mean lengths that the protocol scores.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, final

import numpy as np
import torch

from nsde_torch.arrays import Array
from nsde_torch.data.raw import RawRun
from nsde_torch.systems.base import System

from .benchmark import BenchmarkMetric, BenchmarkOutcome, PublicBenchmark, PublishedRow, Trace
from .files import MOTORS, Work, all_filled, flight_states, long_enough, table
from .named import diagnosed, words_of
from .output_error import machine, output_error, simulated, times, windows

STEP = 0.01
HORIZON = 50
SHOWN = (1, 10, 50)
# [rad/s] of a motor at a command of 1; the fastest of the set reaches two thirds of its square
SPEED = 3000.0
TRAIN = ("square", "random", "chirp")
RUNS = (1, 2, 3)
STRIDE = 100  # samples from one fitted stretch to the next
ITERATIONS = 10
AT_ONCE = 4096
COLUMNS = (
    *("x", "y", "z", "vx", "vy", "vz", "qw", "qx", "qy", "qz", "wx", "wy", "wz"),
    *("m1_rads", "m2_rads", "m3_rads", "m4_rads"),
)
QUANTITIES = (("position", "m"), ("velocity", "m/s"), ("rotation", "rad"), ("rates", "rad/s"))
GROUPS = tuple(tuple(range(k, k + 3)) for k in (0, 3, 6, 9))
TYPICAL = (0.05, 0.2, 0.1, 0.5)  # errors of the published rows over the horizon
FIRST = {"thrust_gain": 7.4, "roll_gain": 100.0, "pitch_gain": 100.0, "yaw_gain": 12.0}
TERMS = ("linear_drag", "flapping_moment", "angular_damping", "motor_lag")
CANDIDATES = (*TERMS, "gyroscopic_moment", "com_offset", "inertia_coupling")
NAMED_ROWS = 1500
RUNGS = (0, 3, 4)  # how many of the terms each of our rows has
SOURCE = "idsia-robotics/nanodrone-sysid-benchmark, results/model_comparison.ipynb"


AT = (*(f"h{h}" for h in SHOWN), "sum")
PUBLISHED = {
    "naive": (
        *(0.0143, 0.1430, 0.6797, 17.7878, 0.0329, 0.3182, 1.4749, 38.9241),
        *(0.0071, 0.0692, 0.3041, 8.2138, 0.0796, 0.3596, 0.8837, 29.0866),
    ),
    "physics": (
        *(0.0013, 0.0126, 0.1269, 2.3223, 0.0080, 0.0570, 0.5781, 10.6232),
        *(0.0011, 0.0205, 0.2544, 5.1013, 0.0796, 0.3596, 0.8837, 29.0866),
    ),
    "MLP": (
        *(0.0032, 0.0305, 0.1712, 4.0519, 0.0116, 0.0890, 0.5720, 12.5809),
        *(0.0022, 0.0331, 0.2268, 6.0591, 0.1138, 0.5949, 0.9005, 35.5735),
    ),
    "hybrid": (
        *(0.0016, 0.0166, 0.1119, 2.3625, 0.0092, 0.0613, 0.5556, 10.4033),
        *(0.0027, 0.0376, 0.2306, 6.1534, 0.0912, 0.4880, 0.5979, 28.9873),
    ),
    "LSTM": (
        *(0.0079, 0.0390, 0.2572, 5.9711, 0.0247, 0.1175, 0.7407, 16.7207),
        *(0.0066, 0.0372, 0.2325, 5.6525, 0.1021, 0.4292, 1.2407, 35.8353),
    ),
}
"""Errors of position, velocity, rotation and rates, each after the steps shown and summed."""
METRICS = tuple(
    BenchmarkMetric(f"{quantity}_{at}", unit, digits=4 if at != "sum" else 2)
    for quantity, unit in QUANTITIES
    for at in AT
)


@final
class Nanodrone(PublicBenchmark):
    name = "nanodrone"
    title = "nano-drone: a Crazyflie 2.1 Brushless under motion capture"
    repository = "idsia-robotics/nanodrone-sysid-benchmark"
    files = (
        *(f"data/train/{kind}_20251017_run{k}.csv" for kind in TRAIN for k in RUNS),
        *(f"data/test/melon_20251017_run{k}.csv" for k in RUNS),
    )
    protocol = (
        "Identified on square, random and chirp, runs 1 to 3; on melon, runs 1 to 3, predicted 50 steps (0.5 s) from "
        "every sample with the measured motor speeds; mean length of the error after h steps, and its sum over h = 1 "
        "to 50."
    )
    metrics = METRICS
    published = tuple(
        PublishedRow(name, {m.key: v for m, v in zip(METRICS, values, strict=True)}, SOURCE)
        for name, values in PUBLISHED.items()
    )
    minutes = 5

    def run(self, paths: Sequence[Path], work: Work) -> BenchmarkOutcome:
        runs = [_read(path) for path in paths]
        train, test = runs[: len(TRAIN) * len(RUNS)], runs[len(TRAIN) * len(RUNS) :]

        def name_effects() -> dict[str, Any]:
            logs = []
            for k in range(1, len(train), len(RUNS)):  # part of run 2 of each kind: the nine take an hour
                x, u = (part[:NAMED_ROWS] for part in train[k])
                logs.append(RawRun(paths[k].stem, 100.0 * k + times(len(x), STEP), x, u))
            how: dict[str, Any] = {"parameters": FIRST, "candidates": CANDIDATES, "max_effects": 4}
            return diagnosed(logs, system="quadrotor", say=work.say, **how)

        named = work.stage("diagnosis", name_effects)
        values: dict[str, Any] = dict(FIRST)
        rows: dict[str, dict[str, float]] = {}
        for count in RUNGS:
            terms = TERMS[:count]
            made = work.stage(f"model_{count}", partial(_fitted, terms, values, train, test, work))
            values = made["values"]
            rows[f"ours, {' + '.join(terms) or 'rigid body'}"] = made["scores"]
        system = machine("quadrotor", TERMS, values)
        return BenchmarkOutcome(
            rows,
            named["added"],
            {**named["parameters"], **{f"rollouts: {k}": {"value": v} for k, v in values.items()}},
            words_of(named["added"], "the rigid quadrotor", named["verdict"]),
            _traces(system, test[0]),
            {"terms_fitted_to_rollouts": list(TERMS), "verdict_of_the_diagnosis": named["verdict"]},
        )


def _fitted(
    terms: Sequence[str], values: Mapping[str, Any], train: Any, test: Any, work: Work
) -> dict[str, Any]:
    """Parameters on the training flights from these first values, and the scores on the test flights."""
    name = " + ".join(["rigid body", *terms])
    system = machine("quadrotor", terms, values)
    data = windows([x for x, _ in train], [u for _, u in train], dt=STEP, length=HORIZON, stride=STRIDE)
    made = output_error(
        system,
        data,
        weights=np.repeat(1.0 / np.array(TYPICAL), 3),
        groups=GROUPS,
        iterations=ITERATIONS,
        stage=f"fitting {name}",
        say=work.say,
    )
    return {"values": made.values, "scores": _scores(system, test, work, name)}


def _scores(system: System, flights: Any, work: Work, name: str) -> dict[str, float]:
    """Mean lengths of the errors after h steps, from every sample of every flight."""
    data = windows([x for x, _ in flights], [u for _, u in flights], dt=STEP, length=HORIZON, stride=1)
    total = np.zeros((4, HORIZON))
    for k in range(0, len(data.x), AT_ONCE):
        work.say(f"predicting with {name}", k, len(data.x))
        part = slice(k, k + AT_ONCE)
        path = simulated(system, data.x[part, 0], data.u[part], dt=STEP)
        with torch.no_grad():
            error = system.error(torch.from_numpy(path[:, 1:]), torch.from_numpy(data.x[part, 1:])).numpy()
        total += np.stack([np.linalg.norm(error[..., list(group)], axis=-1).sum(0) for group in GROUPS])
    mean = total / len(data.x)
    return {
        f"{quantity}_{at}": float(value)
        for (quantity, _), row in zip(QUANTITIES, mean, strict=True)
        for at, value in (*((f"h{h}", row[h - 1]) for h in SHOWN), ("sum", row.sum()))
    }


def _traces(system: System, flight: tuple[Array, Array]) -> list[Trace]:
    """Ten seconds of a test flight, predicted anew every half second."""
    x, u = (part[2000:3001] for part in flight)
    if len(x) <= HORIZON:
        x, u = flight
    data = windows([x], [u], dt=STEP, length=HORIZON)
    path = simulated(system, data.x[:, 0], data.u, dt=STEP)
    t = times(len(path) * HORIZON, STEP)
    title = "melon, run 1, restarted every 0.5 s"
    shown = ((3, "velocity along x [m/s]"), (7, "quaternion x [1]"), (10, "roll rate [rad/s]"))
    return [Trace(title, label, t, data.x[:, :-1, k].ravel(), path[:, :-1, k].ravel()) for k, label in shown]


def _read(path: Path) -> tuple[Array, Array]:
    """States (n, 13) and commands (n, 4) of a flight in the package's order."""
    held = table(path, COLUMNS, what="the nano-drone benchmark")
    rows = np.stack([held[name] for name in COLUMNS], 1)
    long_enough(len(rows), 2 * HORIZON, path)
    all_filled(rows, path)
    return flight_states(rows[:, :13], path), (rows[:, 13:][:, list(MOTORS)] / SPEED) ** 2
