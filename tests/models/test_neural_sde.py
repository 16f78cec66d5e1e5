"""The neural SDE: its drift, its samples, its memory, its sensors, and what it refuses."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from nsde_torch.errors import ConfigError, NonFiniteError, NsdeError, ShapeError
from nsde_torch.models import NeuralSDE, SDESpec
from nsde_torch.sde import brownian
from nsde_torch.sde.derivative import diffusion_and_slope
from tests.helpers.toy_systems import Decay, Gusty, fix_sigma, make_model

SYSTEMS = ("mass_spring_damper", "cartpole", "hexacopter", "quadrotor")


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def make(
    system: str, *, step: str = "euler_maruyama", dtype: torch.dtype = torch.float32, **spec: Any
) -> NeuralSDE:
    options: dict[str, Any] = {"dt": 0.05, "horizon": 10, **spec}
    made = NeuralSDE(SDESpec(system, step=step, **options), generator=generator())
    return made.to(dtype).requires_grad_(False)


def states(
    model: NeuralSDE, batch: int, seed: int = 0, dtype: torch.dtype = torch.float32
) -> tuple[Tensor, Tensor]:
    """Random states near rest and inputs near hover."""
    s = model.system
    x = 0.3 * torch.randn(batch, s.nx, generator=generator(seed), dtype=torch.float64)
    if s.quaternion is not None:
        x[:, s.quaternion.start] += 1.0
        x[:, s.quaternion] = torch.nn.functional.normalize(x[:, s.quaternion], dim=1)
    u = 0.4 + 0.05 * torch.randn(batch, 10, s.nu, generator=generator(seed + 1), dtype=torch.float64)
    return x.to(dtype), u.to(dtype)


@pytest.mark.parametrize("system", SYSTEMS)
def test_drift_is_the_declared_physics_with_the_residual_on_its_ports(system: str) -> None:
    model = make(system, dtype=torch.float64)
    for network in model.residuals.values():
        network.layers[-1].weight.normal_(generator=generator(3))  # type: ignore[union-attr, operator, index]
    x, u = states(model, 7, dtype=torch.float64)
    expected = model.system.drift(0.0, x, u[:, 0], model.residual(x))
    declared = model.system.drift(0.0, x, u[:, 0])
    torch.testing.assert_close(model.drift(0.0, x, u[:, 0]), expected)
    assert float((expected - declared).abs().max()) > 1e-3


@pytest.mark.parametrize("system", SYSTEMS)
@pytest.mark.parametrize("full", [False, True])
def test_samples_have_the_stated_axes_and_start_at_x0(system: str, full: bool) -> None:
    model = make(system, measurement=full, disturbance=full)
    x, u = states(model, 3)
    out = model.sample(x, u, dt=0.05, particles=4, generator=generator())
    assert out.shape == (4, 3, 11, model.system.nx)
    assert bool(torch.isfinite(out).all())
    torch.testing.assert_close(out[:, :, 0], x.expand(4, 3, -1), rtol=0, atol=2e-7)
    if model.system.quaternion is not None:
        norm = out[..., model.system.quaternion].norm(dim=-1)
        torch.testing.assert_close(norm, torch.ones_like(norm), rtol=0, atol=1e-5)


def test_rows_of_a_batch_do_not_see_each_other() -> None:
    model = make("hexacopter", dtype=torch.float64)
    x, u = states(model, 3, dtype=torch.float64)
    noise = brownian(2, 3, 10, model.nz, dt=0.05, generator=generator(), dtype=torch.float64)
    together = model.paths(x, u, dt=0.05, noise=noise)
    alone = model.paths(x[1:2], u[1:2], dt=0.05, noise=noise[:, 1:2])
    torch.testing.assert_close(together[:, 1:2], alone)


def test_spread_of_the_samples_of_a_disturbed_model_does_not_depend_on_the_step() -> None:
    """The authors' code scales noise without sqrt(dt); halving the step must not change the spread here."""
    model = fix_sigma(make_model(Gusty, disturbance=True), torch.tensor([1e-9, 0.5]))
    spreads = []
    with torch.no_grad():
        for k, dt in enumerate((0.04, 0.02, 0.01)):
            u = torch.zeros(1, round(1 / dt), 1)
            out = model.sample(torch.zeros(1, 1), u, dt=dt, particles=20_000, generator=generator(k))
            spreads.append(float(out[:, 0, -1, 0].std()))
    assert max(spreads) / min(spreads) < 1.05


def test_motor_lag_is_carried_but_not_returned_and_starts_settled() -> None:
    model = make("hexacopter", effects=("motor_lag",), dtype=torch.float64)
    assert (model.nz, model.system.nx) == (19, 13)
    x, u = states(model, 3, dtype=torch.float64)
    u = u[:, :1].expand(3, 10, 6).contiguous()  # a constant command: a settled lag changes nothing
    plain = make("hexacopter", dtype=torch.float64)
    plain.load_state_dict({k: v for k, v in model.state_dict().items() if "effects" not in k})
    out = model.paths(x, u, dt=0.05, noise=None)
    assert out.shape == (1, 3, 11, 13)
    torch.testing.assert_close(out, plain.paths(x, u, dt=0.05, noise=None))
    diffusion = model.diffusion(0.0, model.system.augment(x, u[:, 0]), u[:, 0])
    assert float(diffusion[:, 13:].abs().max()) == 0.0
    assert float(diffusion[:, :13].min()) > 0.0


