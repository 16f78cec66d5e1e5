"""torchdiffeq as a step: the same paths and gradients as our own steps, with and without the adjoint."""

import pytest
import torch

from nsde_torch.errors import ConfigError
from nsde_torch.models import NeuralSDE, SDESpec
from nsde_torch.sde import make_step, rollout

DT = 0.05


def model(system: str) -> NeuralSDE:
    spec = SDESpec(system, dt=DT, horizon=10, step="rk4", kind="node")
    return NeuralSDE(spec, generator=torch.Generator().manual_seed(0)).double()


def problem(m: NeuralSDE) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(1)
    x0 = 0.2 * torch.randn(3, m.system.nx, generator=g, dtype=torch.float64)
    u = 0.5 + 0.1 * torch.randn(3, 4, m.system.nu, generator=g, dtype=torch.float64)
    return m.augment(m.project(x0), u[:, 0]), u


@pytest.mark.parametrize(
    ("system", "method"),
    [("hexacopter", "dopri5"), *(("cartpole", m) for m in ("rk4", "dopri5", "dopri8", "bosh3"))],
)
def test_paths_are_those_of_our_own_runge_kutta(system: str, method: str) -> None:
    m = model(system)
    z0, u = problem(m)
    held = u.repeat_interleave(16, 1)
    fine = rollout(m, z0, held, dt=DT / 16, step=make_step("rk4"), noise=None)[:, :, ::16]
    step = make_step("torchdiffeq", method=method, rtol=1e-8, atol=1e-9)
    path = rollout(m, z0, u, dt=DT, step=step, noise=None)
    torch.testing.assert_close(path, fine, rtol=0, atol=1e-3 if method == "rk4" else 5e-4)


def test_a_fixed_method_is_our_own_to_rounding() -> None:
    m = model("cartpole")
    z0, u = problem(m)
    ours = rollout(m, z0, u, dt=DT, step=make_step("midpoint"), noise=None)
    theirs = rollout(m, z0, u, dt=DT, step=make_step("torchdiffeq", method="midpoint"), noise=None)
    torch.testing.assert_close(theirs, ours, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_the_adjoint_gives_the_gradients_of_the_tape() -> None:
    gradients = []
    for adjoint in (False, True):
        m = model("cartpole")
        z0, u = problem(m)
        z0.requires_grad_()
        u.requires_grad_()
        step = make_step("torchdiffeq", rtol=1e-9, atol=1e-10, adjoint=adjoint)
        rollout(m, z0, u, dt=DT, step=step, noise=None).square().sum().backward()
        own = [p.grad for p in m.residuals.parameters()]
        gradients.append([z0.grad, u.grad, *own])
    for tape, adjoint_gradient in zip(*gradients, strict=True):
        torch.testing.assert_close(adjoint_gradient, tape, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("options", [{"method": "rk5"}, {"rtol": 0.0}, {"atol": -1.0}])
def test_a_method_or_tolerance_that_is_none_is_refused(options: dict[str, object]) -> None:
    with pytest.raises(ConfigError, match=r"solver\."):
        make_step("torchdiffeq", **options)


def test_an_option_that_a_step_lacks_is_named() -> None:
    with pytest.raises(ConfigError, match="`rtol`"):
        make_step("milstein", rtol=1e-3)
