"""How fast are rollouts and their gradients, against torchsde on the same work?

The equation is a neural multirotor of the size of the paper's: 13 states, 6 inputs, two tanh 8-16 residual
networks of 6 features, and sigma_max * h(eta) with eta swish 32-32. Both libraries integrate it with the same
method, on the same Brownian increments and inputs, and must give the same trajectories. torchsde has no
projection, so the comparison leaves it out; the columns "with projection" are ours alone. Times are medians
over repetitions that take turns, so that a busy machine slows both alike.

    python benchmarks/bench_rollout.py --threads 1 --out bench_rollout.json

A second run finds the compiled code on disk: the first shows the cold compile time (--cold gives a run its
own cache), the second the warm one.
"""

import argparse
import itertools
import json
import math
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import torch
import torchsde
from torch import Tensor, nn

from nsde_torch.sde import Time, brownian, make_step, rollout

NZ, NU = 13, 6
TORCHSDE = {  # our step -> calculus, method and options there
    "euler_maruyama": ("ito", "euler", {}),
    "milstein": ("ito", "milstein", {"grad_free": True}),
    "heun": ("stratonovich", "heun", {}),
}


def network(*sizes: int, activation: type[nn.Module]) -> nn.Sequential:
    """A multilayer perceptron without activation at its end."""
    layers: list[nn.Module] = []
    for wide, narrow in itertools.pairwise(sizes):
        layers += [nn.Linear(wide, narrow), activation()]
    return nn.Sequential(*layers[:-1])


class Multirotor(nn.Module):
    """Rigid body with residual force and moment, and a distance-aware diffusion."""

    calculus = "either"

    def __init__(self, *, project: bool) -> None:
        super().__init__()
        self.normalise = project
        self.force = network(6, 8, 16, 3, activation=nn.Tanh)
        self.moment = network(6, 8, 16, 3, activation=nn.Tanh)
        self.eta = network(6, 32, 32, 1, activation=nn.SiLU)
        self.scale, self.offset = nn.Parameter(torch.zeros(NZ)), nn.Parameter(torch.zeros(NZ))
        self.mixer = nn.Parameter(0.5 * torch.randn(NU, 4))
        self.log_inertia = nn.Parameter(torch.zeros(3))
        self.register_buffer(
            "sigma_max", torch.tensor([1.0] * 3 + [10.0] * 3 + [1.0] * 4 + [50.0] * 3) * 1e-3
        )

    def drift(self, t: Time, z: Tensor, u: Tensor) -> Tensor:
        features = torch.cat((z[:, 3:6], z[:, 10:13]), 1)
        command = u @ self.mixer
        fx, fy, fz = self.force(features).unbind(1)
        mx, my, mz = (self.moment(features) + command[:, 1:]).unbind(1)
        fz = fz + command[:, 0]
        vx, vy, vz, qw, qx, qy, qz, p, q, r = z[:, 3:].unbind(1)
        tx, ty, tz = 2 * (qy * fz - qz * fy), 2 * (qz * fx - qx * fz), 2 * (qx * fy - qy * fx)
        jx, jy, jz = self.log_inertia.exp().unbind(0)
        return torch.stack(
            (
                vx,
                vy,
                vz,
                fx + qw * tx + qy * tz - qz * ty,
                fy + qw * ty + qz * tx - qx * tz,
                fz + qw * tz + qx * ty - qy * tx - 9.81,
                -0.5 * (qx * p + qy * q + qz * r),
                0.5 * (qw * p + qy * r - qz * q),
                0.5 * (qw * q - qx * r + qz * p),
                0.5 * (qw * r + qx * q - qy * p),
                mx / jx - q * r * (jz - jy),
                my / jy - p * r * (jx - jz),
                mz / jz - p * q * (jy - jx),
            ),
            1,
        )

    def diffusion(self, t: Time, z: Tensor, u: Tensor) -> Tensor:
        eta = torch.sigmoid(self.eta(torch.cat((z[:, 3:6], z[:, 10:13]), 1)))
        return self.sigma_max * torch.sigmoid(nn.functional.softplus(self.scale) * eta + self.offset)

    def project(self, z: Tensor) -> Tensor:
        if not self.normalise:
            return z
        q = z[:, 6:10]
        return torch.cat((z[:, :6], q / q.norm(dim=1, keepdim=True), z[:, 10:]), 1)


class Increments(torchsde.BaseBrownian):
    """A Brownian motion that hands torchsde the increments (T, B, nz) we were given."""

    def __init__(self, dw: Tensor, dt: float) -> None:
        super().__init__()
        self._dw, self._dt = dw.unbind(0), dt

    def __call__(
        self, ta: Time, tb: Time | None = None, return_U: bool = False, return_A: bool = False
    ) -> Tensor:
        return self._dw[round(float(ta) / self._dt)]

    def __repr__(self) -> str:
        return "Increments()"

    @property
    def dtype(self) -> torch.dtype:
        return self._dw[0].dtype

    @property
    def device(self) -> torch.device:
        return self._dw[0].device

    @property
    def shape(self) -> torch.Size:
        return self._dw[0].shape

    @property
    def levy_area_approximation(self) -> str:
        return "none"


class Theirs(nn.Module):
    """The same equation with torchsde's face; the input is held over a step."""

    noise_type = "diagonal"

    def __init__(self, model: Multirotor, calculus: str, u: Tensor, dt: float) -> None:
        super().__init__()
        self.model, self.sde_type, self._u, self._dt = model, calculus, u.unbind(1), dt

    def _input(self, t: Tensor) -> Tensor:
        # Heun asks for the end of the last step, whose input is the last one.
        return self._u[min(round(float(t) / self._dt), len(self._u) - 1)]

    def f(self, t: Tensor, y: Tensor) -> Tensor:
        return self.model.drift(t, y, self._input(t))

    def g(self, t: Tensor, y: Tensor) -> Tensor:
        return self.model.diffusion(t, y, self._input(t))


