"""TorchScript, in one place: graphs of the stages of the step, and the loops between them compiled as they are.

Interpreting a graph costs 1 to 2 us an operation, whatever its size. torch deprecates TorchScript and says so at every
call, and files of it are what libtorch loads.
"""

import io
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor

from nsde_torch.export.step import ExportedStep, WholeStep

Function = Callable[..., Sequence[Tensor]]


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the notices of deprecation, and without those that a graph of constants is traced as such."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*torch.jit.*", category=DeprecationWarning)
        warnings.filterwarnings("ignore", message=".*TorchScript.*", category=DeprecationWarning)
        warnings.filterwarnings("ignore", category=torch.jit.TracerWarning)
        yield


def scripted(step: ExportedStep) -> bytes:
    """The bytes of a file with the step as a frozen module of the methods `step` and `predict` (see `tensors`)."""
    from nsde_torch.export.graph import graph_of  # with torch's tracer, which those who load do without

    def part(name: str, example: Sequence[Tensor]) -> torch.jit.ScriptModule:
        graph = graph_of(step.stage(name), example)
        made: torch.jit.ScriptModule = torch.jit.trace(graph.eval(), tuple(example), check_trace=False)
        return made

    buffer = io.BytesIO()
    with _quiet(), torch.no_grad():
        parts = {name: part(name, example) for name, example in step.examples().items()}
        whole = torch.jit.script(WholeStep(parts, step.loops).eval())
        torch.jit.save(torch.jit.freeze(whole, preserved_attrs=["step", "predict"]), buffer)
    return buffer.getvalue()


def loaded(content: bytes) -> tuple[Function, Function]:
    """`step` and `predict` of the module in a file; it is code, and runs when called.

    They run as they are: to specialise them at their first calls takes a second, and makes them no faster (measured).
    """
    with _quiet():
        module = torch.jit.load(io.BytesIO(content), map_location="cpu")

    plain = torch.jit.optimized_execution(False)
    return plain(module.step), plain(module.predict)
