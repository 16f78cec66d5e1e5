"""The exported step does what the controller does, whatever happens; its graphs lose no value with operations."""

import itertools
from collections.abc import Callable, Sequence

import pytest
import sympy
import torch
from torch import Tensor

from nsde_torch.control.reference import Reference
from nsde_torch.errors import ConfigError
from nsde_torch.export.ahead import quick_indices
from nsde_torch.export.graph import graph_of
from nsde_torch.export.layout import STATUS
from nsde_torch.export.step import STAGES, WHOLE, ExportedStep, Stage, packed, run
from nsde_torch.models import NeuralSDE
from nsde_torch.systems import System
from tests.helpers.exported import all_kinds, flight, small_controller, step_of, word_of


def _stages(step: ExportedStep) -> dict[str, Stage]:
    return {name: step.stage(name) for name in STAGES}


@pytest.mark.slow
def test_sample_after_sample_graphs_of_the_step_do_what_the_controller_does(
    model: NeuralSDE, path: Reference
) -> None:
    controller = small_controller(model)
    step = step_of(controller, model)
    stages = {name: graph_of(step.stage(name), e) for name, e in step.examples().items()}
    words = set()
    for arguments, plan in flight(controller, path):
        out = run(stages, step.loops, *arguments)
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
        one, other = run(whole, step.loops, *arguments), run(_stages(step), step.loops, *arguments)
        assert all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


def test_a_plan_that_the_host_has_spoilt_is_none(declared: System, path: Reference) -> None:
    controller = small_controller(declared)
    step = step_of(controller, declared)
    arguments = step.first()
    cold = run(_stages(step), step.loops, *arguments)
    spoilt = cold[9].clone()
    spoilt[40] = torch.nan
    again = run(_stages(step), step.loops, *arguments[:-1], spoilt)
    assert torch.equal(cold[0], again[0])


def test_a_state_that_is_not_valid_is_bad_whatever_it_says(declared: System) -> None:
    step = step_of(small_controller(declared), declared)
    arguments = step.first()
    arguments[1] = torch.zeros((), dtype=torch.float64)
    out = run(_stages(step), step.loops, *arguments)
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


_X = torch.linspace(-1.0, 2.0, 35, dtype=torch.float64).view(5, 7)
_Y = torch.linspace(0.3, -4.0, 35, dtype=torch.float64).view(5, 7)
_M = torch.linspace(-1.0, 1.0, 49, dtype=torch.float64).view(7, 7)


def _cut_and_joined(x: Tensor, y: Tensor) -> Sequence[Tensor]:
    a, b, nothing = torch.cat((x, y), 1).split((7, 7, 0), 1)
    return a * b + torch.cat((nothing, x), 1), nothing + 1.0


def _cut_across(x: Tensor, y: Tensor) -> Sequence[Tensor]:
    a, b = torch.cat((x, y, x), 1).split((14, 7), 1)
    return torch.cat((a.sin(), b), 1), torch.cat((x, y), 1).split((3, 11), 1)[1]


@pytest.mark.parametrize(
    ("function", "gone", "left"),
    [
        (_cut_and_joined, {"split_with_sizes", "cat"}, {"mul", "add"}),
        (_cut_across, set(), {"cat", "sin", "split_with_sizes"}),
        (lambda x, y: (torch.cat((torch.cat((x, y), 1), x), 1),), set(), {"cat"}),
        (lambda x, y: (x + 0.5 * y, x - 3.0 * y, 2.0 * x - y), set(), {"add", "sub"}),
        (lambda x, y: (x + y @ _M, x[:1] + y @ _M), {"mm", "add"}, {"addmm"}),
    ],
)
def test_values_stay_and_operations_go(
    function: Callable[..., Sequence[Tensor]], gone: set[str], left: set[str]
) -> None:
    graph = graph_of(function, (_X, _Y))
    for ours, theirs in zip(graph(_X, _Y), function(_X, _Y), strict=True):
        assert torch.allclose(ours, theirs, rtol=1e-14, atol=1e-14)
    names = [str(n.target).split(".")[1] for n in graph.graph.nodes if str(n.target).startswith("aten.")]
    assert left <= set(names)
    assert not gone & set(names)
    plain = graph_of(function, (_X, _Y), few=False)
    assert len(names) <= len([n for n in plain.graph.nodes if str(n.target).startswith("aten.")])


def test_a_multiple_that_is_used_twice_is_kept() -> None:
    graph = graph_of(lambda x, y: ((z := 0.5 * y) + x, z.sin()), (_X, _Y))
    assert any("mul" in str(n.target) for n in graph.graph.nodes)
    assert torch.equal(graph(_X, _Y)[1], (0.5 * _Y).sin())
