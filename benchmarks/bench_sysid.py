"""Question: does least-squares identification find the true parameters, and do its 95 % intervals hold 95 %?

    python benchmarks/bench_sysid.py --seeds 200

Plants of this package, identified with all the physics that they have, from the defaults of the system: without gusts
and sensor noise (largest error of a parameter), and with them, motion and noise of every seed its own (how many of the
intervals hold the true value, bias and spread of the estimates). With --differences the same data are also fitted to
finite differences of smoothed states, the classical way.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import options, write_json

from nsde_torch.data import Run
from nsde_torch.models.identified import METHODS
from nsde_torch.simulation import Making, simulated
from nsde_torch.simulation.flights import START, Pilot, fly
from nsde_torch.sysid.identify import identify
from nsde_torch.systems import MACHINES, System, make_plant_system, make_system
from nsde_torch.systems.parameters import ParameterVector

SYSTEMS = ("mass_spring_damper", "cartpole", "hexacopter")
FLIGHTS_S = (40.0, 40.0, 40.0)
AT_ONCE = 20  # seeds whose flights are flown in one batch
LEVEL = 0.95


def main() -> None:
    parser = options(__doc__, seeds=200, first_seed=0, out=Path("bench_sysid.json"))
    parser.add_argument("--systems", nargs="+", choices=SYSTEMS, default=SYSTEMS)
    parser.add_argument("--differences", action="store_true", help="the classical method too")
    a = parser.parse_args()
    results: dict[str, Any] = {}
    for name in a.systems:
        for method in METHODS if a.differences else ("weak",):
            row = {"noise_free": noise_free(name, method)}
            if a.seeds:
                row |= coverage(name, method, range(a.first_seed, a.first_seed + a.seeds))
            results.setdefault(name, {})[method] = row
            report(name, method, row)
            write_json(a.out, results)


def declared(name: str) -> System:
    """The system with all the physics that its plant has, at the default values."""
    known = make_system(name).effect_names
    return make_system(name, effects=[e for e in MACHINES[name].effects if e not in known])


def truth(name: str) -> dict[str, float]:
    vector = ParameterVector(make_plant_system(name))
    return dict(zip(vector.labels, vector.start.tolist(), strict=True))


def recordings(name: str, seeds: Sequence[int], *, noise: float) -> Iterator[Sequence[Run]]:
    if name != "hexacopter":
        options = {"force": "multisine"} if name == "mass_spring_damper" else {}
        process = noise if MACHINES[name].gusts else 1.0
        how = {"sensor_noise": noise, "process_noise": process, "use_cache": False, **options}
        for seed in seeds:
            yield simulated(name, seed=seed, **how).runs
        return
    dt = MACHINES[name].dt
    for first in range(0, len(seeds), AT_ONCE):
        some = seeds[first : first + AT_ONCE]
        paths = [p for s in some for p in Pilot(list(FLIGHTS_S), dt=dt, seed=s).paths(START)]
        generator = torch.Generator().manual_seed(1000 + some[0])
        making = Making(process_noise=noise, sensor_noise=noise)
        flown = fly(name, paths, generator=generator, making=making)
        t = dt * np.arange(len(flown.x))
        for k in range(len(some)):
            rows = range(k * len(FLIGHTS_S), (k + 1) * len(FLIGHTS_S))
            yield [Run(f"flight_{i}", t, flown.x[:, i], flown.u[:, i]) for i in rows]


def noise_free(name: str, method: str) -> dict[str, Any]:
    """Errors without any noise, as shares of the true values."""
    true = truth(name)
    (runs,) = recordings(name, [0], noise=0.0)
    found = identify(declared(name), runs, method=method)
    pairs = zip(found.vector.labels, found.values, strict=True)
    errors = {label: abs(value / true[label] - 1) for label, value in pairs}
    return {"largest": max(errors.values()), "errors": errors}


def coverage(name: str, method: str, seeds: Sequence[int]) -> dict[str, Any]:
    """Share of intervals that hold the truth, bias and spread of the estimates."""
    true, rows = truth(name), []
    for runs in recordings(name, seeds, noise=1.0):
        found = identify(declared(name), runs, method=method)
        rows.append((found.values, found.half_widths(LEVEL)))
    values, half = (np.array(part) for part in zip(*rows, strict=True))
    labels = ParameterVector(declared(name)).labels
    miss = values - np.array([true[label] for label in labels])
    held = np.abs(miss) <= half
    each = {
        label: {
            "true": true[label],
            "held": float(held[:, i].mean()),
            "bias": float(miss[:, i].mean()),
            "spread": float(values[:, i].std(ddof=1)),
        }
        for i, label in enumerate(labels)
    }
    # parameters of one fit err together: the seeds, not the intervals, are independent
    of_seed = held.mean(1)
    return {
        "seeds": len(rows),
        "held": float(held.mean()),
        "held_standard_error": float(of_seed.std(ddof=1) / len(rows) ** 0.5),
        "parameters": each,
    }


def report(name: str, method: str, row: dict[str, Any]) -> None:
    print(f"\n{name}, {method}: noise-free, largest error {row['noise_free']['largest']:.1e}")
    if "parameters" not in row:
        return
    held = f"hold {row['held']:.1%} (+- {row['held_standard_error']:.1%})"
    print(f"  {LEVEL:.0%} intervals over {row['seeds']} seeds {held}")
    for label, p in row["parameters"].items():
        about = f"true {p['true']:9.4f}  bias {p['bias']:+.4f}  spread {p['spread']:.4f}"
        print(f"  {label:28s} {about}  held {p['held']:.1%}", flush=True)


if __name__ == "__main__":
    main()
