"""Controllers in C: written as a pair of files, read, compiled here and called.

The record of what they are is the last comment of the header. The hash in it is that of other exported files
(`container`), over the source, the header without the record, and the record.
"""

import ctypes
import tempfile
from collections.abc import Mapping
from math import prod
from pathlib import Path
from typing import Any, final

import numpy as np
import torch
from torch import Tensor

from nsde_torch.control.compiled import NoCompiler, compiled
from nsde_torch.errors import ExportError
from nsde_torch.export import container
from nsde_torch.export.step import Sizes

MARK, _BEGIN, _END = "@RECORD@", "/* nsde record\n", "\n*/\n"
FLAGS = ("-std=c99", "-O2")
"""What the files compile with; a compiler that is not known yet may warn of more than those of the tests do."""


def is_c(path: Path) -> bool:
    """Whether a file is of this kind, by its name."""
    return path.suffix == ".c"


def write(path: Path, source: str, header: str, record: Mapping[str, Any]) -> str:
    """Write a source file and the header beside it, with their record in the place of `MARK`; their hash (hex)."""
    members = {"controller.c": source.encode(), "controller.h": header.encode()}
    text, digest = container.signed(members, record)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.with_suffix(".h").write_text(header.replace(MARK, text.decode()), encoding="utf-8")
    path.write_text(source, encoding="utf-8")
    return digest


def read(path: Path) -> dict[str, Any]:
    """The record of a pair of files, checked; ExportError where one is missing, changed, or of another format."""
    beside = path.with_suffix(".h")
    for file in (path, beside):
        if not file.is_file():
            raise ExportError(
                f"no file {file}; give the .c that `nsde export format=c` wrote, its .h beside it."
            )
    header = beside.read_text(encoding="utf-8")
    start, end = header.find(_BEGIN), header.rfind(_END)
    if not 0 <= start < end:
        raise ExportError(f"{path} is no exported controller (its header holds no record). Export anew.")
    text = header[start + len(_BEGIN) : end]
    rest = header[: start + len(_BEGIN)] + MARK + header[end:]
    members = {"controller.c": path.read_bytes(), "controller.h": rest.encode()}
    return container.checked(path, {**members, container.RECORD: text.encode()})


def library(path: Path) -> ctypes.CDLL:
    """The controller, compiled for this computer and loaded; ExportError where there is no C compiler, or it refuses.

    It is machine code, and runs when called.
    """
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "controller.so"
        try:
            compiled(path.resolve(), made, FLAGS)
        except NoCompiler as error:
            raise ExportError(
                f"to run a controller in C here needs a C compiler: {error}. Install one (apt install gcc), or verify "
                "it where there is one."
            ) from error
        return ctypes.CDLL(str(made))


@final
class CController:
    """A controller in C behind the face of the exported step: `step` and `predict` of tensors, see `step.tensors`."""

    def __init__(self, built: ctypes.CDLL, about: Mapping[str, Any]) -> None:
        self._sizes = Sizes(**about["sizes"])
        self._dtype = getattr(torch, about["dtype"])
        number = ctypes.c_float if self._dtype == torch.float32 else ctypes.c_double
        tables = [tuple(entry["shape"]) for entry in about["step"]["outputs"][:-3]]
        self._parts = [(prod(shape), shape) for shape in tables]

        class Command(ctypes.Structure):
            _fields_ = (
                *(("numbers", number * sum(width for width, _ in self._parts)),),
                *(("iterations", ctypes.c_int), ("status", ctypes.c_int)),
            )

        self._command = Command()
        self._numbers = torch.from_numpy(np.ctypeslib.as_array(self._command.numbers))
        self._work, self._pilot = (
            ctypes.create_string_buffer(ctypes.c_uint.in_dll(built, f"nsde_{k}_bytes").value)
            for k in ("work", "pilot")
        )
        self._built, self._real = built, number

    def step(self, state: Tensor, valid: Tensor, elapsed: Tensor, *rest: Tensor) -> tuple[Tensor, ...]:
        """See `step.tensors`."""
        # held by a name while the call looks at them
        given, reference, last, push, memory, before = map(self._given, (state, *rest))
        plan, accepted, late = before.clone(), int(float(valid) > 0.5), self._real(float(elapsed))
        tables = map(_at, (reference, last, push, memory, plan))
        self._built.nsde_step(self._work, _at(given), accepted, late, *tables, ctypes.byref(self._command))
        return self._answer(plan)

    def predict(self, z: Tensor, u: Tensor, push: Tensor) -> tuple[Tensor]:
        """See `step.tensors`."""
        after = torch.empty(self._sizes.nz, dtype=self._dtype)
        tables = [*map(self._given, (z, u, push)), after]
        self._built.nsde_predict(*map(_at, tables))
        return (after.double(),)

    def reset(self, state: Tensor) -> None:
        """Start the controller with its estimator from a measured state (nx,)."""
        state = self._given(state)
        self._built.nsde_reset(self._pilot, _at(state))

    def command(self, state: Tensor, reference: Tensor) -> tuple[Tensor, ...]:
        """The answer, without `after`, of the controller with its estimator.

        `state` (nx,) is the newest measured one; `reference` (steps, nx) are the states to track from the time on at
        which the command acts.
        """
        state, reference = self._given(state), self._given(reference)
        self._built.nsde_command_of(self._pilot, _at(state), 1, _at(reference), ctypes.byref(self._command))
        return self._answer(torch.empty(0))[:-1]

    def _given(self, x: Tensor) -> Tensor:
        return x.to(self._dtype).contiguous()

    def _answer(self, plan: Tensor) -> tuple[Tensor, ...]:
        out, start = [], 0
        for width, shape in self._parts:
            out.append(self._numbers[start : start + width].double().view(shape).clone())
            start += width
        counts = (self._command.status, self._command.iterations)
        return (*out, *(torch.tensor(float(n), dtype=torch.float64) for n in counts), plan.double())


def _at(x: Tensor) -> ctypes.c_void_p:
    return ctypes.c_void_p(x.data_ptr() if x.numel() else None)
