"""What feedback may hide: which effects count beside it, and what is sure behind smoothers."""

from dataclasses import replace
from typing import Any, cast

import pytest

from nsde_torch.diagnosis.decisions import Options
from nsde_torch.diagnosis.evidence import filtered_log, joint_nats_by_channel, nats_by_channel
from nsde_torch.diagnosis.feedback_bias import (
    FeedbackBiased,
    allowances,
    behind_smoothers,
    chance_beyond,
    lengths_of_parameters,
    with_suspects,
)
from nsde_torch.diagnosis.joint_selection import JointSearch, fitted_at
from nsde_torch.diagnosis.search import Search
from nsde_torch.inference import LogLikelihood
from nsde_torch.sysid import feedback_test
from nsde_torch.sysid.feedback_test import FACTOR, Answer, FeedbackTest, leaning
from nsde_torch.systems import make_system
from tests.helpers.diagnosed import recorded
from tests.helpers.rate_loops import CONTROLLERS, RateLoop, fly
from tests.helpers.tyres import LAG, TRUTH, Tyre, drives
from tests.inference.springs import linear_runs

DRIVEN = {"the input of w_x": ("w_x",), "the input of w_z": ("w_z",)}


def loop(*, own: float, elsewhere: float, upper: float = 0.002, between: float = 5.0) -> FeedbackTest:
    """A loop whose inputs answer the channel that they drive, and another one, by these shares."""
    ways = list(DRIVEN.items())
    answers = tuple(
        Answer(way, channel, share, 1e-9 if share else 1.0)
        for way, (own_channel,) in ways
        for channel, share in ((own_channel, own), ("v_y", elsewhere))
    )
    knowledge = tuple(Answer(way, c, 0.0, 0.5, upper=upper) for way, (c,) in ways)
    return FeedbackTest(answers, knowledge, driven=DRIVEN, rows=10_000, between={"w_x": between, "w_z": 1.0})


def test_inputs_that_answer_other_channels_alone_were_made_from_other_sensors() -> None:
    test = loop(own=0.001, elsewhere=0.3)
    assert test.other_sensors == ("w_x", "w_z")
    assert test.hidden["w_x"] ** 2 == pytest.approx(FACTOR**2 * 10_000 * 0.002)
    assert "other sensors" in " ".join(test.findings)
    # what moves between rows counts where it is more
    assert loop(own=0.001, elsewhere=0.3, between=30.0).hidden["w_x"] ** 2 == pytest.approx(900.0)


def test_what_inputs_predict_in_a_closed_loop_may_be_what_an_effect_explains() -> None:
    test = loop(own=0.3, elsewhere=0.3)
    assert test.not_from_the_log == ()
    surely = Answer("the input of w_x", "w_x", 0.004, 1e-6, upper=0.006)
    test = replace(test, knowledge=(*test.knowledge, surely))
    assert test.other_sensors == ()
    assert test.not_from_the_log == ("w_x",)
    assert replace(test, answers=()).not_from_the_log == ()  # an open loop: what is missing is physics
    new = replace(test, new={"the input of w_x": 0.9})
    assert new.not_from_the_log == ("w_x",)  # the noise of the controller's own sensors is new
    others = tuple(a for a in test.answers if a.input != "the input of w_x")
    assert replace(new, answers=others).not_from_the_log == ()  # it answers nothing: no controller made it


def test_an_effect_counts_by_what_it_brings_beyond_what_may_be_hidden() -> None:
    allowed = {"w_x": 180.0}
    assert chance_beyond({"w_x": 150.0, "w_y": 0.0}, ["w_x"], allowed, 1) == pytest.approx(1.0)
    assert chance_beyond({"w_x": 260.0}, ["w_x"], allowed, 1) < 1e-12
    # of an effect that moves another channel too, that one shows it
    assert chance_beyond({"w_x": 150.0, "v_y": 60.0}, ["w_x", "v_y"], allowed, 2) < 1e-9
    assert "data.instruments" in FeedbackBiased("angular_damping", ("w_x",)).reason


