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
    """`Estimator.forward` as machine code, of an estimator with its predictor; see `library`.

    NoCompiler: there is none for this model, or no compiler.
    """

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
