"""A drift without physics: scaled by the data, blind to declared parameters, saved and loaded like the others."""

from dataclasses import replace

import pytest
import torch

from nsde_torch.errors import ConfigError
from nsde_torch.models import NeuralSDE, SDESpec

SPEC = SDESpec("cartpole", kind="blackbox_nsde", physics=False, dt=0.02, horizon=10, step="euler_maruyama")


def make(spec: SDESpec = SPEC) -> NeuralSDE:
    return NeuralSDE(spec, generator=torch.Generator().manual_seed(0))


def test_no_physics_is_left_in_the_drift() -> None:
    model = make()
    x, u = torch.randn(5, 4, generator=torch.Generator().manual_seed(1)), torch.ones(5, 1)
    before = model.drift(0.0, x, u)
    with torch.no_grad():
        for parameter in model.system.parameters():
            parameter.add_(1.0)
    assert torch.equal(model.drift(0.0, x, u), before)
    assert len(model.residuals) == 0
    assert not any(p.requires_grad for p in model.system.parameters())


def test_the_rate_depends_on_the_input_and_has_the_size_of_the_data() -> None:
    model = make()
    g = torch.Generator().manual_seed(2)
    x = torch.cumsum(torch.tensor([0.1, 1.0, 10.0, 100.0]) * torch.randn(200, 11, 4, generator=g), 1)
    u = torch.randn(200, 10, 1, generator=g)
    model.black_box.fit(x, u, 0.02)
    sizes = torch.tensor([5.0, 50.0, 500.0, 5000.0])
    torch.testing.assert_close(model.black_box.scale, sizes, rtol=0.1, atol=0.0)
    assert not torch.equal(model.drift(0.0, x[:, 0], u[:, 0]), model.drift(0.0, x[:, 0], u[:, 1]))


def test_effects_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"system\.effects"):
        make(replace(SPEC, effects=("constant_force",)))
