"""Streams of a log, each on its own clock: are offsets of runs found and taken out, and do gains survive them?

    python benchmarks/bench_streams.py --seeds 12

Closed-loop flights of `blind/loop_machine.py` as five streams: motion capture (p and q), an estimator (v) and
a gyroscope (w) at 100 Hz, motors at 50 Hz and a battery at 10 Hz, both held. Estimator and gyroscope are offset against
motion capture by another time in each run (`offset`), by one in all runs (`common`), or not (`null`); with `offset of
motors` the motors are, too. Rotor speeds are quantised, with glitches, gaps and old values.
"""

import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from common import Array, columns, head, line, options, save
from loop_flight import LOG, SENSORS, Flight, fly, measured
from loop_machine import Machine
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

import nsde_torch
from nsde_torch.sysid.identify import identify
from nsde_torch.systems import make_system

RUNS, SECONDS, LAG = 4, 40.0, 0.04
MOST_RPM, POLES = 22_000.0, 14.0
KINDS = ("offset", "common", "null", "offset of motors", "rotor speeds")


class Case(NamedTuple):
    kind: str  # one of `KINDS`
    folder: Path  # where the runs are, one CSV file each
    late: Array  # how late estimator, gyroscope and motors are against motion capture in each run [s], (3, runs)
    gains: Array  # true thrust gain, roll gain and pitch gain


def make(kind: str, seed: int, folder: Path) -> Case:
    rng = np.random.default_rng([seed, KINDS.index(kind), 77])
    gains = np.array([rng.uniform(5, 9), *rng.uniform(60, 180, 2)])
    gain = gains.tolist()
    effects = {"motor_lag": {"time_constant": LAG}, "linear_drag": {"drag": (0.25, 0.25, 0.1)}}
    moments, gust = (*gain[1:], float(rng.uniform(4, 12))), (0.15, 0.15, 0.1, 1.0, 1.0, 0.2)
    machine = Machine("quadrotor", gain[0], 0.0, moments, (0.6, 0.65), effects, gust)
    paths = ["sticks", "waypoints", "sines", "circle"]
    flights = [
        Flight(machine, paths[(seed + r) % 4], "b", SECONDS, 40.0 * r, 1000 * seed + r) for r in range(RUNS)
    ]
    late = rng.uniform(-0.010, 0.020, (3, RUNS)) * (kind != "null")
    if kind == "common":
        late = np.repeat(late[:, :1], RUNS, axis=1)
    if kind != "offset of motors":
        late[2] = 0.0
    for r, flown in enumerate(fly(flights)):
        n = len(flown.t)
        k = np.arange(n) * LOG
        noise = SENSORS * rng.standard_normal((n, 12))
        true = CubicSpline(k, flown.truth)
        x = true(k)
        for some, d in ((slice(3, 6), late[0, r]), (slice(10, 13), late[1, r])):
            x[:, some] = true(np.clip(k - d, 0, k[-1]))[:, some]
        x = measured(x, noise)
        u = flown.u
        if kind == "rotor speeds":  # what the rotors do, behind their lag, at the row and not behind it
            stays = np.exp(-LOG / LAG)
            u = lfilter([1 - stays], [1, -stays], u, axis=0, zi=stays * u[:1])[0]
            u = np.vstack([flown.u[:1], u[:-1]])
            acting = _speeds(_of_stream(u, k - late[2, r], linear=True), rng)
        else:
            acting = _of_stream(u, k - late[2, r], linear=False)
        motors = acting[2 * (np.arange(n) // 2)]
        battery = flown.extra["battery_voltage"][10 * (np.arange(n) // 10)]
        names = (*columns("multirotor", 4), "battery_voltage")
        save(folder / f"flight_{r}.csv", names, [np.column_stack([flown.t, x, motors, battery])[50:-50]])
    return Case(kind, folder, late, gains)


def _of_stream(u: Array, at: Array, *, linear: bool) -> Array:
    """Inputs at other times: held, or straight between rows."""
    k = at / LOG
    low = np.clip(np.floor(k + 1e-9).astype(int), 0, len(u) - 1)
    if not linear:
        return np.asarray(u[low])
    share = np.clip(k - low, 0, 1)[:, None]
    return np.asarray((1 - share) * u[low] + share * u[np.minimum(low + 1, len(u) - 1)])


def _speeds(share: Array, rng: np.random.Generator) -> Array:
    """Speeds of rotors [rpm] that give shares of thrust, as a speed controller reports them."""
    grain = 100.0 * 2.0 / POLES  # hundreds of electrical turns
    rpm = grain * np.round(MOST_RPM * np.sqrt(np.clip(share, 0, 1)) / grain)
    n, motors = rpm.shape
    for motor in range(motors):
        rows = rng.choice(np.arange(60, n - 60, 8), 18, replace=False)
        rpm[rows[:6], motor] = MOST_RPM * rng.uniform(5, 12, 6)
        rpm[rows[6:12], motor] = 0.0
        for row in rows[12:]:
            rpm[row : row + 4, motor] = rpm[row, motor]
    return rpm


def errors(case: Case, *, policy: str) -> tuple[Array, dict[str, dict[str, float]], float]:
    """Relative errors of the gains (3,), offsets that were taken out by stream, and time to read [s]."""
    speeds = case.kind == "rotor speeds"
    system = make_system("quadrotor", effects=() if speeds else ("motor_lag",))
    start = time.perf_counter()
    options = {"rotor_speed": {"u": MOST_RPM}} if speeds else {}
    data = nsde_torch.read(case.folder, system=system, stream_offsets=policy, **options)
    took = time.perf_counter() - start
    findings = [f for f in data.summary.findings if f.kind == "stream_offset"]
    found = {f.message.split(" ")[0]: {k: float(v) for k, v in f.values.items()} for f in findings}
    result = identify(system, data.runs, clock=data.clock_scale)
    values = dict(zip(result.vector.labels, result.values.tolist(), strict=True))
    gains = np.array([values[name] for name in ("thrust_gain", "roll_gain", "pitch_gain")])
    return gains / case.gains - 1.0, found, took


def offset_error(case: Case, found: dict[str, dict[str, float]], stream: str) -> float:
    """Root mean square error of differences between the offsets of runs [ms]; nan where none were found."""
    if stream not in found:
        return float("nan")
    true = case.late["vw".index(stream)]
    got = np.array([found[stream].get(f"flight_{r}_s", 0.0) for r in range(RUNS)])
    off = (got - got.mean()) - (true - true.mean())
    return 1e3 * float(np.sqrt(np.square(off).mean()))


def main() -> None:
    parser = options(__doc__, seeds=12, first=0)
    parser.add_argument("--kinds", default=",".join(KINDS))
    given = parser.parse_args()
    head(
        "streams", "seed", "offsets found", "error v, w [ms]", "gains kept", "gains on one clock", "read [s]"
    )
    for kind in given.kinds.split(","):
        for seed in range(given.first, given.first + given.seeds):
            with tempfile.TemporaryDirectory() as folder:
                case = make(kind, seed, Path(folder))
                kept, _, _ = errors(case, policy="keep")
                there, found, took = errors(case, policy="undo")
            off = [offset_error(case, found, stream) for stream in "vw"]
            gains = [", ".join(f"{100 * o:+.0f}" for o in of) + " %" for of in (kept, there)]
            shown = ", ".join(found) or "none", f"{off[0]:.2g}, {off[1]:.2g}", *gains, f"{took:.1f}"
            print(line([kind, seed, *shown]), flush=True)


if __name__ == "__main__":
    main()