@pytest.mark.parametrize("scale", [1.0, 1.07])
def test_position_advances_by_clock_scale_times_velocity_in_a_logged_second(scale: float) -> None:
    model = make("hexacopter", dtype=torch.float64)
    model.clock_scale.fill_(scale)
    x, u = states(model, 1, dtype=torch.float64)
    rate = model.drift(0.0, x, u[:, 0])
    torch.testing.assert_close(rate[:, :3], scale * x[:, 3:6])
    fine = model.paths(x, u[:, :1].expand(1, 100, 6), dt=0.001, noise=None)[0, 0]
    travelled = fine[-1, :3] - fine[0, :3]
    mean_velocity = (0.5 * (fine[1:, 3:6] + fine[:-1, 3:6])).mean(0)
    torch.testing.assert_close(travelled, scale * 0.1 * mean_velocity, rtol=1e-5, atol=1e-7)


def test_distance_takes_any_leading_axes_and_lies_in_the_unit_interval() -> None:
    model = make("hexacopter")
    x, _ = states(model, 6)
    eta = model.distance(x)
    assert eta.shape == (6,)
    torch.testing.assert_close(model.distance(x.reshape(2, 3, 13)), eta.reshape(2, 3))
    assert 0.0 <= float(eta.min()) <= float(eta.max()) <= 1.0


def test_default_loss_moves_the_state_but_not_eta_and_the_papers_does() -> None:
    for loss, moves in (("replay", False), ("paper", True)):
        model = make_model(Decay, loss=loss)
        x = torch.ones(3, 1, requires_grad=True)
        model.diffusion(0.0, x, torch.zeros(3, 1)).sum().backward()
        gradients = [p.grad for p in model.eta.energy_network.parameters() if p.grad is not None]
        assert bool(gradients) is moves
        assert model.h.slope.grad is not None
        assert float(x.grad.abs().max()) > 0


def test_float64_samples_are_float64_and_agree_with_float32() -> None:
    a, b = make("hexacopter"), make("hexacopter", dtype=torch.float64)
    b.load_state_dict(a.state_dict())
    x, u = states(a, 3, dtype=torch.float64)
    pa = a.paths(x.float(), u.float(), dt=0.05, noise=None)
    pb = b.paths(x, u, dt=0.05, noise=None)
    assert pb.dtype == torch.float64
    torch.testing.assert_close(pa.double(), pb, rtol=1e-4, atol=1e-5)
    assert b.sample(x.float(), u.float(), dt=0.05, particles=2, generator=generator()).dtype == torch.float64


def test_sampling_leaves_the_given_tensors_and_the_global_generator_alone() -> None:
    model = make("hexacopter", measurement=True, disturbance=True, filter_reach=3)
    x, u = states(model, 3)
    before = (x.clone(), u.clone(), torch.random.get_rng_state())
    model.sample(x, u, dt=0.05, particles=2, generator=generator())
    assert torch.equal(x, before[0])
    assert torch.equal(u, before[1])
    assert torch.equal(torch.random.get_rng_state(), before[2])


def put(table: Tensor, at: Any, value: Any) -> Tensor:
    table[at] = value
    return table


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (lambda x, u: (x[0], u), ShapeError, r"`x0` must be \(batch, nx=13\); got \(13,\)"),
        (lambda x, u: (x[:, :12], u), ShapeError, r"`x0`.*nx=13.*\(3, 12\)"),
        (lambda x, u: (x, u[:, 0]), ShapeError, r"`u` must be \(batch, horizon, nu=6\).*Add a horizon axis"),
        (lambda x, u: (x, u[..., :5]), ShapeError, r"`u`.*nu=6.*\(3, 10, 5\)"),
        (lambda x, u: (x[:2], u), ShapeError, r"`x0` has 2 rows and `u` has 3"),
        (lambda x, u: (x, u[:, :0]), ShapeError, r"`u`.*at least one step"),
        (lambda x, u: (put(x, (1, 4), math.nan), u), NonFiniteError, r"`x0` is not finite in rows \[1\]"),
        (lambda x, u: (x, put(u, (2, 5, 0), math.inf)), NonFiniteError, r"`u` is not finite in rows \[2\]"),
        (
            lambda x, u: (put(x, (1, slice(6, 10)), 1.3 * x[1, 6:10]), u),
            ShapeError,
            r"unit quaternions.*6 to 9.*\[1\].*1.3.*Normalise",
        ),
    ],
)
def test_refusals_name_the_argument_what_was_expected_and_what_came(
    change: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]], error: type[NsdeError], message: str
) -> None:
    model = make("hexacopter")
    x, u = states(model, 3)
    with pytest.raises(error, match=message):
        model.sample(*change(x, u), dt=0.05, particles=2, generator=generator())


