"""A controller in C, in Python, as TorchScript and as machine code for libtorch: times and memory, in one run.

    python benchmarks/bench_export_c.py declared RUN [--program build/flight_computer] [--package controller.pt2]

`declared` is the physics alone, RUN what `nsde train system=hexacopter` writes. States are along the lemniscate, 20 ms
apart, off it by more than a flight's errors, so that nearly all plans take two iterations. C is compiled (CC names the
compiler) into a process that does nothing else; files for libtorch are run by examples/flight_computer, if it is given;
the package is that of the last RUN. Forms take turns, and a row shows the lowest and the highest of the repeats. Last
come the seconds from the start of `nsde track` to its first plan, with empty caches and again.
"""

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from common import head, line, options, save

from nsde_torch.control.compiled import compiler
from nsde_torch.control.controller import Controller, Plan, SafetyOptions
from nsde_torch.control.loop import DECLARED, knowledge
from nsde_torch.control.problem import ProblemOptions
from nsde_torch.control.reference import Reference
from nsde_torch.control.shapes import lemniscate
from nsde_torch.control.solve import SolverOptions
from nsde_torch.export.verify import along, resident_mb
from nsde_torch.export.write import export
from nsde_torch.systems.multirotor import Multirotor

Times = dict[str, float]
PERIOD = 0.02
COLUMNS = ("t", *Multirotor.state_names)
DRIVER = Path(__file__).with_suffix(".c")
FORMS = {
    "C, double, -O2": ("float64", ("-O2",)),
    "C, double, -O3 -march=native": ("float64", ("-O3", "-march=native")),
    "C, float, -O2": ("float32", ("-O2",)),
}


def written(run: str, file: Path, kind: str, precision: str) -> Path:
    export(
        knowledge(run, "hexacopter"),
        file,
        problem=ProblemOptions(),
        solver=SolverOptions(iterations=10, tolerance=5e-3),
        safety=SafetyOptions(),
        kind=kind,
        run=None if run == DECLARED else Path(run),
        sample=0.01,
        period=PERIOD,
        latency=0.04,
        dtype=getattr(torch, precision),
    )
    return file


def driver(file: Path, flags: tuple[str, ...], samples: Path, count: int) -> Callable[[], Times]:
    """Runs a controller in C over the samples."""
    program = file.with_name("driver")
    words = [str(compiler()), "-std=c99", *flags, f"-I{file.parent}", str(DRIVER), str(file), "-lm"]
    subprocess.run([*words, "-o", str(program)], check=True)

    def run() -> Times:
        done = subprocess.run([program, samples, str(count), str(PERIOD)], check=True, capture_output=True)
        found: Times = json.loads(done.stdout)
        return found

    return run


def host(program: Path, file: Path, folder: Path) -> Callable[[], Times]:
    """Runs a file for libtorch over the same states."""

    def run() -> Times:
        words = ["--controller", file, "--log", folder / "log.csv", "--reference", folder / "reference.csv"]
        done = subprocess.run([str(program), *map(str, words)], check=True, capture_output=True, text=True)
        print(next(row for row in done.stdout.splitlines() if row.startswith("solves:")), flush=True)
        figures = r"p50 ([\d.]+) ms.*p99 ([\d.]+) ms.*max ([\d.]+) ms.*memory: ([\d.]+) MB"
        found = re.search(figures, done.stdout, re.DOTALL)
        assert found is not None
        keys = ("p50_ms", "p99_ms", "max_ms", "memory_mb")
        return dict(zip(keys, map(float, found.groups()), strict=True))

    return run


def python(run: str, states: list[tuple[torch.Tensor, torch.Tensor]]) -> Callable[[], Times]:
    """Runs the controller in Python over the states, with the checks and tables around a solve."""
    controller = Controller(knowledge(run, "hexacopter"))

    def measure() -> Times:
        before: Plan | None = None
        memory, took = resident_mb(), []
        for x, reference in states:
            began = time.perf_counter()
            before = controller.plan(x[None], reference[None], before, elapsed=PERIOD)
            took.append(1e3 * (time.perf_counter() - began))
        p50, p99, most = np.percentile(took[20:], (50, 99, 100)).tolist()
        return {"memory_mb": memory, "p50_ms": p50, "p99_ms": p99, "max_ms": most}

    return measure


