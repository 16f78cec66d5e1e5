"""Question: how far off is a model of closed-loop flights where inputs are set from outside, and do its intervals hold?

    python benchmarks/bench_interventions.py --folder results/interventions --seeds 5
    python benchmarks/bench_interventions.py --folder results/of_seed_3 --models nsde sysid -- seed=3

Models learn from the built-in flights of seed k (of the quadrotor, 100 + k), which a cascade flew in gusts. They are
judged on 400 interventions on the same machine (`nsde simulate pilot=replay`, from states of the flights of a seed that
is 1000 higher, which no model has seen): one second of commands of another time, independent of the state and of the
gusts, the inputs before the start known. Beside them:

    oracle   the true parameters and effects from the same noisy start, memory from the inputs before, no gusts,
             Runge-Kutta 4 at a quarter of a sample: no model that starts from that measurement beats it but by luck
    hold     the state stays as it is

A model is named by its kind, with `+effects` where the true effects of the machine are declared. Finished trainings are
kept in the folder and not done again. `interventions(run_dir, seed=1)` does the same for one run directory.

`coverage_90_by_distance` in the JSON splits the starts of a neural SDE in halves, by eta where the machine truly was at
the horizon: its diffusion grows with eta, so that intervals are wider than the error where declared physics holds
outside of the data.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import options, train_all

import nsde_torch
from nsde_torch.data import DataSet, Windows
from nsde_torch.evaluation.common_grid import Candidate
from nsde_torch.evaluation.comparison import Comparison, compare
from nsde_torch.evaluation.metrics import start_grid
from nsde_torch.evaluation.scores import LEVELS, group_squares, rms_by_group
from nsde_torch.evaluation.seen import SeenRuns
from nsde_torch.models.neural_sde import NeuralSDE
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
Errors = dict[str, dict[str, float]]


def data_of(system: str, *, seed: int, starts: int, folder: Path) -> DataSet:
    """Interventions on a machine; made once for each folder."""
    path = folder / "data" / f"{system}_{seed}_{starts}"
    truth = path.with_suffix(".truth.json")
    if not truth.is_file():  # written last
        write(simulate(system, seed=seed, replay=Replay(starts)), path, truth=truth, overwrite=True)
    return read("csv", make_system(system), path=str(path))


@torch.no_grad()
def oracle(system: str, data: DataSet, horizons: Sequence[float] = HORIZONS) -> Errors:
    """Errors of the true machine without gusts, from the measured starts."""
    plant = make_plant(
        system,
        generator=torch.Generator().manual_seed(0),
        process_noise=0.0,
        sensor_noise=0.0,
        step=data.dt / 4,
    )
    steps = {h: round(h / data.dt) for h in horizons}
    windows = Windows(data.runs, data.dt, max(steps.values()), dtype=torch.float64)
    starts = start_grid(windows)
    x, u, _ = windows.batch(starts)
    places = windows.locate(starts)
    known = min(_rows_before(data, name, row) for name, row in places)
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


def _rows_before(data: DataSet, name: str, row: int) -> int:
    return next(row - a for a, b in data[name].segments if a < row < b)


def interventions(
    run_dir: str | Path,
    *,
    seed: int,
    starts: int = 400,
    folder: str | Path = "results/interventions",
    particles: int = 199,
    data: DataSet | None = None,
) -> dict[str, Any]:
    """How far off a trained model is on interventions, beside the oracle and a state that is held."""
    run_dir = Path(run_dir)
    model = nsde_torch.load(run_dir)
    metrics = json.loads((run_dir / "metrics.json").read_text(encoding="utf-8"))
    system = model.spec.system
    if data is None:
        data = data_of(system, seed=seed, starts=starts, folder=Path(folder))
    comparison = compare(
        [Candidate(name="model", model=model, seen=SeenRuns.of(metrics))],
        data,
        data.runs,
        seed=0,
        particles=particles,
        horizons=HORIZONS,
        replicates=100,
    )
    content = comparison.content
    (entry,) = content["models"]
    return {
        "starts": content["starts"],
        "errors": entry["errors"],
        "coverage_90": entry["coverage"]["0.9"] if entry["stochastic"] else None,
        "coverage_90_by_distance": by_distance(comparison) if isinstance(model, NeuralSDE) else None,
        "diverged": entry["diverged"],
        "trained_on": not entry["held_out"],
        "oracle": oracle(system, data),
        "hold": content["baselines"]["hold"],
        "parameters": metrics.get("parameters", {}),
        "seconds": metrics.get("seconds"),
    }


@torch.no_grad()
def by_distance(comparison: Comparison) -> dict[str, dict[str, list[float]]]:
    """Coverage of 90 % intervals of a neural SDE in the half of the starts nearer to its data, and in the other."""
    (candidate,), (grid,), (scores,) = comparison.candidates, comparison.grids, comparison.scores
    model = candidate.model
    assert isinstance(model, NeuralSDE)
    x, *_ = grid.windows.batch(grid.starts[scores.kept])
    out: dict[str, dict[str, list[float]]] = {}
    for i, (time, step) in enumerate(zip(grid.times, grid.steps, strict=True)):
        eta = model.distance(x[:, step].to(model.tau))
        halves = eta.argsort().chunk(2)
        inside = scores.inside[:, i, LEVELS.index(0.9)].double()
        out[f"{time:g}"] = {"eta": [float(eta[half].median()) for half in halves]} | {
            g.name: [float(inside[half][:, list(g.channels)].mean()) for half in halves]
            for g in model.system.error_groups
        }
    return out


def overrides(system: str, model: str, seed: int, further: Sequence[str]) -> list[str]:
    """What `nsde train` is told."""
    kind, plus, _ = model.partition("+")
    effects = [f"system.effects=[{','.join(MACHINES[system].effects)}]"] if plus else []
    return [f"system={system}", f"model={kind}", f"data.seed={seed}", *effects, *further]


def table(rows: Sequence[Mapping[str, Any]], system: str) -> str:
    """Means and spreads over the seeds of one system, as Markdown."""
    mine = [r for r in rows if r["system"] == system]
    names = list(dict.fromkeys(r["model"] for r in mine))
    keys = [f"{h:g}" for h in HORIZONS]
    count = len({r["seed"] for r in mine})
    lines = [
        f"| {system}, {count} seeds: rms error | | " + " | ".join(f"{h} s" for h in keys) + " |",
        "|---" * (2 + len(keys)) + "|",
    ]

    def figures(part: str, some: Sequence[Mapping[str, Any]], group: str, h: str) -> np.ndarray:
        return np.array([r[part][group][h] for r in some])

    def spread(values: np.ndarray) -> str:
        around = f" +- {values.std(ddof=1):.2g}" if len(values) > 1 else ""
        return f"{values.mean():.3g}{around}"

    for group, unit in GROUPS.items():
        first = [r for r in mine if r["model"] == names[0]]
        for part in ("oracle", "hold"):
            cells = [spread(figures(part, first, group, h)) for h in keys]
            lines.append(f"| {group} [{unit}] | {part} | " + " | ".join(cells) + " |")
        for name in names:
            some = [r for r in mine if r["model"] == name]
            by_seed = {r["seed"]: r for r in mine if r["model"] == "sysid" + name[len(name.split("+")[0]) :]}
            like = [by_seed[r["seed"]] for r in some if r["seed"] in by_seed]
            cells = []
            for h in keys:
                own = figures("errors", some, group, h)
                text = f"{spread(own)} (x {(own / figures('oracle', some, group, h)).mean():.2f}"
                if len(like) == len(some) and like != some:
                    text += f", x {(own / figures('errors', like, group, h)).mean():.2f}"
                cells.append(text + ")")
            lines.append(f"| {group} [{unit}] | {name} | " + " | ".join(cells) + " |")
    lines += ["", "In brackets: ratio to the oracle, and to `sysid` with the same physics.", ""]
    noisy = [n for n in names if any(r["coverage_90"] for r in mine if r["model"] == n)]
    if noisy:
        lines += ["| 90 % intervals hold | | " + " | ".join(f"{h} s" for h in keys) + " |"]
        lines += ["|---" * (2 + len(keys)) + "|"]
        for group in GROUPS:
            for name in noisy:
                some = [r for r in mine if r["model"] == name]
                cells = [f"{100 * figures('coverage_90', some, group, h).mean():.0f} %" for h in keys]
                lines.append(f"| {group} | {name} | " + " | ".join(cells) + " |")
        lines.append("")
    return "\n".join([*lines, *_parameters(mine, system, names)])


def _parameters(mine: Sequence[Mapping[str, Any]], system: str, names: Sequence[str]) -> list[str]:
    """Declared parameters: mean over the seeds, and how many of the 90 % intervals that are given hold the truth."""
    truth = {k: v[0].flatten().tolist() for k, v in make_plant_system(system).all_declared().items()}
    head = ["| parameter | truth | " + " | ".join(names) + " |", "|---" * (2 + len(names)) + "|"]
    lines = []
    for key, values in truth.items():
        for i, value in enumerate(values):
            cells = []
            for name in names:
                found = [r["parameters"][key] for r in mine if r["model"] == name and key in r["parameters"]]
                if not found:
                    cells.append("-")
                    continue
                own = np.array([f["value"][i] for f in found])
                halves = [(f.get("half_width_90") or [None] * len(values))[i] for f in found]
                given = [
                    abs(v - value) <= h for v, h in zip(own.tolist(), halves, strict=True) if h is not None
                ]
                held = f", {sum(given)} of {len(given)}" if given else ""
                cells.append(f"{own.mean():.3g}{held}")
            label = key if len(values) == 1 else f"{key}[{i}]"
            lines.append(f"| {label} | {value:.3g} | " + " | ".join(cells) + " |")
    return [*head, *lines, ""]


def main() -> None:
    parser = options(__doc__, seeds=5, first_seed=0, at_once=1)
    parser.add_argument(
        "--folder", type=Path, default=Path("results/interventions"), help="keeps data and runs"
    )
    parser.add_argument("--systems", nargs="+", default=list(SYSTEMS), choices=SYSTEMS, help="machines")
    parser.add_argument(
        "--models",
        nargs="+",
        default=["nsde", "sysid", f"nsde{DECLARED}", f"sysid{DECLARED}"],
        choices=[f"{k}{p}" for k in KINDS for p in ("", DECLARED)],
        metavar="MODEL",
        help=f"kinds of models, {', '.join(KINDS)}, each with or without {DECLARED}",
    )
    parser.add_argument("--starts", type=int, default=400, help="interventions for each seed")
    parser.add_argument("--particles", type=int, default=199, help="paths from each start")
    parser.add_argument(
        "--json", type=Path, default=None, help="file for all figures; default: in the folder"
    )
    parser.add_argument(
        "overrides", nargs="*", help="further overrides of nsde train; take another folder for them"
    )
    a = parser.parse_args()
    torch.set_num_threads(1)
    folder = a.folder.resolve()
    jobs = {
        (system, seed, model): folder / "runs" / f"{system}_{seed}_{model}"
        for system in a.systems
        for seed in range(FIRST_SEED[system] + a.first_seed, FIRST_SEED[system] + a.first_seed + a.seeds)
        for model in a.models
    }
    train_all({run: overrides(s, m, k, a.overrides) for (s, k, m), run in jobs.items()}, at_once=a.at_once)
    rows = []
    for (system, seed, model), run in jobs.items():
        data = data_of(system, seed=OTHER_FLIGHTS + seed, starts=a.starts, folder=folder)
        found = interventions(run, seed=OTHER_FLIGHTS + seed, data=data, particles=a.particles)
        rows.append({"system": system, "seed": seed, "model": model, **found})
        at_1s = ", ".join(f"{g} {found['errors'][g]['1']:.3g} {unit}" for g, unit in GROUPS.items())
        print(f"{system} {seed} {model} at 1 s: {at_1s}", flush=True)
        out = a.json or folder / "interventions.json"
        out.write_text(json.dumps(rows, indent=1), encoding="utf-8")
    print()
    for system in a.systems:
        print(table(rows, system))


if __name__ == "__main__":
    main()
