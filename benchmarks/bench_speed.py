"""Question: what do a gradient step, rollouts, Monte Carlo and environments cost, on the processor and on a GPU?

    python benchmarks/bench_speed.py --threads 2
    python benchmarks/bench_speed.py --batch 512 4096 32768 262144
    python benchmarks/bench_speed.py --only environments --batch 1024 --threads 1

Every row is measured on the processor and, where there is one, on the GPU. The hexacopter model as `nsde train` builds
it (disturbance; random data of the flights' size, whose values do not change the work), 20 steps, float32:

- path: rollout, error of every state and its backward pass, for 2 particles (the default loss) and for 1;
- distance: the three distance losses as `loss=default` sets them and their backward pass;
- step: both, with clipping and Adam; losses of the devices have to agree to 1e-4;
- rollouts: without gradients, noise given, compiled; torchsde on the same noise, inputs and first states;
- Monte Carlo: `NeuralSDE.sample`, which draws its noise, eager;
- environments: all that a learner waits for in a step of a batch of carts and poles (truths, and models with fresh
  weights, whose numbers cost what trained ones cost), and the same as stable-baselines3 takes it (`vec_env`).

Shortest of the repetitions, the device's work included. With `--compile` first come the first gradient step and the
first rollout of a fresh process, with an empty compiler cache and with a warm one.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial

import torch
import torchsde
from bench_rollout import DT, STEPS, TORCHSDE, Increments, Theirs
from common import options
from torch import Tensor

from nsde_torch.models import MODELS, Model, NeuralSDE, SDESpec, make_model
from nsde_torch.models.kind import model_kind
from nsde_torch.policy import BatchEnvironment, make_learned, make_task, make_truth
from nsde_torch.policy.ppo import PolicyVecEnv
from nsde_torch.sde import brownian
from nsde_torch.training.losses import data_loss, distance_losses, draw_ball
from nsde_torch.training.options import LossOptions

TRAIN_BATCH = 512
TOLERANCE = 1e-4
ENVIRONMENT_STEPS = 60
TASK = make_task("cartpole")
Timed = Callable[[], object]


def hexacopter(device: str) -> NeuralSDE:
    """The model with random weights."""
    spec = SDESpec("hexacopter", dt=DT, horizon=STEPS, step="milstein", disturbance=True)
    return NeuralSDE(spec, generator=torch.Generator().manual_seed(0)).to(device)


class Case:
    """Data of one batch, and what is timed on them."""

    def __init__(self, device: str, batch: int, particles: int) -> None:
        self.model = model = hexacopter(device)
        g = torch.Generator().manual_seed(1)
        x = 0.3 * torch.randn(batch, STEPS + 1, 13, generator=g)
        x[..., 6:10] = torch.nn.functional.normalize(x[..., 6:10] + torch.tensor([3.0, 0, 0, 0]), dim=-1)
        u = 0.36 + 0.05 * torch.randn(batch, STEPS, 6, generator=g)
        noise = brownian(particles, batch, STEPS, model.nz, dt=DT, generator=g)
        start = torch.randn(particles, batch, model.n_start, generator=g)
        self.x, self.u, self.noise, self.start = (v.to(device) for v in (x, u, noise, start))
        self.particles, self.options = particles, LossOptions()
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

    def path(self) -> None:
        self.gradient(self.path_loss)

    def distance(self) -> None:
        self.gradient(self.distance_loss)

    def step(self) -> None:
        self.gradient(self.path_loss, self.distance_loss)
        torch.nn.utils.clip_grad_norm_(self.model.parameters(), 10.0)
        self.optimiser.step()

    @torch.no_grad()
    def forward(self) -> None:
        self.paths()


def of_torchsde(device: str, batch: int) -> Timed:
    """The same rollouts by torchsde, which has no projection."""
    case = Case(device, batch, 1)
    calculus, method, more = TORCHSDE["milstein"]
    theirs = Theirs(case.model, calculus, case.u, DT)
    motion = Increments(case.noise[0].transpose(0, 1).contiguous(), DT)
    z0 = case.model.augment(case.x[:, 0], case.u[:, 0])
    times = torch.linspace(0.0, STEPS * DT, STEPS + 1, device=device)

    @torch.no_grad()
    def run() -> object:
        return torchsde.sdeint(theirs, z0, times, bm=motion, method=method, dt=DT, options=dict(more))

    return run


def monte_carlo(device: str, batch: int) -> Timed:
    """Paths from one state under one plan, as many as the batch has rows."""
    case, generator = Case(device, 1, 1), torch.Generator().manual_seed(0)

    @torch.no_grad()
    def run() -> object:
        return case.model.sample(case.x[:, 0], case.u, dt=DT, particles=batch, generator=generator)

    return run


def fresh(kind: str, generator: torch.Generator) -> Model:
    common = {"system": "cartpole", "kind": kind, "dt": TASK.dt, "horizon": 30}
    spec = model_kind(kind).spec
    if spec is SDESpec:
        step = "rk4" if kind == "node" else "euler_maruyama"
        common |= {"step": step, "physics": kind != "blackbox_nsde", "measurement": kind != "node"}
    return make_model(spec(**common), generator=generator).eval().requires_grad_(False)


def environments(machine: str, vec_env: bool, device: str, batch: int) -> Timed:
    """Steps of a batch of carts and poles: a truth, or a kind of model."""
    generator = torch.Generator().manual_seed(0)
    shared = {"dt": TASK.dt, "sensor_noise": 1.0, "generator": generator}
    if machine.startswith("truth "):
        dynamics = make_truth(machine.removeprefix("truth "), system="cartpole", **shared)
    else:
        dynamics = make_learned(fresh(machine, generator).to(device), **shared)
    made = BatchEnvironment(TASK, dynamics, n=batch, generator=generator, start=TASK.training, stagger=True)
    made.reset()
    actions = 2 * torch.rand(ENVIRONMENT_STEPS, batch, 1, generator=generator).to(device) - 1
    seen = PolicyVecEnv(made) if vec_env else None

    def run() -> None:
        for action in actions:
            _ = made.step(action) if seen is None else seen.step(action.cpu().numpy())

    return run


def work() -> dict[str, tuple[Callable[[str, int], Timed], int]]:
    """What is timed -> what makes it for a device and a batch, and its steps in a row."""
    out: dict[str, tuple[Callable[[str, int], Timed], int]] = {
        "path": (lambda device, batch: Case(device, batch, 2).path, STEPS),
        "path, 1 particle": (lambda device, batch: Case(device, batch, 1).path, STEPS),
        "distance": (lambda device, batch: Case(device, batch, 2).distance, STEPS),
        "step": (lambda device, batch: Case(device, batch, 2).step, STEPS),
        "step, 1 particle": (lambda device, batch: Case(device, batch, 1).step, STEPS),
        "rollouts": (lambda device, batch: Case(device, batch, 1).forward, STEPS),
        "rollouts, torchsde": (of_torchsde, STEPS),
        "Monte Carlo": (monte_carlo, STEPS),
    }
    for machine in ("truth plant", "truth published", *(k for k in MODELS if k != "sysid")):
        for vec_env in (False, True):
            name = f"environments: {machine}" + (", vec_env" if vec_env else "")
            out[name] = partial(environments, machine, vec_env), ENVIRONMENT_STEPS
    return out


def clocked(function: Timed, device: str) -> float:
    """Time of one call [s], the device's work included."""
    start = time.perf_counter()
    function()
    if device != "cpu":
        torch.cuda.synchronize()
    return time.perf_counter() - start


