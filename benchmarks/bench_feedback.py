"""Question: does the test of feedback say what is so, are estimates by instruments right, and do intervals hold?

    python benchmarks/bench_feedback.py --seeds 30
    python benchmarks/bench_feedback.py --hexacopter --seeds 5

A machine that turns about one axis under a rate controller, flown by tests/helpers/rate_loops.py (no code of the
package). The controller acts on the logged states, or on sensors of its own at 100 Hz or 1 kHz; or inputs are played
(open). The actuator has no lag, one that is declared, or one that is not. With --hexacopter: three flights for each
seed with motor lag, drag and gusts, by sticks through a cascade (`blind/loop_flight.py`), true effects declared.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from common import options, write_json
from loop_flight import STICKS, Flight
from loop_flight import fly as fly_multirotors
from loop_machine import Machine

from nsde_torch.data import Run
from nsde_torch.sysid.identify import identify_in_loop
from nsde_torch.sysid.instruments import adopted
from nsde_torch.sysid.result import Identification
from nsde_torch.systems import make_system
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
    if a.hexacopter:
        kinds = zip(CONTROLLERS, "abc", strict=False)
        write_json(a.out, [hexacopters(controller, regime, seeds) for controller, regime in kinds])
        return
    rows: list[dict[str, Any]] = []
    print(
        "controller lag        | closed predictive | without sticks: gain bias% +- holds | with sticks, printed"
    )
    for controller in CONTROLLERS:
        for name, (lag, told) in LAGS.items():
            rows.append({"controller": controller, "lag": name, **case(controller, seeds, lag, told)})
            r = rows[-1]
            shares = f"{r['closed']:4.0%}   {r['predictive']:4.0%}   | {line(r['without'])}"
            print(
                f"{controller:10s} {name:10s} |  {shares} |   {line(r['sticks'])}  {r['printed']:4.0%}",
                flush=True,
            )
            write_json(a.out, rows)


def case(controller: str, seeds: range, lag: bool, told: bool) -> dict[str, Any]:
    system = RateLoop(effects=["actuator_lag"] if told else [])
    plain, sticks = [], []
    for runs in fly(controller, seeds=seeds, lag=lag):
        plain.append(identify_in_loop(system, runs))
        told = ["stick"] if controller != "open" else []
        sticks.append(identify_in_loop(system, runs, instruments=told) if told else plain[-1])
    loops = [found.loop for found in plain]
    return {
        "closed": share(loop is not None and loop.closed for loop in loops),
        "predictive": share(loop is not None and loop.predictive for loop in loops),
        "without": figures(plain),
        "sticks": figures(sticks),
        "printed": share(map(by_instruments, sticks)),
    }


def share(some: Iterable[bool]) -> float:
    return float(np.mean([*some]))


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


def hexacopters(controller: str, regime: str, seeds: range) -> dict[str, Any]:
    """Figures of the gains and the lag of hexacopters, printed and returned."""
    system = make_system("hexacopter", effects=["linear_drag", "motor_lag"])
    rows: dict[str, list[list[float]]] = {name: [] for name in TRUTH}
    told = []
    for runs in fly_hexacopters(regime, seeds):
        plain, found = (identify_in_loop(system, runs, instruments=names) for names in ((), STICKS))
        assert found.instrumented is not None
        assert found.loop is not None
        told.append((found.loop.closed, found.loop.predictive, adopted(found.instrumented, found.loop)))
        for name, true in TRUTH.items():
            j = found.vector.labels.index(name)
            rows[name].append([])
            for one in (plain, found):
                off, half = one.values[j] - true, one.half_widths(LEVEL)[j]
                rows[name][-1] += [off / true, half / true, abs(off) <= half]
    closed, predictive, printed = np.mean(told, axis=0)
    print(f"{controller}: closed {closed:.0%}, predictive {predictive:.0%}, by instruments {printed:.0%}")
    print("                          without: bias, +-, holds | with sticks: bias, +-, holds")
    means = {name: np.mean(of_seeds, axis=0).tolist() for name, of_seeds in rows.items()}
    for name, (a, width, holds, b, half, holds_b) in means.items():
        print(
            f"{name:25s} {a:+9.1%} {width:6.1%} {holds:6.0%} | {b:+12.1%} {half:6.1%} {holds_b:6.0%}",
            flush=True,
        )
    return {"controller": controller, "closed": closed, "predictive": predictive, "printed": printed, **means}


def figures(found: Sequence[Identification]) -> dict[str, float]:
    """Mean gain, its bias, mean half-width, and the share of intervals that hold the truth."""
    gains = np.array([f.values[0] for f in found])
    halves = np.array([f.half_widths(LEVEL)[0] for f in found])
    return {
        "gain": float(gains.mean()),
        "bias": float(gains.mean() / GAIN - 1.0),
        "half_width": float(halves.mean()),
        "holds": float((np.abs(gains - GAIN) <= halves).mean()),
    }


def by_instruments(found: Identification) -> bool:
    """Whether the printed gain is the instruments'."""
    i = found.instrumented
    return i is not None and found.loop is not None and bool(i.moved[0]) and adopted(i, found.loop)


def line(f: dict[str, float]) -> str:
    return f"{f['gain']:6.1f} {f['bias']:+5.0%} {f['half_width']:5.1f} {f['holds']:5.0%}"


if __name__ == "__main__":
    main()
