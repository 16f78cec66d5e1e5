"""Question: how many environment steps a second do 1024 cart-poles in one batch make?

A step is all that a learner waits for: the machines, reward, what the policy sees, ends of episodes and the next
starts (`environment`), and the arrays and dictionaries that stable-baselines3 takes (`vec_env`). Machines are the
truths, models with fresh weights (their numbers cost what trained ones cost), and run directories if any are given.
Actions are uniform; environments take turns and the best of the repetitions counts, because the machine is shared.

    python benchmarks/bench_policy_env.py --threads 1 --out bench_policy_env.json
"""

import argparse
import json
import os
import time
from collections.abc import Callable
from pathlib import Path

import torch

import nsde_torch
from nsde_torch.models import MODELS, Model, SDESpec, make_model
from nsde_torch.models.kind import model_kind
from nsde_torch.policy import BatchEnvironment, Dynamics, make_learned, make_task, make_truth
from nsde_torch.policy.ppo import PolicyVecEnv

TASK = make_task("cartpole")


def fresh(kind: str, generator: torch.Generator) -> Model:
    """A model of a kind with fresh weights."""
    common = {"system": "cartpole", "kind": kind, "dt": TASK.dt, "horizon": 30}
    spec = model_kind(kind).spec
    if spec is SDESpec:
        step = "rk4" if kind == "node" else "euler_maruyama"
        common |= {"step": step, "physics": kind != "blackbox_nsde", "measurement": kind != "node"}
    return make_model(spec(**common), generator=generator).eval().requires_grad_(False)


def steps_per_second(step: Callable[[torch.Tensor], object], n: int, count: int) -> float:
    """Environment steps a second over `count` steps of all machines."""
    actions = 2 * torch.rand(count, n, 1) - 1
    start = time.perf_counter()
    for action in actions:
        step(action)
    return n * count / (time.perf_counter() - start)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--n", type=int, nargs="+", default=[32, 1024], help="machines in a batch")
    parser.add_argument("--steps", type=int, default=210, help="steps of a repetition; episodes end in it")
    parser.add_argument("--repeats", type=int, default=5, help="repetitions")
    parser.add_argument("--threads", type=int, default=1, help="torch threads")
    parser.add_argument("--run", type=Path, nargs="*", default=[], help="run directories of cart-pole models")
    parser.add_argument("--out", type=Path, help="write the rows as JSON")
    a = parser.parse_args()
    torch.set_num_threads(a.threads)
    generator = torch.Generator().manual_seed(0)
    made: dict[str, Callable[[], Dynamics]] = {
        f"truth {name}": lambda name=name: make_truth(
            name, system="cartpole", dt=TASK.dt, sensor_noise=1.0, generator=generator
        )
        for name in ("plant", "published")
    }
    models = {kind: fresh(kind, generator) for kind in MODELS if kind != "sysid"}
    models |= {str(folder): nsde_torch.load(folder) for folder in a.run}
    for name, model in models.items():
        made[name] = lambda model=model: make_learned(
            model, dt=TASK.dt, sensor_noise=1.0, generator=generator
        )
    rows = []
    print(f"{'machines':<24}{'batch':>7}{'environment':>16}{'vec_env':>16}{'load':>7}")
    for n in a.n:
        best: dict[str, list[float]] = {name: [0.0, 0.0] for name in made}
        for _ in range(a.repeats):
            for name, make in made.items():
                environment = BatchEnvironment(
                    TASK, make(), n=n, generator=generator, start=TASK.training, stagger=True
                )
                environment.reset()
                vec_env = PolicyVecEnv(environment)
                for index, step in enumerate(
                    (environment.step, lambda action, to=vec_env: to.step(action.numpy()))
                ):
                    best[name][index] = max(best[name][index], steps_per_second(step, n, a.steps))
        for name, (plain, stable) in best.items():
            row = {"machines": name, "n": n, "environment_steps_per_s": plain, "vec_env_steps_per_s": stable}
            rows.append({**row, "load": os.getloadavg()[0]})
            print(f"{name:<24}{n:>7}{plain:>12,.0f} /s{stable:>13,.0f} /s{os.getloadavg()[0]:>7.1f}")
    if a.out:
        machine = {"torch": torch.__version__, "threads": a.threads, "cores": os.cpu_count()}
        a.out.write_text(json.dumps({**machine, "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
