"""Writing a controller as a file."""

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import torch

from nsde_torch.control.controller import Controller, SafetyOptions
from nsde_torch.control.options import EstimatorOptions
from nsde_torch.control.predictor import Predictor
from nsde_torch.control.problem import ProblemOptions
from nsde_torch.control.solve import SolverOptions
from nsde_torch.errors import ConfigError
from nsde_torch.export import c_file, container, jit
from nsde_torch.export.container import AOTI, TORCHSCRIPT, C, record_of
from nsde_torch.export.step import ExportedStep
from nsde_torch.models import Model
from nsde_torch.systems import System

KINDS = (TORCHSCRIPT, AOTI, C)


def controller_of(
    known: Model | System,
    *,
    problem: ProblemOptions,
    solver: SolverOptions,
    safety: SafetyOptions,
    dtype: torch.dtype,
) -> Controller:
    """The controller in Python that an exported one is held against; ConfigError for what a file cannot have."""
    if solver.deadline is not None:
        raise ConfigError(
            "`mpc.deadline` needs a clock, which a graph has not; the program around it has. Bound "
            "mpc.iterations instead."
        )
    plain = replace(solver, compile="off")
    return Controller(known, problem=problem, solver=plain, safety=safety, dtype=dtype)


def export(
    known: Model | System,
    path: Path,
    *,
    name: str | None = None,
    problem: ProblemOptions,
    solver: SolverOptions,
    safety: SafetyOptions,
    kind: str = TORCHSCRIPT,
    run: Path | None = None,
    sample: float,
    period: float,
    latency: float,
    estimator: EstimatorOptions | None = None,
    dtype: torch.dtype = torch.float32,
    say: Callable[[str], None] | None = None,
) -> str:
    """Write a controller; returns the hash of its content (hex).

    A ConfigError refuses what a file cannot hold; an ExportError where there is no compiler for format=aoti.

    Args:
        known: What it knows of the machine.
        path: The file.
        name: Name of the machine, of which declared physics is made anew when the file is loaded; None: its own.
        problem, solver, safety: What a plan pays for, how it is found, and when to reject a state or a plan.
        kind: "torchscript", "aoti" or "c" (`path` is then the source file, and its header lies beside it).
        run: Run directory of the model, for its hashes; None: declared physics.
        sample: Step of `predict` [s].
        period, latency: For the record; see `record_of`.
        estimator: Options of the estimator of a controller in C, which is part of the file; None: its
            defaults, with the latency given here. Others leave it to their host.
        dtype: Precision of the arithmetic within.
        say: Called with a line when something takes long.
    """
    if kind not in KINDS:
        raise ConfigError(f"`format` must be {', '.join(KINDS[:-1])} or {KINDS[-1]}; got {kind!r}.")
    if (kind == C) != c_file.is_c(path):
        raise ConfigError(
            f"`format=c` and only that writes a file that ends in .c; got format={kind}, out={path}."
        )
    controller = controller_of(known, problem=problem, solver=solver, safety=safety, dtype=dtype)
    step = ExportedStep(controller, Predictor(known, dt=sample, dtype=dtype))
    about = record_of(step, known, kind=kind, run=run, period=period, latency=latency)
    about["model"]["system"] = name or about["model"]["system"]
    if kind == C:
        from nsde_torch.export.c_code import sources

        known_times = estimator or EstimatorOptions(latency=latency)
        about["estimator"] = asdict(known_times)
        return c_file.write(path, *sources(step, path.stem, about, known_times), about)
    if kind == TORCHSCRIPT:
        members = container.plain(container.members_of(jit.scripted(step)))
    else:
        from nsde_torch.export.ahead import compiled

        members = compiled(step, say=say or (lambda line: None))
    return container.write(path, members, about)
