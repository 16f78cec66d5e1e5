"""What each number that decides is worth: halved and doubled, which answers to blind cases change.

    python benchmarks/blind/generate.py --seed 8123 --count 48 --systems mass_spring_damper cartpole --out blind/
    python benchmarks/blind/thresholds.py --cases blind/ --out thresholds/

Each setting is a process of its own, in which one field of `Decisions` stands at half or at twice its value. An answer
is the verdict, what was added, and what of it is a lead. Settings that are in the folder
are not made again, so that an interrupted study goes on. `thresholds/table.md` says which answers changed.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from dataclasses import MISSING, fields, replace
from pathlib import Path
from typing import Any


def settings() -> list[tuple[str, float | int]]:
    """Fields of `Decisions` with half and twice their values, inside their ranges."""
    from nsde_torch.diagnosis.decisions import DECISIONS, Decisions
    from nsde_torch.errors import NsdeError

    out: list[tuple[str, float | int]] = []
    for field in fields(Decisions):
        value = getattr(DECISIONS, field.name)
        if (
            field.name == "most_effects"
            or isinstance(value, bool)
            or not isinstance(value, int | float)
            or field.default is MISSING
        ):
            continue
        for factor in (0.5, 2.0):
            other = max(1, round(value * factor)) if isinstance(value, int) else value * factor
            try:
                changed: dict[str, Any] = {field.name: other}
                replace(DECISIONS, **changed)
            except NsdeError:
                continue
            if other != value:
                out.append((field.name, other))
    return out


def answers(cases: Path, names: list[str], field: str, value: float) -> dict[str, Any]:
    """Diagnose the cases with a field at another value; the reference where it is empty."""
    import torch

    import nsde_torch
    from nsde_torch.diagnosis.decisions import DECISIONS, Options
    from nsde_torch.diagnosis.pipeline import diagnose
    from nsde_torch.models.identified import SysidSpec
    from nsde_torch.systems import make_system

    torch.set_num_threads(1)
    changed: dict[str, Any] = {field: value} if field else {}
    options = Options(alpha=value) if field == "alpha" else Options()
    out: dict[str, Any] = {}
    for name in names:
        truth = json.loads((cases / "truth" / f"{name}.json").read_text(encoding="utf-8"))
        system = make_system(truth["system"])
        data = nsde_torch.read(cases / "data" / name, system=system)
        spec = SysidSpec(system.name, dt=data.dt, horizon=system.defaults.horizon)
        found = diagnose(system, spec, data, data.runs, options, decisions=replace(DECISIONS, **changed))
        leads = [f.name for f in found.outcome.found if f.provisional]
        out[name] = [found.verdict, sorted(found.added), sorted(leads)]
    return out


def table(out: Path) -> str:
    """What changed, a row for each field."""
    kept = {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in sorted(out.glob("*.json"))}
    reference = kept.pop("reference")["answers"]
    rows: dict[str, dict[str, str]] = {}
    for entry in kept.values():
        changed = [name for name, answer in entry["answers"].items() if answer != reference[name]]
        which = "half" if entry["stem"].endswith("half") else "twice"
        rows.setdefault(entry["field"], {})[which] = (
            f"{len(changed)}: {', '.join(changed)}" if changed else "0"
        )
    lines = ["| field | halved | doubled |", "|---|---|---|"]
    lines += [
        f"| `{field}` | {row.get('half', 'not in range')} | {row.get('twice', 'not in range')} |"
        for field, row in rows.items()
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """One setting where it is told, else all that are not there yet, each in a process."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--cases", type=Path, required=True, help="folder of generate.py")
    parser.add_argument("--out", type=Path, required=True, help="folder to write into")
    parser.add_argument("--names", nargs="+", default=None, help="these cases alone")
    parser.add_argument("--fields", nargs="+", default=None, help="these fields alone")
    parser.add_argument("--one", nargs=3, default=None, help=argparse.SUPPRESS)
    given = parser.parse_args()
    names = given.names or sorted(path.stem for path in (given.cases / "truth").glob("*.json"))
    if given.one is not None:
        stem, field, value = given.one
        number = float(value) if "." in value or "e" in value else int(value)
        entry = {
            "stem": stem,
            "field": field,
            "value": number,
            "answers": answers(given.cases, names, field, number),
        }
        (given.out / f"{stem}.json").write_text(json.dumps(entry, indent=1), encoding="utf-8")
        return
    given.out.mkdir(parents=True, exist_ok=True)
    from nsde_torch.diagnosis.decisions import DECISIONS

    todo: list[tuple[str, str, float]] = [("reference", "", 0)]
    for field, value in settings():
        half = value < getattr(DECISIONS, field)
        if given.fields is None or field in given.fields:
            todo.append((f"{field}-{'half' if half else 'twice'}", field, value))
    started = time.perf_counter()
    for stem, field, value in todo:
        if (given.out / f"{stem}.json").is_file():
            continue
        command = [sys.executable, __file__, "--cases", str(given.cases), "--out", str(given.out)]
        subprocess.run([*command, "--names", *names, "--one", stem, field, repr(value)], check=True)
        print(f"{stem} done ({time.perf_counter() - started:.0f} s)", flush=True)
        if stem != "reference":
            (given.out / "table.md").write_text(table(given.out), encoding="utf-8")
    print(table(given.out))


if __name__ == "__main__":
    main()
