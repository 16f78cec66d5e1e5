"""Question: what do a sparse regression and a residual network make of the same cases, told just as little?

    pip install 'pysindy>=2.0,<3'
    python benchmarks/blind/peers.py --cases blind/ --limit 20

Of each case with a single effect that moves errors, the last fifth of the runs is held out from everybody. On the
others are fitted: the declared physics; the declared physics with the effects that a diagnosis of these runs alone
adds; a sparse regression of all rates on polynomials of degree 3 in states and inputs (and sines and cosines of
angles) with pysindy, its threshold chosen on a run of the training part; and the neural SDE of `nsde train`, whose
residual networks may learn what is missing. The figure is the rms error of open-loop predictions at the longest
horizon up to 1 s, as a ratio to that of the declared physics (geometric mean over quantities).
"""

from __future__ import annotations

import argparse
import json
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).resolve().parents[1]))

import numpy as np
import torch
from common import train
from run import MOVES
from torch import Tensor

import nsde_torch
from nsde_torch.data import DataSet, Run, Windows
from nsde_torch.diagnosis.cross_validation import as_model
from nsde_torch.diagnosis.decisions import Options
from nsde_torch.diagnosis.pipeline import diagnose
from nsde_torch.diagnosis.search import Search, fitted_system
from nsde_torch.evaluation.metrics import horizons_of, start_grid, thinned
from nsde_torch.evaluation.scores import group_squares, rollout_squares
from nsde_torch.models.identified import SysidSpec
from nsde_torch.systems import System, make_system

PARTICLES = 32
THRESHOLDS = (0.003, 0.01, 0.03, 0.1, 0.3)
"""Of pysindy, in units of standardised columns."""
Rollout = Callable[[Tensor, Tensor, int], Tensor]


