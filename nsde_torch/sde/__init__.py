"""Solvers of controlled stochastic equations dz = f(t, z, u) dt + g(t, z, u) * dW with diagonal noise."""

from typing import TYPE_CHECKING

from nsde_torch.lazy import names, resolver

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
    from nsde_torch.sde.registry import STEPS, make_step
    from nsde_torch.sde.step import (
        SDE,
        Calculus,
        HasDiagonalDerivative,
        HoldsColumns,
        Step,
        Time,
        WithoutNoise,
        within,
    )

__all__ = names(__name__)

__getattr__ = resolver(__name__)
