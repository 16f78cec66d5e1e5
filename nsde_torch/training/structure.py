"""What a model is made of: what the user chose, the machine's own constants, and what the data ask for.

sigma_max      learned; the system's with loss=paper or where the user declares it
input filter   as many taps as undo the smoothing that the training runs show; none with loss=paper
sensor noise   learned by innovations, and where the system asks for it
disturbance    where the system has ports for one
integrator     of second order in the drift for innovations, without noise for models without diffusion
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from typing import Any

from nsde_torch.data.run import Run
from nsde_torch.errors import ConfigError
from nsde_torch.models.ensemble import EnsembleSpec
from nsde_torch.models.identified import SysidSpec
from nsde_torch.models.model import ModelSpec
from nsde_torch.models.neural_sde import SDESpec
from nsde_torch.models.options import (
    DiffusionOptions,
    EnsembleOptions,
    ModelOptions,
    NodeOptions,
    NsdeOptions,
    SysidOptions,
)
from nsde_torch.recording.smoothing import smoothing_width
from nsde_torch.sde.options import IntegratorOptions
from nsde_torch.sde.registry import make_step
from nsde_torch.sde.step import Step
from nsde_torch.systems.base import System
from nsde_torch.systems.options import SystemOptions
from nsde_torch.training.options import LossOptions


def filter_reach(runs: Sequence[Run], n_inputs: int, dt: float) -> int:
    """Taps that an input filter needs on each side to undo the smoothing found in the runs; 0 for none."""
    return math.ceil(smoothing_width(runs, n_inputs) / dt - 1e-6)


def model_spec(
    model: ModelOptions,
    system: SystemOptions,
    machine: System,
    runs: Sequence[Run],
    *,
    loss: str = "innovations",
    integrator: IntegratorOptions | None = None,
) -> ModelSpec:
    """The specification of a model.

    Args:
        model: What the user chose.
        system: The machine's name, physics and constants.
        machine: The system that these options make.
        runs: Training runs; whether the inputs were smoothed is read from them.
        loss: Kind of loss.
        integrator: Integrator; None is the one that fits.

    Raises:
        ConfigError: an integrator that does not fit the kind of model.
    """
    own = machine.defaults
    common = {
        "kind": model.kind,
        "effects": tuple(system.effects),
        "declared": None if system.declared is None else tuple(system.declared),
        "system_options": dict(system.options),
        "dt": own.dt if system.dt is None else system.dt,
        "horizon": own.horizon if system.horizon is None else system.horizon,
    }
    for kind, make in _SPECS.items():
        if isinstance(model, kind):
            return make(model, system, machine, runs, loss, integrator or IntegratorOptions(), common)
    raise ConfigError(f"no kind of model has options of the class {type(model).__name__}.")


def machine_losses(losses: LossOptions, system: SystemOptions) -> LossOptions:
    """Losses with the constants that the user gave for the machine, where the losses leave them open."""
    mu = system.lambda_mu if losses.mu is None else losses.mu
    radius = system.ball_radius if losses.ball_radius is None else losses.ball_radius
    return replace(losses, mu=mu, ball_radius=radius)


def integrator_step(
    integrator: IntegratorOptions, machine: System, *, kind: str = "nsde", loss: str = "replay"
) -> Step:
    """The integrator; None is the system's own, and rk4 for a model without diffusion.

    A model of innovations has the parameters of the machine, not those that make up for a coarse step: its own is one
    of second order in the drift.

    Raises:
        ConfigError: There is no such integrator, or it does not fit the kind of model.
    """
    own = "milstein_heun" if loss == "innovations" and kind == "nsde" else machine.defaults.step
    own = "rk4" if kind in ("node", "sysid") else own
    made = make_step(integrator.name or own, **integrator.settings)
    if kind in ("node", "sysid") and not made.deterministic:
        raise ConfigError(
            f"`model={kind}` has no diffusion, and solver={made.name} is for equations with noise. "
            "Take solver=rk4, midpoint or torchdiffeq, or leave it out."
        )
    if kind == "blackbox_nsde" and made.deterministic:
        raise ConfigError(
            f"`model=blackbox_nsde` has a diffusion, which solver={made.name} would leave out; choose a "
            "solver for equations with noise, or leave it out."
        )
    return made


def _sde_spec(
    model: NodeOptions | DiffusionOptions,
    system: SystemOptions,
    machine: System,
    runs: Sequence[Run],
    loss: str,
    integrator: IntegratorOptions,
    common: dict[str, Any],
) -> SDESpec:
    solver = integrator_step(integrator, machine, kind=model.kind, loss=loss)
    paper = loss == "paper"
    physics = model.kind != "blackbox_nsde"
    innovations = physics and loss == "innovations"
    plain = paper or solver.deterministic
    chosen = {f.name: getattr(model, f.name) for f in fields(model)}
    learned = (chosen.get("sigma") or ("declared" if paper else "learned")) == "learned"
    declared = None if learned else tuple(machine.defaults.sigma_max)
    widths: dict[str, Any] = {k: tuple(v) for k, v in chosen.items() if k.endswith("_hidden")}
    reach = model.filter_reach
    if reach is None:
        reach = 0 if paper else filter_reach(runs, machine.nu, common["dt"])
    measurement, disturbance = chosen.get("measurement"), chosen.get("disturbance")
    if measurement is None:
        measurement = not plain and (innovations or machine.sensor_noise)
    if disturbance is None:
        disturbance = not plain and bool(machine.disturbed_ports)
    return SDESpec(
        system=system.name,
        **common,
        **widths,
        step=solver.name,
        solver=integrator.settings,
        physics=physics,
        sigma_max=declared if system.sigma_max is None else tuple(system.sigma_max),
        filter_reach=reach,
        measurement=measurement,
        disturbance=physics and disturbance,
        learn_lag=innovations and isinstance(model, NodeOptions | NsdeOptions) and model.learn_lag,
        loss=loss,
    )


def _ensemble_spec(
    model: EnsembleOptions,
    system: SystemOptions,
    machine: System,
    runs: Sequence[Run],
    loss: str,
    integrator: IntegratorOptions,
    common: dict[str, Any],
) -> EnsembleSpec:
    return EnsembleSpec(
        system=system.name,
        **common,
        members=model.members,
        hidden=tuple(model.hidden),
        batch=model.batch,
        steps=model.steps,
        propagation=model.propagation,
    )


def _sysid_spec(
    model: SysidOptions,
    system: SystemOptions,
    machine: System,
    runs: Sequence[Run],
    loss: str,
    integrator: IntegratorOptions,
    common: dict[str, Any],
) -> SysidSpec:
    solver = integrator_step(integrator, machine, kind=model.kind)
    reach = filter_reach(runs, machine.nu, common["dt"])
    # Restored inputs lack what is fast: weights by the noise would trust them most where they tell least.
    method = model.method or ("differences" if reach else "weak")
    return SysidSpec(
        system=system.name,
        **common,
        method=method,
        filter_reach=reach,
        max_iterations=model.max_iterations,
        step=solver.name,
        solver=integrator.settings,
    )


_SPECS: dict[type[ModelOptions], Callable[..., ModelSpec]] = {
    NodeOptions: _sde_spec,
    DiffusionOptions: _sde_spec,
    EnsembleOptions: _ensemble_spec,
    SysidOptions: _sysid_spec,
}
