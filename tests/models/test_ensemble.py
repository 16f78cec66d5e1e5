"""The Gaussian ensemble: members by themselves, densities, bounds, propagation of particles, refusals."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from nsde_torch.errors import ConfigError, NonFiniteError
from nsde_torch.models import EnsembleSpec, GaussianEnsemble
from tests.helpers.draws import generator
from tests.helpers.toy_systems import DT

DECAY = "tests.helpers.toy_systems:Decay"


@torch.no_grad()
def make(system: str = "cartpole", dt: float = 0.02, *, rough: bool = True, **spec: Any) -> GaussianEnsemble:
    """An ensemble whose members and variances differ, standardised by numbers that are not 0 and 1."""
    model = GaussianEnsemble(EnsembleSpec(system, dt=dt, horizon=5, **spec), generator=generator())
    if rough:
        g = generator(7)
        for p in model.parameters():
            if p.requires_grad:
                p.add_(0.2 * torch.randn(p.shape, generator=g))
        for module in (model.standardise, model.change_scale):
            module.mean.normal_(generator=g)
            module.scale.uniform_(0.5, 1.5, generator=g)
    return model.requires_grad_(False)


@torch.no_grad()
def steady(means: Tensor, *, std: float = 1e-4, **spec: Any) -> GaussianEnsemble:
    """An ensemble whose member m moves a scalar state by means[m] per step whatever the state."""
    model = make(DECAY, DT, rough=False, members=len(means), **spec)
    list(model.networks.weights)[-1].zero_()
    list(model.networks.biases)[-1].copy_(torch.stack((means, torch.zeros_like(means)), -1)[:, None])
    # the bounds meet, and the log-variance saturates softplus(0) above them
    model.gap.fill_(-30.0)
    model.low.fill_(2 * math.log(std) - math.log(2.0))
    return model


def rows(model: GaussianEnsemble, n: int = 9, seed: int = 1) -> tuple[Tensor, Tensor]:
    g = generator(seed)
    s = model.system
    return model.project(torch.randn(n, s.nx, generator=g)), torch.randn(n, s.nu, generator=g)


def change(model: GaussianEnsemble, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of the change over one step, both (members, N, n_change)."""
    mean, v = model.standard(model.inputs(x, u).expand(model.spec.members, -1, -1))
    to = model.change_scale
    return to.mean + to.scale * mean, to.scale * torch.exp(0.5 * v)


# ---- one step -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("system", ["cartpole", "hexacopter"])
def test_every_row_is_moved_by_its_own_member(system: str) -> None:
    model = make(system)
    x, u = rows(model, 40)
    mean, std = change(model, x, u)
    members = model.draw_members(40, generator(3))
    noise = torch.randn(40, model.chart.n_change, generator=generator(4))
    after = model.advance(x, u, members, noise)
    own = torch.arange(40)
    moved = mean[members, own] + std[members, own] * noise
    torch.testing.assert_close(after, model.project(model.chart.moved(x, moved)))


@pytest.mark.parametrize("size", [0.0, 1.0, 1e3, 1e6])
def test_the_variance_stays_between_its_bounds_however_far_the_input(size: float) -> None:
    model = make()
    y = size * torch.randn(5, 200, model.standardise.mean.numel(), generator=generator(2))
    _, v = model.standard(y)
    top = model.low + torch.nn.functional.softplus(model.width())
    assert bool(((v >= model.low) & (v <= top + 1e-5)).all())
    assert bool((model.width() > 0).all())


# ---- paths ----------------------------------------------------------------------------------------------

MEANS = torch.tensor([-2.0, -1.0, 0.0, 1.0, 3.0])


@pytest.mark.parametrize("propagation", ["fixed", "redrawn"])
def test_members_are_drawn_alike_and_independently_once_for_a_path_or_at_every_step(propagation: str) -> None:
    model = steady(MEANS, propagation=propagation)
    path = model.sample(torch.zeros(2, 1), torch.zeros(2, 6, 1), dt=DT, particles=4000, generator=generator())
    # which member moved each particle at each step (P, B, T)
    near = (torch.diff(path[..., 0], dim=2)[..., None] - MEANS).abs().min(-1)
    assert float(near.values.max()) < 0.01
    members = near.indices
    for row in members.flatten(0, 1)[:, [0, 3, 5]].T:
        held = torch.bincount(row, minlength=5).double()
        expected = held.sum() / 5
        assert float(((held - expected).square() / expected).sum()) < 20.0  # chi-square, 4 degrees: p = 5e-4
    first = members[..., 0]
    # rows of a particle, neighbouring particles
    apart = [(first[:, 0], first[:, 1]), (first[1:], first[:-1])]
    if propagation == "fixed":
        assert bool((members == members[..., :1]).all())
    else:
        apart += [(members[..., lag:], members[..., :-lag]) for lag in (1, 2, 5)]
    for one, other in apart:
        agree = (one == other).double()
        assert float(agree.mean()) == pytest.approx(0.2, abs=4 * (0.16 / agree.numel()) ** 0.5)


@pytest.mark.parametrize("propagation", ["fixed", "redrawn"])
def test_mean_and_variance_of_a_sampled_step_are_those_of_the_mixture(propagation: str) -> None:
    model = make(propagation=propagation).double()
    x, u = rows(model, 3)
    x, u = x.double(), u.double()
    mean, std = change(model, x, u)
    count = 40_000
    path = model.sample(x, u[:, None], dt=0.02, particles=count, generator=generator(2))
    moved = path[:, :, 1] - x
    expected = mean.mean(0)
    variance = std.square().mean(0) + mean.var(0, correction=0)
    error = (variance / count).sqrt()
    assert bool(((moved.mean(0) - expected).abs() < 4.5 * error).all())
    torch.testing.assert_close(moved.var(0), variance, rtol=0.04, atol=0.0)


# ---- refusals -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dt", [0.01, 0.0201, 0.04, 0.0, -0.02, math.nan])
def test_another_step_than_the_learned_one_is_refused_with_the_remedy(dt: float) -> None:
    model = make()
    x, u = rows(model)
    with pytest.raises(ConfigError, match=r"`dt` must be 0\.02 s.*system\.dt"):
        model.sample(x, u[:, None], dt=dt, particles=1, generator=generator())


def test_noise_of_other_sensors_is_refused() -> None:
    model = make()
    x, u = rows(model)
    given = {"dt": 0.02, "particles": 1, "generator": generator()}
    with pytest.raises(ConfigError, match="measurement_std"):
        model.sample(x, u[:, None], measurement_std=torch.ones(4), **given)


def test_a_path_that_leaves_the_finite_numbers_says_when_and_where() -> None:
    model = make()
    model.change_scale.scale.fill_(3e38)
    x, u = rows(model)
    with pytest.raises(NonFiniteError, match=r"at step 1 of 3.*training data") as error:
        model.sample(x, u[:, None].expand(-1, 3, -1), dt=0.02, particles=2, generator=generator())
    assert "Shorten dt" not in str(error.value)


def test_effects_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"system\.effects"):
        make(effects=("constant_force",))


@pytest.mark.parametrize("wrong", [{"propagation": "both"}, {"members": 0}, {"batch": 0}])
def test_settings_out_of_range_are_refused_by_name(wrong: dict[str, Any]) -> None:
    (name,) = wrong
    with pytest.raises(ConfigError, match=f"model.{name}"):
        EnsembleSpec("cartpole", dt=0.02, horizon=5, **wrong)