def held_apart(data: DataSet) -> tuple[list[Run], list[Run]]:
    """Training runs and the last fifth, at least one."""
    count = max(1, len(data.runs) // 5)
    return list(data.runs[:-count]), list(data.runs[-count:])


class Sparse:
    """dx/dt as a sparse combination of functions of states and inputs, found by pysindy.

    Args:
        system: Names and units of the states.
        runs: Runs to fit; the threshold is chosen on the last one.
    """

    def __init__(self, system: System, runs: Sequence[Run]) -> None:
        import pysindy as ps

        polynomial = ps.PolynomialLibrary(degree=3)
        angles = [i for i, unit in enumerate(system.state_units) if unit == "rad"]
        library = polynomial
        if angles:
            n = system.nx + system.nu
            waves = ps.FourierLibrary(n_frequencies=2)
            library = ps.GeneralizedLibrary([polynomial, waves], inputs_per_library=[list(range(n)), angles])

        def fitted(threshold: float, some: Sequence[Run]) -> Any:
            model = ps.SINDy(
                optimizer=ps.STLSQ(threshold=threshold, alpha=1e-6, normalize_columns=True),
                feature_library=library,
                differentiation_method=ps.SmoothedFiniteDifference(smoother_kws={"window_length": 9}),
            )
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                model.fit([r.x for r in some], t=some[0].dt, u=[r.u[:, : system.nu] for r in some])
            return model

        def error(model: Any) -> float:
            last = runs[-1]
            smooth = model.differentiation_method
            rate = smooth(last.x, last.dt)
            guess = model.predict(last.x, u=last.u[:, : system.nu])
            return float(np.square((rate - guess) / rate.std(0)).mean())

        best = min(THRESHOLDS, key=lambda t: error(fitted(t, runs[:-1])) if len(runs) > 1 else 0.0)
        self.model, self.nu, self.dt = fitted(best, runs), system.nu, runs[0].dt

    def rollout(self, x: Tensor, u: Tensor, steps: int) -> Tensor:
        """States (B, steps, nx) after the first, by Runge and Kutta; inputs are held."""
        z, out = x.numpy(), []
        for k in range(steps):
            held = u[:, k, : self.nu].numpy()

            def rate(at: np.ndarray, held: np.ndarray = held) -> np.ndarray:
                return np.asarray(self.model.predict(np.clip(at, -1e3, 1e3), u=held))

            a = rate(z)
            b = rate(z + 0.5 * self.dt * a)
            c = rate(z + 0.5 * self.dt * b)
            d = rate(z + self.dt * c)
            z = z + self.dt / 6.0 * (a + 2 * b + 2 * c + d)
            out.append(z)
        return torch.from_numpy(np.stack(out, 1))


def judged(folder: Path, name: str, out: Path) -> dict[str, Any]:
    """Errors of all on the runs that were held apart, as ratios to the declared physics."""
    truth = json.loads((folder / "truth" / f"{name}.json").read_text(encoding="utf-8"))
    system = make_system(truth["system"])
    data = nsde_torch.read(folder / "data" / name, system=system)
    spec = SysidSpec(system.name, dt=data.dt, horizon=system.defaults.horizon)
    training, test = held_apart(data)
    horizon = max(h for h in horizons_of(test, spec.dt) if h <= 1.0)
    steps = round(horizon / spec.dt)
    windows = Windows(test, spec.dt, steps, dtype=torch.float64)
    starts = thinned(start_grid(windows))
    x, u, _ = windows.batch(starts)

    def rms(squares: Tensor) -> Tensor:
        return squares.nan_to_num(posinf=1e6).clamp(max=1e6).mean(0).sqrt()

    declared = fitted_system(Search(system, training, 1.0, Options()).quick(system))
    found = diagnose(system, spec, data, training, Options())
    errors = {
        "declared": rms(rollout_squares(as_model(spec, declared, 1.0), windows, starts, [steps])[:, 0]),
        "diagnosis": rms(
            rollout_squares(as_model(spec, found.outcome.system, 1.0), windows, starts, [steps])[:, 0]
        ),
    }

    def of(end: Tensor) -> Tensor:
        return rms(group_squares(system, system.error(end.double(), x[:, steps])))

    errors["pysindy"] = of(Sparse(system, training).rollout(x[:, 0], u, steps)[:, -1])
    words = [
        f"system={system.name}",
        "data=csv",
        f"data.path={folder.resolve() / 'data' / name}",
        f"data.test=[{','.join(run.name for run in test)}]",
        "trainer.steps=600",
    ]
    model = nsde_torch.load(train(out / name, words))
    paths = model.sample(
        x[:, 0].float(),
        u.float(),
        dt=spec.dt,
        particles=PARTICLES,
        generator=torch.Generator().manual_seed(0),
    )
    errors["network"] = of(paths[:, :, -1].mean(0))
    ratio = {k: float((v / errors["declared"]).log().mean().exp()) for k, v in errors.items()}
    return {"system": system.name, "true": list(truth["effects"]), "added": found.added, "ratio": ratio}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--cases", type=Path, required=True, help="folder of generate.py, answered by run.py")
    parser.add_argument("--out", type=Path, default=Path("results/peers"))
    parser.add_argument("--limit", type=int, default=20, help="cases at most")
    given = parser.parse_args()
    torch.set_num_threads(1)
    cases = json.loads((given.cases / "judged.json").read_text(encoding="utf-8"))
    seen = [n for n, j in cases.items() if j["kind"] == "single" and j.get("moves", 1.0) > MOVES]
    given.out.mkdir(parents=True, exist_ok=True)
    rows = []
    print(
        "| case | system | holds | diagnosis says | diagnosis | pysindy | network |\n|---|---|---|---|---|---|---|"
    )
    for name in seen[: given.limit]:
        kept = given.out / f"{name}.json"
        if not kept.is_file():
            kept.write_text(json.dumps(judged(given.cases, name, given.out)), encoding="utf-8")
        row = json.loads(kept.read_text(encoding="utf-8"))
        rows.append(row)
        r = row["ratio"]
        print(
            f"| {name} | {row['system']} | {', '.join(row['true'])} | {', '.join(row['added'])} | "
            f"{r['diagnosis']:.2f} | {r['pysindy']:.2f} | {r['network']:.2f} |",
            flush=True,
        )
    for key in ("diagnosis", "pysindy", "network"):
        values = np.array([row["ratio"][key] for row in rows])
        print(f"{key}: median ratio {np.median(values):.2f}, worst {values.max():.2f}")


if __name__ == "__main__":
    main()
