"""NanoBench: a Crazyflie 2.1 under motion capture, with motor commands and the battery's voltage (Ullah, Baca, 2026).

Its first task asks for the vertical acceleration from the motor commands: thrust per command falls with the voltage.
The quadrotor of the package is the declared physics; what it lacks is named by a diagnosis of a few flights. The
parameters of the score are least squares of accelerations in the training parts of all flights.

The set publishes one table, of a flight that its repository does not hold: its rows are not comparable with ours. Its
script takes gravity off the predictions of three models and not off what they are scored against; both are scored here.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, final

import numpy as np
import torch

from nsde_torch.api.reading import read
from nsde_torch.arrays import Array
from nsde_torch.data.raw import RawRun
from nsde_torch.errors import DataError
from nsde_torch.sysid.identify import identify
from nsde_torch.systems.base import System

from .benchmark import BenchmarkMetric, BenchmarkOutcome, PublicBenchmark, PublishedRow, Trace
from .files import MOTORS, Work, all_filled, flight_states, long_enough, table
from .named import diagnosed, words_of
from .output_error import by_name, machine, rms

# The four models of thrust that NanoBench compares: a gain of the sum of squared commands, or a regression.
#
#     m (a + g) = k sum_i u_i^2,     k constant, of the second degree in time, or of the second degree in the voltage
#     a + g     = w [u_1 ... u_4, V, 1]
#
# The gain of each row, m (a + g) / sum u^2, is averaged or fitted by a polynomial; the mass is that of the
# set. Here both sides hold gravity.

GRAVITY = 9.81
SAMPLES, DEGREE = 15, 3
"""Of the filter of Savitzky and Golay that differentiates the height twice."""
POLYNOMIAL = 2
SMALLEST = 1e-9
FULL = 65535.0
"""Motor command of full thrust."""
FLYING = 1000.0
"""Command of motor 1 above which a row is of the flight, as the set has it."""
AIRBORNE = 0.5  # [m] height above which nothing touches the ground
TRAINED = 0.7  # share of a flight that is trained on
STEP = 0.01
FLIGHTS = (
    *(f"B2_circle_{speed}_rep{k}" for speed in ("slow", "medium", "fast") for k in (1, 2, 3)),
    *(f"B3_figure8_{speed}_rep{k}" for speed in ("slow", "medium") for k in (1, 2, 3)),
    *(f"B3_figure8_fast_rep{k}" for k in (1, 2)),
)
DIAGNOSED = ("B2_circle_fast_rep2", "B3_figure8_medium_rep2", "B3_figure8_fast_rep2")
"""Flights on batteries of different charge, the fastest ones: a voltage that is the same throughout shows nothing."""
CANDIDATES = (
    *("battery_voltage", "thrust_sag", "motor_lag", "flapping_moment", "linear_drag"),
    *("com_offset", "motor_efficiency_loss"),
)
RUNGS: tuple[tuple[str, ...], ...] = ((), ("battery_voltage",))
METHOD = "differences"
"""How parameters are identified for the score: it is of accelerations with their slow part, which a model of the noise
takes for noise."""
COLUMNS = (
    *("t", "px", "py", "pz", "vx", "vy", "vz", "qw", "qx", "qy", "qz"),
    *("imu_gyro_x", "imu_gyro_y", "imu_gyro_z"),
    *(f"motor_motor_m{k}" for k in (1, 2, 3, 4)),
    "pwr_pm_vbat",
)
SOURCE = "syediu/nanobench-iros2026, benchmarks/results/tables/task1_model_comparison_table.csv"
NOTE = "another flight, below 3.8 V, not in the repository"


@dataclass(frozen=True)
class BatteryFlight:
    """Rows of a flight, from the first on which the motors turn to the last; motors in the order of quad-x."""

    name: str  # of the file
    t: Array  # times (n,) [s]
    x: Array  # states (n, 13)
    u: Array  # commands (n, 4) in [0, 1]
    voltage: Array  # (n,) [V]
    vertical: Array  # vertical acceleration and gravity (n,) [m/s2]

    @property
    def split(self) -> int:
        """First row of the test."""
        return int(TRAINED * len(self.t))

    @property
    def squares(self) -> Array:
        """Sum of the squared commands (n,)."""
        return np.asarray((self.u**2).sum(1))

    @property
    def gain(self) -> Array:
        """Acceleration per squared command in the training part (split,) [m/s2]."""
        return (self.vertical / (self.squares + SMALLEST))[: self.split]

    def training(self) -> RawRun:
        """The airborne rows of the training part."""
        up = np.flatnonzero(self.x[: self.split, 2] > AIRBORNE)
        if not len(up):
            raise DataError(
                f"{self.name} never rises above {AIRBORNE} m: check that it is a file of this set."
            )
        rows = slice(up[0], up[-1] + 1)
        extra = {"battery_voltage": self.voltage[rows]}
        return RawRun(self.name, self.t[rows], self.x[rows], self.u[rows], extra)


def _polynomial(flight: BatteryFlight, of: Array) -> Array:
    """A gain that is a polynomial of a quantity."""
    split = flight.split
    middle = float(of[:split].mean())
    weights = np.polyfit(of[:split] - middle, flight.gain, POLYNOMIAL)
    return np.asarray(np.polyval(weights, of[split:] - middle) * flight.squares[split:])


def _linear(flight: BatteryFlight) -> Array:
    """Least squares on commands and voltage."""
    split = flight.split
    columns = np.column_stack((flight.u, flight.voltage, np.ones(len(flight.t))))
    weights = np.linalg.lstsq(columns[:split], flight.vertical[:split], rcond=None)[0]
    return np.asarray(columns[split:] @ weights)


THRUST_MODELS: dict[str, Callable[[BatteryFlight], Array]] = {
    "constant gain": lambda flight: float(flight.gain.mean()) * flight.squares[flight.split :],
    "time-indexed": lambda flight: _polynomial(flight, flight.t),
    "linear regression": _linear,
    "voltage-conditioned": lambda flight: _polynomial(flight, flight.voltage),
}
"""From a flight to the accelerations of its test rows (m,)."""


@final
class NanoBench(PublicBenchmark):
    name = "nanobench"
    title = "NanoBench: a Crazyflie 2.1 whose battery runs down"
    repository = "syediu/nanobench-iros2026"
    files = tuple(f"datasets/dataset/{name}.csv" for name in FLIGHTS)
    protocol = (
        "Of each circle and figure eight, rows on which motor 1 turns: the first 70 % train, the rest is predicted "
        "from motor commands, voltage and measured states; root mean square error and R2 of the vertical "
        "acceleration (second derivative of the height by Savitzky-Golay, 15 samples, degree 3), on all of these rows "
        "and on those above 0.5 m; median over the flights."
    )
    metrics = (
        BenchmarkMetric("rmse", "m/s2"),
        BenchmarkMetric("r2", "", higher_is_better=True),
        BenchmarkMetric("rmse_airborne", "m/s2"),
        BenchmarkMetric("r2_airborne", "", higher_is_better=True),
    )
    published = tuple(
        PublishedRow(name, {"rmse": rmse, "r2": r2}, SOURCE, NOTE, comparable=False)
        for name, rmse, r2 in (
            ("constant gain", 36.735, -2434.785),
            ("time-indexed", 21.981, -8978.773),
            ("linear regression", 2.171, -0.259),
            ("voltage-conditioned", 254.547, -10146.020),
        )
    )
    minutes = 6

    def run(self, paths: Sequence[Path], work: Work) -> BenchmarkOutcome:
        flights = [read_flight(path) for path in paths]

        def name_effects() -> dict[str, Any]:
            logs = [flight.training() for flight in flights if flight.name in DIAGNOSED]
            return diagnosed(logs, system="quadrotor", candidates=CANDIDATES, max_effects=5, say=work.say)

        named = work.stage("diagnosis", name_effects)
        rows: dict[str, dict[str, float]] = {}
        as_published: dict[str, dict[str, float]] = {}
        for name, model in THRUST_MODELS.items():
            fitted = [model(flight) for flight in flights]
            rows[f"{name}, fitted here"] = _scores(flights, fitted)
            gravity = 0.0 if name == "linear regression" else GRAVITY
            as_published[name] = _scores(flights, [p - gravity for p in fitted])
        values: dict[str, Any] = {}
        for terms in RUNGS:
            made = work.stage(f"model_{len(terms)}", partial(_identified, terms, flights, work))
            values = made["values"]
            rows[f"ours, {' + '.join(('quadrotor', *terms))}"] = made["scores"]
        unseen = [name for name, entry in named["parameters"].items() if entry["interval_90"] is None]
        reserved = {"Provisional": named["leads"], "Not shown by the data": unseen}
        told = [f"{what}: {', '.join(names)}." for what, names in reserved.items() if names]
        system = machine("quadrotor", RUNGS[-1], values)
        return BenchmarkOutcome(
            rows,
            named["added"],
            {**named["parameters"], **{f"all flights: {k}": {"value": v} for k, v in values.items()}},
            [*words_of(named["added"], "the rigid quadrotor", named["verdict"]), *told],
            [_trace(system, flight) for flight in flights if flight.name in DIAGNOSED],
            {
                "verdict_of_the_diagnosis": named["verdict"],
                "with_gravity_as_in_the_compiled_script": as_published,
            },
        )


def read_flight(path: Path) -> BatteryFlight:
    """A file of the set; DataError where it is damaged, cut off, or of another set."""
    from scipy.signal import savgol_filter

    held = table(path, COLUMNS, what="NanoBench")
    rows = np.stack([held[name] for name in COLUMNS], 1)
    rows = rows[rows[:, COLUMNS.index("motor_motor_m1")] > FLYING]
    long_enough(len(rows), 200, path)
    all_filled(rows, path)
    t, x, u, voltage = rows[:, 0], flight_states(rows[:, 1:14], path), rows[:, 14:18], rows[:, 18]
    dt = float(np.median(np.diff(t)))
    vertical = np.asarray(savgol_filter(x[:, 2], SAMPLES, DEGREE, deriv=2, delta=dt) + GRAVITY)
    return BatteryFlight(path.stem, t, x, u[:, list(MOTORS)] / FULL, voltage, vertical)


def _identified(terms: Sequence[str], flights: Sequence[BatteryFlight], work: Work) -> dict[str, Any]:
    """Parameters from the training parts of all flights, and the scores of the tests."""
    name = " + ".join(["quadrotor", *terms])
    work.say(f"identifying {name}", 0, 1)
    system = machine("quadrotor", terms, {})
    data = read([flight.training() for flight in flights], system=system)
    estimate = identify(system, data.runs, clock=data.clock_scale, method=METHOD)
    values = by_name(estimate.vector, estimate.values)
    system = machine("quadrotor", terms, values)
    predicted = []
    for k, flight in enumerate(flights):
        work.say(f"predicting with {name}", k, len(flights))
        predicted.append(predicted_acceleration(system, flight)[flight.split :])
    return {"values": values, "scores": _scores(flights, predicted)}


def predicted_acceleration(system: System, flight: BatteryFlight) -> Array:
    """Vertical acceleration and gravity (n,) [m/s2] that the physics gives each measured row."""
    u = torch.from_numpy(np.column_stack((flight.u, flight.voltage)) if system.exogenous else flight.u)
    x = torch.from_numpy(flight.x)
    vertical = system.state_names.index("v_z")
    with torch.no_grad():
        z = system.augment(x[:1], u[:1])
        memory = [z[:, system.nx :]]
        for k in range(len(x) - 1):
            z = torch.cat((x[k : k + 1], memory[-1]), 1)
            memory.append(memory[-1] + STEP * system.memory_rate(0.0, z, u[k : k + 1]))
        rate = system.drift(0.0, torch.cat((x, torch.cat(memory)), 1), u)[:, vertical]
    return np.asarray(rate.numpy() + GRAVITY)


def _scores(flights: Sequence[BatteryFlight], predicted: Sequence[Array]) -> dict[str, float]:
    """Medians over flights of what the test rows leave."""
    seen: dict[str, list[float]] = {metric.key: [] for metric in NanoBench.metrics}
    for flight, path in zip(flights, predicted, strict=True):
        measured = flight.vertical[flight.split :]
        up = flight.x[flight.split :, 2] > AIRBORNE
        for ending, rows in (("", np.ones(len(up), dtype=bool)), ("_airborne", up)):
            if rows.any():  # or it ends before its last third
                error, spread = (path - measured)[rows], (measured - measured[rows].mean())[rows]
                seen[f"rmse{ending}"].append(rms(error))
                seen[f"r2{ending}"].append(1.0 - float((error**2).sum() / max((spread**2).sum(), 1e-12)))
    return {key: float(np.median(values)) for key, values in seen.items()}


def _trace(system: System, flight: BatteryFlight) -> Trace:
    up = np.flatnonzero(flight.x[flight.split :, 2] > AIRBORNE) + flight.split
    path = predicted_acceleration(system, flight)
    return Trace(
        f"{flight.name}, last 30 %, in the air",
        "vertical acceleration + g [m/s2]",
        flight.t[up] - flight.t[0],
        flight.vertical[up],
        path[up],
    )
