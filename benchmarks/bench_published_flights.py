"""Question: how far off is a held-out second of the published hexacopter flights, and do the intervals hold?

Each flight is held out in turn, with several seeds. Starts, horizons and scores are those of `nsde train` itself
(every 0.25 s, 2 s ahead inside one stretch, 32 particles, mean of the particles as the prediction); the authors'
figures were measured with the same protocol. The inputs of these files see 0.2 s of the future (a centred moving
average of 0.4 s), and the filter that undoes it has taps up to 0.4 s ahead: commands up to 0.6 s ahead are drawn on.

    python benchmarks/bench_published_flights.py --data .../hexacopter/trajs.pkl --out results/
"""

from pathlib import Path

import numpy as np
from common import options, read_json, train_all

# position m, velocity m/s, attitude deg, rate rad/s: the authors' neural SDE, trained on two flights, tested on the
# third, mean over the three folds, measured with their public code
AUTHORS = {
    "0.25": (0.049, 0.214, 6.1, 0.62),
    "0.5": (0.134, 0.494, 10.7, 0.64),
    "1": (0.476, 1.00, 13.2, 0.90),
}
GROUPS = ("position", "velocity", "attitude", "rate")


def main() -> None:
    parser = options(__doc__, out=Path("results/published_flights"), at_once=2)
    parser.add_argument("--data", type=Path, required=True, help="trajs.pkl of the published hexacopter")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--folds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("overrides", nargs="*", help="further overrides of nsde train")
    a = parser.parse_args()
    base = ["system=hexacopter", "data=published", f"data.path={a.data.resolve()}", *a.overrides]
    cases = {(f, s): a.out.resolve() / f"flight{f}_seed{s}" for f in a.folds for s in a.seeds}
    train_all({d: [*base, f"data.test=[{f}]", f"seed={s}"] for (f, s), d in cases.items()}, at_once=a.at_once)
    metrics = {key: read_json(folder / "metrics.json") for key, folder in cases.items()}
    errors: dict[str, list[list[float]]] = {}
    cover: dict[str, list[list[float]]] = {}
    for test in (metrics[key]["test"] for key in cases):
        for h in (f"{h:g}" for h in test["horizons_s"]):
            errors.setdefault(h, []).append([test["errors"]["model"][g][h] for g in GROUPS])
            cover.setdefault(h, []).append([test["coverage"]["0.9"][g][h] for g in GROUPS])
    print(f"\n{len(cases)} models; {sum(m['test']['diverged'] for m in metrics.values())} starts diverged")
    print(
        "rms error: mean over flights and seeds (deviation over seeds of the mean over flights), ratio to the authors'"
    )
    for h, rows in errors.items():
        table = np.array(rows).reshape(len(a.folds), len(a.seeds), 4)
        mean, spread = table.mean((0, 1)), table.mean(0).std(0)
        told = [f"{g} {mean[i]:.3f} ({spread[i]:.3f})" for i, g in enumerate(GROUPS)]
        if h in AUTHORS:
            told = [f"{t} x{r:.2f}" for t, r in zip(told, mean / np.array(AUTHORS[h]), strict=True)]
        print(f"{h:>5} s  " + "   ".join(told))
    print("share of measurements inside the 90 % intervals: mean over flights and seeds")
    for h, rows in cover.items():
        mean = np.array(rows).mean(0)
        told = [f"{g} {v:.3f}" for g, v in zip(GROUPS, mean, strict=True)]
        print(f"{h:>5} s  {'   '.join(told)}   all {mean.mean():.3f}")


if __name__ == "__main__":
    main()
