"""Writing a controller as a file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch

from nsde_torch.control.controller import Controller, SafetyOptions
from nsde_torch.control.predictor import Predictor
from nsde_torch.control.problem import ProblemOptions
from nsde_torch.control.solve import SolverOptions
from nsde_torch.errors import ConfigError, ExportError
from nsde_torch.export import container, jit
from nsde_torch.export.record import AOTI, TORCHSCRIPT, record_of
from nsde_torch.export.script import scripted
from nsde_torch.export.step import ExportedStep
from nsde_torch.models import Model
from nsde_torch.systems import System

KINDS = (TORCHSCRIPT, AOTI)


def controller_of(
    known: Model | System,
    *,
    problem: ProblemOptions,
    solver: SolverOptions,
    safety: SafetyOptions,
    dtype: torch.dtype,
) -> Controller:
    """The controller in Python that an exported one is held against.

    Raises:
        ConfigError: an option that a file cannot have.
    """
    if solver.deadline is not None:
        raise ConfigError(
            "`mpc.deadline` needs a clock, which a graph has not; the program around it has. Bound "
            "mpc.iterations instead."
        )
    plain = SolverOptions(
        name=solver.name, iterations=solver.iterations, tolerance=solver.tolerance, compile="off"
    )
    return Controller(known, problem=problem, solver=plain, safety=safety, dtype=dtype)


def export(
    known: Model | System,
    path: Path,
    *,
    problem: ProblemOptions,
    solver: SolverOptions,
    safety: SafetyOptions,
    kind: str = TORCHSCRIPT,
    run: Path | None = None,
    sample: float,
    period: float,
    latency: float,
    dtype: torch.dtype = torch.float32,
    say: Callable[[str], None] | None = None,
) -> str:
    """Write a controller; returns the hash of its content (hex).

    Args:
        known: What it knows of the machine.
        path: The file.
        problem: What a plan pays for.
        solver: How it is found.
        safety: When to disbelieve.
        kind: "torchscript" or "aoti".
        run: Run directory of the model, for its hashes; None: declared physics.
        sample: Step of `predict` [s].
        period, latency: For the record; see `record_of`.
        dtype: Precision of the arithmetic within.
        say: Called with a line when something takes long.

    Raises:
        ConfigError: something that a file cannot hold.
        ExportError: there is no compiler for format=aoti.
    """
    if kind not in KINDS:
        raise ConfigError(f"`format` must be {' or '.join(KINDS)}; got {kind!r}.")
    controller = controller_of(known, problem=problem, solver=solver, safety=safety, dtype=dtype)
    step = ExportedStep(controller, Predictor(known, dt=sample, dtype=dtype))
    about = record_of(step, known, kind=kind, run=run, period=period, latency=latency)
    if kind == TORCHSCRIPT:
        members = container.plain(container.members_of(jit.saved(scripted(step))))
    else:
        from nsde_torch.export.ahead import compiled

        members = compiled(step, say=say or (lambda line: None))
    if not members:
        raise ExportError("torch wrote an empty archive. Use another version of torch.")
    return container.write(path, members, about)
