"""TorchScript, in one place: torch deprecates it and says so at every call, and files of it are what libtorch loads."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, fx

Function = Callable[..., Sequence[Tensor]]


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the notices of deprecation, and without those that a graph of constants is traced as such."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*torch.jit.*", category=DeprecationWarning)
        warnings.filterwarnings("ignore", message=".*TorchScript.*", category=DeprecationWarning)
        warnings.filterwarnings("ignore", category=torch.jit.TracerWarning)
        yield


def traced(graph: fx.GraphModule, example: Sequence[Tensor]) -> Any:
    """A graph as a TorchScript module of the same arguments and results."""
    with _quiet(), torch.no_grad():
        return torch.jit.trace(graph.eval(), tuple(example), check_trace=False)


def assembled(
    parts: Mapping[str, Any], tensors: Mapping[str, Tensor], source: Sequence[str], methods: Sequence[str]
) -> Any:
    """A frozen TorchScript module of parts, tensors and methods written in its language.

    Args:
        parts: Modules, by the name that the methods call them by.
        tensors: Constants.
        source: Methods.
        methods: Names of those that stay.
    """
    with _quiet(), torch.no_grad():

        class Assembly(torch.jit.ScriptModule):
            def __init__(self) -> None:
                super().__init__()
                for name, part in parts.items():
                    setattr(self, name, part)
                for name, tensor in tensors.items():
                    self.register_buffer(name, tensor)
                for text in source:
                    self.define(text)

        made = Assembly().eval()
        return torch.jit.freeze(made, preserved_attrs=list(methods))


def saved(module: Any) -> bytes:
    """The bytes of a file that holds a module."""
    buffer = io.BytesIO()
    with _quiet():
        torch.jit.save(module, buffer)
    return buffer.getvalue()


def loaded(content: bytes, names: Sequence[str]) -> list[Function]:
    """Methods of the module in a file; it is code, and runs when called.

    They run as they are: to specialise them at their first calls takes a second, and makes them no faster (measured).
    """
    with _quiet():
        module = torch.jit.load(io.BytesIO(content), map_location="cpu")

    def method(name: str) -> Function:
        call = getattr(module, name)

        def run(*arguments: Tensor) -> Sequence[Tensor]:
            with torch.jit.optimized_execution(False):
                out: Sequence[Tensor] = call(*arguments)
            return out

        return run

    return [method(name) for name in names]
