"""Do 90 % intervals of a trained model hold in runs that it has not seen, where runs differ?

    python benchmarks/blind/unseen_runs.py --seed 1 --count 24 --out runs/unseen

Machines are those of `run_differences`; what differs is drawn for each of fifteen runs from one normal law. A model is
trained by default on five of them; coverage, by horizon, and minus the log density of a measurement are of the ten
others.
"""

from __future__ import annotations

import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import numpy as np
from run_differences import KINDS, NOISE, VALUES, Made, changed, write
from small_machines import Small
from study import answers, options

Json = dict[str, Any]
TRAINED, UNSEEN = 5, 10


def made(name: str, seed: int) -> Made:
    """Draw the machines of the runs of a case."""
    kind = KINDS[name]
    rng = np.random.default_rng([seed, 7, list(KINDS).index(name)])
    change = rng.normal(0.0, np.sqrt(kind.least * kind.most), TRAINED + UNSEEN)
    if "friction" in kind.effect and "viscous" not in kind.effect:
        change = abs(change)
    machine = Small(kind.system, dict(VALUES[kind.system]), {}, NOISE[kind.system])
    each = [changed(machine, kind.effect, float(np.exp(v)) if kind.relative else v) for v in change.tolist()]
    return Made(kind, tuple(e[1] for e in each), tuple(e[0] for e in each), tuple(e[2] for e in each))


def trained(name: str, seed: int) -> Json:
    """Simulate a case, train on the first runs, and score the others."""
    import torch

    import nsde_torch

    torch.set_num_threads(1)
    case = made(name, seed)
    with tempfile.TemporaryDirectory() as temporary:
        write(case, Path(temporary), seed)
        start = time.perf_counter()
        unseen = [f"run_{r}" for r in range(TRAINED, TRAINED + UNSEEN)]
        model = nsde_torch.train(temporary, system=case.kind.system, test=unseen, say=False)
    metrics = model.metrics
    coverage = metrics["test"]["coverage"]["0.9"]
    horizons = sorted({h for by in coverage.values() for h in by}, key=float)
    return {
        "kind": name,
        "seed": seed,
        "each": [round(v, 4) for v in case.each],
        "found": {k: v["std"] for k, v in metrics.get("between_runs", {}).items()},
        "networks": {k: v["variables"] for k, v in metrics["innovations"]["networks"].items() if v["kept"]},
        "factor": metrics["calibration"]["factor"],
        "coverage": {h: float(np.mean([by[h] for by in coverage.values()])) for h in horizons},
        "nll": float(np.mean([v for by in metrics["test"]["nll"].values() for v in by.values()])),
        "seconds": round(time.perf_counter() - start, 1),
    }


def line(answer: Json) -> str:
    """A line for an answer."""
    if "error" in answer:
        return f"{answer['kind']} {answer['seed']}: {answer['error']}"
    held = ", ".join(f"{h} s {share:.0%}" for h, share in answer["coverage"].items())
    found = ", ".join(answer["found"]) or "nothing"
    learned = "; ".join(f"{k}: {', '.join(v)}" for k, v in answer["networks"].items())
    return (
        f"{answer['kind']:18} {answer['seed']} {held}; differs: {found}; sigma times {answer['factor']:.2f}; "
        f"{answer['nll']:.2f} nats"
        + (f"; networks of {learned}" if learned else "")
        + f" ({answer['seconds']:.0f} s)"
    )


def main() -> None:
    """Train cases, print a line for each, and the mean coverage."""
    names = list(KINDS)
    given = options(__doc__ or "", count=len(names)).parse_args()
    cases = []
    for i in range(given.first, given.first + given.count):
        name, seed = names[i % len(names)], given.seed + i // len(names)
        wrong = {"kind": name, "seed": seed, "coverage": {}, "found": {}, "networks": {}}
        cases.append((f"{name.replace(': ', '_')}_{seed}", partial(trained, name, seed), wrong))
    rows = answers(given.out, cases, line)
    horizons = sorted({h for r in rows for h in r["coverage"]}, key=float)
    means = {h: [r["coverage"][h] for r in rows if h in r["coverage"]] for h in horizons}
    text = ", ".join(f"{h} s {np.mean(v):.1%}" for h, v in means.items())
    cells = [v for of in means.values() for v in of]
    inside = np.mean([0.8 <= v <= 0.97 for v in cells])
    print(
        f"\nmean coverage of {len(rows)} cases: {text}; between 80 and 97 % in {inside:.0%} of their horizons"
    )


if __name__ == "__main__":
    main()
