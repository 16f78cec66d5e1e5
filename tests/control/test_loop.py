"""Closed loops: tracking, latency, pushes, lost machines."""

from collections.abc import Callable
from typing import Any

import pytest
import torch

from nsde_torch.control.autopilots import CascadePilot, EstimatorOptions, PredictivePilot
from nsde_torch.control.loop import Flight, fly, summarise
from nsde_torch.control.reference import Reference
from nsde_torch.control.shapes import hover, lemniscate
from nsde_torch.errors import ConfigError
from nsde_torch.models import NeuralSDE
from nsde_torch.simulation import make_plant
from nsde_torch.simulation.plant import LearnedPlant
from nsde_torch.systems import System, make_system
from tests.helpers.control_problems import controller_of

SHORT = Reference(lemniscate(duration=4.0, ramp=2.0, speed=2.0))


def _flight(
    declared: System,
    reference: Reference = SHORT,
    *,
    latency: float = 0.0,
    state_latency: float = 0.0,
    known: float | None = None,
    duration: float = 2.0,
    estimator: dict[str, float] | None = None,
    fault: Callable[[float, torch.Tensor], torch.Tensor] | None = None,
    **plant: object,
) -> Flight:
    given = {"declared_only": True, "process_noise": 0.0, "sensor_noise": 0.0, **plant}
    g = torch.Generator().manual_seed(0)
    machine = make_plant("hexacopter", generator=g, latency=latency, check=False, **given)  # type: ignore[arg-type]
    total = latency + state_latency if known is None else known
    times: dict[str, Any] = {
        "period": 0.04,
        "sample": machine.dt,
        "state_latency": 0.0 if known is not None else state_latency,
    }
    options = EstimatorOptions(latency=total, **{"force_time": 0.0, **(estimator or {})})
    pilot = PredictivePilot(controller_of(declared), declared, reference, estimator=options, **times)
    if fault is not None:
        command = pilot.command
        pilot.command = lambda t, x: command(t, fault(t, x))  # type: ignore[method-assign]
    return fly(pilot, machine, reference, state_latency=state_latency, duration=duration)


def _rmse(flight: Flight) -> float:
    found = summarise([flight], make_system("hexacopter"))["rmse_m"]
    assert isinstance(found, float)
    return found


def test_with_the_right_model_and_no_noise_tracking_is_within_a_few_centimetres(declared: System) -> None:
    flight = _flight(declared, duration=1.0)
    assert _rmse(flight) < 0.03
    assert {d.status[0] for d in flight.decisions} <= {"converged", "improved"}


@pytest.mark.slow
def test_latency_is_made_up_for_by_prediction(declared: System) -> None:
    late = {"latency": 0.03, "state_latency": 0.02}
    known, unknown = _flight(declared, **late), _flight(declared, **late, known=0.0)  # type: ignore[arg-type]
    assert _rmse(known) < 0.04
    assert _rmse(known) < 0.7 * _rmse(unknown)


@pytest.mark.slow
def test_a_push_that_lasts_is_learned_in_flight(declared: System) -> None:
    plain = {"duration": 3.0, "effects": [{"motor_efficiency_loss": {"loss": [0.1] * 6}}]}
    still = Reference(hover(duration=3.0))
    without = _flight(declared, still, **plain)  # type: ignore[arg-type]
    learned = _flight(declared, still, estimator={"force_time": 0.3}, **plain)  # type: ignore[arg-type]
    off = [abs(float(f.x[-1, 0, 2]) - 1.5) for f in (without, learned)]
    assert off[0] > 0.01
    assert off[1] < 0.4 * off[0]


def test_the_cascade_flies_the_same_references(declared: System) -> None:
    g = torch.Generator().manual_seed(0)
    machine = make_plant("hexacopter", generator=g, declared_only=True, check=False)
    pilot = CascadePilot(declared, SHORT, batch=2, period=machine.dt)
    flight = fly(pilot, machine, SHORT, machines=2, duration=2.0)
    assert _rmse(flight) < 0.2
    assert summarise([flight], make_system("hexacopter"))["lost"] == 0


@pytest.mark.slow
def test_a_learned_model_can_stand_for_the_machine(model: NeuralSDE) -> None:
    plant = LearnedPlant(model, dt=0.02, generator=torch.Generator().manual_seed(0), process_noise=0.2)
    pilot = PredictivePilot(controller_of(model), model, SHORT, period=0.04, sample=0.02)
    flight = fly(pilot, plant, SHORT, duration=1.0)
    assert _rmse(flight) < 0.1


@pytest.mark.slow
def test_a_machine_that_is_lost_is_counted_and_when(declared: System) -> None:
    def elsewhere(t: float, x: torch.Tensor) -> torch.Tensor:
        return torch.full_like(x, float("nan")) if t > 1.0 else x

    path = Reference(lemniscate(duration=6.0, ramp=1.0))
    flight = _flight(declared, path, fault=elsewhere, duration=5.0)
    found = summarise([flight], make_system("hexacopter"))
    assert found["lost"] == 1
    assert found["rmse_m"] is None
    assert 2.0 < found["flights"][0]["lost_s"] < 5.0


def test_times_that_do_not_fit_into_each_other_are_refused(declared: System) -> None:
    with pytest.raises(ConfigError, match="state_latency"):
        _flight(declared, state_latency=0.015, known=0.0)
