"""Run a command on good and on broken logs, and judge what it says.

    python benchmarks/blind/broken_logs_run.py --cases broken/              # nsde train model=sysid, about 12 s a log
    python benchmarks/blind/broken_logs_run.py --cases broken/ --quick      # nsde_torch.read and identify alone, 3 s

A broken log is *named* where the command refuses it or warns, in words that name the fault, *warned of* where it does
so in other words, and otherwise *missed*. A good log is warned of where anything is refused, found or warned of, but
for inputs that span less than their number. What is said of feedback, and of what the data do not show, is neither.
"""

import re
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

from broken_faults import FAULTS
from study import Json, answered, markdown, missing, options, pooled, truth_of, write_json

_BENIGN = ("dimensions; always zero",)


def by_command(folder: Path, name: str) -> Json:
    truth = truth_of(folder, name)
    step = truth["dt_s"] * max(1, round(0.02 / truth["dt_s"]))  # the model's, a whole multiple of the log's
    words = [sys.executable, "-m", "nsde_torch.cli", "train", "model=sysid", f"system={truth['system']}"]
    words += ["data=csv", f"data.path={folder / 'data' / name}", f"run_dir={folder / 'runs' / name}"]
    words.append(f"system.dt={step:g}")
    started = time.perf_counter()
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    seconds = time.perf_counter() - started
    return {"code": done.returncode, "text": done.stdout + done.stderr, "seconds": seconds}


def quickly(folder: Path, name: str) -> Json:
    """The same checks by Python, without pictures and predictions."""

    import nsde_torch
    from nsde_torch.errors import NsdeError
    from nsde_torch.sysid.identify import identify_in_loop
    from nsde_torch.systems import make_system
    from nsde_torch.training.fit_sysid import summary

    truth = truth_of(folder, name)
    started = time.perf_counter()
    code, text, figures = 0, "", {}
    try:
        data = nsde_torch.read(folder / "data" / name, system=truth["system"])
        text = "found:\n" + "".join(f"  {finding}\n" for finding in data.summary.findings) + "\n"
        found = identify_in_loop(make_system(truth["system"]), data.runs, clock=data.clock_scale)
        text += summary(found)
        figures = found.as_dict()
    except NsdeError as error:
        code, text = 2, text + f"\nerror: {error}"
    return {"code": code, "text": text, "seconds": time.perf_counter() - started, "figures": figures}


def said(answer: Json) -> list[str]:
    """Lines in which the command refuses, finds or warns."""
    lines, out, finding = answer["text"].splitlines(), [], False
    for line in lines:
        finding = (finding and line.startswith("  ")) or line.startswith("found:")
        told = finding and line.startswith("  ") and not any(b in line for b in _BENIGN)
        out += [line.strip()] if told or line.startswith("warning:") else []
    if answer["code"]:
        out += [line for line in lines if line.strip()][-3:]
    return out


def judge(truth: Json, answer: Json) -> str:
    lines = said(answer)
    if not truth["fault"]:
        return "warned of" if lines else "silent"
    if any(re.search(FAULTS[truth["fault"]][2], line) for line in lines):
        return "named"
    return "warned of" if lines else "missed"


def table(folder: Path) -> str:
    rows: dict[str, list[tuple[str, Json, Json]]] = {}
    for _, truth, answer in answered(folder):
        rows.setdefault(truth["fault"] or "nothing", []).append((judge(truth, answer), truth, answer))
    good = rows.get("nothing", [])
    broken = {fault: some for fault, some in rows.items() if fault != "nothing"}
    broken["all"] = [row for some in broken.values() for row in some]
    words = ("named", "warned of", "missed")
    verdicts = {fault: [verdict for verdict, _, _ in some] for fault, some in broken.items()}
    counts = [(fault, len(some), *map(some.count, words)) for fault, some in verdicts.items()]
    lines = markdown(("fault", "logs", *words), counts)
    lines.append(f"\ngood logs: {sum(v == 'warned of' for v, _, _ in good)} of {len(good)} warned of\n")
    for fault, some in rows.items():
        for verdict, truth, answer in some:
            if verdict not in ("named", "silent"):
                what = f"{fault} ({truth['done']}), {truth['system']}, {truth['effect'] or 'no effect'}"
                where = f"{truth['regime']} {truth['dt_s']}: {verdict}: {' / '.join(said(answer))[:700]}"
                lines.append(f"- {truth['name']}: {what}, {where}")
    return "\n".join(lines)


def _one(folder: Path, quick: bool, name: str) -> str:
    answer, truth = (quickly if quick else by_command)(folder, name), truth_of(folder, name)
    write_json(folder / "answers" / f"{name}.json", answer)
    return f"{truth['fault'] or '-'} ({truth['done']}): {judge(truth, answer)} {answer['seconds']:.1f} s"


def main() -> None:
    parser = options(__doc__, "cases", names=None, jobs=1, judge=False)
    parser.add_argument("--quick", action="store_true", help="without the command line")
    given = parser.parse_args()
    names = given.names or sorted(missing(given.cases, "answers"), key=lambda name: name[-3:])
    make = partial(_one, given.cases, given.quick)
    pooled(given.jobs, {name: partial(make, name) for name in ([] if given.judge else names)})
    print(table(given.cases))


if __name__ == "__main__":
    main()
