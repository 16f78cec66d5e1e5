"""Writing a controller as a file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from nsde_torch.control.controller import Controller, SafetyOptions
from nsde_torch.control.options import EstimatorOptions
from nsde_torch.control.predictor import Predictor
from nsde_torch.control.problem import ProblemOptions
from nsde_torch.control.solve import SolverOptions
from nsde_torch.errors import ConfigError, ExportError
from nsde_torch.export import c_file, container, jit
from nsde_torch.export.graph import graph_of
from nsde_torch.export.layout import step_outputs
from nsde_torch.export.record import AOTI, TORCHSCRIPT, C, record_of
from nsde_torch.export.step import ExportedStep
from nsde_torch.models import Model
from nsde_torch.systems import System

# The step as TorchScript: graphs of its stages, and the loops between them in TorchScript's own language.
#
# The loops are those of `step.run`. Interpreting a graph costs 1 to 2 us an operation, whatever its size.

_STEP = """
def step(self, state: Tensor, valid: Tensor, elapsed: Tensor, reference: Tensor, last: Tensor, push: Tensor,
         memory: Tensor, before: Tensor) -> {results}:
    z0, start_u, start_z, ref, now, d, head, trouble = self.begin(
        state, valid, elapsed, reference, last, push, memory, before)
    u = start_u
    z = start_z
    cost = self.infinite
    gap = self.infinite
    iterations = 0
    if bool(trouble < 0.5):
        if bool(head[0] < 0.5):
            _, z, _, _ = self.finish(z0, u, ref, now, d, self.no_step, self.nothing)
        going = True
        while going:
            hessian, gradient, low, high, value, best, least = self.prepare(z0, u, z, ref, now, d)
            step = self.no_step
            slope = gradient
            change = 0
            changing = True
            while changing:
                step, slope, best, least, left = self.active_set(
                    hessian, gradient, low, high, value, step, slope, best, least)
                change += 1
                changing = change < {changes} and not bool(left <= {left!r})
            u, z, cost, gap = self.finish(z0, u, ref, now, d, best, least)
            iterations += 1
            going = iterations < {iterations} and not bool(gap <= {tolerance!r})
    return self.end(u, z, cost, gap, self.counts[iterations], z0, start_u, start_z, head, trouble)
"""
_FINISH = """
def finish(self, z0: Tensor, u: Tensor, ref: Tensor, now: Tensor, d: Tensor, step: Tensor,
           least: Tensor) -> Tuple[Tensor, Tensor, Tensor, Tensor]:
    tried, by_step, row, noise = self.tries(z0, u, step)
    states = [row]
    for own, increment in zip(by_step.unbind(0), noise.unbind(0)):
        row = self.advance(row, own, d, increment)
        states.append(row)
    return self.choose(torch.stack(states, 1), tried, ref, now, least)
"""
_PREDICT = """
def predict(self, z: Tensor, u: Tensor, push: Tensor) -> Tuple[Tensor]:
    return self.foresee(z, u, push)
"""


def scripted(step: ExportedStep) -> Any:
    """The step as a TorchScript module with the methods `step` and `predict` (see `layout`)."""
    import torch

    parts = {}
    for name, example in step.examples().items():
        stage = step.stage(name)
        graph = graph_of(stage, example)
        part = jit.traced(_single(graph) if name == "advance" else graph, example)
        parts["foresee" if name == "predict" else name] = part
    s = step.sizes
    tensors = {
        "infinite": torch.full((1,), torch.inf, dtype=step.dtype),
        "no_step": torch.zeros(1, s.steps * s.nu, dtype=step.dtype),
        "nothing": torch.zeros(1, dtype=step.dtype),
        "counts": torch.arange(step.iterations + 1, dtype=torch.float64),
    }
    numbers = {**asdict(step.loops), "results": f"Tuple[{', '.join(['Tensor'] * len(step_outputs(s)))}]"}
    return jit.assembled(parts, tensors, (_FINISH, _STEP.format(**numbers), _PREDICT), ("step", "predict"))


def _single(graph: Any) -> Any:
    """A graph that returns its one result as it is and not as a tuple."""
    (output,) = (n for n in graph.graph.nodes if n.op == "output")
    output.args = (output.args[0][0],)
    graph.recompile()
    return graph


KINDS = (TORCHSCRIPT, AOTI, C)


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
    estimator: EstimatorOptions | None = None,
    dtype: torch.dtype = torch.float32,
    say: Callable[[str], None] | None = None,
) -> str:
    """Write a controller; returns the hash of its content (hex).

    Args:
        known: What it knows of the machine.
        path: The file.
        problem: What a plan pays for.
        solver: How it is found.
        safety: When to reject a state or a plan.
        kind: "torchscript", "aoti" or "c" (`path` is then the source file, and its header lies beside it).
        run: Run directory of the model, for its hashes; None: declared physics.
        sample: Step of `predict` [s].
        period, latency: For the record; see `record_of`.
        estimator: Options of the estimator of a controller in C, which is part of the file; None: its
            defaults, with the latency given here. Others leave it to their host.
        dtype: Precision of the arithmetic within.
        say: Called with a line when something takes long.

    Raises:
        ConfigError: something that a file cannot hold.
        ExportError: there is no compiler for format=aoti.
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
    if kind == C:
        from nsde_torch.export.c_code import sources

        known_times = estimator or EstimatorOptions(latency=latency)
        about["estimator"] = asdict(known_times)
        return c_file.write(path, *sources(step, path.stem, about, known_times), about)
    if kind == TORCHSCRIPT:
        members = container.plain(container.members_of(jit.saved(scripted(step))))
    else:
        from nsde_torch.export.ahead import compiled

        members = compiled(step, say=say or (lambda line: None))
    if not members:
        raise ExportError("torch wrote an empty archive. Use another version of torch.")
    return container.write(path, members, about)
