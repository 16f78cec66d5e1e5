"""Solvers of controlled stochastic equations dz = f(t, z, u) dt + g(t, z, u) * dW with diagonal noise."""

from typing import TYPE_CHECKING

from nsde_torch.lazy import resolver

if TYPE_CHECKING:
    from nsde_torch.sde.compilation import CompilationWarning, compiled
    from nsde_torch.sde.derivative import diffusion_and_slope, drift_correction, with_calculus
    from nsde_torch.sde.integrate import rollout
    from nsde_torch.sde.noise import brownian, coarsen
    from nsde_torch.sde.options import IntegratorOptions, TorchDiffEqOptions
    from nsde_torch.sde.protocol import SDE, Calculus, HasDiagonalDerivative, HoldsColumns, Time, within
    from nsde_torch.sde.registry import STEPS, make_step
    from nsde_torch.sde.step import Step

__all__ = [
    "SDE",
    "STEPS",
    "Calculus",
    "CompilationWarning",
    "HasDiagonalDerivative",
    "HoldsColumns",
    "IntegratorOptions",
    "Step",
    "Time",
    "TorchDiffEqOptions",
    "brownian",
    "coarsen",
    "compiled",
    "diffusion_and_slope",
    "drift_correction",
    "make_step",
    "rollout",
    "with_calculus",
    "within",
]

__getattr__ = resolver(
    __name__,
    {
        "SDE": "protocol",
        "STEPS": "registry",
        "Calculus": "protocol",
        "CompilationWarning": "compilation",
        "HasDiagonalDerivative": "protocol",
        "HoldsColumns": "protocol",
        "IntegratorOptions": "options",
        "Step": "step",
        "Time": "protocol",
        "TorchDiffEqOptions": "options",
        "brownian": "noise",
        "coarsen": "noise",
        "compiled": "compilation",
        "diffusion_and_slope": "derivative",
        "drift_correction": "derivative",
        "make_step": "registry",
        "rollout": "integrate",
        "with_calculus": "derivative",
        "within": "protocol",
    },
)
