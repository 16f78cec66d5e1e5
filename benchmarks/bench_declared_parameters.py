"""Question: do the intervals of declared parameters of `model=nsde` hold on closed-loop flights?

    python benchmarks/bench_declared_parameters.py --seeds 20
    python benchmarks/bench_declared_parameters.py --seeds 20 --system quadrotor

Built-in flights of each seed (two train, as in `nsde train`), fitted as `loss=default` does, with the true effects of
the machine declared and without them. What is printed: mean estimate, bias as a share of the true value, and how many
of the 90 % intervals hold. Networks take one gradient step: they do not move declared parameters.
"""

import argparse
import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from nsde_torch.models import SDESpec
from nsde_torch.simulation import simulated
from nsde_torch.systems import MACHINES, make_system
from nsde_torch.training import LossOptions, TrainerOptions
from nsde_torch.training.fit_sde import fit_sde
from nsde_torch.training.task import Task

FIRST_SEED = {"hexacopter": 0, "quadrotor": 100}
"""Added to the seed: of one seed both machines fly nearly the same."""


def truths(system: str) -> dict[str, list[float]]:
    """Declared parameters and those of the machine's effects, as lists."""
    machine = MACHINES[system]
    known = {**machine.values}
    known |= {f"{e}.{p}": v for e, values in machine.effects.items() for p, v in values.items()}
    return {name: list(np.atleast_1d(value)) for name, value in known.items()}


def estimates(system: str, seed: int, effects: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """Declared parameters of one fit: name -> value, half_width_90."""
    data = simulated(make_system(system), seed=seed, variants=12, rounds=1)
    spec = SDESpec(
        system,
        dt=0.05,
        horizon=20,
        step="milstein_heun",
        effects=effects,
        measurement=True,
        disturbance=True,
        learn_lag=True,
    )
    with TemporaryDirectory() as folder:
        task = Task(
            spec=spec,
            runs=data.runs[:2],
            seed=seed,
            name="fit",
            loss=LossOptions(),
            options=TrainerOptions(steps=1),
            validation=0.5,
            clock=1.0,
            values={},
            device=torch.device("cpu"),
            dtype=torch.float32,
            checkpoint=Path(folder) / "fit",
            log=lambda *_: None,
        )
        return fit_sde(task).parameters()


def main() -> None:
    """Print a table for each way of declaring."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--system", default="hexacopter", choices=sorted(FIRST_SEED))
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--out", type=Path, default=None, help="JSON file of all estimates")
    given = parser.parse_args()
    torch.set_num_threads(1)
    truth, kept = truths(given.system), {}
    for name, effects in (("declared", ("linear_drag", "motor_lag")), ("undeclared", ())):
        rows = []
        for k in range(given.seeds):
            rows.append(estimates(given.system, FIRST_SEED[given.system] + k, effects))
            print(f"{name}: seed {k + 1} of {given.seeds}", flush=True)
        kept[name] = rows
        report(given.system, name, rows, truth)
    if given.out is not None:
        given.out.write_text(json.dumps(kept, indent=1))


def report(
    system: str, name: str, rows: list[dict[str, dict[str, Any]]], truth: dict[str, list[float]]
) -> None:
    """Print what the fits of all seeds say."""
    print(f"\n{system}, true effects {name}, {len(rows)} seeds")
    print(f"{'parameter':28s} {'truth':>8s} {'mean':>8s} {'bias':>7s} {'90 % hold':>10s} {'seeds':>6s}")
    held, total, biases = 0, 0, []
    for parameter, wanted in truth.items():
        for i, value in enumerate(wanted):
            own = [r[parameter] for r in rows if parameter in r]
            if not own:
                continue
            found = np.array([p["value"][i] for p in own])
            half = np.array([np.nan if p["half_width_90"][i] is None else p["half_width_90"][i] for p in own])
            inside = np.abs(found - value) <= half
            held, total = held + int(inside.sum()), total + int(np.isfinite(half).sum())
            biases.append(abs(found.mean() - value) / abs(value))
            label = parameter if len(wanted) == 1 else f"{parameter}[{i}]"
            print(
                f"{label:28s} {value:8.3g} {found.mean():8.3g} {found.mean() / value - 1:+7.1%} "
                f"{inside.sum():4d} of {np.isfinite(half).sum():2d} {len(own):6d}"
            )
    print(f"all intervals: {held} of {total} ({held / max(total, 1):.1%}); largest bias {max(biases):.1%}\n")


if __name__ == "__main__":
    main()
