"""States carried forward by what was asked for, and pushes learned from velocities, against motions worked by hand."""

from __future__ import annotations

from math import atan2, cos, radians, sin, tan

import pytest

from nsde_torch.control import shapes
from nsde_torch.control.controller import Controller
from nsde_torch.control.problem import ProblemOptions
from nsde_torch.control.reference import Reference
from nsde_torch.control.solve import SolverOptions
from nsde_torch.px4.flight.controller import Demand
from nsde_torch.px4.flight.predictive import NO_DRAG, PredictiveController, PushEstimate, carried
from nsde_torch.systems import make_plant_system

HOVERING = ((-1.0, Demand((0.0, 0.0, 0.0), 9.81)),)
PERIOD = 0.02


def _row(v: tuple[float, float, float], yaw: float = 0.0) -> tuple[float, ...]:
    return (0.0, 0.0, 1.5, *v, cos(0.5 * yaw), 0.0, 0.0, sin(0.5 * yaw), 0.0, 0.0, 0.0)


def _learned(estimate: PushEstimate, a: tuple[float, float, float], seconds: float, yaw: float = 0.0) -> None:
    """A level vehicle that is pushed by a constant acceleration `a` of the world while hovering is asked for."""
    for k in range(round(seconds / PERIOD)):
        t = k * PERIOD
        estimate.take(_row((a[0] * t, a[1] * t, a[2] * t), yaw), t, HOVERING)


def test_a_constant_push_is_learned_along_the_body_within_a_few_time_constants() -> None:
    estimate = PushEstimate(delay=0.08, drag=NO_DRAG, time=0.2, limit=4.0)
    _learned(estimate, (0.0, 0.8, -0.5), 1.0, yaw=radians(90.0))  # world's y is the body's x
    assert estimate.value == pytest.approx((0.8, 0.0, -0.5), abs=0.01)


@pytest.mark.parametrize(("drag", "wind"), [(0.6, 0.0), (0.0, 0.8), (0.6, 0.8)])
def test_braking_that_no_model_knows_is_told_from_a_steady_push(drag: float, wind: float) -> None:
    """To and fro at up to 3 m/s for 15 s: braking changes with the speed, and is known before the speed changes."""
    estimate = PushEstimate(delay=0.08, drag=NO_DRAG, time=0.2, limit=4.0)
    x = v = 0.0
    for k in range(round(15.0 / PERIOD)):
        t = k * PERIOD
        wanted = 3.0 * cos(1.5 * t)  # thrust leans as needed for that
        lean = atan2(-4.5 * sin(1.5 * t) + 2.0 * (wanted - v), 9.81)
        asked = ((t - 1.0, Demand((0.0, 0.0, 0.0), 9.81 / cos(lean))),)
        row = (x, 0.0, 1.5, v, 0.0, 0.0, cos(0.5 * lean), 0.0, sin(0.5 * lean), 0.0, 0.0, 0.0, 0.0)
        estimate.take(row, t, asked)
        x, v = x + PERIOD * v, v + PERIOD * (9.81 * tan(lean) + wind - drag * v)
    assert estimate.slopes[0] == pytest.approx(drag, abs=0.12)
    fast = estimate.at(_row((3.0, 0.0, 0.0)))
    assert fast[0] == pytest.approx(wind - 3.0 * drag, abs=0.35)


def test_what_a_model_says_of_drag_is_no_push() -> None:
    drag = ((0.5, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, 0.0, 0.5))
    estimate = PushEstimate(delay=0.08, drag=drag, time=0.2, limit=4.0)
    v = 2.0
    for k in range(100):
        estimate.take(_row((v, 0.0, 0.0)), k * PERIOD, HOVERING)
        v -= 0.5 * v * PERIOD
    assert estimate.value == pytest.approx((0.0, 0.0, 0.0), abs=0.02)


def test_a_push_is_bounded_forgotten_and_not_learned_across_a_silence() -> None:
    estimate = PushEstimate(delay=0.08, drag=NO_DRAG, time=0.2, limit=1.5)
    _learned(estimate, (5.0, 0.0, 0.0), 1.0)
    assert estimate.value == pytest.approx((1.5, 0.0, 0.0))
    estimate.take(_row((-20.0, 0.0, 0.0)), 3.0, HOVERING)
    assert estimate.value == pytest.approx((1.5, 0.0, 0.0))
    estimate.reset()
    assert estimate.value == (0.0, 0.0, 0.0)
    off = PushEstimate(delay=0.08, drag=NO_DRAG, time=0.0, limit=1.5)
    _learned(off, (1.0, 0.0, 0.0), 1.0)
    assert off.value == (0.0, 0.0, 0.0)


def test_a_state_carried_over_a_delay_knows_the_push() -> None:
    after = carried(_row((0.0, 0.0, 0.0)), 0.0, 0.1, HOVERING, delay=0.1, push=(1.0, 0.0, 0.5))
    assert after[3] == pytest.approx(0.1)
    assert after[5] == pytest.approx(0.05)
    assert after[0] == pytest.approx(0.005)


@pytest.mark.slow
def test_a_machine_that_is_pushed_forward_is_asked_to_lean_back_further_once_the_push_is_known() -> None:
    problem, solver = ProblemOptions(horizon=0.5, steps=10), SolverOptions(compile="off", iterations=4)
    known = Controller(make_plant_system("quadrotor", declared_only=True), problem=problem, solver=solver)
    asked = {}
    for time in (0.0, 0.2):
        made = PredictiveController(known, Reference(shapes.hover()), push_time=time)
        for k in range(15):
            plan = made(_row((0.02 * k, 0.0, 0.0)), k * PERIOD, k * PERIOD, HOVERING)
        asked[time] = plan.at(plan.time).w[1]
    assert asked[0.2] < asked[0.0] - 0.1
