"""Small controllers for the tests of the export, and a flight with every kind of trouble."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from nsde_torch.control.controller import Controller, Plan, SafetyOptions
from nsde_torch.control.predictor import Predictor
from nsde_torch.control.problem import ProblemOptions
from nsde_torch.control.reference import Reference
from nsde_torch.control.solve import SolverOptions
from nsde_torch.export.step import N_HEAD, STATUS, ExportedStep, packed
from nsde_torch.export.write import export
from nsde_torch.models import NeuralSDE
from nsde_torch.systems import System

SAMPLE = 0.01


def made_with(
    *, dtype: torch.dtype = torch.float64, solver: str = "gauss_newton", **problem: Any
) -> dict[str, Any]:
    """What a controller of 6 steps is made with, in Python and in a file."""
    return {
        "problem": ProblemOptions(**{"horizon": 0.3, "steps": 6, **problem}),
        "solver": SolverOptions(name=solver, compile="off", iterations=3, tolerance=5e-3),
        "safety": SafetyOptions(),
        "dtype": dtype,
    }


def written(known: NeuralSDE | System, path: Path, **given: Any) -> Path:
    """A file of a controller, for a step of 20 ms and a latency of 40 ms if nothing else is given."""
    export(known, path, **{"sample": SAMPLE, "period": 0.02, "latency": 0.04, **given})
    return path


def step_of(controller: Controller, knowledge: NeuralSDE | System) -> ExportedStep:
    return ExportedStep(controller, Predictor(knowledge, dt=SAMPLE, dtype=controller.predictor.dtype))


def flight(controller: Controller, path: Reference) -> Iterator[tuple[list[Tensor], Plan]]:
    """What the controller is given along a path, as the step takes it, and the plans that it makes."""
    o, p = controller.options, controller.predictor
    g = torch.Generator().manual_seed(5)
    troubles = (
        *(None,) * 4,
        *("nan", "huge", "norm", "reference", None, "jump", "jump", "jump", "jump", None),
        *("elapsed", "last", "push", None, "gone", None),
        *("nan",) * 4,
        None,
    )
    before: Plan | None = None
    n = N_HEAD + o.steps * p.nu + o.particles * (o.steps + 1) * p.nz
    for k, trouble in enumerate(troubles):
        t, elapsed = 8.0 + 0.02 * k, 0.02
        x = path.at(torch.tensor([t]))
        x[:, :6] += 0.05 * torch.randn(1, 6, generator=g, dtype=torch.float64)
        ref = path.window(t, dt=o.dt, steps=o.steps)[None].clone()
        last = push = None
        if trouble == "nan":
            x[0, 11] = torch.nan
            elapsed = 0.2
        elif trouble == "huge":
            x[0, 2] = 1e39
        elif trouble == "norm":
            x[0, 6:10] *= 1.3
        elif trouble == "reference":
            ref[0, 3, 1] = torch.inf
        elif trouble == "jump":
            x[0, 0] += 4.0
        elif trouble == "elapsed":
            elapsed = 0.11
        elif trouble == "last":
            last = torch.full((1, p.nu), 0.41, dtype=torch.float64)
        elif trouble == "push":
            push = 0.3 * torch.ones(1, p.nd, dtype=torch.float64)
        if trouble == "gone":
            before = None
        jumped, solves = float(controller._jumped[0]), float(controller._solves)
        if before is None:
            old = torch.zeros(n, dtype=torch.float64)
            old[2] = jumped
        else:
            old = packed(before, jumped, solves)
        unknown = torch.full((p.nu,), torch.nan, dtype=torch.float64)
        arguments = [
            *(x[0].double(), torch.ones((), dtype=torch.float64), torch.tensor(elapsed, dtype=torch.float64)),
            *(ref[0], unknown if last is None else last[0]),
            torch.zeros(p.nd, dtype=torch.float64) if push is None else push[0],
            torch.full((p.nz - p.nx,), torch.nan, dtype=torch.float64),
            old,
        ]
        plan = controller.plan(x, ref, before, elapsed=elapsed, last=last, push=push)
        yield arguments, plan
        before = plan


def word_of(answer: Sequence[Tensor], plan: Plan, *, most: float) -> str:
    """The status of a step's answer, which is that of a plan, as its numbers are."""
    word = STATUS[int(answer[7])]
    assert word == plan.status[0]
    assert torch.allclose(answer[0], plan.u[0], atol=most)
    assert torch.allclose(answer[4], plan.x[0], atol=most)
    assert torch.equal(answer[1], answer[4][1, 10:13])
    assert float(answer[2]) == pytest.approx(float(plan.u[0, 0].mean()))
    assert int(answer[8]) == plan.iterations
    return word


def all_kinds(words: set[str]) -> bool:
    trouble = {"bad_state:kept", "bad_state:hover", "bad_reference:kept", "state_jump:kept"}
    return trouble < words and bool(words & {"converged", "improved"})