def test_an_effect_is_bent_by_inputs_between_rows_as_far_as_it_leans_along_them() -> None:
    product = "force = c1 q q_dot"
    system = make_system("mass_spring_damper")
    runs = recorded("mass_spring_damper", durations=(8.0,) * 3).runs
    with_product = system.with_effects(system.make_effect(product, {"c1": 0.1}))
    fitted = Search(system, runs, 1.0, Options()).quick(with_product)
    lean = dict(zip(fitted.vector.labels, leaning(fitted)[0], strict=True))
    assert lean["force_gain"] > 0.5
    assert lean[f"{product}.c1"] < 0.6 * lean["force_gain"]

    way = "force"
    answers = (Answer(way, "q_dot", 0.001, 1e-9),)
    test = FeedbackTest(answers, (), driven={way: ("q_dot",)}, rows=1000, between={"q_dot": 30.0})
    lengths = lengths_of_parameters(test, fitted)
    (own,) = fitted.vector.of(product)
    assert allowances(lengths, [own])["q_dot"] == pytest.approx((30.0 * lean[f"{product}.c1"]) ** 2)
    # so does what inputs know of a step
    knows = replace(test, knowledge=(Answer(way, "q_dot", 0.0, 0.5, upper=0.4),))
    assert allowances(lengths_of_parameters(knows, fitted), [own])["q_dot"] == pytest.approx(
        FACTOR**2 * 400 * lean[f"{product}.c1"] ** 2
    )
    assert lengths_of_parameters(FeedbackTest(), fitted) == {}


@pytest.mark.slow
def test_a_lag_is_suspected_beside_what_was_found_without_it() -> None:
    system = make_system("mass_spring_damper")
    runs = linear_runs(3, 8.0, seed=1, lag=0.08)
    search = Search(system, runs, 1.0, Options())
    some = behind_smoothers(search, system)
    found = JointSearch(some, LogLikelihood(system, runs, run_in=True), system).selected()
    assert not {"input_delay", "actuator_lag"} & set(found.selected)
    assert with_suspects(replace(found, selected={}), search, system).suspected == ()
    found = replace(found, selected={"coulomb_friction": cast(Any, None)})
    assert set(with_suspects(found, search, system).suspected) & {"input_delay", "actuator_lag"}


def test_noise_of_one_state_in_another_is_no_feedback() -> None:
    data = drives(1)
    alone = Tyre(values=TRUTH)
    true = alone.with_effects(alone.make_effect("actuator_lag", LAG))
    search = Search(alone, data.runs, 1.0, Options())
    problem = LogLikelihood(alone, data.runs, run_in=True)
    right, wrong = (fitted_at(problem.of(system), system, None) for system in (true, alone))
    regression = search.at(right)
    log = filtered_log(right, regression)
    assert feedback_test.tested(regression, data.runs, None).predictive
    assert not feedback_test.tested(regression, data.runs, log).predictive
    gained = joint_nats_by_channel(wrong, right, ["v", "rim"])
    assert gained["rim"] > 50.0
    assert sum(gained.values()) == pytest.approx(right.best.likelihood - wrong.best.likelihood, rel=0.02)
    assert nats_by_channel(search.at(wrong), regression)["rim"] < 0.0


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_an_input_was_made_of_the_log_where_that_explains_it_better_than_the_filter(controller: str) -> None:
    loop = RateLoop()
    (runs,) = fly(controller, seeds=range(1), seconds=30.0)
    place = fitted_at(LogLikelihood(loop, runs, run_in=True), loop, None)
    regression = Search(loop, runs, 1.0, Options()).at(place)
    test = feedback_test.tested(regression, runs, filtered_log(place, regression))
    assert test.logged == (("u",) if controller == "logged" else ())
