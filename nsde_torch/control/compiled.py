"""Iterations of the solver and updates of the estimator as machine code, made of C that is written for the problem.

They compute in double precision whatever that of the controller is, row by row of a batch: the numbers of the torch
that they stand for, up to rounding. What writes the C is imported where a library is not kept yet: it takes most of a
second to load. The key of a library is a hash of what its source is written from, weights and all, and of how it is
compiled: of the objects and of this package, or, where they hold anything of other modules, of the source itself. To
write that takes another second.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import inspect
import io
import os
import pickle
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import torch
from torch import Tensor, nn

from nsde_torch.cache import cache_folder
from nsde_torch.control.gauss_newton import AcceleratedGradient, GaussNewton, Iterate, Memory
from nsde_torch.control.predictor import Predictor

if TYPE_CHECKING:
    from nsde_torch.control.autopilots import Estimator


Say = Callable[[str], None] | None
_DOUBLE = torch.float64


@final
class CompiledMethod:
    """Iterations of a method as machine code.

    It works on tables of its own, one solve at a time: the memory between iterations says no more than that there was
    one. For `name`, `folder` and `say` see `library`. NoCompiler: there is none for these paths or this model, or no
    compiler.
    """

    def __init__(
        self,
        method: GaussNewton | AcceleratedGradient,
        name: str,
        *,
        folder: str | None = None,
        say: Say = None,
    ) -> None:
        if method.horizon.particles > 1:
            raise NoCompiler("plans over several paths (particles) are not written in C")

        def source() -> str:
            from nsde_torch.control.codegen.sources import solver_library

            return solver_library(method)

        built = library(source, method, name, folder=folder, say=say)
        self._run: Any = built.nsde_iterate
        pointer, count = ctypes.c_void_p, ctypes.c_int
        self._run.argtypes, self._run.restype = (pointer, count, count, *[pointer] * 10), None
        work, self._own = (ctypes.c_uint.in_dll(built, f"nsde_{k}_bytes").value for k in ("work", "memory"))
        self._work = torch.empty(work, dtype=torch.uint8)
        self._tables: tuple[Tensor, ...] = ()

    def iterate(self, arguments: Sequence[Tensor], memory: Memory) -> tuple[Iterate, Memory]:
        """Improve plans; see `GaussNewton.iterate`. What it returns is in double precision, u and z until the next."""
        first, n = not memory, len(arguments[0])
        if first:
            if not self._tables or len(self._tables[0]) != n:
                # the arguments, what the method keeps, and the costs and gaps (N,)
                given = (torch.empty(x.shape, dtype=_DOUBLE) for x in arguments)
                own = torch.empty(n * self._own, dtype=torch.uint8)
                self._tables = (*given, own, *torch.empty(3, n, dtype=_DOUBLE))
            for table, x in zip(self._tables, arguments, strict=False):
                table.copy_(x)
        self._run(self._work.data_ptr(), n, first, *(x.data_ptr() for x in self._tables))
        cost, before, gap = (x.clone() for x in self._tables[-3:])
        return Iterate(self._tables[1], self._tables[2], cost, before, gap, gap.max()), self._tables[-1:]


def compiled_estimator(
    made: Estimator, predictor: Predictor, *, folder: str | None = None, say: Say = None
) -> Callable[..., list[Tensor]]:
    """`Estimator.forward` as machine code, of an estimator with its predictor; NoCompiler: see `library`."""

    def source() -> str:
        from nsde_torch.control.codegen.sources import estimator_library

        return estimator_library(made, predictor)

    run: Any = library(source, made, "estimator", folder=folder, say=say).nsde_estimate
    run.argtypes, run.restype = (ctypes.c_int, *[ctypes.c_void_p] * 7), None

    def update(x: Tensor, z: Tensor, d: Tensor, commands: Tensor) -> list[Tensor]:
        tables = [t.to(_DOUBLE).contiguous() for t in (x, z, d, commands)]
        out = [torch.empty(t.shape, dtype=_DOUBLE) for t in (z, d, z)]
        run(len(x), *(t.data_ptr() for t in (*tables, *out)))
        return [t.to(x.dtype) for t in out]

    return update


# --- libraries of C: compiled once, kept on disk, and loaded --------------------------------------------------------

LEVELS = {"AVX512": "x86-64-v4", "AVX2": "x86-64-v3"}
"""What compilers call what torch finds of a processor; for others they take their default."""

FLAGS = ("-std=c99", "-O3", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math")
"""What changes no number beyond its rounding, and takes a tenth off a plan (measured)."""


class NoCompiler(RuntimeError):
    """Machine code cannot be made here; the message says why."""


def compiler() -> str | None:
    """A C compiler: what CC names, or cc, gcc or clang."""
    named = os.environ.get("CC")
    return next((c for c in ([named] if named else ["cc", "gcc", "clang"]) if shutil.which(c)), None)


def compiled(source: Path, made: Path, flags: Sequence[str]) -> None:
    """Compile a file to a library. NoCompiler: there is no C compiler, or it refuses."""
    cc = compiler()
    if cc is None:
        raise NoCompiler("there is no C compiler (cc, gcc or clang; CC names it)")
    words = [cc, *flags, "-shared", "-fPIC", "-o", str(made), str(source), "-lm"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        said = (done.stderr.strip().splitlines() or ["no word"])[0]
        raise NoCompiler(f"{cc} does not compile it: {said}")


def library(
    source: Callable[[], str],
    made_of: object,
    name: str,
    *,
    folder: str | Path | None = None,
    say: Callable[[str], None] | None = None,
) -> ctypes.CDLL:
    """A library of this name for this computer, compiled if it is not kept yet.

    `source` writes its text, which follows from `made_of`. Libraries are kept in a folder, or in that of the
    package's cache; `say` is called with one line when it is compiled. NoCompiler: there is no text, no C compiler,
    or it refuses, or what it makes cannot be kept.
    """
    level = LEVELS.get(torch.backends.cpu.get_cpu_capability())
    flags = (*FLAGS, *([f"-march={level}"] if level else []))
    known = _content(made_of) or _written(source).encode()
    key = hashlib.sha256(b"\0".join((known, name.encode(), " ".join(flags).encode()))).hexdigest()[:32]
    path = cache_folder(folder) / f"{name}-{key}.so"
    if _is_whole(path):
        with suppress(OSError):  # of another system: made anew
            return ctypes.CDLL(str(path))
    started = time.perf_counter()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent) as work:
            text, made = Path(work) / f"{name}.c", Path(work) / path.name
            text.write_text(_written(source), encoding="utf-8")
            compiled(text, made, flags)
            content = made.read_bytes()
            made.write_bytes(content + hashlib.sha256(content).digest())
            os.replace(made, path)
        built = ctypes.CDLL(str(path))
    except OSError as error:
        raise NoCompiler(f"its library cannot be kept in {path.parent} ({error})") from error
    if say is not None:
        say(f"compiled {name} in {time.perf_counter() - started:.0f} s, kept in {path.parent}")
    return built


def _written(source: Callable[[], str]) -> str:
    try:
        return source()
    except Exception as error:  # whatever a model of the user does that numbers alone cannot
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise NoCompiler(reason.removesuffix(".")) from error


def _is_whole(path: Path) -> bool:
    """Whether a library ends in its hash: to load one that was cut off ends the process."""
    content = path.read_bytes() if path.is_file() else b""
    return hashlib.sha256(content[:-32]).digest() == content[-32:]


class _Digest(pickle.Pickler):
    """Writes objects alike in every process, for their hash alone: tensors by their values and not by their place."""

    def reducer_override(self, obj: Any) -> Any:
        kind = obj if isinstance(obj, type) or inspect.isroutine(obj) else type(obj)
        if (kind.__module__ or "").split(".")[0] not in _KNOWN:
            raise pickle.PicklingError(f"{kind} may change without this package")
        if isinstance(obj, Tensor):
            values = obj.detach().cpu().contiguous().view(-1).view(torch.uint8).numpy()
            return tuple, ((str(obj.dtype), tuple(obj.shape), values.tobytes()),)
        if isinstance(obj, nn.Module):  # with its sets in one order
            return kind, (), {k: sorted(v) if isinstance(v, set) else v for k, v in vars(obj).items()}
        return NotImplemented


_KNOWN = ("nsde_torch", "torch", "builtins", "collections", "enum", "functools", "numpy", "types", "pathlib")
"""Modules that change with the version of this package or of torch alone, or not at all."""


def _content(made_of: object) -> bytes | None:
    """Hash of objects, of this package and of torch; None for objects that hold anything else."""
    written = io.BytesIO()
    try:
        _Digest(written).dump(made_of)
    except Exception:  # whatever an object of the user does when it is written
        return None
    return hashlib.sha256(written.getvalue() + _package()).digest()


@functools.cache
def _package() -> bytes:
    """Hash of all code that a source may come from."""
    digest = hashlib.sha256(torch.__version__.encode())
    for path in sorted(Path(__file__).parents[1].rglob("*")):
        if path.suffix in (".py", ".c", ".h"):
            digest.update(path.read_bytes())
    return digest.digest()
