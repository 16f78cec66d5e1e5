"""Question: how fast are rollouts of a neural SDE, and their gradients, against torchsde on the same work?

    python benchmarks/bench_rollout.py --threads 1

Both integrate the drift and diffusion of the hexacopter's model with the same method on the same increments, inputs and
first states, float32, 20 steps, and must give the same trajectories, which is checked before anything is timed.
torchsde gets the increments as its Brownian motion; it has no projection, which is left out on both sides. `eager` is
our rollout without compilation. Functions take turns, and the shortest time counts.
"""

import os
import time
from collections.abc import Callable
from itertools import product

import torch
import torchsde
from common import head, line, options
from torch import Tensor, nn

from nsde_torch.models import NeuralSDE, SDESpec
from nsde_torch.sde import Time, brownian, make_step, rollout

DT, STEPS = 0.05, 20
TORCHSDE = {  # our step -> calculus, method and options there
    "milstein": ("ito", "milstein", {"grad_free": True}),
    "euler_maruyama": ("ito", "euler", {}),
    "heun": ("stratonovich", "heun", {}),
}


class Unprojected(nn.Module):
    """The model without its projection, which torchsde does not have."""

    calculus = "either"

    def __init__(self, model: NeuralSDE) -> None:
        super().__init__()
        self.model = model

    def drift(self, t: Time, z: Tensor, u: Tensor) -> Tensor:
        return self.model.drift(t, z, u)

    def diffusion(self, t: Time, z: Tensor, u: Tensor) -> Tensor:
        return self.model.diffusion(t, z, u)

    def project(self, z: Tensor) -> Tensor:
        return z


class Increments(torchsde.BaseBrownian):
    """A Brownian motion that hands torchsde given increments (T, B, nz)."""

    levy_area_approximation = "none"

    def __init__(self, dw: Tensor, dt: float) -> None:
        super().__init__()
        self._dw, self._dt = dw.unbind(0), dt
        self._like = dw[0]

    def __call__(
        self, ta: Time, tb: Time | None = None, return_U: bool = False, return_A: bool = False
    ) -> Tensor:
        return self._dw[round(float(ta) / self._dt)]

    def __repr__(self) -> str:
        return "Increments()"

    @property
    def dtype(self) -> torch.dtype:
        return self._like.dtype

    @property
    def device(self) -> torch.device:
        return self._like.device

    @property
    def shape(self) -> torch.Size:
        return self._like.shape


class Theirs(nn.Module):
    """The same equation with torchsde's face; the input is held over a step."""

    noise_type = "diagonal"

    def __init__(self, model: NeuralSDE, calculus: str, u: Tensor, dt: float) -> None:
        super().__init__()
        self.model, self.sde_type, self._u, self._dt = model, calculus, u.unbind(1), dt

    def _input(self, t: Tensor) -> Tensor:
        # Heun asks for the end of the last step, whose input is the last one.
        return self._u[min(round(float(t) / self._dt), len(self._u) - 1)]

    def f(self, t: Tensor, y: Tensor) -> Tensor:
        return self.model.drift(t, y, self._input(t))

    def g(self, t: Tensor, y: Tensor) -> Tensor:
        return self.model.diffusion(t, y, self._input(t))


def case(model: NeuralSDE, batch: int) -> tuple[Tensor, Tensor, Tensor]:
    """First states, one input a row held throughout (Heun's end points then agree), increments (1, B, T, nz)."""
    g = torch.Generator().manual_seed(0)
    z0 = 0.1 * torch.randn(batch, model.nz, generator=g)
    z0[:, 6] = 1.0
    u = 0.36 + 0.05 * torch.randn(batch, 1, model.system.nu, generator=g)
    noise = brownian(1, batch, STEPS, model.nz, dt=DT, generator=g)
    return model.project(z0), u.expand(batch, STEPS, -1).contiguous(), noise


def minima(repeats: int, *functions: Callable[[], object]) -> list[float]:
    """Shortest time [ms] of each function; they take turns."""
    times: list[list[float]] = [[] for _ in functions]
    for _ in range(repeats + 2):
        for function, record in zip(functions, times, strict=True):
            start = time.perf_counter()
            function()
            record.append(1e3 * (time.perf_counter() - start))
    return [min(record[2:]) for record in times]


def measure(name: str, batch: int, *, repeats: int, gradient: bool) -> list[float]:
    """Shortest times [ms] of torchsde, of our rollout without compilation, and with it."""
    spec = SDESpec("hexacopter", dt=DT, horizon=STEPS, step=name, disturbance=True)
    model = NeuralSDE(spec, generator=torch.Generator().manual_seed(0))
    plain, step = Unprojected(model), make_step(name)
    z0, u, noise = case(model, batch)
    calculus, method, options = TORCHSDE[name]
    theirs, times = Theirs(model, calculus, u, DT), torch.linspace(0.0, STEPS * DT, STEPS + 1)
    motion = Increments(noise[0].transpose(0, 1).contiguous(), DT)

    def ours(compile: bool) -> Tensor:
        return rollout(plain, z0, u, dt=DT, step=step, noise=noise, compile=compile, check=False)[0]

    def other() -> Tensor:
        path = torchsde.sdeint(theirs, z0, times, bm=motion, method=method, dt=DT, options=dict(options))
        return path.transpose(0, 1)

    def run(function: Callable[[], Tensor]) -> Callable[[], Tensor]:
        def once() -> Tensor:
            with torch.set_grad_enabled(gradient):
                model.zero_grad(set_to_none=True)
                path = function()
                if gradient:
                    path.square().mean().backward()
                return path.detach()

        return once

    peer, *own = run(other), run(lambda: ours(False)), run(lambda: ours(True))
    for function in own:  # the same answer, to float32 accuracy
        torch.testing.assert_close(function(), peer(), rtol=1e-4, atol=1e-5)
    return minima(repeats, peer, *own)


def main() -> None:
    parser = options(__doc__, repeats=20, threads=1)
    parser.add_argument("--batch", type=int, nargs="+", default=[32, 512, 4096], help="rows")
    a = parser.parse_args()
    torch.set_num_threads(a.threads)
    head("step", "rows", "pass", "torchsde [ms]", "eager [ms]", "compiled [ms]", "ratio", "load")
    for name, gradient, batch in product(TORCHSDE, (False, True), a.batch):
        times = measure(name, batch, repeats=a.repeats, gradient=gradient)
        cells = [f"{t:.1f}" for t in (*times, times[0] / times[2], os.getloadavg()[0])]
        print(line([name, batch, "gradient" if gradient else "forward", *cells]), flush=True)


if __name__ == "__main__":
    main()
