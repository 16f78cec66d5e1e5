"""Question: does a diagnosis of two published hexacopter flights find the same as of the others, and hold on the third?

    python benchmarks/bench_published_diagnosis.py --data .../hexacopter/trajs.pkl --out results/published_diagnosis

Each flight is held out in turn, and nothing is told. Printed are what was found with its parameters, and on the flight
held out, with parameters fitted to the other two: the residual as a rate (rms of means over a quarter of a second) and
the open-loop errors, with the declared physics alone and with what was found. Both see the flight with those
faults of the recording chain undone that the other two showed.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import options, read_json, write_json

from nsde_torch.data import Run, Windows
from nsde_torch.diagnosis.cross_validation import as_model
from nsde_torch.diagnosis.decisions import Options
from nsde_torch.diagnosis.pipeline import diagnose
from nsde_torch.diagnosis.result import Diagnosis
from nsde_torch.diagnosis.search import Search, fitted_system
from nsde_torch.evaluation.metrics import start_grid, thinned
from nsde_torch.evaluation.scores import rollout_squares
from nsde_torch.models.identified import SysidSpec
from nsde_torch.recording import read
from nsde_torch.sysid.physics import Physics, bump, smooth_rate
from nsde_torch.systems import System, make_system
from nsde_torch.systems.parameters import ParameterVector

HORIZONS_S = (0.1, 0.25, 0.5, 1.0)


def fold(data: Any, system: System, out: int) -> dict[str, Any]:
    """Diagnose all flights but one, and measure on that one."""
    spec = SysidSpec(system.name, dt=data.dt, horizon=system.defaults.horizon)
    rest = [run for i, run in enumerate(data.runs) if i != out]
    found = diagnose(system, spec, data, rest, Options())
    test = found.recorded.like(data.runs[out], system)
    content = found.content()
    return {
        **{key: content[key] for key in ("verdict", "added", "parameters")},
        "flight": data.runs[out].name,
        "residual": rates(found, test),
        "errors": errors(found, spec, test),
        "seconds": sum(found.seconds.values()),
    }


def rates(found: Diagnosis, test: Run) -> dict[str, list[float]]:
    """Residual of each dynamic channel on a run left out: rms [unit/s] without and with effects."""
    steps = Search(found.system, [test], found.recorded.clock, found.options).steps
    out: dict[str, list[float]] = {}
    for fitted in (found.outcome.declared, found.outcome.final):
        physics = Physics(ParameterVector(fitted_system(fitted)), steps)
        left = physics.residual(fitted.theta)[:, fitted.rows]
        smooth = smooth_rate(left, steps.segments, bump(steps.dt), steps.dt)
        for channel, rms in zip(fitted.rows, np.sqrt(np.square(smooth).mean(0)), strict=True):
            out.setdefault(physics.names[channel], []).append(float(rms))
    return out


def errors(found: Diagnosis, spec: SysidSpec, test: Run) -> dict[str, dict[str, list[float]]]:
    """Open-loop errors on a run left out by quantity and horizon, without and with effects."""
    steps = [round(h / spec.dt) for h in HORIZONS_S]
    windows = Windows([test], spec.dt, steps[-1], dtype=torch.float64)
    starts = thinned(start_grid(windows))
    out: dict[str, dict[str, list[float]]] = {}
    for fitted in (found.outcome.declared, found.outcome.final):
        model = as_model(spec, fitted_system(fitted), found.recorded.clock)
        squares = rollout_squares(model, windows, starts, steps)
        for j, group in enumerate(found.system.error_groups):
            rms = squares[:, :, j].double().mean(0).sqrt() * group.factor
            for h, value in zip(HORIZONS_S, rms.tolist(), strict=True):
                out.setdefault(group.name, {}).setdefault(f"{h:g}", []).append(value)
    return out


def value_of(p: Any) -> str:
    """A parameter with its interval, where there are any."""
    if p is None:
        return "-"
    ends = p["interval_90"]
    return f"{p['value']:.3g}" + (f" [{ends[0]:.3g}, {ends[1]:.3g}]" if ends else "")


def show(results: list[dict[str, Any]]) -> None:
    """Print what was found in each fold, and the means over folds."""
    for r in results:
        print(f"\nheld out: {r['flight']}; {r['verdict']}: {', '.join(r['added'])} ({r['seconds']:.0f} s)")
    names = sorted({n for r in results for n in r["parameters"]})
    print("\nparameter: value [90 % interval] without each flight in turn")
    for name in names:
        print(f"  {name}: {' | '.join(value_of(r['parameters'].get(name)) for r in results)}")

    def means(pairs: list[list[float]]) -> Any:
        return np.sqrt(np.square(pairs).mean(0))

    print("\nresidual on the flight held out, rms: declared -> with what was found, mean of folds")
    for channel in results[0]["residual"]:
        one, two = means([r["residual"][channel] for r in results])
        print(f"  {channel}: {one:.3g} -> {two:.3g}")
    print("\nopen-loop errors on the flight held out: ratio by horizon [s]")
    for group, by in results[0]["errors"].items():
        pairs = {h: means([r["errors"][group][h] for r in results]) for h in by}
        print(f"  {group}: {', '.join(f'{h}: x{two / one:.2f}' for h, (one, two) in pairs.items())}")


def main() -> None:
    parser = options(__doc__, out=Path("results/published_diagnosis"))
    parser.add_argument("--data", type=Path, required=True, help="trajs.pkl of the published hexacopter")
    a = parser.parse_args()
    system = make_system("hexacopter")
    data = read("published", system, path=str(a.data))
    a.out.mkdir(parents=True, exist_ok=True)
    results = []
    for k in range(len(data.runs)):
        path = a.out / f"fold_{k}.json"
        if not path.is_file():
            write_json(path, fold(data, system, k))
            print(f"wrote {path}", flush=True)
        results.append(read_json(path))
    show(results)


if __name__ == "__main__":
    main()
