"""Question: how far off is a model of closed-loop flights where inputs are set from outside, and do its intervals hold?

    python benchmarks/bench_interventions.py --folder results/interventions --seeds 5
    python benchmarks/bench_interventions.py --folder results/of_seed_3 --models nsde sysid -- seed=3

Models learn from the built-in flights of a seed, which a cascade flew in gusts, and are judged on interventions on the
same machine from flights that no model has seen: one second of commands of another time, the inputs before the start
known. `oracle` has the true parameters and effects from the same noisy start, and no gusts.

A model is named by its kind, with `+effects` where the true effects of the machine are declared. Finished trainings are
kept in the folder and not done again.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from common import Array, Json, markdown, options, read_json, train_all, write_json

import nsde_torch
from nsde_torch.data import DataSet, Windows
from nsde_torch.evaluation.common_grid import Candidate
from nsde_torch.evaluation.comparison import compare
from nsde_torch.evaluation.metrics import start_grid
from nsde_torch.evaluation.scores import group_squares, rms_by_group
from nsde_torch.evaluation.seen import SeenRuns
from nsde_torch.recording import read
from nsde_torch.simulation import Replay, make_plant, simulate, write
from nsde_torch.systems import MACHINES, make_plant_system, make_system

SYSTEMS = ("hexacopter", "quadrotor")
KINDS = ("nsde", "sysid", "node", "blackbox_nsde", "ensemble")
HORIZONS = (0.1, 0.25, 0.5, 1.0)
GROUPS = {"position": "m", "velocity": "m/s", "attitude": "deg", "rate": "rad/s"}
DECLARED = "+effects"
FIRST_SEED = {"hexacopter": 0, "quadrotor": 100}
"""Added to the seed: the cascade makes equal loops of both machines, and of one seed nearly equal flights."""
OTHER_FLIGHTS = 1000
"""Added to the seed of the flights that a model learned from, for those that interventions start from."""


def data_of(system: str, *, seed: int, starts: int, folder: Path) -> DataSet:
    """Interventions on a machine; made once for each folder."""
    path = folder / "data" / f"{system}_{seed}_{starts}"
    truth = path.with_suffix(".truth.json")
    if not truth.is_file():  # written last
        write(simulate(system, seed=seed, replay=Replay(starts)), path, truth=truth, overwrite=True)
    return read("csv", make_system(system), path=str(path))


@torch.no_grad()
def oracle(system: str, data: DataSet) -> dict[str, dict[str, float]]:
    """Errors of the true machine without gusts, from the measured starts."""
    quiet = {"process_noise": 0.0, "sensor_noise": 0.0}
    plant = make_plant(system, generator=torch.Generator().manual_seed(0), step=data.dt / 4, **quiet)
    steps = {h: round(h / data.dt) for h in HORIZONS}
    windows = Windows(data.runs, data.dt, max(steps.values()), dtype=torch.float64)
    starts = start_grid(windows)
    x, u, _ = windows.batch(starts)
    places = windows.locate(starts)
    known = min(next(row - a for a, b in data[name].segments if a < row < b) for name, row in places)
    before = torch.stack([torch.tensor(data[name].u[row - known : row]) for name, row in places])
    first = torch.stack([torch.tensor(data[name].x[row - known]) for name, row in places])
    plant.reset(first, before[:, 0])
    for k in range(known):
        plant.step(before[:, k])
    memory = plant.whole_state[:, plant.system.nx :]  # of the inputs alone; the state is the measured one
    plant.resume(torch.cat((x[:, 0], memory), 1), before)
    path = [plant.state]
    for k in range(u.shape[1]):
        plant.step(u[:, k])
        path.append(plant.state)
    system = plant.system
    squares = [group_squares(system, system.error(path[k], x[:, k])) for k in steps.values()]
    return rms_by_group(system, torch.stack(squares, 1), [f"{h:g}" for h in steps])


def interventions(run_dir: Path, data: DataSet, particles: int) -> Json:
    """How far off a trained model is on interventions, beside the oracle: by group, horizon."""
    model, metrics = nsde_torch.load(run_dir), read_json(run_dir / "metrics.json")
    candidates = [Candidate(name="model", model=model, seen=SeenRuns.of(metrics))]
    how: Json = {"seed": 0, "particles": particles, "horizons": HORIZONS, "replicates": 100}
    content = compare(candidates, data, data.runs, **how).content
    (entry,) = content["models"]
    return {
        "errors": entry["errors"],
        "coverage_90": entry["coverage"]["0.9"] if entry["stochastic"] else None,
        "oracle": oracle(model.spec.system, data),
        "parameters": metrics.get("parameters", {}),
    }


def table(rows: Sequence[Json], system: str) -> str:
    """Means and spreads over the seeds of one system, as Markdown."""
    mine = [r for r in rows if r["system"] == system]
    of = {name: [r for r in mine if r["model"] == name] for name in dict.fromkeys(r["model"] for r in mine)}
    keys = [f"{h:g}" for h in HORIZONS]

    def figures(part: str, some: Sequence[Json], group: str) -> Array:
        return np.array([[r[part][group][h] for h in keys] for r in some])

    def spread(values: Array) -> list[str]:
        around = [f" +- {v:.2g}" for v in values.std(0, ddof=1)] if len(values) > 1 else [""] * len(keys)
        return [f"{mean:.3g}{more}" for mean, more in zip(values.mean(0), around, strict=True)]

    errors, held = [], []
    for group, unit in GROUPS.items():
        first = figures("oracle", next(iter(of.values())), group)
        errors.append((f"{group} [{unit}]", "oracle", *spread(first)))
        for name, some in of.items():
            own = figures("errors", some, group)
            ratios = [(own / figures("oracle", some, group)).mean(0)]
            like = of.get("sysid" + name[len(name.split("+")[0]) :], [])
            if len(like) == len(some) and like != some:
                ratios.append((own / figures("errors", like, group)).mean(0))
            brackets = [", ".join(f"x {r:.2f}" for r in at) for at in zip(*ratios, strict=True)]
            cells = [f"{text} ({ratio})" for text, ratio in zip(spread(own), brackets, strict=True)]
            errors.append((f"{group} [{unit}]", name, *cells))
            if some[0]["coverage_90"]:
                shares = 100 * figures("coverage_90", some, group).mean(0)
                held.append((group, name, *(f"{share:.0f} %" for share in shares)))
    times = [f"{h} s" for h in keys]
    count = len({r["seed"] for r in mine})
    lines = markdown((f"{system}, {count} seeds: rms error", "", *times), errors)
    lines += ["", "In brackets: ratio to the oracle, and to `sysid` with the same physics.", ""]
    lines += [*markdown(("90 % intervals hold", "", *times), held), ""]
    return "\n".join([*lines, *markdown(("parameter", "truth", *of), _parameters(system, of)), ""])


def _parameters(system: str, of: dict[str, list[Json]]) -> Iterator[Sequence[str]]:
    """Declared parameters: mean over the seeds, and how many of the 90 % intervals that are given hold the truth."""
    for key, (values, *_) in make_plant_system(system).all_declared().items():
        for i, value in enumerate(values.flatten().tolist()):
            cells = []
            for some in of.values():
                found = [r["parameters"][key] for r in some if key in r["parameters"]]
                own = [f["value"][i] for f in found]
                halves = [f["half_width_90"][i] if f.get("half_width_90") else None for f in found]
                given = [abs(v - value) <= h for v, h in zip(own, halves, strict=True) if h is not None]
                held = f", {sum(given)} of {len(given)}" if given else ""
                cells.append(f"{np.mean(own):.3g}{held}" if own else "-")
            yield key if values.numel() == 1 else f"{key}[{i}]", f"{value:.3g}", *cells


def main() -> None:
    parser = options(__doc__, seeds=5, first_seed=0, at_once=1)
    parser.add_argument("--folder", type=Path, default=Path("results/interventions"), help="of data and runs")
    parser.add_argument("--systems", nargs="+", default=list(SYSTEMS), choices=SYSTEMS, help="machines")
    kinds = [f"{k}{p}" for k in KINDS for p in ("", DECLARED)]
    usual = ["nsde", "sysid", f"nsde{DECLARED}", f"sysid{DECLARED}"]
    parser.add_argument("--models", nargs="+", default=usual, choices=kinds, help="kinds of models")
    parser.add_argument("--starts", type=int, default=400, help="interventions for each seed")
    parser.add_argument("--particles", type=int, default=199, help="paths from each start")
    parser.add_argument(
        "overrides", nargs="*", help="further overrides of nsde train, in a folder of their own"
    )
    a = parser.parse_args()
    folder = a.folder.resolve()
    jobs = {
        (system, seed, model): folder / "runs" / f"{system}_{seed}_{model}"
        for system in a.systems
        for seed in range(FIRST_SEED[system] + a.first_seed, FIRST_SEED[system] + a.first_seed + a.seeds)
        for model in a.models
    }
    words = {}
    for (system, seed, model), run in jobs.items():
        kind, plus, _ = model.partition("+")
        effects = [f"system.effects=[{','.join(MACHINES[system].effects)}]"] if plus else []
        words[run] = [f"system={system}", f"model={kind}", f"data.seed={seed}", *effects, *a.overrides]
    train_all(words, at_once=a.at_once)
    rows = []
    for (system, seed, model), run in jobs.items():
        data = data_of(system, seed=OTHER_FLIGHTS + seed, starts=a.starts, folder=folder)
        found = interventions(run, data, a.particles)
        rows.append({"system": system, "seed": seed, "model": model, **found})
        at_1s = ", ".join(f"{g} {found['errors'][g]['1']:.3g} {unit}" for g, unit in GROUPS.items())
        print(f"{system} {seed} {model} at 1 s: {at_1s}", flush=True)
        write_json(folder / "interventions.json", rows)
    print()
    for system in a.systems:
        print(table(rows, system))


if __name__ == "__main__":
    main()
