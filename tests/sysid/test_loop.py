"""The test of feedback and estimates by instruments, on machines that NumPy flies and whose truth is known."""

import json
from dataclasses import replace

import numpy as np
import pytest

from nsde_torch.data import Run
from nsde_torch.errors import DataError
from nsde_torch.sysid.feedback_test import feedback_summary, lengths
from nsde_torch.sysid.identify import identify_in_loop
from nsde_torch.sysid.instruments import adopted
from nsde_torch.sysid.regression import ITERATIONS, regression_of
from nsde_torch.sysid.result import Identification
from nsde_torch.sysid.signals import directions, score_tests
from tests.helpers.rate_loops import CONTROLLERS, GAIN, RateLoop, fly

SEEDS = range(1)
Flights = dict[str, list[list[Run]]]


@pytest.fixture(scope="module")
def flights() -> Flights:
    return {c: fly(c, seeds=SEEDS) for c in CONTROLLERS}


@pytest.fixture(scope="module")
def plain(flights: Flights) -> dict[str, list[Identification]]:
    return {c: [identify_in_loop(RateLoop(), r) for r in flights[c]] for c in CONTROLLERS}


def holds(found: Identification) -> bool:
    return bool(abs(found.values[0] - GAIN) <= found.half_widths(0.99)[0])


@pytest.mark.slow
def test_the_loop_is_closed_where_it_is_and_open_where_it_is_not(
    plain: dict[str, list[Identification]],
) -> None:
    for controller, found in plain.items():
        assert all(f.loop is not None and f.loop.closed == (controller != "open") for f in found), controller
    loop = plain["logged"][0].loop
    assert loop.answers[0].within_s == pytest.approx(0.01)  # the controller acts on what it sees at once
    assert loop.answers[0].share > 0.2


def test_inputs_predict_innovations_only_where_the_controller_saw_more_than_the_log(
    plain: dict[str, list[Identification]],
) -> None:
    for controller, found in plain.items():
        told = controller in ("other", "fast")
        assert all(f.loop is not None and f.loop.predictive == told for f in found), controller


def test_intervals_hold_what_feedback_hides_and_are_not_widened_where_it_hides_nothing(
    plain: dict[str, list[Identification]],
) -> None:
    for controller, found in plain.items():
        assert all(holds(f) for f in found), controller
        assert all(
            f.doubt is not None and (f.doubt[0] > 0) == (controller in ("other", "fast")) for f in found
        )
    # without the widening they would not: it is needed
    assert all(abs(f.values[0] - GAIN) > 4 * f.standard_errors[0] for f in plain["fast"])
    assert any("widened" in sentence for sentence in plain["fast"][0].of_the_loop)


def test_a_lag_that_is_not_declared_is_told_too_and_is_silent_once_it_is() -> None:
    runs = fly("logged", seeds=range(1), lag=True)[0]
    assert feedback_summary(RateLoop(), runs).predictive
    assert not feedback_summary(RateLoop(effects=["actuator_lag"]), runs).predictive


def test_the_stick_finds_the_gain_that_ordinary_estimates_miss(flights: Flights) -> None:
    values = []
    for runs in flights["other"]:
        found = identify_in_loop(RateLoop(), runs, instruments=["stick", "idle"])
        i = found.instrumented
        assert found.loop is not None
        assert adopted(i, found.loop)
        assert i.differs
        assert not i.refused
        assert found.half_widths(0.9)[0] < 6
        assert holds(found)
        values.append(found.values[0])
    assert np.mean(values) == pytest.approx(GAIN, rel=0.03)  # ordinary ones: 84


def test_a_signal_that_moves_nothing_is_weak_and_the_ordinary_estimate_stays(flights: Flights) -> None:
    found = identify_in_loop(RateLoop(), flights["other"][0], instruments=["idle"], likelihood=False)
    assert not found.instrumented.moved.any()
    assert found.values[0] == found.instrumented.ordinary[0]
    assert found.doubt[0] > 0


def test_a_stick_that_answers_the_machine_is_refused_by_name() -> None:
    runs = fly("logged", seeds=range(1), pilot=True)[0]
    found = identify_in_loop(RateLoop(), runs, instruments=["stick"])
    assert "not exogenous" in found.instrumented.refused["stick"]
    assert any("instrument stick is not used" in sentence for sentence in found.of_the_loop)


def test_instruments_tell_a_missing_lag_and_are_then_not_printed() -> None:
    runs = fly("logged", seeds=range(1), lag=True)[0]
    found = identify_in_loop(RateLoop(), runs, instruments=["stick"])
    assert found.instrumented.unexplained < 1e-6
    assert found.values[0] == found.instrumented.ordinary[0]
    assert holds(found)


def test_inputs_that_are_a_function_of_the_state_are_said_to_show_no_gain() -> None:
    runs = fly("logged", seeds=range(1), stick=0.0)[0]
    loop = feedback_summary(RateLoop(), runs)
    assert loop.functions_of_state == ("u",)
    assert any("its gain is not identifiable" in sentence for sentence in loop.findings)
    found = identify_in_loop(RateLoop(), runs)
    assert np.isnan(found.half_widths(0.9)).all()  # it says 22, and is sure of it, where the truth is 100
    json.dumps(found.as_dict(), allow_nan=False)


def test_instruments_that_are_missing_or_never_change_are_errors(flights: Flights) -> None:
    run = flights["open"][0][0]
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
