"""The model of system identification: the declared physics, integrated."""

import math

import pytest
import torch

from nsde_torch.errors import ConfigError, ShapeError
from nsde_torch.models import IdentifiedModel, SysidSpec

SPEC = SysidSpec("mass_spring_damper", dt=0.01, horizon=50)


def made(spec: SysidSpec = SPEC, **values: float | list[float]) -> IdentifiedModel:
    return IdentifiedModel(spec, generator=torch.Generator(), values=values).double().requires_grad_(False)


def sample(model: IdentifiedModel, x0: torch.Tensor, u: torch.Tensor, **more: object) -> torch.Tensor:
    options: dict[str, object] = {"dt": 0.01, "particles": 1, "generator": torch.Generator(), **more}
    return model.sample(x0, u, **options)  # type: ignore[arg-type]


def test_a_path_is_the_solution_of_the_declared_physics() -> None:
    model = made(**{"viscous_friction.damping": 0.5, "linear_spring.stiffness": 1.0})
    x0 = torch.tensor([[0.1, 0.0]], dtype=torch.float64)
    path = sample(model, x0, torch.zeros(1, 300, 1, dtype=torch.float64))
    w = math.sqrt(1 - 0.25**2)
    t = 3.0
    expected = 0.1 * math.exp(-0.25 * t) * (math.cos(w * t) + 0.25 / w * math.sin(w * t))
    assert float(path[0, 0, -1, 0]) == pytest.approx(expected, abs=1e-9)


def test_the_clock_of_the_log_scales_the_rate() -> None:
    model = made()
    z = torch.tensor([[0.1, 0.2]], dtype=torch.float64)
    u = torch.zeros(1, 1, dtype=torch.float64)
    before = model.drift(0.0, z, u)
    model.clock_scale.fill_(1.1)
    torch.testing.assert_close(model.drift(0.0, z, u), 1.1 * before)
    assert torch.equal(model.diffusion(0.0, z, u), torch.zeros_like(z))


def test_memory_of_effects_starts_stationary() -> None:
    spec = SysidSpec("hexacopter", dt=0.05, horizon=20, effects=("motor_lag",))
    model = made(spec)
    x = torch.zeros(1, 13, dtype=torch.float64)
    x[:, 6] = 1.0
    u = torch.full((1, 6), 0.4, dtype=torch.float64)
    assert model.nz == 19
    z = model.system.augment(x, u)
    assert torch.equal(z[:, 13:], u)
    torch.testing.assert_close(model.drift(0.0, x, u), model.drift(0.0, z, u)[:, :13])
    assert sample(model, x, u[:, None], dt=0.05).shape == (1, 1, 2, 13)


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"`model\.method` must be weak"):
        SysidSpec("cartpole", dt=0.02, horizon=30, method="magic")
    with pytest.raises(ConfigError, match=r"`model\.max_iterations`"):
        SysidSpec("cartpole", dt=0.02, horizon=30, max_iterations=0)
    with pytest.raises(ConfigError, match="no diffusion"):
        made(SysidSpec("cartpole", dt=0.02, horizon=30, step="heun"))
    x0, u = torch.zeros(1, 2, dtype=torch.float64), torch.zeros(1, 3, 1, dtype=torch.float64)
    with pytest.raises(ConfigError, match="has no noise"):
        sample(made(), x0, u, measurement_std=torch.zeros(2))
    with pytest.raises(ShapeError, match="`measurement_std`"):
        sample(made(), x0, u, measurement_std=torch.zeros(3))
    with pytest.raises(ShapeError, match="must have 2 columns"):
        made().drift(0.0, torch.zeros(1, 3, dtype=torch.float64), u[:, 0])
