"""Question: what do a sparse regression and a residual network make of the same cases, told just as little?

    python benchmarks/blind/peers.py --cases blind/ --limit 20      # needs pysindy>=2.0,<3

Of each case with a single effect that moves errors, the last fifth of the runs is held out from everybody. On the
others are fitted: the declared physics; the same with the effects that a diagnosis adds; a sparse regression of all
rates (pysindy); and the neural SDE of `nsde train`. The figure is the rms error of open-loop predictions at the longest
horizon up to 1 s, over that of the declared physics (geometric mean over quantities).
"""

import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).resolve().parents[1]))

import numpy as np
import torch
from common import finished
from run import MOVES
from small_machines import step
from study import head, line, options, read_json, truth_of, write_json
from torch import Tensor

import nsde_torch
from nsde_torch.data import Run, Windows
from nsde_torch.diagnosis.cross_validation import as_model
from nsde_torch.diagnosis.decisions import Options
from nsde_torch.diagnosis.pipeline import diagnose
from nsde_torch.diagnosis.search import Search, fitted_system
from nsde_torch.evaluation.metrics import horizons_of, start_grid, thinned
from nsde_torch.evaluation.scores import group_squares, rollout_squares
from nsde_torch.models.identified import SysidSpec
from nsde_torch.systems import System, make_system

PARTICLES = 32
KEYS = ("diagnosis", "pysindy", "network")
THRESHOLDS = (0.003, 0.01, 0.03, 0.1, 0.3)
"""Of pysindy, in units of standardised columns."""
Rollout = Callable[[Tensor, Tensor, int], Tensor]


class Sparse:
    """dx/dt as a sparse combination of functions of states and inputs; the last run chooses the threshold."""

    def __init__(self, system: System, runs: Sequence[Run]) -> None:
        import pysindy as ps

        library = ps.PolynomialLibrary(degree=3)
        angles = [i for i, unit in enumerate(system.state_units) if unit == "rad"]
        if angles:
            every, waves = list(range(system.nx + system.nu)), ps.FourierLibrary(n_frequencies=2)
            library = ps.GeneralizedLibrary([library, waves], inputs_per_library=[every, angles])

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
            rate = model.differentiation_method(last.x, last.dt)
            guess = model.predict(last.x, u=last.u[:, : system.nu])
            return float(np.square((rate - guess) / rate.std(0)).mean())

        best = min(THRESHOLDS, key=lambda t: error(fitted(t, runs[:-1])) if len(runs) > 1 else 0.0)
        self.model, self.nu, self.dt = fitted(best, runs), system.nu, runs[0].dt

    def _rate(self, z: np.ndarray, held: np.ndarray) -> np.ndarray:
        return np.asarray(self.model.predict(np.clip(z, -1e3, 1e3), u=held))

    def rollout(self, x: Tensor, u: Tensor, steps: int) -> Tensor:
        """States (B, steps, nx) after the first, by Runge and Kutta; inputs are held."""
        z, out = x.numpy(), []
        for k in range(steps):
            held = u[:, k, : self.nu].numpy()
            (z,) = step(lambda rows, held=held: [self._rate(rows[0], held)], [z], self.dt)
            out.append(z)
        return torch.from_numpy(np.stack(out, 1))


def judged(folder: Path, name: str, out: Path) -> dict[str, Any]:
    """Errors of all on the runs that were held apart, as ratios to the declared physics."""
    truth = truth_of(folder, name)
    system = make_system(truth["system"])
    data = nsde_torch.read(folder / "data" / name, system=system)
    spec = SysidSpec(system.name, dt=data.dt, horizon=system.defaults.horizon)
    count = max(1, len(data.runs) // 5)
    training, test = list(data.runs[:-count]), list(data.runs[-count:])
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
        name: rms(rollout_squares(as_model(spec, machine, 1.0), windows, starts, [steps])[:, 0])
        for name, machine in (("declared", declared), ("diagnosis", found.outcome.system))
    }

    def of(end: Tensor) -> Tensor:
        return rms(group_squares(system, system.error(end.double(), x[:, steps])))

    errors["pysindy"] = of(Sparse(system, training).rollout(x[:, 0], u, steps)[:, -1])
    words = [f"system={system.name}", "data=csv", f"data.path={folder.resolve() / 'data' / name}"]
    words += [f"data.test=[{','.join(run.name for run in test)}]", "trainer.steps=600"]
    model = nsde_torch.load(finished("train", "metrics.json", out / name, words))
    how = {"dt": spec.dt, "particles": PARTICLES, "generator": torch.Generator().manual_seed(0)}
    paths = model.sample(x[:, 0].float(), u.float(), **how)
    errors["network"] = of(paths[:, :, -1].mean(0))
    ratio = {k: float((v / errors["declared"]).log().mean().exp()) for k, v in errors.items()}
    return {"system": system.name, "true": list(truth["effects"]), "added": found.added, "ratio": ratio}


def main() -> None:
    parser = options(__doc__, "cases", out=Path("results/peers"))
    parser.add_argument("--limit", type=int, default=20, help="cases at most")
    given = parser.parse_args()
    cases = read_json(given.cases / "judged.json")
    seen = [n for n, j in cases.items() if j["kind"] == "single" and j.get("moves", 1.0) > MOVES]
    rows = []
    head("case", "system", "holds", "diagnosis says", *KEYS)
    for name in seen[: given.limit]:
        kept = given.out / f"{name}.json"
        if not kept.is_file():
            write_json(kept, judged(given.cases, name, given.out))
        row = read_json(kept)
        rows.append(row)
        ratios = [f"{row['ratio'][key]:.2f}" for key in KEYS]
        says = ", ".join(row["true"]), ", ".join(row["added"])
        print(line([name, row["system"], *says, *ratios]), flush=True)
    for key in KEYS:
        values = np.array([row["ratio"][key] for row in rows])
        print(f"{key}: median ratio {np.median(values):.2f}, worst {values.max():.2f}")


if __name__ == "__main__":
    main()
