"""Runs left out judge an effect by its own channels, step by step, and not by predictions under replayed inputs."""

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from nsde_torch.diagnosis.cross_validation import HeldOut, Scored, one_step
from nsde_torch.diagnosis.decision import judged_on_runs_left_out, sized
from nsde_torch.diagnosis.decisions import Options
from nsde_torch.diagnosis.joint_selection import Evidence
from nsde_torch.diagnosis.outcome import Estimate, Found, Outcome
from nsde_torch.diagnosis.reading import Log, not_sure
from nsde_torch.diagnosis.residual_tests import Dependence
from nsde_torch.sysid.regression import Regression
from nsde_torch.systems import make_system
from tests.helpers.diagnosed import diagnosed

SPRING = "mass_spring_damper"
NONE = cast(Regression, None)


def found_of(name: str, *moves: str) -> Found:
    return Found(name, Evidence(100.0, 5.0, 1e-9), (), moves=moves)


def test_the_gain_of_the_log_likelihood_is_the_sum_over_steps_and_its_interval_holds() -> None:
    system, inside = make_system(SPRING), 0
    run, t, none = np.arange(400) // 200, np.tile(np.arange(200) / 10.0, 2), np.zeros((400, 1))
    for seed in range(60):
        rng = np.random.default_rng(seed)
        after = 0.3 + np.repeat(rng.normal(size=(40, 1)), 10, 0)  # what lasts for a second
        first, second = (Scored(("q_dot",), ("m/s2",), d, run, t, none, run, t) for d in (none, after))
        content = one_step(first, second, system, seed=0)
        assert content["nats"] == pytest.approx(after.sum())
        inside += content["low_90"] <= 0.3 * 400 <= content["high_90"]
    assert 48 <= inside <= 60


def test_a_residual_that_grows_on_one_channel_doubts_what_acts_there_though_it_explains_another() -> None:
    def judged(ratio: float, *, inputs: bool = True) -> list[str]:
        grows = {"low_90": 0.05, "high_90": 0.1, "ratio": ratio}
        falls = {"low_90": -0.2, "high_90": -0.1, "ratio": 0.1}
        errors = HeldOut({"residual": {"surge": grows, "yaw": falls}}, True, ("a", "b"), {}, inputs)
        both = [found_of("lag", "surge", "yaw"), found_of("ripple", "yaw")]
        first = Outcome("effect_found", NONE, NONE, both, None)
        return [f.provisional for f in judged_on_runs_left_out(first, errors).found]

    assert judged(1.4) == ["the residual of surge on runs left out is larger with the effects", ""]
    assert judged(1.02) == ["", ""], "as of right effects where a controller answers gusts"
    assert judged(1.4, inputs=False) == ["", ""]


def test_no_change_at_a_moment_is_sure_where_the_residual_depends_on_time() -> None:
    found = [found_of(name, "q_dot") for name in ("run_difference[gain]", "coulomb_friction")]
    left = [Dependence("q_dot", "time", 1e-6, 0.05, 0.5, 40.0, 4)]
    outcome = Outcome("effect_found", NONE, NONE, found, None, structured=left)

    def judged(moments: dict[str, tuple[tuple[float, float], ...]], of: Outcome = outcome) -> list[str]:
        log = cast(Log, SimpleNamespace(runs=[SimpleNamespace(inferred=())], moments=moments))
        return [f.provisional for f in not_sure(log, of).found]

    assert judged({"run_0": ((15.4, 17.6),)}) == [
        "the residual still depends on time: it may change slowly",
        "",
    ]
    assert judged({"run_0": ((15.4, 17.6),)}, replace(outcome, structured=[])) == ["", ""]
    assert judged({}) == ["", ""], "a number of its own for a run, from its start to its end"


@pytest.mark.parametrize(
    ("low", "slowest", "why"),
    [
        (0.0, 0.9, "beside it all that is declared may be nothing"),
        (0.3, 0.9, ""),
        (0.3, 0.1, "it may hardly resonate: an inertia 70% larger"),
    ],
)
def test_what_is_beside_physics_that_may_be_nothing_or_swings_at_any_frequency_is_provisional(
    low: float, slowest: float, why: str
) -> None:
    class Estimated(Outcome):
        def estimated(self, columns: Sequence[int]) -> list[Estimate]:
            both = [Estimate("gain", 1.0, 0.0, 7.0, "1", "below"), Estimate("damping", 1.0, low, 3.0, "1")]
            both[1] = replace(both[1], bound=None if low else "below")
            swing = Estimate("hidden_mass.frequency", 1.0, slowest, 1.1, "Hz")
            return [([*both, Estimate("hidden_mass.mass", 0.7, 0.4, 1.0, "1"), swing])[j] for j in columns]

    vector = SimpleNamespace(labels=["gain", "damping"])
    declared = cast(Regression, SimpleNamespace(vector=vector))
    system = make_system(SPRING, effects=["hidden_mass"])
    labels = ["gain", "damping", "hidden_mass.mass", "hidden_mass.frequency"]
    final = SimpleNamespace(labels=labels, of=lambda name: [2, 3], system=system)
    last = cast(Regression, SimpleNamespace(vector=final))
    outcome = Estimated("effect_found", declared, last, [found_of("hidden_mass")], None)
    said = sized(outcome).found[0].provisional
    assert said.startswith(why)
    assert bool(said) == bool(why)


@pytest.mark.slow
def test_what_makes_no_residual_smaller_where_structure_is_left_explains_nothing() -> None:
    few = Options(candidates=("coulomb_friction",))
    found = diagnosed(SPRING, {"coulomb_friction": {"size": 0.5}}, options=few)[0]
    errors, outcome = found.errors, found.outcome
    (channel,) = outcome.found[0].moves
    assert errors.smaller({channel})
    left = replace(outcome, structured=[Dependence(channel, "q", 1e-6, 0.05, 0.5, 40.0, 4)])
    assert judged_on_runs_left_out(left, errors) == left, "its residual is smaller"
    none = errors.content | {"residual": {channel: {"low_90": -0.01, "high_90": 0.01}}}
    same = replace(errors, content=none)
    judged = judged_on_runs_left_out(outcome, same)
    assert judged.verdict == "effect_found", "nothing is left"
    assert "no smaller with what was found" in judged.found[0].provisional
    unmeasured = replace(same, inferred=(channel,))
    assert judged_on_runs_left_out(outcome, unmeasured) == outcome, "no sensor measured the rate"
    judged = judged_on_runs_left_out(left, same)
    assert judged.verdict == "unexplained"
    assert "no smaller with what was found" in judged.found[0].provisional
    grown = {channel: {"low_90": 0.1, "high_90": 0.2, "ratio": 1.3}}
    more = replace(errors, content=errors.content | {"residual": grown})
    judged = judged_on_runs_left_out(outcome, more)
    assert judged.verdict == "unexplained"
    assert "is larger with the effects" in judged.found[0].provisional
