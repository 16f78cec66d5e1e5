"""Machine code of a solver's iteration, made ahead of time and kept on disk.

The iteration holds derivatives, which torch.export cannot trace by itself: `make_fx` writes down the operations first,
the derivatives among them, and export and AOTInductor see plain arithmetic. What comes out is one package for each kind
of problem. Its key is a hash of what determines the operations (source files, architecture, shapes, torch's version,
processor); the weights of the model and of the cost are loaded into it, so that training anew compiles nothing.
"""

from __future__ import annotations

import functools
import hashlib
import inspect
import json
import os
import platform
import shutil
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, final

import sympy
import torch
from torch import Tensor, nn
from torch._functorch.compile_utils import fx_graph_cse
from torch.fx.experimental.proxy_tensor import make_fx

from nsde_torch.cache import cache_folder

Function = Callable[[Sequence[Tensor]], list[Tensor]]
_SOURCES = (
    *("control/compiled.py", "control/gauss_newton.py"),
    *("control/problem.py", "control/predictor.py", "rotation.py", "columns.py", "sde/deterministic.py"),
)
_NAMES = "constants"


@final
class Stage(nn.Module):
    """A method of a module as a module of its own.

    Args:
        owner: The module.
        name: The method.
    """

    def __init__(self, owner: nn.Module, name: str) -> None:
        super().__init__()
        self.owner, self.name = owner, name

    def forward(self, *arguments: Tensor) -> tuple[Tensor, ...]:
        """See the method."""
        return tuple(getattr(self.owner, self.name)(*arguments))

    def extra_repr(self) -> str:
        """The method, by which stages of one module differ."""
        return self.name


class NoCompiler(RuntimeError):
    """Machine code cannot be made here; the message says why."""


def compile_ahead(
    module: nn.Module,
    example: Sequence[Tensor],
    *,
    name: str,
    structure: str,
    fused: bool = False,
    folder: str | Path | None = None,
    say: Callable[[str], None] | None = None,
) -> Function:
    """The module as machine code for tensors of the shapes of an example.

    Args:
        module: Takes tensors, returns tensors; without gradients, on the CPU.
        example: Arguments.
        name: What it is, for the file and for messages.
        structure: Every setting of the module that is not one of its tensors.
        fused: Put columns together in registers instead of in memory.
        folder: Where packages are kept; default: the folder of the package's cache.
        say: Called with one line when something takes long.

    Returns:
        A function of a list of tensors.

    Raises:
        NoCompiler: there is no C++ compiler, or it refuses.
    """
    path = cache_folder(folder) / f"{name}-{_key(module, example, structure)}.pt2"
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if not path.is_file():
            _make(module, example, path, name=name, fused=fused, say=say or (lambda line: None))
        return _load(module, path)


def _make(
    module: nn.Module,
    example: Sequence[Tensor],
    path: Path,
    *,
    name: str,
    fused: bool,
    say: Callable[[str], None],
) -> None:
    if not has_compiler():
        raise NoCompiler("there is no C++ compiler (g++ or clang++; CXX names it)")
    say(f"compiling {name}, about a minute; kept in {path.parent} for the next time")
    started = time.perf_counter()
    temporary: str | None = None
    try:
        graph = make_fx(lambda *args: tuple(module(*args)), tracing_mode="real")(*example)
        # steps repeat what follows from constants alone: once is enough
        graph.graph = fx_graph_cse(graph.graph)
        graph.graph.eliminate_dead_code()
        graph.recompile()
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=path.stem, suffix=".pt2")
        os.close(handle)
        program = torch.export.export(graph, tuple(example), strict=False)
        with quick_indices():
            torch._inductor.aoti_compile_and_package(
                program,
                package_path=temporary,
                inductor_configs={
                    # constants stay constants, however small: other weights can be loaded in their place
                    "always_keep_tensor_constants": True,
                    "force_pointwise_cat": fused,
                    "aot_inductor.metadata": {_NAMES: json.dumps(_constants(graph, module))},
                },
            )
        os.replace(temporary, path)
    except Exception as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise NoCompiler(f"the compiler gave up: {reason}") from error
    finally:
        if temporary is not None:
            with suppress(OSError):
                os.unlink(temporary)
    say(f"compiled {name} in {time.perf_counter() - started:.0f} s")


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

    sympy.simplify = quick
    try:
        yield
    finally:
        sympy.simplify = simplify


def _load(module: nn.Module, path: Path) -> Function:
    try:
        loader: Any = torch._inductor.aoti_load_package(str(path)).loader
        names: dict[str, str] = json.loads(loader.get_metadata()[_NAMES])
        own = _tensors(module)
        used = set(loader.get_constant_fqns())
        values = {constant: own[name] for constant, name in names.items() if constant in used}
        loader.load_constants(values, use_inactive=False, check_full_update=False)
    except Exception as error:
        with suppress(OSError):
            path.unlink()  # damaged, or of another machine: made anew the next time
        raise NoCompiler(f"{path} cannot be loaded ({error}); it was removed, try again") from error

    def run(arguments: Sequence[Tensor]) -> list[Tensor]:
        out: list[Tensor] = loader.run(list(arguments))
        return out

    return run


def _constants(graph: torch.fx.GraphModule, module: nn.Module) -> dict[str, str]:
    """Names of constants of the graph that are tensors of the module -> their names there."""
    own = {id(tensor): name for name, tensor in _tensors(module).items()}
    held = {
        str(node.target): getattr(graph, str(node.target))
        for node in graph.graph.nodes
        if node.op == "get_attr"
    }
    return {constant: own[id(tensor)] for constant, tensor in held.items() if id(tensor) in own}


def _tensors(module: nn.Module) -> dict[str, Tensor]:
    return {**dict(module.named_parameters()), **dict(module.named_buffers())}


def _key(module: nn.Module, example: Sequence[Tensor], structure: str) -> str:
    digest = hashlib.sha256()
    where = (torch.__version__, platform.machine(), torch.backends.cpu.get_cpu_capability())
    for part in (*where, str(torch.get_num_threads()), _source_hash(), structure, str(module)):
        digest.update(str(part).encode() + b"\0")
    classes = {kind for m in module.modules() for kind in type(m).__mro__ if kind.__module__ != "builtins"}
    for own in sorted({inspect.getsourcefile(kind) or "" for kind in classes if _is_ours(kind)}):
        digest.update(hashlib.sha256(Path(own).read_bytes()).digest())
    for tensor in (*example, *(t for _, t in sorted(_tensors(module).items()))):
        digest.update(f"{tuple(tensor.shape)} {tensor.stride()} {tensor.dtype}".encode())
    return digest.hexdigest()[:32]


@functools.cache
def _source_hash() -> str:
    """Hash of the source files of functions that an iteration runs through, beside those of its classes."""
    package = Path(__file__).resolve().parents[1]
    return hashlib.sha256(b"\0".join((package / part).read_bytes() for part in _SOURCES)).hexdigest()


def _is_ours(kind: type) -> bool:
    """Whether a class is one of the package or of the user; torch's own come with torch's version."""
    return kind.__module__.split(".")[0] not in ("torch", "abc", "typing")


def has_compiler() -> bool:
    """Whether a C++ compiler is found."""
    named = os.environ.get("CXX")
    return any(shutil.which(c) for c in ([named] if named else []) + ["g++", "clang++"])
