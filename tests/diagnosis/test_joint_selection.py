"""Effects are selected together, by the likelihood of the whole machine."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt

from nsde_torch.data import Run
from nsde_torch.diagnosis.decisions import Options
from nsde_torch.diagnosis.joint_selection import JointSearch, JointSelection
from nsde_torch.diagnosis.search import Search
from nsde_torch.inference import LogLikelihood
from nsde_torch.systems import make_system
from tests.helpers.diagnosed import diagnosed, recorded
from tests.inference.springs import linear_runs, rubbing, small_runs

STRIBECK = {"k": 5.06, "b": 0.5, "g": 1.0}
"""Beside these values a Stribeck friction without a dry part explains dry and quadratic friction nearly as well."""


def selected(runs: list[Run]) -> JointSelection:
    system = make_system("mass_spring_damper")
    search = Search(system, runs, 1.0, Options())
    return JointSearch(search, LogLikelihood(system, runs, run_in=True), system).selected()


def two_frictions(seed: int, seconds: float = 8.0) -> list[Run]:
    effects = {"coulomb": {"size": 0.231}, "quadratic": {"size": 0.224}}
    machine = replace(rubbing(0.0), values=STRIBECK, effects=effects, noise=(0.001, 0.003), gust=0.02)
    return small_runs(machine, 4, seconds, seed=seed)


def test_two_frictions_of_one_speed_are_both_selected_with_their_sizes() -> None:
    found = selected(two_frictions(seed=1))
    assert set(found.selected) == {"coulomb_friction", "quadratic_damping"}
    best = found.final.best
    known = dict(zip(best.vector.labels, zip(best.theta, best.standard_errors, strict=True), strict=True))
    sizes = {"coulomb_friction.size": 0.231, "quadratic_damping.damping": 0.224}
    for effect, true in {**sizes, "viscous_friction.damping": 0.5}.items():
        value, error = known[effect]
        assert value == pytest.approx(true, abs=3.0 * error)
        assert error < 0.2 * true


@pytest.mark.slow
def test_a_delay_is_selected_whose_lack_hides_the_gain_of_the_input() -> None:
    late = 13  # rows; forces of ten rows each are white from there
    runs = [Run(r.name, r.t[:-late], r.x[:-late], r.u[late:]) for r in linear_runs(4, 8.0, seed=1)]
    found = selected(runs)
    assert set(found.selected) == {"input_delay"}
    known = dict(zip(found.final.best.vector.labels, found.final.best.theta, strict=True))
    assert known["input_delay.delay"] == pytest.approx(late * 0.02, abs=0.002)
    assert known["force_gain"] == pytest.approx(1.3, rel=0.03)


@pytest.mark.slow
def test_friction_is_selected_in_states_without_what_lies_above_a_frequency() -> None:
    band = 8.0
    runs = []
    for run in small_runs(rubbing(0.2), 4, 16.0, seed=2):
        x = np.column_stack([sosfiltfilt(butter(8, band, fs=1.0 / run.dt, output="sos"), c) for c in run.x.T])
        runs.append(replace(run, x=x, low_pass={"q": band, "q_dot": band}, segments=((50, len(x) - 50),)))
    found = selected(runs)
    assert set(found.selected) == {"coulomb_friction"}
    assert found.final.at.of.space.every == [7, 7]  # rows of 20 ms, below 0.85 of the band
    at = found.final.best.vector.labels.index("coulomb_friction.size")
    assert found.final.best.theta[at] == pytest.approx(0.2, abs=3.0 * found.final.best.standard_errors[at])
    # as they are, increments that are gone above the band contradict any noise
    assert selected([replace(run, low_pass={}) for run in runs]).final.best.misfit


@pytest.mark.slow
def test_a_law_that_is_likelier_than_an_effect_takes_its_place() -> None:
    # a quadratic damping below 0 is in no catalogue, and much like a dry friction that no speed of the log develops
    machine = replace(rubbing(0.0), effects={"quadratic": {"size": -0.04}})
    found = selected(small_runs(machine, 4, 12.0, seed=3))
    assert set(found.selected) == {"force = c1 abs(q_dot) q_dot"}
    assert found.final.best.theta[-1] == pytest.approx(0.04, abs=2.0 * found.final.best.standard_errors[-1])


FEW = {"variants": 2, "rounds": 1}
"""Pilots to choose a flight of: what it flies matters little here."""


def test_a_flight_with_drag_is_selected_by_the_likelihood() -> None:
    effect = {"linear_drag": {"drag": [0.35, 0.3, 0.15]}}
    runs = recorded("hexacopter", effect, seed=8, durations=(10.0,), plant=FEW).runs
    system = make_system("hexacopter")
    options = Options(candidates=("linear_drag", "quadratic_drag"))
    search = Search(system, runs, 1.0, options)
    found = JointSearch(search, LogLikelihood(system, runs, run_in=True), system).selected()
    assert set(found.selected) == {"linear_drag"}
    values = dict(zip(found.final.best.vector.labels, found.final.best.theta, strict=True))
    assert values["linear_drag.drag[0]"] == pytest.approx(0.35, abs=0.06)


@pytest.mark.slow
def test_a_steady_push_is_no_gust_that_never_ends() -> None:
    found = selected(linear_runs(1, 30.0, gust=0.05, lasts=1e9, white=0.005, seed=2))
    assert set(found.selected) == {"constant_force"}
    first = found.rounds[0].look[0]
    assert first.name == "constant_force"
    assert first.nats > 10.0  # 1.2 beside a gust of 81 s


def test_a_candidate_is_looked_for_from_each_of_its_starts() -> None:
    few = Options(candidates=("actuator_saturation", "asymmetric_saturation", "actuator_deadband"))
    _, content = diagnosed("mass_spring_damper", {"actuator_saturation": {"level": 0.9}}, options=few)
    assert content["added"] == ["actuator_saturation"]
