"""Is a real PX4 flown to the end, and does every fault end as the documentation says?

PX4 must run and send its offboard link to udp 14540 (see how-to/px4.md; `nsde vehicle` does so too). Flights are those
of `nsde fly` at default settings, each in a process of its own; faults are made on the line, by signals and by limits.

    python benchmarks/px4/fly_table.py --out results/px4 --system quadrotor --models runs/quad --flights 20
    python benchmarks/px4/fly_table.py --out results/faults --system quadrotor --flights 0 --faults --px4-pid PID

Writes `table.json` with everything that was measured, and `table.md`.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.px4.faults import Fault, Flight, faults, verdict
from benchmarks.px4.line import Line
from nsde_torch.px4.link import dialect as d

INNER = 100
"""Port on which `nsde fly` waits, behind that to which PX4 sends."""
REFERENCES = {
    "hover": ("reference=hover",),
    "circle": ("reference=circle",),
    "lemniscate": ("reference=lemniscate",),
    "waypoints": ("reference=waypoints", "reference.points=[[0,0,1.5],[2,1,2],[0,2,1.5],[0,0,1.5]]"),
}
LONGEST = 900.0
"""Time after which a flight that does not end is killed [s]; a solver that is compiled takes minutes of it."""


class Fly:
    """One `nsde fly` in a process of its own.

    Args:
        folder: Where it writes.
        words: Its settings.
        port: On which it waits.
    """

    def __init__(self, folder: Path, words: list[str], port: int) -> None:
        self.folder, self.phases, self.lines = folder, dict[str, float](), list[str]()
        command = [sys.executable, "-m", "nsde_torch.cli", "fly", *words, f"out_dir={folder}"]
        self.process = subprocess.Popen(
            [*command, f"link.url=udpin:127.0.0.1:{port}"],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
        )
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.append(line.rstrip())
            _, s, phase = line.strip().partition(" s  ")
            if s:
                self.phases.setdefault(phase.partition(":")[0].strip(), time.monotonic())

    def wait(self) -> int:
        """Its exit status."""
        try:
            return self.process.wait(LONGEST)
        except subprocess.TimeoutExpired:
            self.process.kill()
            return self.process.wait()

    def wait_for(self, phase: str, after: float) -> bool:
        """Whether it has been in a phase for a time [s]."""
        end = time.monotonic() + LONGEST
        while time.monotonic() < end and self.process.poll() is None:
            if phase in self.phases and time.monotonic() - self.phases[phase] >= after:
                return True
            time.sleep(0.02)
        return False

    @property
    def report(self) -> dict[str, Any] | None:
        """What it wrote of the flight."""
        file = self.folder / "flight.json"
        return json.loads(file.read_text())["flights"][-1] if file.is_file() else None


def _flight(name: str, run: str, k: int, options: argparse.Namespace, line: Line) -> dict[str, Any]:
    controller = "pid" if run == "pid" else "mpc"
    folder = options.out / "flights" / f"{k:02d}_{name}_{controller}"
    fly = Fly(folder, [f"run={run}", f"system={options.system}", *REFERENCES[name]], options.port + INNER)
    status = fly.wait()
    found, disarmed = fly.report or {}, line.wait_until_disarmed(60.0)
    age, gap, solve = (found.get(n) or {} for n in ("state_age_ms", "setpoint_gap_ms", "solve_ms"))
    return {
        "reference": name,
        "controller": controller,
        "status": status,
        "tracked": found.get("tracked", False),
        "landed": found.get("landed", False) and disarmed,
        "rmse_m": found.get("rmse_m"),
        "position_error_max_m": found.get("position_error_max_m"),
        "state_age_p50_ms": age.get("p50"),
        "setpoint_gap_p99.9_ms": gap.get("p99.9"),
        "solve_p99_ms": solve.get("p99"),
        "resets": found.get("estimate_resets", []),
        "trouble": found.get("trouble"),
        "said": fly.lines[-3:],
    }


def _faulty(fault: Fault, options: argparse.Namespace, line: Line) -> dict[str, Any]:
    run = options.models[0] if fault.predictive or options.predictive else "pid"
    folder = options.out / "faults" / fault.name.replace(" ", "_").replace("'", "")
    line.cut = line.stale = False
    fly = Fly(folder, [f"run={run}", f"system={options.system}", *fault.words], options.port + INNER)
    made = fault.make is None
    if fault.make is not None and fly.wait_for(fault.phase, fault.after):
        fault.make(Flight(fly.process.pid, line, options.px4_pid))
        made = True
    status, flight = fly.wait(), fly.report
    begun = time.monotonic()
    gone = fault.name == "PX4 killed"
    disarmed = gone or line.wait_until_disarmed(60.0)
    took = time.monotonic() - begun
    line.cut = line.stale = False
    wrong = verdict(fault, status, flight, disarmed) if made else ["the fault could not be made"]
    if not disarmed:  # so that the next flight finds it on the ground
        line.ask(d.LAND)
        line.wait_until_disarmed(60.0)
    return {
        "fault": fault.name,
        "status": status,
        "trouble": (flight or {}).get("trouble"),
        "gap_max_ms": ((flight or {}).get("setpoint_gap_ms") or {}).get("max"),
        "disarmed_after_s": took,
        "wrong": wrong,
        "said": fly.lines[-3:],
    }


def _cell(value: float | None, factor: float = 1.0, digits: int = 1) -> str:
    return "-" if value is None else f"{factor * value:.{digits}f}"


def table(content: dict[str, Any]) -> str:
    """The results as Markdown."""
    lines = [f"PX4: {content['px4']}; {content['date']}; {content['system']}", ""]
    if content["flights"]:
        lines += [
            "| reference | controller | flown and landed | RMSE [cm] | largest [cm] | age p50 [ms] | gap p99.9 [ms] |",
            "|---|---|---|---|---|---|---|",
        ]
        for f in content["flights"]:
            row = [
                f["reference"],
                f["controller"],
                "yes" if f["tracked"] and f["landed"] and not f["status"] else f"no (exit {f['status']})",
                _cell(f["rmse_m"], 100.0),
                _cell(f["position_error_max_m"], 100.0),
                _cell(f["state_age_p50_ms"]),
                _cell(f["setpoint_gap_p99.9_ms"]),
            ]
            lines.append(f"| {' | '.join(row)} |")
        lines.append("")
    if content["faults"]:
        lines += ["| fault | exit status | trouble | as documented |", "|---|---|---|---|"]
        for f in content["faults"]:
            trouble = "-" if f["trouble"] is None else f["trouble"]["text"].replace("|", "/")
            good = "yes" if not f["wrong"] else "NO: " + "; ".join(f["wrong"])
            lines.append(f"| {f['fault']} | {f['status']} | {trouble} | {good} |")
        lines.append("")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder to write into")
    parser.add_argument("--system", default="quadrotor", help="machine that PX4 flies")
    parser.add_argument(
        "--models", nargs="*", default=[], help="run directories for the predictive controller"
    )
    parser.add_argument(
        "--flights", type=int, default=20, help="flights, over references and controllers in turn"
    )
    parser.add_argument("--references", nargs="*", default=list(REFERENCES), choices=list(REFERENCES))
    parser.add_argument("--faults", action="store_true", help="make the faults too")
    parser.add_argument(
        "--predictive", action="store_true", help="make every fault while a predictive controller flies"
    )
    parser.add_argument("--only", nargs="*", default=[], help="names of the faults to make; none: all")
    parser.add_argument("--px4-pid", type=int, help="process id of PX4, to kill it in the end")
    parser.add_argument("--px4", default="not said", help="version of PX4 and simulator, for the table")
    parser.add_argument("--port", type=int, default=14540, help="port to which PX4 sends its offboard link")
    options = parser.parse_args()
    options.out = options.out.resolve()
    options.out.mkdir(parents=True, exist_ok=True)
    content: dict[str, Any] = {
        "px4": options.px4,
        "date": time.strftime("%Y-%m-%d"),
        "system": options.system,
        "flights": [],
        "faults": [],
    }

    def write() -> None:
        (options.out / "table.json").write_text(json.dumps(content, indent=1), encoding="utf-8")
        (options.out / "table.md").write_text(table(content), encoding="utf-8")

    with Line(options.port, options.port + INNER) as line:
        cases = [(name, run) for run in ("pid", *options.models) for name in options.references]
        for k in range(options.flights):
            name, run = cases[k % len(cases)]
            content["flights"].append(_flight(name, run, k, options, line))
            write()
            print(json.dumps(content["flights"][-1]), flush=True)
        for fault in faults(options.px4_pid) if options.faults else ():
            if ((fault.predictive or options.predictive) and not options.models) or (
                options.only and fault.name not in options.only
            ):
                continue
            content["faults"].append(_faulty(fault, options, line))
            write()
            print(json.dumps(content["faults"][-1]), flush=True)
    print(table(content))


if __name__ == "__main__":
    main()
