"""Rates and thrust out of plans of motor commands."""

from __future__ import annotations

import pytest
import torch

from nsde_torch.control import shapes
from nsde_torch.control.controller import Controller
from nsde_torch.control.problem import ProblemOptions
from nsde_torch.control.reference import Reference
from nsde_torch.control.solve import SolverOptions
from nsde_torch.plants import make_plant_system
from nsde_torch.px4.predictive import PredictiveController


@pytest.fixture(scope="module")
def controller() -> Controller:
    system = make_plant_system("quadrotor", declared_only=True)
    return Controller(
        system,
        problem=ProblemOptions(horizon=0.5, steps=10),
        solver=SolverOptions(compile="off", iterations=4),
    )


def _row(**moved: float) -> tuple[float, ...]:
    x = torch.zeros(13)
    x[2], x[6] = 1.5, 1.0
    for name, value in moved.items():
        x[{"x": 0, "y": 1, "z": 2}[name]] += value
    return tuple(x.tolist())


def test_hovering_at_the_reference_asks_for_no_rates_and_for_the_weight(controller: Controller) -> None:
    made = PredictiveController(controller, Reference(shapes.hover()), lead=0.05)
    plan = made(_row(), 10.0, 1.0)
    demand = plan.at(10.0)
    assert demand.w == pytest.approx((0.0, 0.0, 0.0), abs=0.05)
    assert demand.thrust == pytest.approx(9.81, abs=0.5)
    assert plan.time == pytest.approx(9.95)
    assert plan.end > 10.3


def test_behind_the_reference_it_pitches_forward_and_below_it_climbs(controller: Controller) -> None:
    made = PredictiveController(controller, Reference(shapes.hover()), lead=0.1)
    behind = made(_row(x=-0.3), 10.0, 1.0)
    assert behind.at(10.0).w[1] > 0.1  # nose down is a positive rate about FLU y
    below = PredictiveController(controller, Reference(shapes.hover()), lead=0.0)(_row(z=-0.3), 10.0, 1.0)
    assert below.at(10.0).thrust > 10.5
