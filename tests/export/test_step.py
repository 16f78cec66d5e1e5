"""The exported step does what the controller does, whatever happens, and its stages are graphs."""

import itertools

import pytest
import sympy
import torch

from nsde_torch.control.reference import Reference
from nsde_torch.errors import ConfigError
from nsde_torch.export.ahead import quick_indices
from nsde_torch.export.graph import graph_of
from nsde_torch.export.layout import STATUS
from nsde_torch.export.step import STAGES, WHOLE, packed
from nsde_torch.models import NeuralSDE
from nsde_torch.systems import System
from tests.helpers.exported import all_kinds, flight, small_controller, step_of, word_of


@pytest.mark.slow
def test_sample_after_sample_graphs_of_the_step_do_what_the_controller_does(
    model: NeuralSDE, path: Reference
) -> None:
    controller = small_controller(model)
    step = step_of(controller, model)
    stages = {name: graph_of(step.stage(name), e) for name, e in step.examples().items()}
    words = set()
    for arguments, plan in flight(controller, path):
        out = step.run(stages, *arguments)
        words.add(word_of(out, plan, most=1e-9))
        known = packed(plan, float(controller._jumped[0]), float(controller._solves))
        assert torch.allclose(out[9], known, atol=1e-8, equal_nan=True)
    assert all_kinds(words)


@pytest.mark.slow
def test_graphs_of_every_stage_give_its_numbers(declared: System) -> None:
    step = step_of(small_controller(declared, particles=2, steps=3), declared)
    for name, example in step.examples().items():
        graph = graph_of(step.stage(name), example)
        plain = step.stage(name)(*example)
        for ours, theirs in zip(graph(*example), plain, strict=True):
            assert torch.allclose(ours, theirs, rtol=1e-9, atol=1e-9, equal_nan=True), name
        assert set(STAGES) >= {name}


def test_the_rollout_as_one_stage_or_step_by_step_makes_the_same_plans(
    declared: System, path: Reference
) -> None:
    controller = small_controller(declared, particles=2)
    step = step_of(controller, declared)
    whole = {name: step.stage(name) for name in WHOLE}
    assert set(step.examples(WHOLE)) == set(WHOLE)
    for arguments, _ in itertools.islice(flight(controller, path), 6):
        one, other = step.run(whole, *arguments), step.run(step.stages, *arguments)
        assert all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


def test_a_plan_that_the_host_has_spoilt_is_none(declared: System, path: Reference) -> None:
    controller = small_controller(declared)
    step = step_of(controller, declared)
    arguments = step.first()
    cold = step.run(step.stages, *arguments)
    spoilt = cold[9].clone()
    spoilt[40] = torch.nan
    again = step.run(step.stages, *arguments[:-1], spoilt)
    assert torch.equal(cold[0], again[0])


def test_a_state_that_is_not_valid_is_bad_whatever_it_says(declared: System) -> None:
    step = step_of(small_controller(declared), declared)
    arguments = step.first()
    arguments[1] = torch.zeros((), dtype=torch.float64)
    out = step.run(step.stages, *arguments)
    assert STATUS[int(out[7])] == "bad_state:hover"
    assert all(bool(torch.isfinite(out[k]).all()) for k in (0, 1, 2, 3, 4))


def test_what_cannot_be_exported_is_refused(declared: System) -> None:
    with pytest.raises(ConfigError, match="gauss_newton"):
        step_of(small_controller(declared, solver="apg"), declared)


def test_indices_are_expanded_quickly_and_sympy_is_itself_again_afterwards() -> None:
    before, i = sympy.simplify, sympy.Symbol("i", integer=True)
    with quick_indices():
        assert sympy.simplify(3 * (i + 1) + 2 - 3 * i) == 5
        assert sympy.simplify(sympy.sin(i) ** 2 + sympy.cos(i) ** 2) == 1  # not a polynomial: as ever
    assert sympy.simplify is before
