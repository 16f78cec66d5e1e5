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
from common import options
from torch import Tensor, nn

from nsde_torch.models import NeuralSDE, SDESpec
from nsde_torch.sde import Time, brownian, make_step, rollout

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


def case(model: NeuralSDE, batch: int, steps: int, dt: float) -> tuple[Tensor, Tensor, Tensor]:
    """First states, one input a row held throughout (Heun's end points then agree), increments (1, B, T, nz)."""
    g = torch.Generator().manual_seed(0)
    z0 = 0.1 * torch.randn(batch, model.nz, generator=g)
    z0[:, 6] = 1.0
    u = 0.36 + 0.05 * torch.randn(batch, 1, model.system.nu, generator=g)
    noise = brownian(1, batch, steps, model.nz, dt=dt, generator=g)
    return model.project(z0), u.expand(batch, steps, -1).contiguous(), noise


def minima(repeats: int, *functions: Callable[[], object]) -> list[float]:
    """Shortest time [s] of each function; they take turns."""
    times: list[list[float]] = [[] for _ in functions]
    for turn in range(repeats + 2):
        for function, record in zip(functions, times, strict=True):
            start = time.perf_counter()
            function()
            if turn >= 2:
                record.append(time.perf_counter() - start)
    return [min(record) for record in times]


def measure(
    name: str, batch: int, *, steps: int, dt: float, repeats: int, gradient: bool
) -> dict[str, object]:
    spec = SDESpec("hexacopter", dt=dt, horizon=steps, step=name, disturbance=True)
    model = NeuralSDE(spec, generator=torch.Generator().manual_seed(0))
    plain, step = Unprojected(model), make_step(name)
    z0, u, noise = case(model, batch, steps, dt)
    calculus, method, options = TORCHSDE[name]
    theirs, times = Theirs(model, calculus, u, dt), torch.linspace(0.0, steps * dt, steps + 1)
    motion = Increments(noise[0].transpose(0, 1).contiguous(), dt)

    def ours(compile: bool) -> Tensor:
        return rollout(plain, z0, u, dt=dt, step=step, noise=noise, compile=compile, check=False)[0]

    def other() -> Tensor:
        path = torchsde.sdeint(theirs, z0, times, bm=motion, method=method, dt=dt, options=dict(options))
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

    compiled, eager, peer = run(lambda: ours(True)), run(lambda: ours(False)), run(other)
    for path in (compiled(), eager()):  # the same answer, to float32 accuracy
        torch.testing.assert_close(path, peer(), rtol=1e-4, atol=1e-5)
    fast_s, slow_s, peer_s = minima(repeats, compiled, eager, peer)
    kind = "gradient" if gradient else "forward"
    times_ms = {"torchsde_ms": 1e3 * peer_s, "eager_ms": 1e3 * slow_s, "compiled_ms": 1e3 * fast_s}
    times_ms["ratio"] = peer_s / fast_s
    return {"step": name, "batch": batch, "pass": kind, **times_ms, "load": os.getloadavg()[0]}


def main() -> None:
    parser = options(__doc__, repeats=20, threads=1)
    parser.add_argument("--batch", type=int, nargs="+", default=[32, 512, 4096], help="rows")
    a = parser.parse_args()
    torch.set_num_threads(a.threads)
    print(
        f"{'step':<15}{'batch':>6}{'pass':>9}{'torchsde':>12}{'eager':>10}{'compiled':>10}{'ratio':>7}{'load':>6}"
    )
    for name, gradient, batch in product(TORCHSDE, (False, True), a.batch):
        r = measure(name, batch, steps=20, dt=0.05, repeats=a.repeats, gradient=gradient)
        print(
            f"{name:<15}{batch:>6}{r['pass']:>9}{r['torchsde_ms']:>9.1f} ms{r['eager_ms']:>7.1f} ms"
            f"{r['compiled_ms']:>7.1f} ms{r['ratio']:>7.1f}{r['load']:>6.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
