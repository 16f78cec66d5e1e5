"""Question: does the test of feedback say what is so, are estimates by instruments right, and do intervals hold?

    python benchmarks/bench_feedback.py --seeds 30
    python benchmarks/bench_feedback.py --hexacopter --seeds 5

A machine that turns about one axis under a rate controller, flown by tests/helpers/rate_loops.py (no code of the
package). The controller acts on the logged states, or on sensors of its own at 100 Hz or 1 kHz; or inputs are played
(open). The actuator has no lag, one that is declared, or one that is not. With --hexacopter: three flights for each
seed with motor lag, drag and gusts, by sticks through a cascade (`blind/loop_flight.py`), true effects declared.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from common import Json, options, write_json
from loop_flight import STICKS, Flight
from loop_flight import fly as fly_multirotors
from loop_machine import Machine

from nsde_torch.data import Run
from nsde_torch.sysid.identify import identify_in_loop
from nsde_torch.sysid.instruments import adopted
from nsde_torch.systems import System, make_system
from tests.helpers.rate_loops import CONTROLLERS, GAIN, RateLoop, fly

LAGS = {"none": (False, False), "declared": (True, True), "undeclared": (True, False)}
LEVEL = 0.9
TRUTH = {"thrust_gain": 4.6, "roll_gain": 108.0, "pitch_gain": 108.0, "yaw_gain": 3.4}
TRUTH["motor_lag.time_constant"] = 0.05


def main() -> None:
    parser = options(__doc__, seeds=30, first_seed=0, out=Path("bench_feedback.json"))
    parser.add_argument("--hexacopter", action="store_true", help="three axes instead of one")
    a = parser.parse_args()
    seeds = range(a.first_seed, a.first_seed + a.seeds)
    rows: list[Json] = []
    for name, *case in hexacopters(seeds) if a.hexacopter else rate_loops(seeds):
        rows.append({"case": name, **compared(*case)})
        shares = (f"{k} {rows[-1][k]:.0%}" for k in ("closed", "predictive", "by instruments"))
        print(f"{name}: {', '.join(shares)}\n{'':26}without: bias, +-, holds | with sticks: bias, +-, holds")
        for label, (*plain, b, half, holds) in rows[-1]["parameters"].items():
            print(f"{label:25s} {figures(*plain)} | {figures(b, half, holds):>26s}", flush=True)
        write_json(a.out, rows)


def rate_loops(seeds: range) -> Iterator[tuple[Any, ...]]:
    """Name, system, runs of each seed, instruments and true values of each controller and lag."""
    for controller in CONTROLLERS:
        for name, (lag, declared) in LAGS.items():
            runs = fly(controller, seeds=seeds, lag=lag)
            system = RateLoop(effects=["actuator_lag"] if declared else [])
            sticks = ("stick",) if controller != "open" else ()
            yield f"{controller}, lag {name}", system, runs, sticks, {"gain": GAIN}


def hexacopters(seeds: range) -> Iterator[tuple[Any, ...]]:
    """The same of hexacopters, by controller."""
    system = make_system("hexacopter", effects=["linear_drag", "motor_lag"])
    for controller, regime in zip(CONTROLLERS, "abc", strict=False):
        yield controller, system, fly_hexacopters(regime, seeds), STICKS, TRUTH


def fly_hexacopters(regime: str, seeds: range) -> list[list[Run]]:
    effects = {"motor_lag": {"time_constant": 0.05}, "linear_drag": {"drag": (0.15, 0.15, 0.05)}}
    gust = (0.5, 0.5, 0.3, 3.0, 3.0, 0.3)
    machine = Machine("hexacopter", 4.6, 0.0, (108.0, 108.0, 3.4), (0.6, 0.6), effects, gust)
    asked = [Flight(machine, "sticks", regime, 45.0, 0.0, 8 * seed + k) for seed in seeds for k in range(3)]
    runs = [
        Run(f"flight_{i % 3}", one.t, one.x, one.u, extra={name: one.extra[name] for name in STICKS})
        for i, one in enumerate(fly_multirotors(asked))
    ]
    return [runs[k : k + 3] for k in range(0, len(runs), 3)]


def compared(system: System, logs: Any, sticks: tuple[str, ...], truth: dict[str, float]) -> Json:
    """Shares of seeds, and of each parameter bias, half-width and share that holds, without and with sticks."""
    told: list[tuple[bool, ...]] = []
    rows: dict[str, list[list[float]]] = {name: [] for name in truth}
    for runs in logs:
        plain = identify_in_loop(system, runs)
        found = identify_in_loop(system, runs, instruments=sticks) if sticks else plain
        by_sticks = found.instrumented is not None and adopted(found.instrumented, found.loop)
        told.append((plain.loop.closed, plain.loop.predictive, by_sticks))
        for name, true in truth.items():
            j = found.vector.labels.index(name)
            rows[name].append([])
            for one in (plain, found):
                off, half = one.values[j] - true, one.half_widths(LEVEL)[j]
                rows[name][-1] += [off / true, half / true, abs(off) <= half]
    shares = dict(zip(("closed", "predictive", "by instruments"), np.mean(told, axis=0), strict=True))
    return {**shares, "parameters": {name: np.mean(each, axis=0).tolist() for name, each in rows.items()}}


def figures(bias: float, half: float, holds: float) -> str:
    return f"{bias:+9.1%} {half:6.1%} {holds:6.0%}"


if __name__ == "__main__":
    main()