def case(batch: int, steps: int, dt: float) -> tuple[Tensor, Tensor, Tensor]:
    """First states, one input a row held throughout (Heun's end points then agree), increments."""
    g = torch.Generator().manual_seed(0)
    z0 = 0.1 * torch.randn(batch, NZ, generator=g)
    z0[:, 6] = 1.0
    u = torch.rand(batch, 1, NU, generator=g).expand(batch, steps, NU).contiguous()
    return z0, u, brownian(1, batch, steps, NZ, dt=dt, generator=g)


def medians(repeats: int, *functions: Callable[[], object]) -> list[float]:
    """Median time [s] of each function; they take turns."""
    times: list[list[float]] = [[] for _ in functions]
    for turn in range(repeats + 2):
        for function, record in zip(functions, times, strict=True):
            start = time.perf_counter()
            function()
            if turn >= 2:
                record.append(time.perf_counter() - start)
    return [statistics.median(record) for record in times]


def clocked(function: Callable[[], object]) -> float:
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def measure(
    name: str, batch: int, *, steps: int, dt: float, repeats: int, gradient: bool
) -> dict[str, object]:
    """One row of the table."""
    torch.manual_seed(0)
    plain, full = Multirotor(project=False), Multirotor(project=True)
    step = make_step(name)
    z0, u, noise = case(batch, steps, dt)
    calculus, method, options = TORCHSDE[name]
    theirs, times = Theirs(plain, calculus, u, dt), torch.linspace(0.0, steps * dt, steps + 1)
    motion = Increments(noise[0].transpose(0, 1).contiguous(), dt)

    def ours(model: Multirotor, compile: bool) -> Tensor:
        return rollout(model, z0, u, dt=dt, step=step, noise=noise, compile=compile, check=False)

    def other() -> Tensor:
        path = torchsde.sdeint(theirs, z0, times, bm=motion, method=method, dt=dt, options=dict(options))
        return path.transpose(0, 1)

    def run(function: Callable[[], Tensor], model: Multirotor) -> Callable[[], Tensor]:
        def once() -> Tensor:
            if not gradient:
                with torch.no_grad():
                    return function()
            model.zero_grad(set_to_none=True)
            path = function()
            path.square().mean().backward()
            return path.detach()

        return once

    compiled, eager = run(lambda: ours(plain, True), plain), run(lambda: ours(plain, False), plain)
    peer, projected = run(other, plain), run(lambda: ours(full, True), full)
    compile_s = clocked(projected)
    fast, slow, reference = compiled()[0], eager()[0], peer()
    for path in (fast, slow):  # the same answer, to float32 accuracy
        torch.testing.assert_close(path, reference, rtol=1e-4, atol=1e-5)
    fast_s, slow_s, peer_s, full_s = medians(repeats, compiled, eager, peer, projected)
    return {
        "step": name,
        "batch": batch,
        "gradient": gradient,
        "compile_s": compile_s,
        "torchsde_ms": 1e3 * peer_s,
        "eager_ms": 1e3 * slow_s,
        "compiled_ms": 1e3 * fast_s,
        "projected_ms": 1e3 * full_s,
        "ratio": peer_s / fast_s,
        "million_steps_per_s": batch * steps / full_s / 1e6,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--batch", type=int, nargs="+", default=[32, 512, 4096], help="rows")
    parser.add_argument("--step", nargs="+", default=list(TORCHSDE), choices=list(TORCHSDE), help="methods")
    parser.add_argument("--steps", type=int, default=20, help="steps of a rollout")
    parser.add_argument("--dt", type=float, default=0.05, help="step [s]")
    parser.add_argument("--repeats", type=int, default=20, help="timed repetitions")
    parser.add_argument("--threads", type=int, default=1, help="torch threads")
    parser.add_argument("--cold", action="store_true", help="compile from nothing, in a cache of its own")
    parser.add_argument("--out", type=Path, help="write the rows as JSON")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    if options.cold:
        os.environ["TORCHINDUCTOR_CACHE_DIR"] = tempfile.mkdtemp(prefix="bench_rollout_")

    head = f"{'step':<15}{'batch':>6}{'pass':>9}{'compile':>9}{'torchsde':>10}{'eager':>9}{'compiled':>10}"
    print(f"{head}{'ratio':>7}   with projection: {'ms':>7}{'M steps/s':>11}")
    rows = []
    for name in options.step:
        for gradient in (True, False):
            for batch in options.batch:
                row = measure(
                    name,
                    batch,
                    steps=options.steps,
                    dt=options.dt,
                    repeats=options.repeats,
                    gradient=gradient,
                )
                rows.append(row)
                kind = "gradient" if gradient else "forward"
                print(
                    f"{name:<15}{batch:>6}{kind:>9}{row['compile_s']:>7.1f} s{row['torchsde_ms']:>7.1f} ms"
                    f"{row['eager_ms']:>6.1f} ms{row['compiled_ms']:>7.1f} ms{row['ratio']:>7.1f}"
                    f"{row['projected_ms']:>27.1f}{row['million_steps_per_s']:>11.2f}",
                    flush=True,
                )
    ratios = [float(str(row["ratio"])) for row in rows]
    mean = math.exp(statistics.fmean(math.log(ratio) for ratio in ratios))
    print(f"torchsde takes {min(ratios):.1f} to {max(ratios):.1f} times as long, geometric mean {mean:.1f}")
    if options.out:
        machine = {"torch": torch.__version__, "threads": options.threads, "cores": os.cpu_count()}
        options.out.write_text(json.dumps({**machine, "steps": options.steps, "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
