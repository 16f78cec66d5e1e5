"""Plans in trouble: whatever comes in, what goes out is finite, within bounds, and says how it came about."""

import pytest
import torch

from nsde_torch.control.controller import Controller, Plan, setpoints
from nsde_torch.control.problem import ProblemOptions
from nsde_torch.control.reference import Reference
from nsde_torch.control.solve import SolverOptions
from nsde_torch.errors import ShapeError
from nsde_torch.models import NeuralSDE
from nsde_torch.systems import Multirotor, System
from tests.helpers.control_problems import controller_of

T = 12.0


def _state(path: Reference, t: float = T) -> torch.Tensor:
    return path.at(torch.tensor([t]))


def _window(path: Reference, t: float = T) -> torch.Tensor:
    return path.window(t, dt=0.1, steps=10)[None]


def _safe(plan: Plan) -> None:
    assert bool(torch.isfinite(plan.u).all() and torch.isfinite(plan.z).all())
    assert 0.0 <= float(plan.u.min()) <= float(plan.u.max()) <= 1.0


@pytest.fixture
def controller(declared: System) -> Controller:
    return controller_of(declared)


def test_a_plan_says_cost_gap_and_status_and_starts_where_the_machine_is(
    controller: Controller, path: Reference
) -> None:
    plan = controller.plan(_state(path), _window(path))
    _safe(plan)
    assert plan.status == ("converged",)
    assert torch.allclose(plan.x[:, 0], _state(path).float(), atol=1e-5)
    assert 0.0 < float(plan.cost) < 100.0
    assert float(plan.gap) < 5e-3
    assert plan.solve_ms > 0.0


def test_a_warm_start_needs_no_more_iterations_than_a_cold_one(
    controller: Controller, path: Reference
) -> None:
    first = controller.plan(_state(path), _window(path))
    second = controller.plan(_state(path, T + 0.02), _window(path, T + 0.02), first, elapsed=0.02)
    assert second.iterations <= first.iterations
    assert second.iterations == 1


@pytest.mark.parametrize(("column", "value"), [(0, "nan"), (4, "inf"), (8, "nan"), (12, "inf")])
def test_a_state_that_is_no_number_keeps_the_last_plan_and_then_hovers(
    controller: Controller, path: Reference, column: int, value: str
) -> None:
    plan = controller.plan(_state(path), _window(path))
    bad = _state(path)
    bad[:, column] = float(value)
    words = []
    for _ in range(40):
        after = controller.plan(bad, _window(path), plan, elapsed=0.02)
        _safe(after)
        words.append(after.status[0])
        if after.status[0].endswith("kept"):
            assert torch.allclose(after.u, plan.shifted(0.02).u)
        plan = after
    assert words[0] == "bad_state:kept"
    assert words[-1] == "bad_state:hover"
    assert torch.allclose(plan.u[0, 0], controller.hover)
    again = controller.plan(_state(path), _window(path), plan, elapsed=0.02)
    assert again.status[0] in ("converged", "improved")


def test_the_very_first_state_may_be_bad_and_a_quaternion_that_is_none_is_and_a_reference_may_be(
    controller: Controller, path: Reference
) -> None:
    long, wrong = _state(path), _window(path)
    long[:, 6:10] *= 1.2
    for bad in (torch.full((1, 13), float("nan")), long):
        plan = controller.plan(bad, _window(path))
        _safe(plan)
        assert plan.status == ("bad_state:hover",)
    plan = controller.plan(_state(path), _window(path))
    wrong[:, 7, 3] = float("nan")
    after = controller.plan(_state(path), wrong, plan, elapsed=0.02)
    _safe(after)
    assert after.status == ("bad_reference:kept",)


def test_a_state_that_jumps_is_believed_only_when_it_stays(controller: Controller, path: Reference) -> None:
    plan = controller.plan(_state(path), _window(path))
    away = _state(path)
    away[:, 0] += 2.0
    words = []
    for _ in range(4):
        plan = controller.plan(away, _window(path), plan, elapsed=0.02)
        _safe(plan)
        words.append(plan.status[0])
    assert words[:2] == ["state_jump:kept"] * 2
    assert words[3] in ("converged", "improved")


