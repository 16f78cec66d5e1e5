"""Run a command on good and on broken logs, and judge what it says.

    python benchmarks/blind/broken_logs.py --seed 1 --count 100 --out broken/
    python benchmarks/blind/broken_logs_run.py --cases broken/              # nsde train model=sysid, about 12 s a log
    python benchmarks/blind/broken_logs_run.py --cases broken/ --quick      # nsde_torch.read and identify alone, 3 s
    python benchmarks/blind/broken_logs_run.py --cases broken/ --judge      # the table again

A broken log is *named* where the command refuses it or warns, in words that name the fault (a regular expression of
`broken_faults.FAULTS`), *warned of* where it refuses or warns in other words, and otherwise *missed*. A good log is
warned of where anything is refused, found or warned of, but for inputs that span less than their number. What the
command says of feedback, and of what the data do not show, counts as neither.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parent))

from broken_faults import FAULTS

_BENIGN = ("dimensions; always zero",)
Json = dict[str, Any]


def by_command(folder: Path, name: str, further: list[str]) -> Json:
    """`nsde train model=sysid` on one log."""
    truth = json.loads((folder / "truth" / f"{name}.json").read_text(encoding="utf-8"))
    words = [
        *(sys.executable, "-m", "nsde_torch.cli", "train", "model=sysid", f"system={truth['system']}"),
        *("data=csv", f"data.path={folder / 'data' / name}", f"run_dir={folder / 'runs' / name}", *further),
    ]
    step = truth["dt_s"] * max(1, round(0.02 / truth["dt_s"]))  # the model's, a whole multiple of the log's
    words.append(f"system.dt={step:g}")
    started = time.perf_counter()
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    return {
        "code": done.returncode,
        "text": done.stdout + done.stderr,
        "seconds": time.perf_counter() - started,
    }


def quickly(folder: Path, name: str, further: list[str]) -> Json:
    """The same checks by Python, without pictures and predictions."""
    import torch

    import nsde_torch
    from nsde_torch.errors import NsdeError
    from nsde_torch.sysid.identify import identify_in_loop
    from nsde_torch.systems import make_system
    from nsde_torch.training.fit_sysid import summary

    torch.set_num_threads(1)
    truth = json.loads((folder / "truth" / f"{name}.json").read_text(encoding="utf-8"))
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
        if finding and line.startswith("  ") and not any(b in line for b in _BENIGN):
            out.append(line.strip())
        elif line.startswith("warning:"):
            out.append(line)
    if answer["code"]:
        out += [line for line in lines if line.strip()][-3:]
    return out


def judge(truth: Json, answer: Json) -> str:
    """What became of a log."""
    lines = said(answer)
    if not truth["fault"]:
        return "warned of" if lines else "silent"
    if any(re.search(FAULTS[truth["fault"]][2], line) for line in lines):
        return "named"
    return "warned of" if lines else "missed"


def table(folder: Path) -> str:
    """What became of all logs, as Markdown."""
    rows: dict[str, list[tuple[str, Json, Json]]] = {}
    for path in sorted((folder / "answers").glob("*.json")):
        truth = json.loads((folder / "truth" / path.name).read_text(encoding="utf-8"))
        answer = json.loads(path.read_text(encoding="utf-8"))
        rows.setdefault(truth["fault"] or "nothing", []).append((judge(truth, answer), truth, answer))
    words = ("named", "warned of", "missed", "silent")
    lines = ["| fault | logs | named | warned of | missed |", "|---|---|---|---|---|"]
    total = dict.fromkeys(words, 0)
    for fault, some in rows.items():
        count = {w: sum(v == w for v, _, _ in some) for w in words}
        if fault != "nothing":
            lines.append(
                f"| {fault} | {len(some)} | {count['named']} | {count['warned of']} | {count['missed']} |"
            )
            total = {w: total[w] + count[w] for w in words}
    good = rows.get("nothing", [])
    broken = sum(len(some) for fault, some in rows.items() if fault != "nothing")
    lines.append(f"| all | {broken} | {total['named']} | {total['warned of']} | {total['missed']} |")
    lines.append(f"\ngood logs: {sum(v == 'warned of' for v, _, _ in good)} of {len(good)} warned of\n")
    for fault, some in rows.items():
        for verdict, truth, answer in some:
            if verdict not in ("named", "silent"):
                what = f"{fault} ({truth['done']}), {truth['system']}, {truth['effect'] or 'no effect'}"
                where = f"{truth['regime']} {truth['dt_s']}: {verdict}: {' / '.join(said(answer))[:700]}"
                lines.append(f"- {truth['name']}: {what}, {where}")
    return "\n".join(lines)


def _one(folder: Path, name: str, quick: bool, further: list[str]) -> str:
    answer = (quickly if quick else by_command)(folder, name, further)
    truth = json.loads((folder / "truth" / f"{name}.json").read_text(encoding="utf-8"))
    (folder / "answers").mkdir(exist_ok=True)
    (folder / "truth" / f"{name}.json").write_text(json.dumps({**truth, "name": name}), encoding="utf-8")
    (folder / "answers" / f"{name}.json").write_text(json.dumps(answer, default=str), encoding="utf-8")
    return (
        f"{name} {truth['fault'] or '-'} ({truth['done']}): {judge(truth, answer)} {answer['seconds']:.1f} s"
    )


def main() -> None:
    """Run what has not been run, and judge."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--cases", type=Path, required=True, help="folder of broken_logs.py")
    parser.add_argument("--quick", action="store_true", help="without the command line")
    parser.add_argument("--judge", action="store_true", help="judge what is there")
    parser.add_argument("--names", nargs="+", default=None, help="these alone, again")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("further", nargs="*", help="further keys of the command")
    given = parser.parse_args()
    if not given.judge:
        names = given.names or [
            path.stem
            for path in sorted((given.cases / "truth").glob("*.json"), key=lambda path: path.stem[-3:])
            if not (given.cases / "answers" / path.name).is_file()
        ]
        with ProcessPoolExecutor(given.jobs) as pool:
            jobs = [pool.submit(_one, given.cases, name, given.quick, given.further) for name in names]
            for job in jobs:
                print(job.result(), flush=True)
    print(table(given.cases))


if __name__ == "__main__":
    main()
