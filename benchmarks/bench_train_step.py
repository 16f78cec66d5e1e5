"""Question: what does a gradient step cost, what a rollout, and what the compilation before them?

The hexacopter model as `nsde train` builds it (disturbance; random data of the flights' size, whose values do not
change the work), batch 512, 20 steps:

- path part: rollout, error of every state and its backward pass, for 1 and for 2 particles (the default loss);
- distance part: the three distance losses as `loss=default` sets them and their backward pass;
- whole step: both, with clipping and Adam;
- rollouts without gradients against the batch size, noise given;
- the first gradient step and the first rollout in a fresh process: cold (an empty compiler cache) and warm.

Minima over repetitions, with the load of the machine beside them.

    python benchmarks/bench_train_step.py --threads 2 --out bench_train_step.json
    python benchmarks/bench_train_step.py --device cuda --batch 512 4096 32768 262144
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from nsde_torch.models import NeuralSDE, SDESpec
from nsde_torch.sde import brownian
from nsde_torch.training.losses import data_loss, distance_losses, draw_ball
from nsde_torch.training.options import LossOptions

DT, STEPS, TRAIN_BATCH = 0.05, 20, 512


def hexacopter(device: str) -> NeuralSDE:
    """The model with random weights."""
    spec = SDESpec("hexacopter", dt=DT, horizon=STEPS, step="milstein", disturbance=True)
    return NeuralSDE(spec, generator=torch.Generator().manual_seed(0)).to(device)


class Case:
    """Data of one batch, and what is timed on them."""

    def __init__(self, model: NeuralSDE, batch: int, particles: int, device: str) -> None:
        g = torch.Generator().manual_seed(1)
        x = 0.3 * torch.randn(batch, STEPS + 1, 13, generator=g)
        x[..., 6:10] = torch.nn.functional.normalize(
            x[..., 6:10] + torch.tensor([3.0, 0.0, 0.0, 0.0]), dim=-1
        )
        u = 0.36 + 0.05 * torch.randn(batch, STEPS, 6, generator=g)
        noise = brownian(particles, batch, STEPS, model.nz, dt=DT, generator=g)
        start = torch.randn(particles, batch, model.n_start, generator=g)
        self.x, self.u, self.noise, self.start = (v.to(device) for v in (x, u, noise, start))
        self.model, self.particles, self.options = model, particles, LossOptions()
        self.scale = torch.ones(12, device=device)
        self.generator = torch.Generator().manual_seed(2)
        self.optimiser = torch.optim.Adam([p for p in model.parameters() if p.requires_grad], foreach=True)

    def paths(self) -> Tensor:
        given = {"noise": self.noise, "start": self.start, "std": self.model.measurement_std}
        return self.model.paths(self.x[:, 0], self.u, dt=DT, compile=True, check=False, **given)

    def path_loss(self) -> Tensor:
        errors = self.model.system.error(self.paths()[:, :, 1:], self.x[:, 1:])
        kind = "default" if self.particles > 1 else "paper"
        return data_loss(errors, self.scale, kind=kind, early=self.options.early, paired=kind == "default")

    def distance_loss(self) -> Tensor:
        o, rows = self.options, self.x.reshape(-1, 13)
        pick = torch.randint(len(rows), (o.points,), generator=self.generator).to(rows.device)
        features = self.model.system.features(rows[pick])
        ball = draw_ball(o.points, o.ball_samples, features.shape[1], self.generator, features)
        near = self.model.system.defaults.ball_radius
        terms = distance_losses(self.model.eta, features, *ball, kind=o.kind, near=near, far=o.far_radius)
        return torch.stack(terms).sum()

    def gradient(self, *losses: Callable[[], Tensor]) -> None:
        self.model.zero_grad(set_to_none=True)
        torch.stack([loss() for loss in losses]).sum().backward()

    def whole_step(self) -> None:
        self.gradient(self.path_loss, self.distance_loss)
        torch.nn.utils.clip_grad_norm_(self.model.parameters(), 10.0)
        self.optimiser.step()

    def forward(self) -> None:
        with torch.no_grad():
            self.paths()


def clocked(function: Callable[[], object], device: str) -> float:
    """Time of one call [s], the device's work included."""
    start = time.perf_counter()
    function()
    if device != "cpu":
        torch.cuda.synchronize()
    return time.perf_counter() - start


def shortest(function: Callable[[], object], repeats: int, device: str) -> float:
    """Shortest time of a call [s]."""
    return min([clocked(function, device) for _ in range(repeats + 2)][2:])


def first_calls(device: str) -> dict[str, float]:
    """Seconds that the first gradient step and the first rollout of this process take."""
    case = Case(hexacopter(device), TRAIN_BATCH, 2, device)
    step = clocked(case.whole_step, device)
    return {"first_step_s": step, "first_rollout_s": clocked(case.forward, device)}


def fresh_process(device: str, threads: int, cache: str) -> dict[str, float]:
    """`first_calls` in a process of its own: all of its processor time (imports and compiler too), and wall times."""
    words = [sys.executable, __file__, "--first-calls", "--device", device, "--threads", str(threads)]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        words,
        env={**os.environ, "TORCHINDUCTOR_CACHE_DIR": cache},
        capture_output=True,
        text=True,
        check=True,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    busy = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"processor_time_of_all_s": busy, **json.loads(done.stdout.splitlines()[-1])}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--batch", type=int, nargs="+", default=[32, 512, 4096], help="rows of the rollouts")
    parser.add_argument("--repeats", type=int, default=30, help="timed repetitions")
    parser.add_argument("--threads", type=int, default=2, help="torch threads")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--no-compile-times", action="store_true", help="leave out the fresh processes")
    parser.add_argument("--first-calls", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path, help="write the numbers as JSON")
    a = parser.parse_args()
    torch.set_num_threads(a.threads)
    if a.first_calls:
        print(json.dumps(first_calls(a.device)))
        return
    rows: list[dict[str, object]] = []

    def record(what: str, value: float, unit: str) -> None:
        load = os.getloadavg()[0]
        rows.append({"what": what, "value": value, "unit": unit, "load": load})
        print(f"{what:<52}{value:>9.2f} {unit:<12} load {load:.1f}", flush=True)

    if not a.no_compile_times:
        with tempfile.TemporaryDirectory(prefix="bench_train_step_") as cache:
            for start in ("cold", "warm"):
                for key, value in fresh_process(a.device, a.threads, cache).items():
                    record(f"{start} process: {key[:-2].replace('_', ' ')}", value, "s")
    model = hexacopter(a.device)
    for particles in (1, 2):
        case = Case(model, TRAIN_BATCH, particles, a.device)
        parts: dict[str, Callable[[], object]] = {
            "path part": lambda case=case: case.gradient(case.path_loss),
            "distance part": lambda case=case: case.gradient(case.distance_loss),
            "whole step": case.whole_step,
        }
        for name, function in parts.items():
            time_s = shortest(function, a.repeats, a.device)
            record(f"gradient step, {particles} particle(s): {name}", 1e3 * time_s, "ms")
    for batch in a.batch:
        case = Case(model, batch, 1, a.device)
        time_s = shortest(case.forward, a.repeats, a.device)
        record(f"rollouts without gradients, batch {batch}", batch * STEPS / time_s / 1e6, "M steps/s")
    if a.out:
        about = {
            "torch": torch.__version__,
            "threads": a.threads,
            "device": a.device,
            "cores": os.cpu_count(),
        }
        a.out.write_text(json.dumps({**about, "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