def first_plan(run: str, folder: Path) -> float:
    """Seconds from the start of `nsde track` to its first plan, with what the cache in a folder holds."""
    words = ["nsde", "track", "reference=lemniscate", f"out_dir={folder / 'out'}"]
    words += (
        ["run=declared", "plant.system=hexacopter"] if run == DECLARED else [f"run={Path(run).resolve()}"]
    )
    code = (
        f"import os, sys; sys.argv = {words!r}\n"
        "from nsde_torch.control.autopilots import PredictivePilot as Pilot\n"
        "command = Pilot.command\n"
        "Pilot.command = lambda *given: (command(*given), os._exit(0))\n"
        "from nsde_torch.cli.main import entry; entry()"
    )
    own = {**os.environ, "NSDE_CACHE": str(folder), "OMP_NUM_THREADS": "1"}
    began = time.perf_counter()
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, env=own)
    return time.perf_counter() - began


def main() -> None:
    parser = options(__doc__, repeats=5)
    parser.add_argument("runs", nargs="+")
    parser.add_argument("--program", type=Path, default=None)
    parser.add_argument("--package", type=Path, default=None)
    parser.add_argument("--seconds", type=float, default=20.0)
    given = parser.parse_args()
    path, problem, count = Reference(lemniscate()), ProblemOptions(), round(given.seconds / PERIOD)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        states = along(path, count, dt=problem.dt, steps=problem.steps, period=PERIOD)
        seconds, rows = 2.0 + PERIOD * np.arange(count), [x.tolist() for x, _ in states]
        save(folder / "log.csv", COLUMNS, [seconds, rows], "%.17g")
        grid = path.dt * torch.arange(round(path.duration / path.dt) + 1, dtype=torch.float64)
        save(folder / "reference.csv", COLUMNS, [grid.numpy(), path.at(grid).numpy()], "%.17g")
        samples = folder / "samples.bin"
        torch.cat([torch.cat((x[None], ref)).flatten() for x, ref in states]).numpy().tofile(samples)
        forms: dict[tuple[str, str], Callable[[], Times]] = {}
        for n, run in enumerate(given.runs):
            called = "physics alone" if run == DECLARED else "with networks"
            for k, (form, (precision, flags)) in enumerate(FORMS.items()):
                file = written(run, folder / f"c_{n}_{k}" / "controller.c", "c", precision)
                forms[called, form] = driver(file, flags, samples, count)
            forms[called, "Python"] = python(run, states)
            if given.program is not None:
                file = written(run, folder / f"controller_{n}.ts", "torchscript", "float64")
                forms[called, "TorchScript"] = host(given.program, file, folder)
        if given.program is not None and given.package is not None:
            forms[called, "format=aoti"] = host(given.program, given.package, folder)
        found = defaultdict(list)
        for _ in range(given.repeats):
            for form, measured in forms.items():
                found[form].append(measured())
    columns = ("p50", "p99", "max")
    times = ("p50 [ms]", "p99 [ms]", "largest [ms]")
    head("model", "form", *times, "the same of the processor alone", "resident [MB]")

    def span(rows: list[Times], key: str) -> str:
        low, high = min(r[key] for r in rows), max(r[key] for r in rows)
        return f"{low:.2f} to {high:.2f}"

    for (called, form), rows in found.items():
        clock = [span(rows, f"{c}_ms") for c in columns]
        own = ", ".join(span(rows, f"{c}_cpu_ms") for c in columns) if "p50_cpu_ms" in rows[0] else ""
        print(line([called, form, *clock, own, f"{max(r['memory_mb'] for r in rows):.1f}"]))
    for run in given.runs:
        with tempfile.TemporaryDirectory() as name:
            seconds = [first_plan(run, Path(name)) for _ in range(1 + given.repeats)]
        again = f"{min(seconds[1:]):.1f} to {max(seconds[1:]):.1f}"
        print(f"first plan of `nsde track run={run}`: {seconds[0]:.1f} s with an empty cache, then {again} s")


if __name__ == "__main__":
    main()
