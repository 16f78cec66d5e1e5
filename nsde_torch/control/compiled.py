"""Iterations of the solver and updates of the estimator as machine code, made of C that is written for the problem.

They compute in double precision whatever that of the controller is, row by row of a batch: the numbers of the torch
that they stand for, up to rounding. What writes the C is imported where a library is not kept yet: it takes most of a
second to load.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, final

import torch
from torch import Tensor

from nsde_torch.control.codegen.library import NoCompiler, library
from nsde_torch.control.gauss_newton import AcceleratedGradient, GaussNewton, Iterate
from nsde_torch.control.predictor import Predictor

if TYPE_CHECKING:
    from nsde_torch.control.autopilots import Estimator

Say = Callable[[str], None] | None
_DOUBLE = torch.float64


@final
class CompiledMethod:
    """Iterations of a method as machine code.

    It works on tables of its own, one solve at a time: the memory between iterations says no more than that there was
    one.

    Args:
        method: What it stands for.
        name: Its name, for the file and for messages.
        folder: Where machine code is kept; see `library`.
        say: Called with one line when it is made.

    Raises:
        NoCompiler: there is none for these paths or this model, or no compiler.
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

        built = _library(source, method, name, folder, say)
        pointer, count = ctypes.c_void_p, ctypes.c_int
        self._run = _function(built.nsde_iterate, pointer, count, count, *[pointer] * 10)
        work, self._own = (ctypes.c_uint.in_dll(built, f"nsde_{k}_bytes").value for k in ("work", "memory"))
        self._work = torch.empty(work, dtype=torch.uint8)
        self._tables: tuple[Tensor, ...] = ()

    def start(self, u: Tensor) -> tuple[Tensor, ...]:
        """Memory before the first iteration: there is none."""
        return ()

    def iterate(
        self, arguments: Sequence[Tensor], memory: tuple[Tensor, ...]
    ) -> tuple[Iterate, tuple[Tensor, ...]]:
        """Improve plans; see `GaussNewton.iterate`. What it returns is in double precision, u and z until the next."""
        first, n = not memory, len(arguments[0])
        if first:
            if not self._tables or len(self._tables[0]) != n:
                self._tables = self._made(arguments)
            for table, given in zip(self._tables, arguments, strict=False):
                table.copy_(given)
        self._run(self._work.data_ptr(), n, first, *(x.data_ptr() for x in self._tables))
        cost, before, gap = (x.clone() for x in self._tables[-3:])
        return Iterate(self._tables[1], self._tables[2], cost, before, gap, gap.max()), self._tables[-1:]

    def _made(self, arguments: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Tables that C works on: the arguments, what the method keeps, and the costs and gaps (N,)."""
        n = len(arguments[0])
        own = torch.empty(n * self._own, dtype=torch.uint8)
        return (
            *(torch.empty(x.shape, dtype=_DOUBLE) for x in arguments),
            own,
            *torch.empty(3, n, dtype=_DOUBLE),
        )


def compiled_estimator(
    made: Estimator, predictor: Predictor, *, folder: str | None = None, say: Say = None
) -> Callable[..., list[Tensor]]:
    """`Estimator.forward` as machine code.

    Args:
        made: The estimator.
        predictor: What predicts its samples.
        folder: Where machine code is kept; see `library`.
        say: Called with one line when it is made.

    Raises:
        NoCompiler: there is none for this model, or no compiler.
    """

    def source() -> str:
        from nsde_torch.control.codegen.sources import estimator_library

        return estimator_library(made, predictor)

    built = _library(source, made, "estimator", folder, say)
    run = _function(built.nsde_estimate, ctypes.c_int, *[ctypes.c_void_p] * 7)

    def update(x: Tensor, z: Tensor, d: Tensor, commands: Tensor) -> list[Tensor]:
        tables = [_double(t) for t in (x, z, d, commands)]
        out = [torch.empty(t.shape, dtype=_DOUBLE) for t in (z, d, z)]
        run(len(x), *(t.data_ptr() for t in (*tables, *out)))
        return [t.to(x.dtype) for t in out]

    return update


def _library(
    source: Callable[[], str], made_of: object, name: str, folder: str | None, say: Say
) -> ctypes.CDLL:
    try:
        return library(source, made_of, name, folder=folder, say=say)
    except NoCompiler:
        raise
    except Exception as error:  # whatever a model of the user does that numbers alone cannot
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise NoCompiler(reason.removesuffix(".")) from error


def _function(function: Any, *arguments: type[Any]) -> Callable[..., None]:
    function.argtypes, function.restype = arguments, None
    run: Callable[..., None] = function
    return run


def _double(x: Tensor) -> Tensor:
    return x.to(_DOUBLE).contiguous()