def test_a_missed_deadline_is_said_and_the_plan_is_still_good(declared: System, path: Reference) -> None:
    now = iter(0.5 * k for k in range(1000))
    solver = SolverOptions(compile="off", iterations=50, tolerance=0.0, deadline=0.2)
    problem = ProblemOptions(steps=10)
    late = Controller(declared, problem=problem, solver=solver, clock=lambda: next(now))
    plan = late.plan(_state(path), _window(path))
    _safe(plan)
    assert plan.status == ("improved:late",)
    assert plan.iterations == 1


def test_a_reference_far_outside_the_envelope_gives_a_safe_plan(
    controller: Controller, path: Reference
) -> None:
    far = _window(path)
    far[:, :, :3] += 500.0
    far[:, :, 3:6] *= 40.0
    plan = controller.plan(_state(path), far)
    _safe(plan)
    assert plan.status[0] in ("converged", "improved")


@pytest.mark.slow
def test_a_model_that_diverges_is_not_flown_on(model: NeuralSDE, path: Reference) -> None:
    controller = controller_of(model)
    plan = controller.plan(_state(path), _window(path))
    assert plan.status[0] in ("converged", "improved")
    residual = controller.predictor._residual
    assert residual is not None
    residual.bias_2.fill_(float("nan"))
    words = []
    for _ in range(30):
        plan = controller.plan(_state(path), _window(path), plan, elapsed=0.02)
        _safe(plan)
        words.append(plan.status[0])
    assert words[0] == "diverged:kept"
    assert words[-1] == "diverged:hover"


def test_rows_of_a_batch_are_in_trouble_alone(declared: System, path: Reference) -> None:
    controller = controller_of(declared, batch=3)
    x = _state(path).repeat(3, 1)
    window = _window(path).repeat(3, 1, 1)
    plan = controller.plan(x, window)
    bad = x.clone()
    bad[1] = float("nan")
    after = controller.plan(bad, window, plan, elapsed=0.02)
    _safe(after)
    assert after.status[1] == "bad_state:kept"
    assert after.status[0] == after.status[2] == "converged"


def test_soft_limits_and_input_rates_change_the_plan(declared: System, path: Reference) -> None:
    def plan(**options: object) -> Plan:
        problem = ProblemOptions(steps=10, **options)  # type: ignore[arg-type]
        solver = SolverOptions(compile="off", iterations=8)
        return Controller(declared, problem=problem, solver=solver).plan(_state(path), _window(path))

    free, slow, smooth = plan(), plan(speed_limit=2.0, limit_weight=1000.0), plan(rate_weight=50.0)
    assert float(slow.x[0, 5:, 3:6].norm(dim=1).max()) < float(free.x[0, 5:, 3:6].norm(dim=1).max()) - 0.3
    assert float(smooth.u.diff(dim=1).square().sum()) < 0.5 * float(free.u.diff(dim=1).square().sum())


def test_wrong_shapes_are_refused_with_what_is_expected(controller: Controller, path: Reference) -> None:
    with pytest.raises(ShapeError, match="batch=1, nx=13"):
        controller.plan(torch.zeros(13), _window(path))
    with pytest.raises(ShapeError, match="steps=10"):
        controller.plan(_state(path), _window(path)[:, :5])


def test_rates_are_those_that_the_plan_expects_ahead_and_thrust_is_that_of_its_inputs(
    controller: Controller, path: Reference
) -> None:
    plan, machine = controller.plan(_state(path), _window(path)), controller.predictor.system
    assert isinstance(machine, Multirotor)
    rates, thrust = setpoints(plan, machine, ahead=0.1)
    assert torch.allclose(rates, plan.x[:, 1:, 10:13])
    gain, offset = machine.value("thrust_gain"), machine.value("thrust_offset")
    assert torch.allclose(thrust, gain * plan.u.sum(2) + offset)
    between = setpoints(plan, machine, ahead=0.05)[0][:, 0]
    assert torch.allclose(between, 0.5 * (plan.x[:, 0, 10:13] + plan.x[:, 1, 10:13]))
