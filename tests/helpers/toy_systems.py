"""Small systems with closed forms, and runs of them; `SDESpec.system` names them by module and class."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nsde_torch.data import Run
from nsde_torch.effects import Parameter, Port
from nsde_torch.models import NeuralSDE, SDESpec
from nsde_torch.systems import Defaults, ErrorGroup, ResidualPort, System

DT = 0.05


class Decay(System):
    """x' = -rate x + u: with noise, an Ornstein-Uhlenbeck process."""

    name = "decay"
    state_names = ("x",)
    state_units = ("1",)
    input_names = ("u",)
    input_units = ("1/s",)
    ports = {Port.FORCE: 1}
    residual_ports = {Port.FORCE: ResidualPort(1, 0.1, "1/s")}
    defaults = Defaults(DT, 20, (0.5,), 0.05, 1.0, "euler_maruyama")
    error_groups = (ErrorGroup("position", (0,), "1"),)
    PARAMETERS = {"rate": Parameter(1.0, "1/s", low=0.0)}

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        rate = u - self.value("rate") * x
        return rate + forces[Port.FORCE] if Port.FORCE in forces else rate


class Gusty(Decay):
    """The same with a lasting disturbance of the force."""

    name = "gusty"
    disturbed_ports = (Port.FORCE,)


def make_model(
    cls: type[System], *, seed: int = 0, dtype: torch.dtype = torch.float32, **spec: Any
) -> NeuralSDE:
    """A model of a system of this module."""
    own = cls.defaults
    options: dict[str, Any] = {"dt": own.dt, "horizon": own.horizon, "step": own.step, **spec}
    made = SDESpec(f"{cls.__module__}:{cls.__name__}", **options)
    return NeuralSDE(made, generator=torch.Generator().manual_seed(seed)).to(dtype)


@torch.no_grad()
def fix_sigma(model: NeuralSDE, sigma: float | Tensor) -> NeuralSDE:
    """No residual, and a diffusion of this size everywhere (states; disturbances after them)."""
    for network in model.residuals.values():
        network.layers[-1].weight.zero_()  # type: ignore[union-attr, operator, index]
    model.h.slope.fill_(-40.0)
    model.h.offset.fill_(40.0)
    model.h.log_sigma_max.copy_(torch.as_tensor(sigma).log())
    return model


def decay_runs(
    count: int, seconds: float, *, sigma: float, rate: float = 1.0, seed: int = 0, dt: float = DT
) -> list[Run]:
    """Runs of x' = -rate x + sigma W' by the Euler-Maruyama scheme of the same step: exact for the model."""
    rng = np.random.default_rng(seed)
    n = round(seconds / dt) + 1
    runs = []
    for k in range(count):
        x = np.empty((n, 1))
        x[0] = sigma / math.sqrt(2 * rate) * rng.standard_normal()
        for i in range(n - 1):
            x[i + 1] = x[i] - rate * dt * x[i] + sigma * math.sqrt(dt) * rng.standard_normal()
        runs.append(Run(f"run_{k}", dt * np.arange(n), x, np.zeros((n, 1))))
    return runs
