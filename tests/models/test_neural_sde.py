"""The neural SDE: its drift with and without physics, samples, memory, sensors, disturbances, and what it refuses."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from nsde_torch.errors import NonFiniteError, NsdeError, ShapeError
from nsde_torch.models import NeuralSDE, SDESpec
from nsde_torch.models.ensemble import Chart
from nsde_torch.sde.derivative import diffusion_and_slope
from nsde_torch.systems import make_system
from tests.helpers.draws import generator
from tests.helpers.toy_systems import DT, Decay, Gusty, fix_sigma, make_model

SYSTEMS = ("mass_spring_damper", "cartpole", "hexacopter", "quadrotor")


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


def test_default_loss_moves_the_state_but_not_eta_and_the_papers_does() -> None:
    for loss, moves in (("replay", False), ("paper", True)):
        model = make_model(Decay, loss=loss)
        x = torch.ones(3, 1, requires_grad=True)
        model.diffusion(0.0, x, torch.zeros(3, 1)).sum().backward()
        gradients = [p.grad for p in model.eta.energy_network.parameters() if p.grad is not None]
        assert bool(gradients) is moves
        assert model.h.slope.grad is not None
        assert float(x.grad.abs().max()) > 0


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


@pytest.mark.parametrize("wrong", [{"dt": 0.0}, {"measurement_std": torch.ones(13)}], ids=["step", "noise"])
def test_a_step_that_is_not_positive_and_noise_of_sensors_that_it_has_not_are_refused(
    wrong: dict[str, Any],
) -> None:
    model = make("hexacopter")
    x, u = states(model, 3)
    with pytest.raises(NsdeError, match=next(iter(wrong))):
        model.sample(x, u, **{"dt": 0.05, **wrong}, particles=2, generator=generator())


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


BLACK = SDESpec("cartpole", kind="blackbox_nsde", physics=False, dt=0.02, horizon=10, step="euler_maruyama")


def black_box(spec: SDESpec = BLACK) -> NeuralSDE:
    return NeuralSDE(spec, generator=torch.Generator().manual_seed(0))


def test_no_physics_is_left_in_the_drift() -> None:
    model = black_box()
    x, u = torch.randn(5, 4, generator=torch.Generator().manual_seed(1)), torch.ones(5, 1)
    before = model.drift(0.0, x, u)
    with torch.no_grad():
        for parameter in model.system.parameters():
            parameter.add_(1.0)
    assert torch.equal(model.drift(0.0, x, u), before)
    assert len(model.residuals) == 0
    assert not any(p.requires_grad for p in model.system.parameters())


def alike(name: str, n: int = 64, seed: int = 0) -> torch.Tensor:
    system = make_system(name)
    x = torch.randn(n, system.nx, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return system.double().project(x)


@pytest.mark.parametrize("name", SYSTEMS)
def test_a_state_moved_by_its_change_is_the_other_state(name: str) -> None:
    system = make_system(name).double()
    chart = Chart(system)
    x, after = alike(name), alike(name, seed=1)
    assert chart.inputs(x).shape == (64, chart.width)
    before = x.clone(), after.clone()
    change = chart.change(x, after)
    assert change.shape == (64, chart.n_change)
    assert float(system.error(chart.moved(x, change), after).abs().max()) <= 1e-9
    assert torch.equal(x, before[0])
    assert torch.equal(after, before[1])


@pytest.mark.parametrize(
    ("name", "at", "sign", "turns"), [("cartpole", 2, 1, 2 * math.pi), ("hexacopter", slice(6, 10), -1, 0.0)]
)
def test_full_turns_and_the_sign_of_a_quaternion_are_not_seen(
    name: str, at: int | slice, sign: int, turns: float
) -> None:
    chart = Chart(make_system(name).double())
    x, after = alike(name), alike(name, seed=1)
    other = put(x.clone(), (..., at), sign * x[:, at] + turns)
    other_after = put(after.clone(), (..., at), after[:, at] - 2 * turns)
    torch.testing.assert_close(chart.inputs(other), chart.inputs(x))
    torch.testing.assert_close(chart.change(other, other_after), chart.change(x, after))


def test_disturbance_is_not_returned_and_starts_in_its_stationary_law() -> None:
    sigma, scale = 0.6, 1.3
    model = fix_sigma(make_model(Gusty, disturbance=True, dtype=torch.float64), torch.tensor([1e-9, sigma]))
    with torch.no_grad():
        model.log_tau.fill_(math.log(0.2))
        model.clock_scale.fill_(scale)
        tau = float(model.tau) / scale  # on the logged clock
        n = 40_000
        normal, none = (
            torch.randn(n, 1, generator=generator(), dtype=torch.float64),
            torch.zeros(n, 1).double(),
        )
        z = model.augment(none, none, normal)
        assert z.shape == (n, 2)
        stationary = sigma * math.sqrt(tau / 2)
        assert float(z[:, 1].std()) == pytest.approx(stationary, rel=0.02)
        dt = 0.005
        for _ in range(60):  # it stays there
            dw = math.sqrt(dt) * torch.randn(n, 2, generator=generator(_), dtype=torch.float64)
            u = torch.zeros(n, 1, dtype=torch.float64)
            z = z + dt * model.drift(0.0, z, u) + model.diffusion(0.0, z, u) * dw
        assert float(z[:, 1].std()) == pytest.approx(stationary, rel=0.03)
    out = model.sample(torch.zeros(2, 1), torch.zeros(2, 5, 1), dt=DT, particles=3, generator=generator())
    assert out.shape == (3, 2, 6, 1)


def test_a_disturbance_acts_on_its_port_like_a_force() -> None:
    model = make_model(Gusty, disturbance=True, dtype=torch.float64).requires_grad_(False)
    x, u = torch.randn(5, 1, dtype=torch.float64), torch.zeros(5, 1, dtype=torch.float64)
    d = torch.randn(5, 1, dtype=torch.float64)
    rate = model.drift(0.0, torch.cat((x, d), 1), u) - model.drift(0.0, torch.cat((x, 0 * d), 1), u)
    torch.testing.assert_close(rate[:, :1], d)
    torch.testing.assert_close(rate[:, 1:], -d / model.tau)


def sensing(std: float) -> NeuralSDE:
    model = fix_sigma(make_model(Decay, measurement=True), 1e-9)
    with torch.no_grad():
        model.log_measurement_std.fill_(math.log(std))
    return model.requires_grad_(False)


def test_predicted_measurements_carry_sensor_noise_at_the_start_and_at_every_later_state() -> None:
    model, n = sensing(0.2), 20_000
    out = model.sample(torch.ones(1, 1), torch.zeros(1, 20, 1), dt=DT, particles=n, generator=generator())
    assert float(out[:, 0, 0].std()) == 0.0  # x0 was measured: it is what it is
    for k in (1, 10, 20):  # the noise of the start decays with the state, that of the sensor does not
        expected = 0.2 * math.sqrt(1 + (1 - DT) ** (2 * k))
        assert float(out[:, 0, k].std()) == pytest.approx(expected, rel=0.03)
    late = out[:, 0, 19:, 0] - out[:, 0, 19:, 0].mean(0)
    shared = 0.2**2 * (1 - DT) ** 39  # only the start's noise is shared by neighbours
    assert float((late[:, 0] * late[:, 1]).mean()) == pytest.approx(shared, abs=0.002)
