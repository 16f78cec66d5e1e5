"""Times of an exported controller from C++, one thread, on states along the lemniscate.

    python benchmarks/bench_export.py RUN --program build/flight_computer [--file controller.ts] [--seconds 20]

RUN is what `nsde train system=hexacopter` writes; the program is examples/flight_computer, built. Without --file the
controller is exported first. States are off the reference by the errors of a flight, 20 ms apart, so that plans are
warm-started as in a flight; the predictions over the latency are not counted, as in the times of `nsde track`.
"""

from __future__ import annotations

import argparse
import csv
import subprocess
import tempfile
from pathlib import Path

import torch

import nsde_torch
from nsde_torch.control.controller import SafetyOptions
from nsde_torch.control.problem import ProblemOptions
from nsde_torch.control.reference import Reference
from nsde_torch.control.shapes import lemniscate
from nsde_torch.control.solve import SolverOptions
from nsde_torch.export.verify import along
from nsde_torch.export.write import KINDS, export
from nsde_torch.systems.multirotor import Multirotor

PERIOD = 0.02


def write(file: Path, times: list[float], rows: list[list[float]]) -> None:
    """States over time as a CSV file."""
    with file.open("w", newline="", encoding="utf-8") as opened:
        writer = csv.writer(opened)
        writer.writerow(["t", *Multirotor.state_names])
        writer.writerows([t, *row] for t, row in zip(times, rows, strict=True))


def main() -> None:
    """Run the measurement."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("--program", type=Path, required=True)
    parser.add_argument("--file", type=Path, default=None)
    parser.add_argument("--kind", choices=KINDS, default="torchscript")
    parser.add_argument("--seconds", type=float, default=20.0)
    given = parser.parse_args()
    torch.set_num_threads(1)
    path, problem = Reference(lemniscate()), ProblemOptions()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        file = given.file
        if file is None:
            file = folder / "controller"
            export(
                nsde_torch.load(given.run),
                file,
                problem=problem,
                solver=SolverOptions(iterations=10, tolerance=5e-3),
                safety=SafetyOptions(),
                kind=given.kind,
                run=given.run,
                sample=0.01,
                period=PERIOD,
                latency=0.04,
                say=print,
            )
        count = round(given.seconds / PERIOD)
        states = along(path, count, dt=problem.dt, steps=problem.steps, period=PERIOD)
        write(folder / "log.csv", [2.0 + PERIOD * k for k in range(count)], [x.tolist() for x, _ in states])
        grid = path.dt * torch.arange(round(path.duration / path.dt) + 1, dtype=torch.float64)
        write(folder / "reference.csv", grid.tolist(), path.at(grid).tolist())
        words = ["--controller", file, "--log", folder / "log.csv", "--reference", folder / "reference.csv"]
        subprocess.run([str(given.program), *map(str, words)], check=True)


if __name__ == "__main__":
    main()
