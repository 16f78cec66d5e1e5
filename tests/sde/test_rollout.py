"""Rollouts, and the increments that drive them: layout, laws, gradients, what is refused and reported."""

import pytest
import torch
from torch import Tensor

from nsde_torch.errors import ConfigError, NonFiniteError, ShapeError, SolverError
from nsde_torch.models import NeuralSDE, SDESpec
from nsde_torch.sde import STEPS, Step, Time, brownian, coarsen, make_step, rollout, with_calculus
from tests.helpers.sde_problems import DistanceAware, GeometricBrownianMotion, Quiet, SmallNetwork

P, B, T, NZ, NU = 3, 4, 5, 3, 2
STOCHASTIC = [name for name, cls in STEPS.items() if not cls.deterministic]


def case(
    dtype: torch.dtype = torch.float64, particles: int = P
) -> tuple[SmallNetwork, Tensor, Tensor, Tensor]:
    g = torch.Generator().manual_seed(0)
    z0 = torch.randn(B, NZ, generator=g, dtype=dtype)
    u = torch.randn(B, T, NU, generator=g, dtype=dtype)
    return SmallNetwork().to(dtype), z0, u, brownian(particles, B, T, NZ, dt=0.1, generator=g, dtype=dtype)


@pytest.mark.parametrize("name", list(STEPS))
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rollout_gives_particles_batch_time_state_with_and_without_gradients(
    name: str, dtype: torch.dtype
) -> None:
    sde, z0, u, noise = case(dtype)
    step, before = make_step(name), [x.clone() for x in (z0, u, noise)]
    dw = None if step.deterministic else noise
    path = rollout(sde, z0, u, dt=0.1, step=step, noise=dw)
    with torch.no_grad():
        assert torch.equal(path, rollout(sde, z0, u, dt=0.1, step=step, noise=dw))
    assert all(torch.equal(x, y) for x, y in zip((z0, u, noise), before, strict=True))
    assert path.shape == (1 if step.deterministic else P, B, T + 1, NZ)
    assert path.dtype == dtype
    assert torch.equal(path[0, :, 0], z0)
    assert torch.allclose(
        path[:, :, 1:, :2].norm(dim=-1), torch.ones((), dtype=dtype)
    )  # projected every step


@pytest.mark.parametrize("name", STOCHASTIC)
def test_every_particle_and_row_is_rolled_out_as_if_alone(name: str) -> None:
    sde, z0, u, noise = case()
    t0 = torch.arange(B, dtype=torch.float64)
    path = rollout(sde, z0, u, dt=0.1, step=make_step(name), noise=noise, t0=t0)
    for p, b in ((0, 0), (2, 1), (1, 3)):
        one, dw = slice(b, b + 1), noise[p : p + 1, b : b + 1]
        alone = rollout(sde, z0[one], u[one], dt=0.1, step=make_step(name), noise=dw, t0=float(b))
        assert torch.allclose(path[p, b], alone[0, 0], atol=1e-12)


