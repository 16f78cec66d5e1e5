"""Question: on the supplement's scarce and noisy spring, is the neural SDE calibrated, and what does diffusion cost?

Five noisy runs of one corner of the state space (`MSD_MeasHigh_TopRight_5`) train, ten less noisy ones of the whole
region (`MSD_TestData`) test. The same model is trained without diffusion (`solver=rk4`) for comparison, once with
the declared spring and damper and once with q'' left to the network, as in the supplement (`system.declared=[]`).

The sensors of the test set are less noisy than those of the training set. Intervals are of measurements, so they
take the noise of the sensors from the fourth differences of the test runs; nothing else of the test set is used.

Inside is the test set; outside are as many starts drawn uniformly in a box three times as wide as the training
data's, of which those are kept that eta puts further away than 99 % of the training data. Interval widths are of
the state itself (without sensor noise) at 1 s.

    python benchmarks/bench_mass_spring_damper.py --data .../mass_spring_damper --out results/
"""

import argparse
import json
from pathlib import Path

import numpy as np
import torch
import yaml
from common import train_all
from omegaconf import OmegaConf

import nsde_torch
from nsde_torch.api.reading import split_runs
from nsde_torch.cli import build
from nsde_torch.evaluation.scores import interval_quantiles


def main() -> None:
    """Train, collect, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True, help="folder of the published spring data")
    parser.add_argument("--out", type=Path, default=Path("results/mass_spring_damper"))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--at-once", type=int, default=2)
    a = parser.parse_args()
    folder = a.data.resolve()
    base = [
        "system=mass_spring_damper",
        "data=published",
        f"data.path={folder / 'MSD_MeasHigh_TopRight_5.pkl'}",
        f"data.test_path={folder / 'MSD_TestData.pkl'}",
    ]
    kinds = {
        "sde": [],
        "ode": ["solver=rk4"],
        "sde_black_box": ["system.declared=[]"],
        "ode_black_box": ["system.declared=[]", "solver=rk4"],
    }
    jobs = {
        a.out.resolve() / f"{kind}_seed{s}": [*base, *extra, f"seed={s}"]
        for kind, extra in kinds.items()
        for s in a.seeds
    }
    train_all(jobs, at_once=a.at_once)
    for kind in kinds:
        tests = [
            json.loads((a.out / f"{kind}_seed{s}" / "metrics.json").read_text())["test"] for s in a.seeds
        ]
        print(f"\n{kind}: mean over seeds (deviation)")
        for h in (f"{h:g}" for h in tests[0]["horizons_s"]):
            cells = []
            for group in ("position", "velocity"):
                e = 1e3 * np.array([t["errors"]["model"][group][h] for t in tests])
                c = np.mean([t["coverage"]["0.9"][group][h] for t in tests])
                cells.append(
                    f"{group} {e.mean():.2f} ({e.std():.2f}) mm"
                    + ("/s" if group == "velocity" else "")
                    + (f", 90 % holds {c:.0%}" if kind.startswith("sde") else "")
                )
            print(f"{h:>5} s  " + "   ".join(cells))
        if kind.startswith("sde"):
            ratios = np.array([widening(a.out / f"{kind}_seed{s}", s) for s in a.seeds])
            print(
                f"90 % intervals outside are wider by q x{ratios.mean(0)[0]:.1f}, q' x{ratios.mean(0)[1]:.1f}"
            )


def widening(folder: Path, seed: int) -> list[float]:
    """Mean width of the 90 % intervals at 1 s of starts away from the training data, over that of the test runs."""
    model = nsde_torch.load(folder)
    config = OmegaConf.create(yaml.safe_load((folder / "config.yaml").read_text())["config"])
    system = build.system(config.system)
    split = split_runs(build.dataset(config.data, system), config.data.test)
    train, test = (
        torch.as_tensor(np.concatenate([r.x for r in side])).float() for side in (split.train, split.test)
    )
    generator = torch.Generator().manual_seed(seed)
    low, high = train.min(0).values, train.max(0).values
    away = (low + high) / 2 + 3 * (high - low) * (torch.rand(len(test), 2, generator=generator) - 0.5)
    away = away[model.distance(away) > model.distance(train).quantile(0.99)]
    widths = []
    for x0 in (test, away):
        u = torch.zeros(len(x0), 100, 1)
        paths = model.sample(x0, u, dt=0.01, particles=39, generator=generator, measurement=False)
        ends = interval_quantiles(paths[:, :, -1], 0.9)
        widths.append((ends[1] - ends[0]).mean(0))
    return (widths[1] / widths[0]).tolist()


if __name__ == "__main__":
    main()
