"""Question: what does a GPU make of a gradient step, rollouts, Monte Carlo and environments, against the batch size?

Every row is measured on the processor and, where there is one, on the GPU; without one the table has one column and
says so. Work is that of `bench_train_step.py` (a hexacopter with disturbance, 20 steps), in float32:

- loss: the path part and the distance part of the loss on the same batch, which must agree to 1e-4;
- training step: both parts, backward, clipping, Adam;
- rollouts: without gradients, noise given, compiled; torchsde on the same device, noise, inputs and first states;
- Monte Carlo: `NeuralSDE.sample`, which draws its noise, eager;
- environments: steps of the learned cart and pole that PPO waits for;
- the likelihood's pass (a filter with its sensitivities, numba) runs on the processor alone.

Shortest of the repetitions, the device's work included.

    python benchmarks/bench_gpu.py --batch 512 4096 32768 262144
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable
from pathlib import Path

import torch
import torchsde
from bench_policy_env import TASK, fresh
from bench_rollout import TORCHSDE, Increments, Theirs
from bench_train_step import DT, STEPS, Case, hexacopter, shortest

from nsde_torch.policy import BatchEnvironment, make_learned

TOLERANCE = 1e-4
ENVIRONMENT_STEPS = 50


def losses(device: str) -> torch.Tensor:
    """Path and distance part of the loss of one batch, on the processor."""
    case = Case(hexacopter(device), 512, 2, device)
    return torch.stack((case.path_loss(), case.distance_loss())).detach().cpu()


def training_step(device: str, batch: int) -> Callable[[], object]:
    """One step of the optimiser."""
    return Case(hexacopter(device), batch, 2, device).whole_step


def rollouts(device: str, batch: int) -> Callable[[], object]:
    """Rollouts of this project."""
    return Case(hexacopter(device), batch, 1, device).forward


def of_torchsde(device: str, batch: int) -> Callable[[], object]:
    """The same rollouts by torchsde, which has no projection."""
    model = hexacopter(device)
    case = Case(model, batch, 1, device)
    calculus, method, options = TORCHSDE["milstein"]
    theirs = Theirs(model, calculus, case.u, DT)
    motion = Increments(case.noise[0].transpose(0, 1).contiguous(), DT)
    z0 = model.augment(case.x[:, 0], case.u[:, 0])
    times = torch.linspace(0.0, STEPS * DT, STEPS + 1, device=device)

    @torch.no_grad()
    def run() -> object:
        return torchsde.sdeint(theirs, z0, times, bm=motion, method=method, dt=DT, options=dict(options))

    return run


def monte_carlo(device: str, batch: int) -> Callable[[], object]:
    """Paths from one state under one plan, as many as the batch has rows."""
    model = hexacopter(device)
    case = Case(model, 1, 1, device)
    generator = torch.Generator().manual_seed(0)

    @torch.no_grad()
    def run() -> object:
        return model.sample(case.x[:, 0], case.u, dt=DT, particles=batch, generator=generator)

    return run


def environments(device: str, batch: int) -> Callable[[], object]:
    """Steps of a batch of learned carts and poles."""
    generator = torch.Generator().manual_seed(0)
    machine = make_learned(
        fresh("nsde", generator).to(device), dt=TASK.dt, sensor_noise=1.0, generator=generator
    )
    made = BatchEnvironment(TASK, machine, n=batch, generator=generator, start=TASK.training, stagger=True)
    made.reset()
    actions = 2 * torch.rand(ENVIRONMENT_STEPS, batch, 1, generator=generator).to(device) - 1

    def run() -> None:
        for action in actions:
            made.step(action)

    return run


WORK: dict[str, tuple[Callable[[str, int], Callable[[], object]], int]] = {
    "training step": (training_step, STEPS),
    "rollouts": (rollouts, STEPS),
    "rollouts, torchsde": (of_torchsde, STEPS),
    "Monte Carlo": (monte_carlo, STEPS),
    "environments": (environments, ENVIRONMENT_STEPS),
}
"""What is timed -> what makes it for a device and a batch, and its steps in a row."""


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--batch", type=int, nargs="+", default=[512, 4096], help="rows")
    parser.add_argument("--only", nargs="+", default=list(WORK), choices=list(WORK), help="what is timed")
    parser.add_argument("--repeats", type=int, default=5, help="timed repetitions")
    parser.add_argument("--threads", type=int, default=2, help="torch threads")
    parser.add_argument("--out", type=Path, help="write the rows as JSON")
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    devices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    if len(devices) == 1:
        print("there is no GPU here (torch.cuda.is_available() is false): the table has the processor alone.")
    found = {device: losses(device) for device in devices}
    for device in devices[1:]:
        torch.testing.assert_close(found[device], found["cpu"], rtol=TOLERANCE, atol=TOLERANCE)
        print(f"losses on {device} and cpu agree: {found[device].tolist()}, {found['cpu'].tolist()}")
    rows: list[dict[str, object]] = []
    print(f"{'':<22}{'rows':>8}" + "".join(f"{d + ' [ms]':>14}{'M steps/s':>11}" for d in devices) + "  load")
    for name in given.only:
        make, steps = WORK[name]
        for batch in given.batch:
            line, row = f"{name:<22}{batch:>8}", {"what": name, "batch": batch, "load": os.getloadavg()[0]}
            for device in devices:
                try:
                    seconds = shortest(make(device, batch), given.repeats, device)
                except torch.OutOfMemoryError:
                    line += f"{'no memory':>14}{'':>11}"
                    continue
                row[f"{device}_ms"] = 1e3 * seconds
                line += f"{1e3 * seconds:>14.2f}{batch * steps / seconds / 1e6:>11.2f}"
            rows.append(row)
            print(f"{line}  {row['load']:.1f}", flush=True)
    if given.out:
        about = {"torch": torch.__version__, "threads": given.threads, "devices": devices}
        given.out.write_text(json.dumps({**about, "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