def first_calls(device: str, threads: int, cache: str) -> dict[str, float]:
    """Seconds of the first calls in a process of its own."""
    words = [sys.executable, __file__, "--first-calls", device, "--threads", str(threads)]
    env = {**os.environ, "TORCHINDUCTOR_CACHE_DIR": cache}
    done = subprocess.run(words, env=env, capture_output=True, text=True, check=True)
    return dict(json.loads(done.stdout.splitlines()[-1]))


def agreed(devices: list[str]) -> None:
    """Losses of one batch are the same on every device."""
    found = []
    for device in devices:
        case = Case(device, TRAIN_BATCH, 2)
        found.append(torch.stack((case.path_loss(), case.distance_loss())).detach().cpu())
        torch.testing.assert_close(found[-1], found[0], rtol=TOLERANCE, atol=TOLERANCE)
    print(f"losses on {' and '.join(devices)} agree: {found[0].tolist()}")


def main() -> None:
    parser = options(__doc__, repeats=5, threads=2)
    parser.add_argument("--batch", type=int, nargs="+", default=[512, 4096], help="rows")
    parser.add_argument("--only", nargs="+", default=[""], help="what is timed, by how its name begins")
    parser.add_argument("--compile", action="store_true", help="the first calls of fresh processes too")
    parser.add_argument("--first-calls", default="", help=argparse.SUPPRESS)
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    if given.first_calls:
        case = Case(given.first_calls, TRAIN_BATCH, 2)
        step = clocked(case.step, given.first_calls)
        print(json.dumps({"first step": step, "first rollout": clocked(case.forward, given.first_calls)}))
        return
    devices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    if len(devices) == 1:
        print("there is no GPU here (torch.cuda.is_available() is false): the table has the processor alone.")
    else:
        agreed(devices)
    if given.compile:
        with tempfile.TemporaryDirectory(prefix="bench_speed_") as cache:
            for state in ("cold", "warm"):
                found = first_calls(devices[-1], given.threads, cache)
                print(f"{state} process: " + ", ".join(f"{k} {v:.1f} s" for k, v in found.items()))
    print(f"{'':<34}{'rows':>8}" + "".join(f"{d + ' [ms]':>14}{'M steps/s':>11}" for d in devices) + "  load")
    for name, (make, steps) in work().items():
        for batch in given.batch if name.startswith(tuple(given.only)) else ():
            text, load = f"{name:<34}{batch:>8}", os.getloadavg()[0]
            for device in devices:
                try:
                    function = make(device, batch)
                    seconds = min([clocked(function, device) for _ in range(given.repeats + 2)][2:])
                except torch.OutOfMemoryError:
                    text += f"{'no memory':>14}{'':>11}"
                    continue
                text += f"{1e3 * seconds:>14.2f}{batch * steps / seconds / 1e6:>11.2f}"
            print(f"{text}  {load:.1f}", flush=True)


if __name__ == "__main__":
    main()
