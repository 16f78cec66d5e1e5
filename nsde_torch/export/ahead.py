"""The step as machine code, compiled ahead of time: one package that holds every stage as a model of its own.

The loops between the stages are those of `step.run`, in Python and in any other host: they compare one number each. As
operations of one graph (`while_loop`) they do not pass torch.export 2.13 when they are nested; unrolled, the rollout
alone takes minutes to compile.
"""

from __future__ import annotations

import functools
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nsde_torch.control.compiled import has_compiler
from nsde_torch.errors import ExportError
from nsde_torch.export.graph import graph_of
from nsde_torch.export.step import STAGES, Loops, Stage, Step, run


def compiled(step: Step, path: Path, *, say: Callable[[str], None]) -> None:
    """Write a package with all stages.

    Args:
        step: The step.
        path: Package to write.
        say: Called with a line when something takes long.

    Raises:
        ExportError: there is no compiler, or it refuses.
    """
    from torch._inductor.package import package_aoti

    if not has_compiler():
        raise ExportError(
            "`format=aoti` needs a C++ compiler (g++ or clang++; CXX names it). Install one, or take "
            "format=torchscript."
        )
    files: dict[str, Any] = {}
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, example in step.examples().items():
            say(f"compiling {name}")
            try:
                # columns, which fuse when compiled, in the place of few operations
                graph = graph_of(step.stage(name), example, few=False)
                program = torch.export.export(graph, tuple(example), strict=False)
                files[name] = torch._inductor.aot_compile(
                    program.module(), tuple(example), options={"aot_inductor.package": True}
                )
            except Exception as error:
                if os.environ.get("NSDE_TRACEBACK") == "1":
                    raise
                reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
                raise ExportError(
                    f"the compiler gave up on {name}: {reason}. Take format=torchscript."
                ) from error
        package_aoti(str(path), files)


def loaded(
    path: Path, loops: Mapping[str, float]
) -> tuple[Callable[..., Sequence[Tensor]], Callable[..., Sequence[Tensor]]]:
    """`step` and `predict` of a package; it is machine code, and runs when called.

    Args:
        path: The package.
        loops: What `Loops` is made of.

    Raises:
        ExportError: the package cannot be loaded here.
    """
    from torch._inductor.package import load_package

    stages: dict[str, Stage] = {}
    try:
        for name in STAGES:
            loader: Any = load_package(str(path), model_name=name, run_single_threaded=True).loader
            stages[name] = _function(loader)
    except Exception as error:
        raise ExportError(
            f"its machine code cannot be loaded here ({str(error).splitlines()[0]}). Export it here with format=aoti."
        ) from error
    return functools.partial(run, stages, Loops(**loops)), stages["predict"]  # type: ignore[arg-type]


def _function(loader: Any) -> Stage:
    def call(*arguments: Tensor) -> Sequence[Tensor]:
        out: Sequence[Tensor] = loader.run(list(arguments))
        return out

    return call
