"""The exported step does what the controller does, whatever happens; its graphs lose no value with operations."""

import itertools

import pytest
import torch

from nsde_torch.control.reference import Reference
from nsde_torch.errors import ConfigError
from nsde_torch.export.graph import graph_of
from nsde_torch.export.step import STAGES, STATUS, WHOLE, ExportedStep, Stage, packed, run
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
