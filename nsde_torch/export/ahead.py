"""The step as machine code, compiled ahead of time: one package that holds every stage as a model of its own.

The loops between the stages are those of `step.WholeStep`, in Python and in any other host: they compare one number
each. As operations of one graph (`while_loop`) they do not pass torch.export 2.13 when they are nested.

Code is made for a level of the processor (x86-64-v4 with AVX-512, x86-64-v3 with AVX2) and not for the very one that
compiles it: what the record says of the processor is then all that has to fit. Of what the compiler leaves behind, the
package holds what is loaded: no source, no symbols, and no name of a file or folder in which it was made, so that the
same controller makes the same bytes.
"""

import logging
import os
import shutil
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import sympy
import torch
from torch import Tensor

from nsde_torch.control.compiled import LEVELS
from nsde_torch.errors import ExportError
from nsde_torch.export import container
from nsde_torch.export.graph import graph_of
from nsde_torch.export.step import WHOLE, ExportedStep, Loops, Stage, WholeStep

_FUSED = ("finish",)
"""Stages that compile best with columns put together in registers: a rollout, whose steps then are one loop each."""


@contextmanager
def quick_indices() -> Iterator[None]:
    """While it lasts, sympy expands what is a polynomial where inductor asks it to simplify.

    It asks so for the index of every access to memory, and of a long rollout that took two thirds of the compilation
    (180 s, and 60 s with this; the code that comes out is as fast).
    """
    simplify = sympy.simplify

    def quick(expression: Any, *arguments: Any, **options: Any) -> Any:
        if isinstance(expression, sympy.Expr) and not arguments and not options:
            # by `identity`, parts that inductor marked against it are expanded too
            plain = sympy.expand(expression, identity=True)
            if plain.is_number or plain.is_polynomial(*plain.free_symbols):
                return plain
        return simplify(expression, *arguments, **options)

    with mock.patch.object(sympy, "simplify", quick):
        yield


def compiled(step: ExportedStep, *, say: Callable[[str], None]) -> dict[str, bytes]:
    """Members of a package with all stages, saying what takes long; an ExportError where no compiler does it."""
    from torch._inductor.package import package_aoti

    named = os.environ.get("CXX")
    if not any(shutil.which(c) for c in ([named] if named else ["g++", "clang++"])):
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
    # names of kernels' files differ from time to time, and what is loaded of them is in the wrappers'
    left = (".data/serialization_id",)
    return {
        n: c for n, c in members.items() if n not in left and ".kernel" not in n and not n.endswith(".cpp")
    }


def _machine_code(step: ExportedStep, stage: str, example: Sequence[Tensor]) -> Any:
    # columns, which fuse when compiled, in the place of few operations
    graph = graph_of(step.stage(stage), example, few=False)
    program = torch.export.export(graph, tuple(example), strict=False)
    options: dict[str, Any] = {
        "aot_inductor.package": True,
        "aot_inductor.enable_line_tables": False,
        "force_pointwise_cat": stage in _FUSED,
        "cpp.march": LEVELS.get(torch.backends.cpu.get_cpu_capability()),
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
    """While it lasts, the compiler works in this folder, uses nothing made before, and keeps names to itself."""
    from torch._inductor import cpp_builder

    flags = cpp_builder._get_optimization_cflags

    def nameless(*arguments: Any, **options: Any) -> tuple[list[str], list[str]]:
        compiling, linking = flags(*arguments, **options)
        return [*compiling, "D__FILE__='\"controller\"'", "Wno-builtin-macro-redefined", "s"], linking

    own = mock.patch.dict(os.environ, TORCHINDUCTOR_CACHE_DIR=folder)
    with own, mock.patch.object(cpp_builder, "_get_optimization_cflags", nameless):
        yield


def loaded(
    path: Path, loops: Mapping[str, float]
) -> tuple[Callable[..., Sequence[Tensor]], Callable[..., Sequence[Tensor]]]:
    """`step` and `predict` of a package, with the numbers of its `Loops`; it is machine code, and runs when called.

    An ExportError where the package cannot be loaded here.
    """
    stages: dict[str, Stage] = {}
    try:
        for name in WHOLE:
            # (path, name, single threaded, runners, device)
            loader: Any = torch._C._aoti.AOTIModelPackageLoader(str(path), name, True, 1, -1)
            stages[name] = lambda *given, loader=loader: loader.run(list(given))
    except Exception as error:
        raise ExportError(
            f"its machine code cannot be loaded here ({str(error).splitlines()[0]}). Export it here with format=aoti."
        ) from error
    whole = WholeStep(stages, Loops(**loops))  # type: ignore[arg-type]
    return torch.no_grad()(whole.step), whole.predict
