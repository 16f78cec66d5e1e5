"""Question: what is a neural SDE worth on a machine with an undeclared law, beside a model that has it declared?

    python benchmarks/bench_undeclared.py --out results/undeclared --seeds 3

Flights of a hexacopter with an undeclared law and a lag of its motors (`nsde simulate`) train three models: `nsde` by
default, `sysid` (the declared physics alone) and `informed` (least squares with both effects declared). Judges are
400 interventions on the same machine from flights of another seed (rms error at 1 s and what 90 % intervals hold), and
flights of it (`nsde track`, four machines with gusts of their own). Ratios are to `informed`.
"""

import json
import subprocess
from pathlib import Path
from typing import Any

from common import head, line, nsde, options, read_json, train_all, write_json

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


def judged(folder: Path, name: str, seed: int, starts: int) -> dict[str, Any]:
    """Train, score and fly the three models of one machine; what is finished is used again."""
    law, flown = MACHINES[name]
    effects = json.dumps([LAG, law]).replace('"', "").replace(" ", "")
    plant = [f"plant.effects={effects}", "plant.declared_only=true"]
    flights, others = folder / "flights", folder / "interventions"
    replay = [f"seed={1000 + seed}", "pilot=replay", f"replay.starts={starts}"]
    for out, words in ((flights, [f"seed={seed}"]), (others, replay)):
        if not out.with_suffix(".truth.json").is_file():  # written last
            made = nsde("simulate", "system=hexacopter", f"out={out}", "overwrite=true", *words, *plant)
            subprocess.run(made, check=True)
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
        subprocess.run(nsde("track", f"run={runs['nsde']}", beside, *words, *plant), check=True)
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


def main() -> None:
    parser = options(__doc__, "out", seeds=3, first_seed=0)
    parser.add_argument("--starts", type=int, default=400, help="interventions for each machine")
    a = parser.parse_args()
    ratios = ("errors at 1 s: nsde / informed", "sysid / informed", "90 % hold: nsde")
    head("law", "seed", *ratios, "flown [cm]: nsde, sysid, informed")
    every = {}
    for name in MACHINES:
        for seed in range(a.first_seed, a.first_seed + a.seeds):
            folder = a.out.resolve() / f"{name.replace(' ', '_')}_{seed}"
            every[f"{name} {seed}"] = found = judged(folder, name, seed, a.starts)
            informed = found["informed"]["errors"]
            ratios = ([found[m]["errors"][g] / informed[g] for g in GROUPS] for m in ("nsde", "sysid"))
            held = [f"{100 * found['nsde']['coverage_90'][g]:.0f}" for g in GROUPS]
            flown = [f"{found[m]['track_cm']:.2f}" for m in ("nsde", "sysid", "informed")]
            cells = ([f"{r:.2f}" for r in of] for of in ratios)
            print(line([name, seed, *map(", ".join, (*cells, held, flown))]), flush=True)
            write_json(a.out / "undeclared.json", every)


if __name__ == "__main__":
    main()
