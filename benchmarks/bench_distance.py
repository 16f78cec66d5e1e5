"""Question: does eta know the data? Held-out features against features drawn away from the data.

For a run directory and its data set: AUROC of eta between features of the held-out runs and features drawn uniformly
in a box three times as wide as the training data's, and the Spearman correlation of eta's logit with the distance
to the nearest training point (in standard deviations), over both together and over the uniform ones alone.

    nsde train system=cartpole run_dir=runs/cartpole
    python benchmarks/bench_distance.py runs/cartpole [runs/hexacopter ...]
"""

import argparse
import json
from pathlib import Path

import numpy as np
import torch
import yaml
from omegaconf import OmegaConf
from scipy.spatial import cKDTree
from scipy.stats import spearmanr

import nsde_torch
from nsde_torch.api.reading import split_runs
from nsde_torch.cli import build


def main() -> None:
    """Score each run directory."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--seed", type=int, default=0)
    a = parser.parse_args()
    torch.set_num_threads(1)
    for folder in a.runs:
        r = score(folder, a.seed)
        print(f"{folder.name:24s} " + "  ".join(f"{k} {v:.3f}" for k, v in r.items()), flush=True)


def score(folder: Path, seed: int) -> dict[str, float]:
    """Figures of one run directory."""
    model = nsde_torch.load(folder)
    config = OmegaConf.create(yaml.safe_load((folder / "config.yaml").read_text())["config"])
    system = build.system(config.system)
    split = split_runs(build.dataset(config.data, system), config.data.test)
    assert set(json.loads((folder / "metrics.json").read_text())["test_runs"]) == {r.name for r in split.test}
    train, test = (
        model.system.features(
            torch.as_tensor(np.concatenate([r.x[p:q] for r in side for p, q in r.segments])).float()
        ).numpy()
        for side in (split.train, split.test)
    )
    rng = np.random.default_rng(seed)
    low, high = train.min(0), train.max(0)
    test = test[rng.permutation(len(test))[:5000]]
    away = (low + high) / 2 + 1.5 * (high - low) * rng.uniform(-1, 1, (len(test), train.shape[1]))
    spread = train.std(0)
    tree = cKDTree(train / spread)
    with torch.no_grad():
        eta_in, eta_out = (model.eta(torch.as_tensor(f).float()).double().numpy() for f in (test, away))
    near, far = (tree.query(f / spread)[0] for f in (test, away))
    logit_in, logit_out = (np.log(e) - np.log1p(-e) for e in (eta_in, eta_out))
    rank = np.searchsorted(np.sort(eta_in), eta_out).mean() / len(eta_in)
    return {
        "AUROC": float(rank),
        "Spearman": float(spearmanr(np.r_[logit_in, logit_out], np.r_[near, far])[0]),
        "Spearman of the uniform ones": float(spearmanr(logit_out, far)[0]),
        "eta on held-out": float(eta_in.mean()),
        "eta away": float(eta_out.mean()),
    }


if __name__ == "__main__":
    main()
