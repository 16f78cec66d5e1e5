"""Is a real PX4 flown to the end, and does every fault end as the documentation says?

PX4 must run and send its offboard link to udp 14540 (see how-to/px4.md; `nsde vehicle` does so too). Flights are those
of `nsde fly` at default settings, each in a process of its own. Faults are made by signals, by limits, and on a line of
two UDP sockets that can be cut, thinned and spoken on: PX4 -> udp 14540 (here) -> udp 14640 (`nsde fly`), and back.

    python benchmarks/px4/fly_table.py --out results/px4 --system quadrotor --models runs/quad --flights 20
    python benchmarks/px4/fly_table.py --out results/faults --system quadrotor --flights 0 --faults --px4-pid PID

Writes `table.json` with everything that was measured, and `table.md`.
"""

from __future__ import annotations

import argparse
import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "blind"))

from study import markdown, options, write_json

from nsde_torch.control import shapes
from nsde_torch.px4.flight.cascade import PathPoints
from nsde_torch.px4.link import dialect as d
from nsde_torch.px4.link.codec import Codec
from nsde_torch.px4.link.dialect import Mode, mavlink
from nsde_torch.px4.link.endpoint import NUMBERS

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
STATES = frozenset(NUMBERS[n] for n in ("ODOMETRY", "ATTITUDE_QUATERNION", "LOCAL_POSITION_NED"))
_OPERATOR = 255
"""System id of a ground station."""


def _frames(data: bytes) -> Iterator[bytes]:
    """MAVLink 2 frames of a datagram; what is none comes as it is."""
    at = 0
    while at < len(data):
        if data[at] != 0xFD or len(data) - at < 12:
            yield data[at:]
            return
        size = 12 + data[at + 1] + (13 if data[at + 2] & 1 else 0)
        yield data[at : at + size]
        at += size


@final
class Line:
    """The line, between the port to which PX4 sends its offboard link and that on which `nsde fly` waits.

    Nothing passes while it is `cut`, and no states while it is `stale`; `armed` and the time `heard` [s] are those
    of PX4's last heartbeat.
    """

    def __init__(self, outer: int, inner: int) -> None:
        self._outer = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._outer.bind(("127.0.0.1", outer))
        self._inner = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._inner.bind(("127.0.0.1", 0))
        self._fly, self._px4 = ("127.0.0.1", inner), ("", 0)
        self._reader = Codec(_OPERATOR, 190, wanted=frozenset({NUMBERS["HEARTBEAT"]}))
        self._writer = Codec(_OPERATOR, 190)
        self._system = 1
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self.cut = self.stale = self.armed = False
        self.heard = 0.0

    def __enter__(self) -> Line:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stop.set()
        self._thread.join(2.0)
        self._outer.close()
        self._inner.close()

    def ask(self, mode: Mode) -> None:
        """Ask PX4 for a mode, as another client would."""
        if not self._px4[1]:
            return  # it was never heard
        message = mavlink.MAVLink_command_long_message(
            self._system, 1, d.SET_MODE, 0, 1, mode.main, mode.sub, 0, 0, 0, 0
        )
        self._outer.sendto(self._writer.pack(message), self._px4)

    def wait_until_disarmed(self, longest: float) -> bool:
        """Whether PX4 says within a time [s] that it is disarmed; a heartbeat that comes now counts."""
        begun = time.monotonic()
        while time.monotonic() - begun < longest:
            if self.heard > begun and not self.armed:
                return True
            time.sleep(0.1)
        return False

    def _run(self) -> None:
        while not self._stop.is_set():
            for ready in select.select([self._outer, self._inner], [], [], 0.05)[0]:
                try:
                    data, source = ready.recvfrom(65536)
                except OSError:  # the other side is not there yet
                    continue
                if ready is self._outer:
                    self._px4 = source
                    self._listen(data)
                    if not self.cut:
                        self._pass_down(data)
                elif not self.cut and self._px4[1]:
                    self._outer.sendto(data, self._px4)

    def _listen(self, data: bytes) -> None:
        for message in self._reader.unpack(data, time.monotonic()):
            if message.autopilot == d.AUTOPILOT_PX4:
                self._system = message.get_srcSystem()
                self.armed = bool(message.base_mode & d.ARMED_FLAG)
                self.heard = time.monotonic()

    def _pass_down(self, data: bytes) -> None:
        if self.stale:
            data = b"".join(f for f in _frames(data) if int.from_bytes(f[7:10], "little") not in STATES)
        if data:
            self._inner.sendto(data, self._fly)


