"""Diagnose blind cases, and judge the answers by the truth.

    python benchmarks/blind/generate.py --seed 1 --count 300 --out blind/
    python benchmarks/blind/run.py --cases blind/ --jobs 2

Each case is diagnosed from its files alone; its answer is kept in `blind/answers/NAME.json`, so that an interrupted
study goes on where it stopped. Then the truth is opened: an oracle that is told the effects fits the same physics and
predicts the same runs left out, and `blind/table.md` says how often the answers are right.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parent))  # `outside:Cogging` is found by its name

from study import held

MOVES = 1.1
"""Ratio of errors without and with the true effect from which a case counts as visible."""
NEAR = 1.05


def diagnose_case(folder: Path, name: str) -> dict[str, Any]:
    """Diagnose one case and measure what an oracle would reach."""
    import torch
    from outside import OUTSIDE

    import nsde_torch
    from nsde_torch.diagnosis.cross_validation import by_likelihood, held_out
    from nsde_torch.diagnosis.decisions import Options
    from nsde_torch.diagnosis.pipeline import diagnose
    from nsde_torch.diagnosis.reading import with_channels
    from nsde_torch.models.identified import SysidSpec
    from nsde_torch.systems import make_system

    torch.set_num_threads(1)
    truth = json.loads((folder / "truth" / f"{name}.json").read_text(encoding="utf-8"))
    system = make_system(truth["system"])
    data = nsde_torch.read(folder / "data" / name, system=system)
    spec = SysidSpec(system.name, dt=data.dt, horizon=system.defaults.horizon)
    started = time.perf_counter()
    found = diagnose(system, spec, data, data.runs, Options())
    seconds = time.perf_counter() - started
    content = found.content()
    answer: dict[str, Any] = {
        "seconds": seconds,
        "verdict": content["verdict"],
        "added": content["added"],
        "findings": content["findings"],
        "ties": content["ties"],
        "parameters": content["parameters"],
        "errors": content["errors"],
        "structure": content["structure"]["after"][:3],
        "ranking": [r for r in content["ranking"] if r["p"] is not None][:6],
    }
    classes = {cls.name: f"outside:{cls.__name__}" for every in OUTSIDE.values() for cls in every}
    effects = {classes.get(key, key): of["parameters"] for key, of in truth["effects"].items()}
    joint = found.outcome.joint
    if effects and joint is not None:
        made = [system.make_effect(key, values) for key, values in effects.items()]
        runs = with_channels(system, found.recorded.runs)
        told = found.system.with_effects(*made)
        oracle = held_out(
            (found.outcome.declared_system, told),
            spec,
            runs,
            fitted=by_likelihood([joint.declared, joint.final]),
            steps=joint.final.at.of.space.steps,
            clock=found.recorded.clock,
            seed=0,
        )
        answer["oracle"] = oracle.content["after"]
    return answer


def _job(folder: str, name: str) -> tuple[str, str]:
    import traceback

    try:
        answer = diagnose_case(Path(folder), name)
    except Exception as error:  # a crash is an answer too, and the worst
        answer = {"verdict": "crash", "added": [], "error": str(error), "traceback": traceback.format_exc()}
    path = Path(folder) / "answers" / f"{name}.json"
    path.write_text(json.dumps(answer, indent=1), encoding="utf-8")
    return name, answer["verdict"]


def worth(first: dict[str, Any], other: dict[str, Any]) -> float:
    """Geometric mean over quantities of the ratio of two tables of errors, at the last horizon up to 1 s."""
    ratios = []
    for quantity, by in first.items():
        horizons = [h for h in by if float(h) <= 1.0]
        if horizons and by[horizons[-1]] and other[quantity][horizons[-1]]:
            ratios.append(by[horizons[-1]] / other[quantity][horizons[-1]])
    product = 1.0
    for r in ratios:
        product *= r
    return product ** (1 / len(ratios)) if ratios else 1.0


def judge(truth: dict[str, Any], answer: dict[str, Any]) -> dict[str, Any]:
    """What became of a case."""
    case = truth["case"]
    names = [key.rpartition(":")[2] if ":" in key else key for key in truth["effects"]] + [
        k.removesuffix("_s").removesuffix("_deg") for k in truth.get("recording", {})
    ]
    added = answer["added"]
    if "theta" in truth.get("recording", {}).get("sensor_bias", {}):  # of a state that is no rate: an effect
        added = ["sensor_bias" if name == "position_bias[pole]" else name for name in added]
    out: dict[str, Any] = {
        "kind": case["kind"],
        "system": truth["system"],
        "noise": case["noise"],
        "true": names,
    }
    out["added"], out["verdict"] = added, answer["verdict"]
    ties = [t["effects"] for t in answer.get("ties", []) if t["effects"][0] in added]
    tied = {part for tie in ties for name in tie for part in name.split(" + ")}
    out["first"] = bool(added) and added[0] in names
    out["exact"] = sorted(added) == sorted(names)
    out["in_tie"] = all(n in added or n in tied for n in names)
    errors = answer.get("errors", {})
    if "oracle" in answer and errors.get("before"):
        out["moves"] = worth(errors["before"], answer["oracle"])
        out["beside_oracle"] = worth(errors["after"], answer["oracle"])
        out["gain"] = worth(errors["before"], errors["after"])
    elif errors.get("before"):
        out["gain"] = worth(errors["before"], errors["after"])
    out["lead"] = any(f["lead"] for f in answer.get("findings", [])) or bool(answer.get("ties"))
    effects = {key: of["parameters"] for key, of in truth["effects"].items()}
    out["inside"], out["intervals"] = held(effects, answer.get("parameters", {}))
    out["seconds"] = answer.get("seconds", 0.0)
    return out


def table(judged: dict[str, dict[str, Any]]) -> str:
    """The figures that the issue asks for, and every case that went wrong."""
    lines = ["| what | system | cases | right | share |", "|---|---|---|---|---|"]

    def row(what: str, system: str, cases: list[dict[str, Any]], right: list[bool]) -> None:
        if cases:
            lines.append(
                f"| {what} | {system} | {len(cases)} | {sum(right)} | {sum(right) / len(right):.0%} |"
            )

    systems = sorted({j["system"] for j in judged.values()})
    for system in ["all", *systems]:
        mine = [j for j in judged.values() if system in ("all", j["system"])]
        visible = [j for j in mine if j["kind"] == "single" and j.get("moves", 1.0) > MOVES]
        row(
            "single effect that moves errors by 10 %: named first",
            system,
            visible,
            [j["first"] for j in visible],
        )
        row("the same: named first or tied", system, visible, [j["first"] or j["in_tie"] for j in visible])
        row("the same: named, and nothing else", system, visible, [j["exact"] for j in visible])
        pairs = [j for j in mine if j["kind"] == "pair" and j.get("moves", 1.0) > MOVES]
        row("pairs: both found", system, pairs, [set(j["true"]) <= set(j["added"]) for j in pairs])
        null = [j for j in mine if j["kind"] == "null"]
        row("nothing missing: silent", system, null, [j["verdict"] == "no_effect" for j in null])
        out = [j for j in mine if j["kind"] == "outside"]
        good = [
            j["verdict"] == "unexplained"
            or (bool(j["added"]) and j.get("gain", 1.0) > 1.0 and j["lead"])
            or (
                all("=" in n for n in j["added"])
                and j["verdict"] != "no_effect"
                and j["beside_oracle"] < NEAR
            )
            for j in out
        ]
        row("outside the catalogue: the law, unexplained, or a lead that helps", system, out, good)
        seen = [
            (j, g)
            for j, g in zip(out, good, strict=True)
            if j.get("gain", 1.0) > MOVES or j["verdict"] != "no_effect"
        ]
        row("the same, where it moves errors by 10 %", system, [j for j, _ in seen], [g for _, g in seen])
        recording = [j for j in mine if j["kind"] == "recording"]
        row("recording chain: named", system, recording, [j["first"] or j["in_tie"] for j in recording])
        near = [j for j in visible if j["first"] and "beside_oracle" in j]
        row("error within 5 % of the oracle's", system, near, [j["beside_oracle"] < NEAR for j in near])
        counted = [j for j in visible if j["first"]]
        inside, total = sum(j["inside"] for j in counted), sum(j["intervals"] for j in counted)
        if total:
            lines.append(
                f"| 90 % intervals that hold | {system} | {total} | {inside} | {inside / total:.0%} |"
            )
        seconds = sorted(j["seconds"] for j in mine)
        lines.append(
            f"| seconds a case, median | {system} | {len(mine)} | {seconds[len(seconds) // 2]:.0f} | |"
        )
    lines += [
        "",
        "| case | kind | system | noise | true | answer | verdict | moves | gain |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, j in sorted(judged.items()):
        wrong = (j["kind"] in ("single", "recording") and not j["exact"]) or (
            j["kind"] == "pair" and set(j["true"]) != set(j["added"])
        )
        wrong |= j["kind"] == "null" and j["verdict"] != "no_effect"
        wrong |= j["kind"] == "outside"
        if wrong:
            numbers = [f"x{j[k]:.2f}" if k in j else "" for k in ("moves", "gain")]
            cells = [
                name,
                j["kind"],
                j["system"],
                j["noise"],
                ", ".join(j["true"]),
                ", ".join(j["added"]),
                j["verdict"],
            ]
            lines.append("| " + " | ".join([*cells, *numbers]) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Answer the cases that have no answer yet, then judge all."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--cases", type=Path, required=True, help="folder of generate.py")
    parser.add_argument("--jobs", type=int, default=1, help="processes at a time")
    parser.add_argument("--limit", type=int, default=10**6, help="answer this many at most")
    given = parser.parse_args()
    (given.cases / "answers").mkdir(exist_ok=True)
    names = sorted(p.stem for p in (given.cases / "truth").glob("*.json"))
    todo = [n for n in names if not (given.cases / "answers" / f"{n}.json").is_file()][: given.limit]
    started = time.perf_counter()
    with ProcessPoolExecutor(given.jobs) as pool:
        jobs = [pool.submit(_job, str(given.cases), name) for name in todo]
        for k, job in enumerate(as_completed(jobs), start=1):
            name, verdict = job.result()
            spent = time.perf_counter() - started
            left = spent / k * (len(todo) - k)
            print(
                f"{name} {verdict} ({k} of {len(todo)}, {spent:.0f} s, about {left:.0f} s left)", flush=True
            )
    judged = {}
    for path in sorted((given.cases / "answers").glob("*.json")):
        truth = json.loads((given.cases / "truth" / path.name).read_text(encoding="utf-8"))
        judged[path.stem] = judge(truth, json.loads(path.read_text(encoding="utf-8")))
    (given.cases / "judged.json").write_text(json.dumps(judged, indent=1), encoding="utf-8")
    text = table(judged)
    (given.cases / "table.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
