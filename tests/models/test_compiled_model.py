"""The compiled step of the hexacopter: the eager numbers and gradients, one code for all models."""

import pytest
import torch
from torch import Tensor

from nsde_torch.models import NeuralSDE, SDESpec
from nsde_torch.sde import brownian

EFFECTS = ("linear_drag", "angular_damping", "motor_lag")
LEARNED = {"measurement": True, "disturbance": True, "effects": EFFECTS}
SPEC = SDESpec("hexacopter", dt=0.05, horizon=5, step="milstein", **LEARNED)


def model(seed: int, kind: str) -> NeuralSDE:
    spec = SDESpec.from_dict({**SPEC.as_dict(), "loss": kind})
    return NeuralSDE(spec, generator=torch.Generator().manual_seed(seed))


def paths(sde: NeuralSDE, batch: int, *, compile: bool) -> Tensor:
    g = torch.Generator().manual_seed(batch)
    x0 = 0.3 * torch.randn(batch, 13, generator=g)
    x0[:, 6] = 3.0
    x0 = sde.project(x0)
    u = 0.4 + 0.05 * torch.randn(batch, 5, 6, generator=g)
    noise = brownian(2, batch, 5, sde.nz, dt=0.05, generator=g)
    start = torch.randn(2, batch, sde.n_start, generator=g)
    given = {"noise": noise, "start": start, "std": sde.measurement_std, "t0": torch.zeros(batch)}
    return sde.paths(x0, u, dt=0.05, compile=compile, **given)


def gradients(sde: NeuralSDE, batch: int, *, compile: bool) -> dict[str, Tensor]:
    sde.zero_grad()
    path = paths(sde, batch, compile=compile)
    path[:, :, 1:].square().mean().backward()
    found = {name: p.grad.clone() for name, p in sde.named_parameters() if p.grad is not None}
    return {"path": path.detach(), **found}


@pytest.mark.usefixtures("compiler")
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["replay", "paper"])
def test_compiled_hexacopter_gives_the_eager_paths_and_gradients(kind: str) -> None:
    sde = model(0, kind)
    fast, slow = gradients(sde, 7, compile=True), gradients(sde, 7, compile=False)
    assert fast.keys() == slow.keys()
    some = {"h.slope", "log_tau", "system.raw.yaw_gain", "residuals.body_moment.layers.0.weight"}
    assert some <= fast.keys()
    for name, value in slow.items():
        scale = float(value.abs().max())
        assert torch.allclose(fast[name], value, rtol=1e-4, atol=2e-5 * max(scale, 1e-3)), name
    if kind == "paper":
        return
    other = model(1, kind)
    with torch.no_grad():
        paths(sde, 6, compile=True)
    with torch._dynamo.config.patch(error_on_recompile=True):
        fast = gradients(other, 7, compile=True)
        assert torch.allclose(fast["path"], gradients(other, 7, compile=False)["path"], atol=1e-5)
        with torch.no_grad():
            path = paths(other, 3, compile=True)
    assert torch.allclose(path, paths(other, 3, compile=False), atol=1e-5)