Make = Callable[[int, Line], None]
"""Makes a fault, by the process of `nsde fly` and the line between it and PX4."""


@dataclass(frozen=True)
class Fault:
    name: str  # what happens
    make: Make | None  # None: a limit that is set beforehand
    status: tuple[int, ...]  # exit statuses that are right
    trouble: tuple[str, ...] = ()  # kinds of trouble that are right; empty: none is written, as it has ended
    words: tuple[str, ...] = ("reference=lemniscate",)  # settings of the flight
    phase: str = "track"  # in which it is made
    after: float = 3.0  # how long into it [s]
    predictive: bool = False  # whether it needs a predictive controller


def _signal(*numbers: int, pause: float = 0.5) -> Make:
    def make(pid: int, line: Line) -> None:
        for k, number in enumerate(numbers):
            if k:
                time.sleep(pause)
            os.kill(pid, number)

    return make


def _set(name: str) -> Make:
    return lambda pid, line: setattr(line, name, True)


def _stop_the_solver(pid: int, line: Line) -> None:
    """The controller's process stands still; it is the child that is not Python's resource tracker."""
    tasks = Path(f"/proc/{pid}/task")
    for child in [int(c) for t in tasks.iterdir() for c in (t / "children").read_text().split()]:
        if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes():
            os.kill(child, signal.SIGSTOP)


def _fence() -> str:
    """A fence one centimetre outside of the circle."""
    path = PathPoints(shapes.circle())
    rows = [[low - 0.01, high + 0.01] for low, high in zip(path.low[:2], path.high[:2], strict=True)]
    return f"limits.fence={[*rows, [-0.5, 6.0]]}".replace(" ", "")


def faults(px4: int | None) -> list[Fault]:
    """All of them; PX4 is killed last, and only where its process is known."""
    lost = (4,), ("link", "estimate")
    stands = _signal(signal.SIGSTOP, signal.SIGCONT, pause=4.0)
    out: list[Fault] = [
        Fault("killed with -9", _signal(signal.SIGKILL), (-signal.SIGKILL,)),
        Fault("stopped for 4 s", stands, (3,), ("late", "mode", "link")),
        Fault("SIGINT once", _signal(signal.SIGINT), (130,), ("stop",)),
        Fault("SIGINT twice", _signal(signal.SIGINT, signal.SIGINT), (130,), ("stop",)),
        Fault("fence", None, (3,), ("fence",), ("reference=circle", _fence())),
        Fault("speed", None, (3,), ("speed",), ("reference=lemniscate", "limits.speed=1.5")),
        # a predictive controller does not fly plans that tilt too far
        Fault("tilt", None, (3,), ("tilt", "solver"), ("reference=lemniscate", "limits.tilt=15")),
        Fault("no states", _set("stale"), (3,), ("estimate",)),
        Fault("another client's mode", lambda pid, line: line.ask(d.LAND), (3,), ("mode",)),
        Fault("link cut at take-off", _set("cut"), *lost, phase="take off", after=1.5),
        Fault("link cut on the reference", _set("cut"), *lost),
        Fault("link cut while landing", _set("cut"), *lost, phase="land", after=0.3),
        Fault("plans late", _stop_the_solver, (3,), ("solver",), predictive=True),
        Fault("battery low", None, (3,), ("battery",), ("reference=lemniscate", "limits.battery=0.85")),
    ]
    if px4 is not None:
        out.append(Fault("PX4 killed", lambda pid, line: os.kill(px4, signal.SIGKILL), *lost))
    return out


def verdict(fault: Fault, status: int, flight: dict[str, Any] | None, disarmed: bool) -> list[str]:
    """What did not end as it should have; empty: nothing."""
    out = []
    if status not in fault.status:
        out.append(f"exit status {status}, not {' or '.join(map(str, fault.status))}")
    trouble = ((flight or {}).get("trouble") or {}).get("kind")
    if fault.trouble and trouble not in fault.trouble:
        out.append(f"trouble {trouble!r}, not {' or '.join(fault.trouble)}")
    if not disarmed:
        out.append("not disarmed within a minute")
    return out


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
        threading.Thread(target=self._read, daemon=True).start()

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
        fault.make(fly.process.pid, line)
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
    lines = [f"PX4: {content['px4']}; {content['date']}; {content['system']}", ""]
    if flights:
        lines += [*markdown((*of_flights, "age p50 [ms]", "gap p99.9 [ms]"), flights), ""]
    if faults:
        lines += [*markdown(("fault", "exit status", "trouble", "as documented"), faults), ""]
    return "\n".join(lines)


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
