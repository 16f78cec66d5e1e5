"""What reading sound logs says that is not so.

    python benchmarks/blind/sound_logs.py --seed 5 --out sound/
    python benchmarks/blind/sound_logs_run.py --seed 5 --logs sound/                 # reads them
    python benchmarks/blind/sound_logs_run.py --seed 5 --logs sound/ --judge         # the table again
    python benchmarks/blind/sound_logs_run.py --seed 5 --logs sound/ --diagnose 16   # diagnoses of some of each system

What `nsde_torch.read` finds of a log of `sound_logs`, beside what a habit truly does (`TRUE`), is a false alarm, and so
is a refusal.
"""

import time
from pathlib import Path

import numpy as np
from sound_logs import Case, cases, options
from study import Json, markdown, read_json, write_json

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


def read(case: Case, folder: Path) -> Json:
    import nsde_torch
    from nsde_torch.errors import NsdeError

    started = time.perf_counter()
    try:
        data = nsde_torch.read(folder / "data" / case.name, system=case.system)
        found = [(f.kind, str(f)) for f in data.summary.findings]
    except NsdeError as error:
        found = [("refused", str(error))]
    return {"found": found, "seconds": time.perf_counter() - started}


def diagnose(case: Case, folder: Path) -> Json:
    """What a diagnosis says of one log of a machine that lacks nothing."""
    import nsde_torch
    from nsde_torch.errors import NsdeError

    started = time.perf_counter()
    try:
        found = nsde_torch.diagnose(folder / "data" / case.name, system=case.system)
        said = {"verdict": found.verdict, "added": list(found.added), "report": found.report}
        said["recording"] = [[f.name, f.sentence] for f in found.faults]
    except NsdeError as error:
        said = {"verdict": "refused", "added": [], "recording": [], "report": str(error)}
    return {**said, "seconds": time.perf_counter() - started}


def _diagnose_some(plan: list[Case], folder: Path, count: int) -> None:
    """Diagnoses of some logs of each system, evenly over the plan; false alarms are printed."""
    false = total = 0
    for system in dict.fromkeys(case.system for case in plan):
        of = [case for case in plan if case.system == system]
        for case in [of[i] for i in np.linspace(0, len(of) - 1, count).round().astype(int)]:
            path = folder / "answers" / f"{case.name}_diagnosis.json"
            if not path.is_file():
                write_json(path, diagnose(case, folder))
            said = read_json(path)
            lag = "tacho" in case.habits and set(said["added"]) <= {"sensor_delay", "sensor_lag"}
            alarm = said["verdict"] != "no_effect" and not (lag and said["added"])
            false, total = false + bool(alarm), total + 1
            what = f"{said['verdict']} {said['added']} {said['recording']}" if alarm else "silent"
            told = f"{case.excitation}, {'+'.join(case.habits)}, {1 / case.dt:g} Hz"
            print(f"{case.name} {told}: {what} {said['seconds']:.1f} s", flush=True)
    print(f"{false} of {total} diagnoses say what is not so")


def false_alarms(case: Case, found: list[tuple[str, str]]) -> list[tuple[str, str]]:
    true = set(BENIGN).union(*(TRUE.get(habit, set()) for habit in case.habits))
    return [(kind, text) for kind, text in found if kind not in true]


def table(plan: list[Case], folder: Path) -> str:
    """False alarms by system, and each with its habits and excitation."""
    answers = {
        case: false_alarms(case, read_json(path)["found"])
        for case in plan
        if (path := folder / "answers" / f"{case.name}.json").is_file()
    }
    by_system: dict[str, list[bool]] = {}
    for case, alarms in answers.items():
        by_system.setdefault(case.system, []).append(bool(alarms))
    rows = [(system, f"{sum(some)} of {len(some)}") for system, some in by_system.items()]
    lines = [*markdown(("", "logs with a false alarm"), rows), ""]
    for case, alarms in answers.items():
        for kind, text in alarms:
            lines.append(
                f"- {case.name} {case.excitation}, {'+'.join(case.habits)}, {1 / case.dt:g} Hz: {kind}: {text[:400]}"
            )
    return "\n".join(lines)


def main() -> None:
    parser = options(__doc__, judge=False)
    parser.add_argument("--logs", type=Path, required=True, help="folder of sound_logs.py")
    parser.add_argument("--diagnose", type=int, default=0, help="so many of each system, instead of reading")
    given = parser.parse_args()
    every = cases(given.seed, given.systems)
    plan = [c for c in every if (given.logs / "data" / c.name).is_dir()]
    if given.diagnose:
        _diagnose_some(plan, given.logs, given.diagnose)
        return
    for case in () if given.judge else plan:
        answer = given.logs / "answers" / f"{case.name}.json"
        if answer.is_file():
            continue
        said = read(case, given.logs)
        write_json(answer, said)
        alarms = [kind for kind, _ in false_alarms(case, said["found"])]
        told = f"{case.name} {case.excitation}, {'+'.join(case.habits)}"
        print(f"{told}: {alarms or 'silent'} {said['seconds']:.1f} s", flush=True)
    print(table(plan, given.logs))


if __name__ == "__main__":
    main()
