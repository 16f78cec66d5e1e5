"""Question: what is a neural SDE worth on a machine with an undeclared law, beside a model that has it declared?

    python benchmarks/bench_undeclared.py --out results/undeclared --seeds 3

Flights of a hexacopter with an undeclared law and a lag of its motors (`nsde simulate`) train three models: `nsde` by
default, `sysid` (the declared physics alone) and `informed` (least squares with both effects declared). Judges are
400 interventions on the same machine from flights of another seed (rms error at 1 s and what 90 % intervals hold), and
flights of it (`nsde track`, four machines with gusts of their own). Ratios are to `informed`.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import torch
from common import options, read_json, train_all

import nsde_torch

MACHINES: dict[str, tuple[dict[str, Any], str]] = {
    "ground effect": (
        {"ground_effect": {"area": 0.03, "height": 0.2}},
        "reference=circle reference.height=0.4",
    ),
    "linear drag": ({"linear_drag": {"drag": [0.7, 0.5, 0.3]}}, "reference=lemniscate"),
    "quadratic drag": ({"quadratic_drag": {"drag": [0.12, 0.12, 0.08]}}, "reference=circle"),
    "flapping": ({"flapping_moment": {"gain": [1.5, 1.5]}}, "reference=lemniscate"),
}
"""Law, and what is flown: low where the ground is felt."""
LAG = {"motor_lag": {"time_constant": 0.05}}
GROUPS = ("position", "velocity", "attitude", "rate")


def nsde(*words: str) -> None:
    """Run a command of the package; what it prints is shown where it fails."""
    done = subprocess.run([sys.executable, "-m", "nsde_torch.cli", *words], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"nsde {' '.join(words)}\n{done.stdout[-2000:]}{done.stderr[-2000:]}")


def plant_words(law: dict[str, Any]) -> list[str]:
    """The machine: the law and the lag, and nothing else undeclared."""
    effects = json.dumps([LAG, law]).replace('"', "").replace(" ", "")
    return [f"plant.effects={effects}", "plant.declared_only=true"]


def judged(folder: Path, name: str, seed: int, starts: int) -> dict[str, Any]:
    """Train, score and fly the three models of one machine; what is finished is used again."""
    law, flown = MACHINES[name]
    plant = plant_words(law)
    flights, others = folder / "flights", folder / "interventions"
    for out, words in (
        (flights, [f"seed={seed}"]),
        (others, [f"seed={1000 + seed}", "pilot=replay", f"replay.starts={starts}"]),
    ):
        if not out.with_suffix(".truth.json").is_file():  # written last
            nsde("simulate", "system=hexacopter", f"out={out}", "overwrite=true", *words, *plant)
    base = ["system=hexacopter", "data=csv", f"data.path={flights}"]
    informed = f"system.effects=[{','.join([*LAG, *law])}]"
    jobs = {"nsde": [], "sysid": ["model=sysid"], "informed": ["model=sysid", informed]}
    runs = {model: folder / model for model in jobs}
    train_all({runs[model]: [*base, *words] for model, words in jobs.items()}, at_once=1)
    content = nsde_torch.evaluate(runs, str(others), horizons=[0.5, 1.0], bootstrap=100, say=False).content
    tracks = folder / "track"
    if not (tracks / "tracking.json").is_file():
        beside = f"beside=[{runs['informed']},{runs['sysid']}]"
        words = [*flown.split(), "machines=4", f"seed={seed}", f"out_dir={tracks}"]
        nsde("track", f"run={runs['nsde']}", beside, *words, *plant)
    tracked = read_json(tracks / "tracking.json")["controllers"].values()
    flown_by = {Path(c["run"]).name: c for c in tracked}
    return {
        model: {
            "errors": {g: entry["errors"][g]["1"] for g in GROUPS},
            "coverage_90": {g: v["1"] for g, v in (entry["coverage"] or {"0.9": {}})["0.9"].items()},
            "track_cm": 100 * flown_by[model]["rmse_m"],
            "lost": flown_by[model]["lost"],
        }
        for model, entry in zip(runs, content["models"], strict=True)
    }


def line(name: str, seed: int, found: dict[str, Any]) -> str:
    """One row of the table: ratios to the informed model."""
    cells = [name, str(seed)]
    for model in ("nsde", "sysid"):
        ratios = [found[model]["errors"][g] / found["informed"]["errors"][g] for g in GROUPS]
        cells.append(", ".join(f"{r:.2f}" for r in ratios))
    cells.append(", ".join(f"{100 * found['nsde']['coverage_90'][g]:.0f}" for g in GROUPS))
    cells.append(", ".join(f"{found[m]['track_cm']:.2f}" for m in ("nsde", "sysid", "informed")))
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    parser = options(__doc__, "out", seeds=3, first_seed=0)
    parser.add_argument("--machines", nargs="+", default=list(MACHINES), choices=MACHINES, metavar="NAME")
    parser.add_argument("--starts", type=int, default=400, help="interventions for each machine")
    a = parser.parse_args()
    torch.set_num_threads(1)
    print(
        "| law | seed | errors at 1 s: nsde / informed | sysid / informed | 90 % hold: nsde "
        "| flown [cm]: nsde, sysid, informed |"
    )
    print("|---" * 6 + "|")
    every = {}
    for name in a.machines:
        for seed in range(a.first_seed, a.first_seed + a.seeds):
            folder = a.out.resolve() / f"{name.replace(' ', '_')}_{seed}"
            every[f"{name} {seed}"] = found = judged(folder, name, seed, a.starts)
            print(line(name, seed, found), flush=True)
            (a.out / "undeclared.json").write_text(json.dumps(every, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
