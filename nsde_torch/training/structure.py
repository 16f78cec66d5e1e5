"""What a model is made of and trained by: what the user chose, the machine's constants, and what the data ask for."""

from collections.abc import Sequence
from dataclasses import replace

from nsde_torch.data.run import Run
from nsde_torch.models.kind import Choice, model_kind
from nsde_torch.models.model import ModelSpec
from nsde_torch.models.options import ModelOptions
from nsde_torch.sde.options import IntegratorOptions
from nsde_torch.systems.base import System
from nsde_torch.systems.options import SystemOptions
from nsde_torch.training.options import LossOptions


def model_spec(
    model: ModelOptions,
    system: SystemOptions,
    machine: System,
    runs: Sequence[Run],
    *,
    loss: str = "innovations",
    integrator: IntegratorOptions | None = None,
) -> ModelSpec:
    """The specification of a model, whose kind says what it is made of.

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
    used = integrator or IntegratorOptions()
    choice = Choice(options=model, system=system, machine=machine, runs=runs, loss=loss, integrator=used)
    return model_kind(model.kind).make_spec(choice)


def machine_losses(losses: LossOptions, system: SystemOptions) -> LossOptions:
    """Losses with the constants that the user gave for the machine, where the losses leave them open."""
    mu = system.lambda_mu if losses.mu is None else losses.mu
    radius = system.ball_radius if losses.ball_radius is None else losses.ball_radius
    return replace(losses, mu=mu, ball_radius=radius)
