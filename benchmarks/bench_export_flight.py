"""Errors of an exported controller on the simulated PX4 vehicle, beside those of the controller in Python.

    python benchmarks/bench_export_flight.py RUN controller.ts [controller.pt2 ...] [--flights 5] [--seconds 24]

RUN is what `nsde train system=hexacopter` writes, and the files are what `nsde export` made of it. Flights are in
virtual time (the link, the checks and the commands of `nsde fly`), one after the other, in the same gusts for all.
"""

import time
from pathlib import Path
from statistics import fmean

from common import options

from nsde_torch.control.controller import SafetyOptions
from nsde_torch.control.problem import ProblemOptions
from nsde_torch.control.shapes import lemniscate
from nsde_torch.control.solve import SolverOptions
from nsde_torch.px4.flight.cascade import PathPoints
from nsde_torch.px4.flight.predictive import PredictiveMaker
from nsde_torch.px4.simulator.body import Body
from nsde_torch.px4.simulator.simulated import fly_simulated

PERIOD = 0.02


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("files", type=Path, nargs="+")
    parser.add_argument("--flights", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=24.0)
    given = parser.parse_args()
    path = lemniscate(duration=given.seconds)
    errors: dict[str, list[float]] = {}
    for name in (given.run, *given.files):
        how = {"system": "hexacopter", "path": path, "problem": ProblemOptions(), "safety": SafetyOptions()}
        controller = PredictiveMaker(
            run=str(name), solver=SolverOptions(iterations=10, tolerance=5e-3), **how
        )(print)
        found = errors.setdefault(name.name, [])
        for seed in range(given.flights):
            controller.reset()
            body = Body("hexacopter", seed=seed, latency=0.02)
            started = time.perf_counter()
            report = fly_simulated(body, controller, PathPoints(path), seed=seed, period=PERIOD)
            if report.rmse is None:
                raise SystemExit(f"{name}, flight {seed}: {report.outcome.trouble}")
            found.append(100.0 * report.rmse)
            took = time.perf_counter() - started
            print(f"{name.name}, flight {seed}: RMSE {found[-1]:.3f} cm ({took:.0f} s)")
    theirs = errors[given.run.name]
    for name, ours in errors.items():
        apart = ", ".join(f"{100.0 * (a / b - 1.0):+.2f}" for a, b in zip(ours, theirs, strict=True))
        more = 100.0 * (fmean(ours) / fmean(theirs) - 1.0)
        print(f"{name}: mean {fmean(ours):.3f} cm ({more:+.2f} %); flight by flight {apart} %")


if __name__ == "__main__":
    main()
