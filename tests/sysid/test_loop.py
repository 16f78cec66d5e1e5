"""The test of feedback and estimates by instruments, on machines that NumPy flies and whose truth is known."""

import json
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from nsde_torch.data import Run
from nsde_torch.errors import DataError
from nsde_torch.sysid.feedback_test import Answer, FeedbackTest, feedback_summary, lengths
from nsde_torch.sysid.identify import identify_in_loop
from nsde_torch.sysid.instruments import adopted
from nsde_torch.sysid.regression import ITERATIONS, regression_of
from nsde_torch.sysid.result import Identification
from nsde_torch.sysid.signals import directions, score_tests
from tests.helpers.electric_motors import CoilMotor, follows
from tests.helpers.rate_loops import CONTROLLERS, GAIN, RateLoop, fly


@cache
def flown(controller: str, **how: Any) -> list[Run]:
    return fly(controller, seeds=range(1), **how)[0]


@cache
def plain(controller: str) -> Identification:
    return identify_in_loop(RateLoop(), flown(controller))


def holds(found: Identification) -> bool:
    return bool(abs(found.values[0] - GAIN) <= found.half_widths(0.99)[0])


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_the_loop_is_closed_where_it_is_and_intervals_hold_what_it_hides(controller: str) -> None:
    found, hides = plain(controller), controller in ("other", "fast")
    assert found.loop.closed == (controller != "open")
    # inputs predict innovations only where the controller saw more than the log
    assert found.loop.predictive == hides
    assert holds(found)
    assert (found.doubt[0] > 0) == hides


def test_the_widening_is_needed_and_said() -> None:
    found = plain("fast")
    assert abs(found.values[0] - GAIN) > 4 * found.standard_errors[0]
    assert any("widened" in sentence for sentence in found.of_the_loop)
    answer = plain("logged").loop.answers[0]
    assert answer.within_s == pytest.approx(0.01)  # the controller acts on what it sees at once
    assert answer.share > 0.2


def test_a_lag_that_is_not_declared_is_told_too_and_is_silent_once_it_is() -> None:
    runs = flown("logged", lag=True)
    assert feedback_summary(RateLoop(), runs).predictive
    assert not feedback_summary(RateLoop(effects=["actuator_lag"]), runs).predictive


def test_the_stick_finds_the_gain_that_ordinary_estimates_miss() -> None:
    found = identify_in_loop(RateLoop(), flown("other"), instruments=["stick", "idle"])
    assert adopted(found.instrumented, found.loop)
    assert found.instrumented.differs
    assert not found.instrumented.refused
    assert found.half_widths(0.9)[0] < 6
    assert holds(found)
    assert found.values[0] == pytest.approx(GAIN, rel=0.03)  # the ordinary one: 84


def test_a_signal_that_moves_nothing_is_weak_and_the_ordinary_estimate_stays() -> None:
    found = identify_in_loop(RateLoop(), flown("other"), instruments=["idle"], likelihood=False)
    assert not found.instrumented.moved.any()
    assert found.values[0] == found.instrumented.ordinary[0]
    assert found.doubt[0] > 0


def test_a_stick_that_answers_the_machine_is_refused_by_name() -> None:
    runs = flown("logged", pilot=True)
    found = identify_in_loop(RateLoop(), runs, instruments=["stick"])
    assert "not exogenous" in found.instrumented.refused["stick"]
    assert any("instrument stick is not used" in sentence for sentence in found.of_the_loop)


def test_instruments_tell_a_missing_lag_and_are_then_not_printed() -> None:
    runs = flown("logged", lag=True)
    found = identify_in_loop(RateLoop(), runs, instruments=["stick"])
    assert found.instrumented.unexplained < 1e-6
    assert found.values[0] == found.instrumented.ordinary[0]
    assert holds(found)


def test_inputs_that_are_a_function_of_the_state_are_said_to_show_no_gain() -> None:
    runs = flown("logged", stick=0.0)
    loop = feedback_summary(RateLoop(), runs)
    assert loop.functions_of_state == ("u",)
    assert any("its gain is not identifiable" in sentence for sentence in loop.findings)
    found = identify_in_loop(RateLoop(), runs)
    assert np.isnan(found.half_widths(0.9)).all()  # it says 22, and is sure of it, where the truth is 100
    json.dumps(found.as_dict(), allow_nan=False)


