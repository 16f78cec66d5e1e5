"""What a user chooses of an integrator."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

from nsde_torch.options import Checked, documented, key

if TYPE_CHECKING:
    from nsde_torch.sde.step import Step

STEP_HOMES: dict[str, str] = {
    "euler_maruyama": "nsde_torch.sde.steps:EulerMaruyama",
    "heun": "nsde_torch.sde.steps:Heun",
    "milstein": "nsde_torch.sde.steps:MilsteinItoFree",
    "milstein_stratonovich_free": "nsde_torch.sde.steps:MilsteinStratonovichFree",
    "milstein_ito": "nsde_torch.sde.steps:MilsteinIto",
    "milstein_stratonovich": "nsde_torch.sde.steps:MilsteinStratonovich",
    "milstein_heun": "nsde_torch.sde.steps:MilsteinHeun",
    "rk4": "nsde_torch.sde.steps:RungeKutta4",
    "exponential": "nsde_torch.sde.exponential:Exponential",
    "exponential_maruyama": "nsde_torch.sde.exponential:ExponentialMaruyama",
    "midpoint": "nsde_torch.sde.steps:Midpoint",
    "torchdiffeq": "nsde_torch.sde.torchdiffeq_step:TorchDiffEq",
}
"""Name of a solver of the package -> `module:Class`; a line here registers one, and imports none."""

TORCHDIFFEQ_METHODS = (
    *("euler", "midpoint", "rk4", "heun3"),
    *("dopri5", "dopri8", "bosh3", "adaptive_heun", "fehlberg2"),
)


@documented
@dataclass(frozen=True)
class IntegratorOptions(Checked):
    """An integrator by name."""

    name: str | None = key(
        None, "name of the integrator, set by solver=, or module:Class of your own; null: the system's own"
    )

    @property
    def settings(self) -> dict[str, Any]:
        """Arguments of the integrator's class."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "name"}


@documented
@dataclass(frozen=True)
class TorchDiffEqOptions(IntegratorOptions):
    """A method of torchdiffeq, for models without diffusion."""

    name: str | None = key("torchdiffeq", "name of the integrator, set by solver=")
    method: str = key(
        "dopri5",
        "method of torchdiffeq; the first four take fixed steps",
        choices=TORCHDIFFEQ_METHODS,
    )
    rtol: float = key(1e-5, "relative tolerance of adaptive methods", above=0)
    atol: float = key(1e-6, "absolute tolerance of adaptive methods", unit="state", above=0)
    adjoint: bool = key(False, "gradients by the adjoint equation: less memory, more time")


def integrator_options(solver: str | type[Step] | IntegratorOptions | None) -> IntegratorOptions:
    """An integrator by its name or class, with its own settings; options as they are."""
    if isinstance(solver, IntegratorOptions):
        return solver
    if isinstance(solver, type):
        own = not solver.__module__.startswith("nsde_torch.")
        solver = f"{solver.__module__}:{solver.__qualname__}" if own else solver.name
    return TorchDiffEqOptions() if solver == "torchdiffeq" else IntegratorOptions(solver)
