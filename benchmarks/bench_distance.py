"""Question: does eta know the data? Held-out features against features drawn away from the data.

For a run directory and its data set: AUROC of eta between features of the held-out runs and features drawn uniformly
in a box three times as wide as the training data's.

    nsde train system=cartpole run_dir=runs/cartpole
    python benchmarks/bench_distance.py runs/cartpole [runs/hexacopter ...]
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import Array, options, read_json

import nsde_torch
from nsde_benchmarks.paper.figure_table import held_out
from nsde_torch.evaluation.scores import interval_quantiles


def main() -> None:
    parser = options(__doc__, seed=0)
    parser.add_argument("runs", type=Path, nargs="+")
    a = parser.parse_args()
    for folder in a.runs:
        r = score(folder, a.seed)
        print(f"{folder.name:24s} " + "  ".join(f"{k} {v:.3f}" for k, v in r.items()), flush=True)


def score(folder: Path, seed: int) -> dict[str, float]:
    model = nsde_torch.load(folder)
    parts = held_out(folder)
    sides = parts.train, parts.test
    assert set(read_json(folder / "metrics.json")["test_runs"]) == {r.name for r in sides[1]}
    states = (np.concatenate([r.x[p:q] for r in side for p, q in r.segments]) for side in sides)
    train, test = (model.system.features(torch.as_tensor(x).float()).numpy() for x in states)
    rng = np.random.default_rng(seed)
    low, high = train.min(0), train.max(0)
    test = test[rng.permutation(len(test))[:5000]]
    away = (low + high) / 2 + 1.5 * (high - low) * rng.uniform(-1, 1, (len(test), train.shape[1]))
    with torch.no_grad():
        eta_in, eta_out = (model.eta(torch.as_tensor(f).float()).double().numpy() for f in (test, away))
    rank = np.searchsorted(np.sort(eta_in), eta_out).mean() / len(eta_in)
    scores = {"AUROC": rank, "eta on held-out": eta_in.mean(), "eta away": eta_out.mean()}
    if model.spec.system == "mass_spring_damper":  # whose features are its states
        for name, width in zip("qv", widening(model, train, test), strict=True):
            scores[f"width of {name} away over held-out"] = width
    return scores


def widening(model: Any, train: Array, test: Array) -> list[float]:
    """Mean width of the 90 % intervals of the state at 1 s of starts away from the data, over that of held-out ones.

    Those away are drawn uniformly in a box three times as wide as the training data's; of them those are kept that eta
    puts further away than 99 % of the training data.
    """
    generator = torch.Generator().manual_seed(0)
    inside, held = (torch.as_tensor(x).float() for x in (train, test))
    low, high = inside.min(0).values, inside.max(0).values
    away = (low + high) / 2 + 3 * (high - low) * (torch.rand(len(held), 2, generator=generator) - 0.5)
    away = away[model.distance(away) > model.distance(inside).quantile(0.99)]
    widths = []
    for x0 in (held, away):
        u = torch.zeros(len(x0), 100, 1)
        paths = model.sample(x0, u, dt=0.01, particles=39, generator=generator, measurement=False)
        ends = interval_quantiles(paths[:, :, -1], 0.9)
        widths.append((ends[1] - ends[0]).mean(0))
    return (widths[1] / widths[0]).tolist()


if __name__ == "__main__":
    main()