def test_instruments_that_are_missing_or_never_change_are_errors() -> None:
    run = flown("open")[0]
    with pytest.raises(
        DataError, match="names 'sticks', which run 'run_0' does not have; further columns: idle, stick"
    ):
        identify_in_loop(RateLoop(), [run], instruments=["sticks"])
    still = replace(run, extra={"stick": np.ones(len(run))})
    with pytest.raises(DataError, match="never changes"):
        identify_in_loop(RateLoop(), [still], instruments=["stick"])


def test_chances_of_the_score_test_are_even_where_nothing_predicts_anything() -> None:
    rng = np.random.default_rng(0)
    chances = []
    for _ in range(400):
        size = np.exp(rng.standard_normal(500))  # uneven noise
        fitted = np.linalg.qr(rng.standard_normal((500, 3)))[0]
        noise = size[:, None] * rng.standard_normal((500, 1))
        chances.append(score_tests(noise, rng.standard_normal((500, 4)), fitted)[0][0])
    assert np.mean(np.array(chances) < 0.1) == pytest.approx(0.1, abs=0.045)
    e = rng.standard_normal((500, 1)) + 0.3 * fitted[:, :1] * 500**0.5
    assert score_tests(e, fitted[:, :1], np.zeros((500, 0)))[0][0] < 1e-6
    assert score_tests(e, fitted[:, :1], fitted)[0][0] == 1.0


def _dithered(seed: int, *, gain: float) -> list[Run]:
    """A rate under sines and steps, and a controller with a gyroscope of its own; damping and drag are missing."""
    rng, dt, rows, out = np.random.default_rng(seed), 0.01, 4000, []
    for name in ("a", "b", "c"):
        t = dt * np.arange(rows)
        waves = np.sin(np.outer(t, 2.0 * np.pi * rng.uniform(0.05, 2.0, 7)) + rng.uniform(0.0, 6.0, 7)).sum(1)
        dither = 0.1 * waves + 0.1 * np.repeat(rng.standard_normal(rows // 28 + 1), 28)[:rows]
        x, u = np.zeros((rows, 2)), np.zeros(rows)
        for k in range(rows):
            u[k] = dither[k] - gain * (x[k, 1] + 0.02 * rng.standard_normal())
            if k + 1 < rows:
                push = (
                    GAIN * u[k] - 4.0 * x[k, 1] - 2.0 * x[k, 1] * abs(x[k, 1]) + 5.0 * rng.standard_normal()
                )
                x[k + 1] = x[k, 0] + dt * x[k, 1] + 0.5 * dt**2 * push, x[k, 1] + dt * push
        seen = x + np.array([0.003, 0.02]) * rng.standard_normal(x.shape)
        out.append(Run(name, t, seen, u[:, None], ((0, rows),)))
    return out


def test_a_weak_controller_beside_a_dither_hides_little() -> None:
    regression = regression_of(RateLoop(), _dithered(3, gain=0.05))
    regression.run(ITERATIONS)
    ways = directions(regression)
    whole, little = (lengths(regression, ways, [share])["rate"] for share in (1.0, 1e-4))
    assert little == pytest.approx(0.05 * whole)
    assert feedback_summary(RateLoop(), _dithered(3, gain=0.05)).between["rate"] < 0.9 * whole


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_sines_and_steps_that_nothing_controls_are_an_open_loop_whatever_is_missing(seed: int) -> None:
    assert not feedback_summary(RateLoop(), _dithered(seed, gain=0.0)).closed


@pytest.mark.parametrize("friction", [0.0, 15.0])
def test_a_speed_that_a_voltage_moves_within_a_row_is_answered_from_the_log(friction: float) -> None:
    # the voltage drives the current, which settles in 1 ms of a row of 10, and answers angle and speed
    loop = feedback_summary(CoilMotor(), follows(1, 1000.0, friction=friction).runs)
    assert loop.closed
    assert loop.other_sensors == ()


def test_an_input_that_answers_nothing_has_no_controller_with_other_sensors() -> None:
    """Weather, which the wall of a room follows, beside a heater that a thermostat sets by the logged room."""
    answers = (Answer("heater", "room", 0.03, 1e-9), Answer("weather", "wall", 0.0, 1.0))
    driven = {"heater": ("room",), "weather": ("wall",)}
    new = {"heater": 0.1, "weather": 0.3}
    found = FeedbackTest(answers=answers, driven=driven, new=new, made=("heater",))
    assert found.closed
    assert found.other_sensors == ()
    assert replace(found, made=("heater", "weather")).other_sensors == ("wall",)