@pytest.mark.parametrize("name", list(STEPS))
def test_gradients_in_state_input_noise_and_parameters_are_exact(name: str) -> None:
    sde, z0, u, noise = case()
    # a method that adapts its steps is no smooth function of the state, beyond its tolerance
    step = make_step(name, method="rk4") if name == "torchdiffeq" else make_step(name)

    def run(z: Tensor, v: Tensor, dw: Tensor, *weights: Tensor) -> Tensor:
        class Bound:
            calculus = "either"
            project = staticmethod(sde.project)

            def drift(self, t: Time, z: Tensor, u: Tensor) -> Tensor:
                return torch.tanh(torch.cat((z, u), -1) @ weights[0].T) @ weights[1].T

            def diffusion(self, t: Time, z: Tensor, u: Tensor) -> Tensor:
                return 0.3 * torch.sigmoid(z @ weights[2].T)

        return rollout(Bound(), z, v, dt=0.1, step=step, noise=None if step.deterministic else dw)

    inputs = [z0[:2], u[:2, :3], noise[:2, :2, :3], *(p.detach() for p in sde.parameters())]
    assert torch.autograd.gradcheck(run, [x.clone().requires_grad_() for x in inputs], fast_mode=True)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"z0": torch.zeros(3)}, ShapeError, r"`z0` must be \(batch, nz\)"),
        ({"u": torch.zeros(4, 5)}, ShapeError, r"`u` must be \(batch=4, horizon, nu\)"),
        ({"u": torch.zeros(4, 6, 2)}, ShapeError, r"`noise` must be .*horizon=6"),
        ({"noise": torch.zeros(0, 4, 5, 3)}, ShapeError, "`noise` must be"),
        ({"noise": torch.zeros(1, 4, 5, 2)}, ShapeError, "nz=3"),
        ({"t0": torch.zeros(3)}, ShapeError, r"`t0` must be one time or \(batch=4,\)"),
        ({"noise": torch.zeros(1, 4, 5, 3, dtype=torch.float64)}, SolverError, "`noise` must have the dtype"),
        ({"noise": torch.zeros(1, 4, 5, 3, device="meta")}, SolverError, "got torch.float32 on meta"),
        ({"z0": torch.zeros(4, 3, dtype=torch.int64)}, SolverError, "floating-point"),
        ({"noise": None}, SolverError, "`noise` must be given with 'milstein'"),
        ({"step": make_step("rk4")}, SolverError, "`noise` must be None with 'rk4'"),
        ({"step": "milstein"}, SolverError, "make_step"),
        ({"dt": 0.0}, SolverError, "`dt`"),
    ],
)
def test_what_does_not_fit_is_refused_by_name(
    change: dict[str, object], error: type[Exception], message: str
) -> None:
    sde, z0, u, noise = case(torch.float32)
    arguments = {"z0": z0, "u": u, "dt": 0.1, "step": make_step("milstein"), "noise": noise, **change}
    with pytest.raises(error, match=message):
        rollout(sde, arguments.pop("z0"), arguments.pop("u"), **arguments)  # type: ignore[arg-type]


def roll(sde: GeometricBrownianMotion | DistanceAware, step: Step) -> Tensor:
    noise = brownian(1, 2, 4, 1, dt=0.1, generator=torch.Generator().manual_seed(0))
    return rollout(sde, torch.ones(2, 1), torch.zeros(2, 4, 1), dt=0.1, step=step, noise=noise)


@pytest.mark.parametrize("name", STOCHASTIC)
def test_a_step_of_the_other_calculus_is_refused(name: str) -> None:
    step = make_step(name)
    other = {"ito": "stratonovich", "stratonovich": "ito"}[step.calculus]
    roll(GeometricBrownianMotion(calculus=step.calculus), step)
    with pytest.raises(SolverError, match=f"`sde.calculus` is '{other}'"):
        roll(GeometricBrownianMotion(calculus=other), step)


def test_an_unknown_step_lists_the_choices() -> None:
    with pytest.raises(ConfigError, match=r"euler_maruyama, heun, milstein.*got 'euler'"):
        make_step("euler")


@pytest.mark.parametrize("calculus", ["ito", "stratonovich"])
def test_the_drift_correction_preserves_the_process_in_the_other_calculus(calculus: str) -> None:
    """On coupled noise, one fine path integrated in both calculi ends in the same place."""
    steps = 1024
    sde = DistanceAware(calculus=calculus)  # type: ignore[arg-type]
    g = torch.Generator().manual_seed(0)
    noise = brownian(200, 1, steps, 2, dt=1 / steps, generator=g, dtype=torch.float64)
    z0, u = torch.ones(1, 2, dtype=torch.float64), torch.zeros(1, steps, 1, dtype=torch.float64)

    def end(calculus: str) -> Tensor:
        step = make_step({"ito": "milstein", "stratonovich": "milstein_stratonovich_free"}[calculus])
        equation = with_calculus(sde, calculus)  # type: ignore[arg-type]
        return rollout(equation, z0, u, dt=1 / steps, step=step, noise=noise)[:, 0, -1]

    assert (end("ito") - end("stratonovich")).abs().mean() < 0.02
    free = DistanceAware(calculus="either")
    read_other = rollout(free, z0, u, dt=1 / steps, step=make_step("heun"), noise=noise)[:, 0, -1]
    read_ito = rollout(free, z0, u, dt=1 / steps, step=make_step("milstein"), noise=noise)[:, 0, -1]
    assert (read_other - read_ito).abs().mean() > 0.05


