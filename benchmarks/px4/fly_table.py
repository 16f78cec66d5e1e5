"""Is a real PX4 flown to the end, and does every fault end as the documentation says?

PX4 must run and send its offboard link to udp 14540 (see how-to/px4.md; `nsde vehicle` does so too). Flights are those
of `nsde fly` at default settings, each in a process of its own; faults are made on the line, by signals and by limits.

    python benchmarks/px4/fly_table.py --out results/px4 --system quadrotor --models runs/quad --flights 20
    python benchmarks/px4/fly_table.py --out results/faults --system quadrotor --flights 0 --faults --px4-pid PID

Writes `table.json` with everything that was measured, and `table.md`.
"""

import argparse
import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "blind"))
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from study import markdown, options, write_json

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
    """One `nsde fly` in a process of its own: where it writes, its settings, and the port on which it waits."""

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
        file = self.folder / "flight.json"
        return json.loads(file.read_text())["flights"][-1] if file.is_file() else None


def _flight(name: str, run: str, k: int, given: argparse.Namespace, line: Line) -> dict[str, Any]:
    controller = "pid" if run == "pid" else "mpc"
    folder = given.out / "flights" / f"{k:02d}_{name}_{controller}"
    fly = Fly(folder, [f"run={run}", f"system={given.system}", *REFERENCES[name]], given.port + INNER)
    status = fly.wait()
    found, disarmed = fly.report or {}, line.wait_until_disarmed(60.0)
    age, gap, solve = (found.get(n) or {} for n in ("state_age_ms", "setpoint_gap_ms", "solve_ms"))
    return {
        **{"reference": name, "controller": controller, "status": status},
        "tracked": found.get("tracked", False),
        "landed": found.get("landed", False) and disarmed,
        **{key: found.get(key) for key in ("rmse_m", "position_error_max_m", "trouble")},
        "state_age_p50_ms": age.get("p50"),
        "setpoint_gap_p99.9_ms": gap.get("p99.9"),
        "solve_p99_ms": solve.get("p99"),
        "resets": found.get("estimate_resets", []),
        "said": fly.lines[-3:],
    }


def _faulty(fault: Fault, given: argparse.Namespace, line: Line) -> dict[str, Any]:
    run = given.models[0] if fault.predictive or given.predictive else "pid"
    folder = given.out / "faults" / fault.name.replace(" ", "_").replace("'", "")
    line.cut = line.stale = False
    fly = Fly(folder, [f"run={run}", f"system={given.system}", *fault.words], given.port + INNER)
    made = fault.make is None or fly.wait_for(fault.phase, fault.after)
    if fault.make is not None and made:
        fault.make(Flight(fly.process.pid, line))
    status, flight = fly.wait(), fly.report
    begun = time.monotonic()
    disarmed = fault.name == "PX4 killed" or line.wait_until_disarmed(60.0)
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


def _cell(value: float | None, factor: float = 1.0) -> str:
    return "-" if value is None else f"{factor * value:.1f}"


def table(content: dict[str, Any]) -> str:
    flights, faults = [], []
    for f in content["flights"]:
        good = f["tracked"] and f["landed"] and not f["status"]
        errors = (_cell(f[name], 100.0) for name in ("rmse_m", "position_error_max_m"))
        times = (_cell(f[name]) for name in ("state_age_p50_ms", "setpoint_gap_p99.9_ms"))
        flown = "yes" if good else f"no (exit {f['status']})"
        flights.append((f["reference"], f["controller"], flown, *errors, *times))
    for f in content["faults"]:
        trouble = "-" if f["trouble"] is None else f["trouble"]["text"].replace("|", "/")
        good = "yes" if not f["wrong"] else "NO: " + "; ".join(f["wrong"])
        faults.append((f["fault"], f["status"], trouble, good))
    of_flights = ("reference", "controller", "flown and landed", "RMSE [cm]", "largest [cm]")
    heads = (
        (*of_flights, "age p50 [ms]", "gap p99.9 [ms]"),
        ("fault", "exit status", "trouble", "as documented"),
    )
    tables = (
        [*markdown(head, rows), ""] for head, rows in zip(heads, (flights, faults), strict=True) if rows
    )
    about = f"PX4: {content['px4']}; {content['date']}; {content['system']}"
    return "\n".join([about, "", *(line for lines in tables for line in lines)])


def main() -> None:
    parser = options(__doc__, "out")
    parser.add_argument("--system", default="quadrotor", help="machine that PX4 flies")
    parser.add_argument(
        "--models", nargs="*", default=[], help="run directories for the predictive controller"
    )
    parser.add_argument("--flights", type=int, default=20, help="over references and controllers in turn")
    parser.add_argument("--faults", action="store_true", help="make the faults too")
    parser.add_argument("--predictive", action="store_true", help="a predictive controller flies every fault")
    parser.add_argument("--px4-pid", type=int, help="process id of PX4, to kill it in the end")
    parser.add_argument("--px4", default="not said", help="version of PX4 and simulator, for the table")
    parser.add_argument("--port", type=int, default=14540, help="port to which PX4 sends its offboard link")
    given = parser.parse_args()
    given.out = given.out.resolve()
    about = {"px4": given.px4, "date": time.strftime("%Y-%m-%d"), "system": given.system}
    content: dict[str, Any] = {**about, "flights": [], "faults": []}

    def add(part: str, found: dict[str, Any]) -> None:
        content[part].append(found)
        write_json(given.out / "table.json", content)
        (given.out / "table.md").write_text(table(content), encoding="utf-8")
        print(json.dumps(found), flush=True)

    with Line(given.port, given.port + INNER) as line:
        cases = [(name, run) for run in ("pid", *given.models) for name in REFERENCES]
        for k in range(given.flights):
            add("flights", _flight(*cases[k % len(cases)], k, given, line))
        for fault in faults(given.px4_pid) if given.faults else ():
            possible = given.models or not (fault.predictive or given.predictive)
            if possible:
                add("faults", _faulty(fault, given, line))
    print(table(content))


if __name__ == "__main__":
    main()
