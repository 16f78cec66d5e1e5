"""The solvers of the package: a file each, and a line here. Listing them imports none."""

STEP_HOMES: dict[str, str] = {
    "euler_maruyama": "nsde_torch.sde.deterministic:EulerMaruyama",
    "heun": "nsde_torch.sde.heun:Heun",
    "milstein": "nsde_torch.sde.milstein:MilsteinItoFree",
    "milstein_stratonovich_free": "nsde_torch.sde.milstein:MilsteinStratonovichFree",
    "milstein_ito": "nsde_torch.sde.milstein:MilsteinIto",
    "milstein_stratonovich": "nsde_torch.sde.milstein:MilsteinStratonovich",
    "milstein_heun": "nsde_torch.sde.heun:MilsteinHeun",
    "rk4": "nsde_torch.sde.deterministic:RungeKutta4",
    "exponential": "nsde_torch.sde.exponential:Exponential",
    "exponential_maruyama": "nsde_torch.sde.exponential:ExponentialMaruyama",
    "midpoint": "nsde_torch.sde.deterministic:Midpoint",
    "torchdiffeq": "nsde_torch.sde.torchdiffeq_step:TorchDiffEq",
}
"""Name of a solver -> `module:Class`."""
