"""The step as machine code, compiled ahead of time: one package that holds every stage as a model of its own.

The loops between the stages are those of `step.run`, in Python and in any other host: they compare one number each. As
operations of one graph (`while_loop`) they do not pass torch.export 2.13 when they are nested.

Code is made for a level of the processor (x86-64-v4 with AVX-512, x86-64-v3 with AVX2) and not for the very one that
compiles it: what the record says of the processor is then all that has to fit. Of what the compiler leaves behind, the
package holds what is loaded, and no source.
"""

from __future__ import annotations

import functools
import logging
import os
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nsde_torch.control.compiled import has_compiler, quick_indices
from nsde_torch.errors import ExportError
from nsde_torch.export import container
from nsde_torch.export.graph import graph_of
from nsde_torch.export.step import WHOLE, Loops, Stage, Step, run

_LEVELS = {"AVX512": "x86-64-v4", "AVX2": "x86-64-v3"}
"""What the compiler calls what torch finds of a processor; for others it takes the one that it runs on."""
_FUSED = ("finish",)
"""Stages that compile best with columns put together in registers; see `GaussNewton.fused`."""


def compiled(step: Step, *, say: Callable[[str], None]) -> dict[str, bytes]:
    """Members of a package with all stages.

    Args:
        step: The step.
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
    with torch.no_grad(), _quiet(), tempfile.TemporaryDirectory() as name, _built_in(name):
        examples = step.examples(WHOLE)
        for k, (stage, example) in enumerate(examples.items()):
            say(f"compiling {stage}, {k + 1} of {len(examples)}")
            started = time.perf_counter()
            try:
                files[stage] = _machine_code(step, stage, example)
            except Exception as error:
                if os.environ.get("NSDE_TRACEBACK") == "1":
                    raise
                reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
                raise ExportError(
                    f"the compiler gave up on {stage}: {reason}. Take format=torchscript."
                ) from error
            say(f"  took {time.perf_counter() - started:.0f} s")
        package = Path(name) / "package.pt2"
        package_aoti(str(package), files)
        members = container.members_of(package.read_bytes())
    return {name: content for name, content in members.items() if _is_loaded(name)}


def _machine_code(step: Step, stage: str, example: Sequence[Tensor]) -> Any:
    # columns, which fuse when compiled, in the place of few operations
    graph = graph_of(step.stage(stage), example, few=False)
    program = torch.export.export(graph, tuple(example), strict=False)
    options: dict[str, Any] = {
        "aot_inductor.package": True,
        "force_pointwise_cat": stage in _FUSED,
        "cpp.march": _LEVELS.get(torch.backends.cpu.get_cpu_capability()),
    }
    with quick_indices():
        return torch._inductor.aot_compile(program.module(), tuple(example), options=options)


@contextmanager
def _quiet() -> Iterator[None]:
    """Without what torch's compiler says of itself."""
    log = logging.getLogger("torch._inductor")
    before = log.level
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(before)


@contextmanager
def _built_in(folder: str) -> Iterator[None]:
    """While it lasts, the compiler works in this folder, and uses nothing that it made before."""
    before = os.environ.get("TORCHINDUCTOR_CACHE_DIR")
    os.environ["TORCHINDUCTOR_CACHE_DIR"] = folder
    try:
        yield
    finally:
        if before is None:
            del os.environ["TORCHINDUCTOR_CACHE_DIR"]
        else:
            os.environ["TORCHINDUCTOR_CACHE_DIR"] = before


def _is_loaded(member: str) -> bool:
    return not member.endswith(".cpp") and member != ".data/serialization_id"


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
    stages: dict[str, Stage] = {}
    try:
        for name in WHOLE:
            # (path, name, single threaded, runners, device)
            loader: Any = torch._C._aoti.AOTIModelPackageLoader(str(path), name, True, 1, -1)
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
