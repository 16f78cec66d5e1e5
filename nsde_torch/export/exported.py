"""An exported controller, loaded: it has the face of `control.controller.Controller`.

A file is code and runs when it is called: the hash in its record guards against accidents. Load files that you trust.
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, final

import torch
from torch import Tensor, nn

from nsde_torch.control.controller import LATE, Plan
from nsde_torch.effects import Port
from nsde_torch.errors import ExportError, ShapeError
from nsde_torch.export import c_file, container, jit
from nsde_torch.export.step import AGE, JUMPED, N_HEAD, SOLVES, Sizes, first_inputs, packed
from nsde_torch.systems import System
from nsde_torch.systems.parameters import frozen

Function = Callable[..., Sequence[Tensor]]


@final
class Prediction(nn.Module):
    """One sample of the file's model, with the attributes of `control.predictor.Predictor`."""

    def __init__(self, function: Function, about: dict[str, Any], system: System, dt: float) -> None:
        super().__init__()
        self._function = function
        sizes = Sizes(**about["sizes"])
        self.nx, self.nu, self.nz, self.nd = sizes.nx, sizes.nu, sizes.nz, sizes.nd
        self.ports = {Port(name): int(width) for name, width in about["ports"].items()}
        self.dt, self.dtype = dt, getattr(torch, about["dtype"])
        self.system = frozen(system, dtype=self.dtype)
        """Declared physics with the model's values; the learned part is in the file alone."""

    def forward(self, z: Tensor, u: Tensor, d: Tensor) -> Tensor:
        """States a sample later (N, nz), from states (N, nz), inputs (N, nu) and pushes (N, nd)."""
        rows = zip(z.double(), u.double(), d.double(), strict=True)
        return torch.stack([self._function(*row)[0] for row in rows]).to(self.dtype)

    def augment(self, x: Tensor, u: Tensor) -> Tensor:
        """See `Predictor.augment`."""
        return self.system.augment(x, u)


@final
class ExportedController:
    """A controller out of a file that `nsde export` wrote; `plan` and its attributes are those of `Controller`.

    An ExportError refuses a file that is damaged, changed, of another version or for another processor, or in C where
    there is no compiler.

    Attributes:
        record: What the file says of itself.
        known: Declared physics with the model's values.
        pilot: The file's own estimator and controller, which files in C have; else None.
    """

    batch = 1

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        in_c = c_file.is_c(self.path)
        archive, self.record = (b"", c_file.read(self.path)) if in_c else container.read(self.path)
        self.step: Function  # the step itself; see `step.tensors`
        predict: Function
        try:
            container.check(self.record)
            self.pilot: c_file.CController | None = None
            if self.record["kind"] == container.C:
                self.pilot = c_file.CController(c_file.library(self.path), self.record)
                self.step, predict = self.pilot.step, self.pilot.predict
            else:
                self.step, predict = _functions(self.record, archive, self.path)
            self.options, self.solver, self.safety = container.options_of(self.record)
            self.sizes = Sizes(**self.record["sizes"])
            self.known = container.system_of(self.record)
            self.hover = torch.tensor(self.record["hover"], dtype=getattr(torch, self.record["dtype"]))
            sample = float(self.record["sample_s"])
        except ExportError as error:
            raise ExportError(f"{path}: {error}") from error
        except (LookupError, TypeError, ValueError) as error:
            raise ExportError(f"{path}: its record is of another version ({error}). Export anew.") from error
        self.dtype = self.hover.dtype
        self.predictor = Prediction(predict, self.record, self.known, self.options.dt)
        self.sample = Prediction(predict, self.record, self.known, sample)
        self._jumped = self._solves = 0.0

    @torch.no_grad()
    def plan(
        self,
        x: Tensor,
        reference: Tensor,
        before: Plan | None = None,
        *,
        elapsed: float = 0.0,
        **more: Tensor | None,
    ) -> Plan:
        """See `Controller.plan`; ShapeError for wrong axes or columns."""
        s = self.sizes
        if x.shape != (1, s.nx) or reference.shape != (1, s.steps, s.nx):
            raise ShapeError(
                f"`x` must be (batch=1, nx={s.nx}) and `reference` (batch=1, steps={s.steps}, nx={s.nx}); got "
                f"{tuple(x.shape)} and {tuple(reference.shape)}."
            )
        given = {"state": x, "reference": reference, **more}  # `last`, `push`, `memory`
        arguments = first_inputs(s, x[0].double())
        arguments |= {k: v[0].double().contiguous() for k, v in given.items() if v is not None}
        arguments["elapsed"] = torch.tensor(elapsed, dtype=torch.float64)
        if before is not None:
            arguments["before"] = packed(before, self._jumped, self._solves)
        arguments["before"][JUMPED] = self._jumped
        started = time.perf_counter()
        u, *_, states, cost, gap, status, iterations, after = self.step(*arguments.values())
        seconds = time.perf_counter() - started
        self._jumped, self._solves = float(after[JUMPED]), float(after[SOLVES])
        word, dtype, deadline = self.record["status"][int(status)], self.dtype, self.solver.deadline
        if ":" not in word and deadline is not None and seconds > deadline:
            word += f":{LATE}"
        z = after[N_HEAD + s.steps * s.nu :].view(1, s.particles, s.steps + 1, s.nz)
        u, states, cost, gap = (part[None].to(dtype) for part in (u, states, cost, gap))
        ms, dt, age = 1e3 * seconds, self.options.dt, after[AGE, None].to(dtype)
        return Plan(u, states, cost, gap, (word,), ms, int(iterations), dt, age, z.to(dtype))


def _functions(about: dict[str, Any], archive: bytes, path: Path) -> tuple[Function, Function]:
    """`step` and `predict` of a file that has been checked."""
    kind = about["kind"]
    if kind == container.TORCHSCRIPT:
        try:
            return jit.loaded(archive)
        except (RuntimeError, AttributeError) as error:
            raise ExportError(f"torch cannot load it ({str(error).splitlines()[0]}). Export anew.") from error
    if kind == container.AOTI:
        from nsde_torch.export.ahead import loaded

        return loaded(path, about["loops"])
    raise ExportError(
        f"it is of the kind {kind!r}; this version knows {container.TORCHSCRIPT}, {container.AOTI} and {container.C}."
    )