def test_a_step_that_is_not_positive_is_refused() -> None:
    model = make("hexacopter")
    x, u = states(model, 3)
    with pytest.raises(NsdeError, match="dt"):
        model.sample(x, u, dt=0.0, particles=2, generator=generator())


def test_sigma_max_of_another_length_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"sigma_max.*\(13\); got 2"):
        make("hexacopter", sigma_max=(0.1, 0.1))


def test_fixed_sigma_max_is_kept_and_not_learned() -> None:
    spec = SDESpec("mass_spring_damper", dt=0.01, horizon=5, step="euler_maruyama", sigma_max=(0.001, 0.02))
    model = NeuralSDE(spec, generator=generator())
    torch.testing.assert_close(model.h.log_sigma_max.exp().detach(), torch.tensor([0.001, 0.02]))
    assert not model.h.log_sigma_max.requires_grad


def test_a_specification_with_unknown_keys_is_refused() -> None:
    spec = SDESpec("hexacopter", dt=0.05, horizon=20, step="milstein")
    with pytest.raises(ConfigError, match="colour"):
        SDESpec.from_dict({**spec.as_dict(), "colour": 1})


@pytest.mark.parametrize("step", ["rk4", "midpoint"])
def test_a_model_without_noise_predicts_one_path(step: str) -> None:
    model = make("cartpole", step=step)
    x, u = states(model, 2)
    out = model.sample(x, u, dt=0.02, particles=3, generator=generator())
    assert out.shape == (3, 2, 11, 4)
    assert torch.equal(out[0], out[1])


@pytest.mark.parametrize("loss", ["replay", "paper"])
def test_slope_of_the_diffusion_is_the_finite_difference_under_every_loss(loss: str) -> None:
    model = make("mass_spring_damper", dtype=torch.float64, loss=loss)
    model.h.slope.fill_(20.0)
    x, u = states(model, 5, dtype=torch.float64)
    _, slope = diffusion_and_slope(model, 0.0, x, u[:, 0])
    for i in range(2):
        step = torch.zeros(2, dtype=torch.float64)
        step[i] = 1e-6
        high, low = (model.diffusion(0.0, x + s * step, u[:, 0])[:, i] for s in (1.0, -1.0))
        torch.testing.assert_close(slope[:, i], (high - low) / 2e-6, rtol=1e-5, atol=1e-9)
    assert float(slope.abs().max()) > 1e-4


def test_rotation_noise_is_the_same_at_every_attitude() -> None:
    model = make("hexacopter", dtype=torch.float64)
    model.h.log_sigma_max.copy_(torch.linspace(-5, -1, 13, dtype=torch.float64))
    x = torch.zeros(4, 13, dtype=torch.float64)
    x[:, 6:10] = torch.nn.functional.normalize(
        torch.tensor([[1.0, 0, 0, 0], [0.5, 0, 0, 0.9], [0.7, 0.7, 0, 0], [0.1, 0.2, 0.9, -0.4]]), dim=1
    ).double()
    sigma = model.diffusion(0.0, x, torch.full((4, 6), 0.4, dtype=torch.float64))[:, 6:10]
    w, v = x[:, 6:7], x[:, 7:10]
    eye = torch.eye(3, dtype=torch.float64)
    cross = torch.stack([torch.cross(v, e.expand_as(v), dim=1) for e in eye], 2)
    tangent = torch.cat((-v[:, None], w[..., None] * eye + cross), 1)  # dq / d(theta/2)
    covariance = torch.einsum("nki,nk,nkj->nij", tangent, sigma**2, tangent)
    expected = float(sigma[0, 0]) ** 2 * eye
    torch.testing.assert_close(covariance, expected.expand(4, 3, 3))


def test_sensor_noise_for_a_model_without_it_is_refused() -> None:
    model = make("hexacopter")
    x, u = states(model, 2)
    with pytest.raises(ConfigError, match="measurement_std"):
        model.sample(x, u, dt=0.05, particles=2, generator=generator(), measurement_std=torch.ones(13))


@pytest.mark.parametrize("step", ["milstein", "heun"])
def test_memory_faster_than_the_step_does_not_blow_up(step: str) -> None:
    values: dict[str, float | list[float]] = {"motor_lag.time_constant": 0.004, "input_delay.delay": 0.01}
    spec = SDESpec("hexacopter", dt=0.05, horizon=20, step=step, effects=("motor_lag", "input_delay"))
    with_memory = NeuralSDE(spec, generator=generator(), values=values)
    plain = NeuralSDE(SDESpec("hexacopter", dt=0.05, horizon=20, step=step), generator=generator())
    x0 = torch.zeros(4, 13)
    x0[:, 6] = 1.0
    u = 0.2 + 0.4 * torch.rand(4, 40, 6, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        a, b = (
            model.paths(x0, u, dt=0.05, noise=torch.zeros(1, 4, 40, model.nz))
            for model in (with_memory, plain)
        )
    assert float((a - b)[..., 10:].abs().max()) < 0.5 * float(b[..., 10:].abs().max())
