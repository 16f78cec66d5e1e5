"""A drift without physics: scaled by the data, blind to declared parameters, saved and loaded like the others."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

import nsde_torch
from nsde_torch.errors import ConfigError
from nsde_torch.models import NeuralSDE, SDESpec
from nsde_torch.models.run_directory import save

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
    assert model.black_box is not None
    g = torch.Generator().manual_seed(2)
    x = torch.cumsum(torch.tensor([0.1, 1.0, 10.0, 100.0]) * torch.randn(200, 11, 4, generator=g), 1)
    u = torch.randn(200, 10, 1, generator=g)
    model.black_box.fit(x, u, 0.02)
    torch.testing.assert_close(
        model.black_box.scale, torch.tensor([5.0, 50.0, 500.0, 5000.0]), rtol=0.1, atol=0.0
    )
    assert not torch.equal(model.drift(0.0, x[:, 0], u[:, 0]), model.drift(0.0, x[:, 0], u[:, 1]))


def test_it_is_saved_and_loaded_and_samples_the_same(tmp_path: Path) -> None:
    model = make()
    save(model, tmp_path)
    again = nsde_torch.load(tmp_path)
    assert isinstance(again, NeuralSDE)
    assert again.spec == model.spec
    x0, u = torch.zeros(2, 4), torch.ones(2, 5, 1)

    def paths(m: NeuralSDE) -> torch.Tensor:
        return m.sample(x0, u, dt=0.02, particles=3, generator=torch.Generator().manual_seed(0))

    assert torch.equal(paths(model), paths(again))


def test_effects_are_refused() -> None:
    spec = SDESpec(
        "cartpole",
        kind="blackbox_nsde",
        physics=False,
        dt=0.02,
        horizon=10,
        step="milstein",
        effects=("constant_force",),
    )
    with pytest.raises(ConfigError, match=r"system\.effects"):
        make(spec)
