"""Problems and controllers for the tests of the controller, without compilation."""

import torch
from torch import Tensor

from nsde_torch.control.controller import Controller, SafetyOptions
from nsde_torch.control.predictor import Predictor
from nsde_torch.control.problem import Horizon, ProblemOptions
from nsde_torch.control.reference import Reference
from nsde_torch.control.solve import Problem, SolverOptions
from nsde_torch.models import NeuralSDE
from nsde_torch.rotation import turned
from nsde_torch.systems import System

PAID: tuple[dict[str, object], ...] = (
    {"rate_weight": 3.0, "input_centre": 0.3},
    {"speed_limit": 1.0, "tilt_limit": 10.0, "fence": ((-1, 1), (-1, 1), (0, 1.2))},
    {"low": 0.3, "high": 0.5},
)
"""What plans may pay for beside the supplement's cost, and limits of inputs."""


def horizon_of(knowledge: NeuralSDE | System, **options: object) -> Horizon:
    """A horizon in double precision."""
    given = ProblemOptions(**options)  # type: ignore[arg-type]
    return Horizon(Predictor(knowledge, dt=given.dt, dtype=torch.float64), given)


def problem_of(horizon: Horizon, path: Reference, *, rows: int, off: float = 1.0, seed: int = 0) -> Problem:
    """Problems along a path, started off it."""
    g = torch.Generator().manual_seed(seed)
    dtype = horizon.predictor.dtype

    def draw(width: int, size: float) -> Tensor:
        return off * size * torch.randn(rows, width, generator=g, dtype=torch.float64)

    t = 8.0 + 20.0 * torch.rand(rows, generator=g, dtype=torch.float64)
    o = horizon.options
    ref = torch.stack([path.window(float(s), dt=o.dt, steps=o.steps) for s in t])
    x = path.at(t)
    moved = x[:, :6] + torch.cat((draw(3, 0.1), draw(3, 0.2)), 1)
    x = torch.cat((moved, turned(x[:, 6:10], draw(3, 0.08)), x[:, 10:] + draw(3, 0.3)), 1)
    last = torch.full((rows, horizon.nu), 0.4, dtype=dtype)
    z0 = horizon.predictor.augment(x.to(dtype), last)
    return Problem(z0, ref.to(dtype), last, torch.zeros(rows, horizon.nd, dtype=dtype))


def controller_of(knowledge: NeuralSDE | System, *, batch: int = 1, **safety: float) -> Controller:
    """A controller without compilation."""
    return Controller(
        knowledge,
        problem=ProblemOptions(steps=10),
        solver=SolverOptions(compile="off", iterations=3, tolerance=5e-3),
        safety=SafetyOptions(**safety),  # type: ignore[arg-type]
        batch=batch,
    )
