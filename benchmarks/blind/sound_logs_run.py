"""What reading sound logs says that is not so.

    python benchmarks/blind/sound_logs.py --seed 5 --out sound/
    python benchmarks/blind/sound_logs_run.py --seed 5 --logs sound/                 # reads them
    python benchmarks/blind/sound_logs_run.py --seed 5 --logs sound/ --judge         # the table again
    python benchmarks/blind/sound_logs_run.py --seed 5 --logs sound/ --diagnose 16   # diagnoses of some of each system

What `nsde_torch.read` finds of a log of `sound_logs`, beside what a habit truly does (`TRUE`), is a false alarm, and so
is a refusal.
"""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from sound_logs import Case, cases, options
from study import markdown, read_json, write_json

import nsde_torch
from nsde_torch.errors import NsdeError

TRUE = {
    "3 decimals": {"quaternion_norm"},
    "4 digits": {"quaternion_norm"},
    "jitter": {"non_uniform_step"},
    "wrap": {"angle_wrap"},
    "tacho": {"late_sensor"},
}
"""Findings that are so, by habit."""
BENIGN = {"rank_deficient_inputs", "interventions", "constant_input"}
"""Findings of what was asked for, no faults of a log."""


def read(path: Path, case: Case) -> list[tuple[str, str]]:
    """What reading a log says that is not so."""
    true = set(BENIGN).union(*(TRUE.get(habit, set()) for habit in case.habits))
    findings = nsde_torch.read(path, system=case.system).summary.findings
    return [(f.kind, str(f)) for f in findings if f.kind not in true]


def diagnose(path: Path, case: Case) -> list[tuple[str, str]]:
    """What a diagnosis says of a machine that lacks nothing."""
    found = nsde_torch.diagnose(path, system=case.system)
    lag = "tacho" in case.habits and found.added and {*found.added} <= {"sensor_delay", "sensor_lag"}
    if found.verdict == "no_effect" or lag:
        return []
    return [(found.verdict, f"{[*found.added]} {[f.sentence for f in found.faults]}")]


def answer(case: Case, folder: Path, ask: Callable[[Path, Case], list[tuple[str, str]]], kept: Path) -> None:
    """Ask of one log what is kept in a file, and print the false alarms."""
    started = time.perf_counter()
    try:
        alarms = ask(folder / "data" / case.name, case)
    except NsdeError as error:
        alarms = [("refused", str(error))]
    write_json(kept, {"alarms": alarms, "seconds": time.perf_counter() - started})
    said = ", ".join(kind for kind, _ in alarms) or "silent"
    print(f"{case.name} {said} {time.perf_counter() - started:.1f} s", flush=True)


def table(kept: dict[Case, Path]) -> str:
    """False alarms by system, and each with its habits and excitation."""
    answers = {case: read_json(path)["alarms"] for case, path in kept.items() if path.is_file()}
    rows = []
    for system in dict.fromkeys(case.system for case in answers):
        some = [bool(alarms) for case, alarms in answers.items() if case.system == system]
        rows.append((system, f"{sum(some)} of {len(some)}"))
    lines = [*markdown(("", "logs with a false alarm"), rows), ""]
    for case, alarms in answers.items():
        about = f"{case.name} {case.excitation}, {'+'.join(case.habits)}, {1 / case.dt:g} Hz"
        lines += [f"- {about}: {kind}: {text[:400]}" for kind, text in alarms]
    return "\n".join(lines)


def main() -> None:
    parser = options(__doc__, judge=False)
    parser.add_argument("--logs", type=Path, required=True, help="folder of sound_logs.py")
    parser.add_argument("--diagnose", type=int, default=0, help="so many of each system, instead of reading")
    given = parser.parse_args()
    every = cases(given.seed, given.systems)
    plan = [c for c in every if (given.logs / "data" / c.name).is_dir()]
    if given.diagnose:  # some of each system, evenly over the plan
        systems = [[c for c in plan if c.system == s] for s in dict.fromkeys(c.system for c in plan)]
        at = [np.linspace(0, len(of) - 1, given.diagnose).round().astype(int) for of in systems]
        plan = [of[i] for of, some in zip(systems, at, strict=True) for i in some]
    ask, ending = (diagnose, "_diagnosis") if given.diagnose else (read, "")
    kept = {case: given.logs / "answers" / f"{case.name}{ending}.json" for case in plan}
    for case in [c for c in plan if not (given.judge or kept[c].is_file())]:
        answer(case, given.logs, ask, kept[case])
    print(table(kept))


if __name__ == "__main__":
    main()
