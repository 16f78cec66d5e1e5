"""Solvers of controlled stochastic equations dz = f(t, z, u) dt + g(t, z, u) * dW with diagonal noise."""

from typing import TYPE_CHECKING

from nsde_torch.lazy import resolver

if TYPE_CHECKING:
    from nsde_torch.sde.checks import brownian, coarsen
    from nsde_torch.sde.derivative import (
        CompilationWarning,
        compiled,
        diffusion_and_slope,
        with_calculus,
    )
    from nsde_torch.sde.integrate import rollout
    from nsde_torch.sde.options import IntegratorOptions, TorchDiffEqOptions
    from nsde_torch.sde.protocol import (
        SDE,
        Calculus,
        HasDiagonalDerivative,
        HoldsColumns,
        Time,
        WithoutNoise,
        within,
    )
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
    "WithoutNoise",
    "brownian",
    "coarsen",
    "compiled",
    "diffusion_and_slope",
    "make_step",
    "rollout",
    "with_calculus",
    "within",
]

__getattr__ = resolver(__name__)