class Blows(Quiet):
    """Rows that start above one leave the finite numbers once t passes 0.27 s."""

    def drift(self, t: Time, z: Tensor, u: Tensor) -> Tensor:
        late = torch.as_tensor(t) > 0.27
        return torch.where((z > 1) & late.reshape(-1, 1), torch.inf, 0.0)


def test_a_rollout_that_is_not_finite_reports_step_time_and_rows() -> None:
    z0, u = torch.tensor([[0.0], [2.0], [0.0]]), torch.zeros(3, 6, 1)
    with pytest.raises(NonFiniteError, match=r"step 4 of 6 \(t = 0.4 s\) in 1 of 3 rows.*\(0, 1\)\."):
        rollout(Blows(), z0, u, dt=0.1, step=make_step("midpoint"), noise=None)
    t0 = torch.tensor([0.0, 0.2, 0.0])
    with pytest.raises(NonFiniteError, match=r"step 2 of 6 \(t = 0.4 s\)"):
        rollout(Blows(), z0, u, dt=0.1, step=make_step("midpoint"), noise=None, t0=t0)
    path = rollout(Blows(), z0, u, dt=0.1, step=make_step("midpoint"), noise=None, check=False)
    assert path.isinf().any()


def draw(seed: int = 0, **options: object) -> torch.Tensor:
    arguments = {"dt": 0.25, "generator": torch.Generator().manual_seed(seed), **options}
    return brownian(3, 4, 6, 2, **arguments)  # type: ignore[arg-type]


def test_one_seed_gives_one_path_of_the_shape_and_type_asked_for_and_global_state_is_left_alone() -> None:
    before = torch.get_rng_state()
    assert torch.equal(draw(7), draw(7))
    assert not torch.equal(draw(7), draw(8))
    assert draw().shape == (3, 4, 6, 2)
    assert draw(dtype=torch.float64).dtype == torch.float64
    assert torch.equal(before, torch.get_rng_state())


def test_coarse_increments_are_the_sums_of_the_fine_ones() -> None:
    dw = draw(dtype=torch.float64)
    coarse = coarsen(dw, 3)
    assert coarse.shape == (3, 4, 2, 2)
    assert torch.allclose(coarse[:, :, 1], dw[:, :, 3:].sum(2))
    assert torch.allclose(coarsen(dw, 6)[:, :, 0], dw.sum(2))


def test_no_particles_and_steps_that_are_not_positive_and_finite_are_refused() -> None:
    for dt in (0.0, -0.1, float("nan"), float("inf")):
        with pytest.raises(SolverError, match="`dt`"):
            draw(dt=dt)
    with pytest.raises(SolverError, match="`particles`"):
        brownian(0, 1, 1, 1, dt=0.1, generator=torch.Generator())


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
    [("hexacopter", "dopri5"), *(("cartpole", m) for m in ("rk4", "dopri5", "bosh3"))],
)
def test_paths_are_those_of_our_own_runge_kutta(system: str, method: str) -> None:
    m = model(system)
    z0, u = problem(m)
    held = u.repeat_interleave(16, 1)
    fine = rollout(m, z0, held, dt=DT / 16, step=make_step("rk4"), noise=None)[:, :, ::16]
    step = make_step("torchdiffeq", method=method, rtol=1e-8, atol=1e-9)
    path = rollout(m, z0, u, dt=DT, step=step, noise=None)
    torch.testing.assert_close(path, fine, rtol=0, atol=1e-3 if method == "rk4" else 5e-4)


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
