"""What a model leaves of every step of runs that it has not seen: figures that feedback does not bend.

    residual    root mean square of the residual rate, in means over a quarter of a second, beside the measured rate
    nats        Whittle log likelihood of the residuals under the model's own diffusion, disturbances and sensors, per
                second of data and channel: what a stationary filter of the model would score (see
                `evaluation.spectra`); only the difference of two models on the same runs means something

Errors of predictions over many steps under the log's own inputs reward a model for knowing the pilot; these do not: a
step's input and state come before what is new in it.
"""

import copy
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from nsde_torch.arrays import Array
from nsde_torch.data import Run
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.evaluation.report import number, table
from nsde_torch.evaluation.residuals import Residuals, disturbed_channels, residuals, with_networks
from nsde_torch.evaluation.spectra import Disturbance, density, spectrum
from nsde_torch.inference.steps import steps_of
from nsde_torch.models.capabilities import is_equation
from nsde_torch.models.model import Model
from nsde_torch.models.neural_sde import NeuralSDE
from nsde_torch.recording.smoothing import as_applied
from nsde_torch.sysid.physics import Physics, bump, explained
from nsde_torch.systems.parameters import ParameterVector


@torch.no_grad()
def one_step(model: Model, runs: Sequence[Run]) -> dict[str, dict[str, Any]] | None:
    """Residuals of a model's steps.

    Args:
        model: The model.
        runs: Runs on the step of the data.

    Returns:
        channel -> `unit` (of its rate), `measured`, `residual` (root mean squares), `explained` (share of the variance)
        and `nats_per_s` (None without a diffusion); None for a model without physics, or runs that are too short.
    """
    if not model.capabilities.has_physics:
        return None
    system = copy.deepcopy(model.system).cpu()
    applied = list(runs) if model.filter is None else as_applied(runs, system.nu)
    clock = float(model.clock_scale)
    try:
        vector = ParameterVector(system)
        steps = steps_of(vector.system, applied, clock=clock, smooth=False)
    except (ConfigError, DataError):
        return None
    physics = Physics(vector, steps)
    # networks are evaluated in single precision, whatever the model is in
    own = copy.deepcopy(model).cpu().float() if is_equation(model) else None
    if own is not None and own.residual_ports:
        physics = with_networks(physics, own)
    left = residuals(physics, vector.inside(vector.start), tuple(system.residual_ports))
    change = left.change
    window = bump(left.dt)
    physics.estimate_sensors(change)
    laws = _laws(own, left) if own is not None and own.capabilities.is_stochastic else {}
    out = {}
    for channel in explained(physics, change[:, left.rows], left.rows, window):
        row = physics.names.index(channel.name)
        out[channel.name] = {
            "unit": channel.unit,
            "measured": channel.measured,
            "residual": channel.residual,
            "explained": channel.r2,
            "nats_per_s": _nats(change[:, [row]], left, laws[row]) if row in laws else None,
        }
    return out


def _laws(model: NeuralSDE, left: Residuals) -> dict[int, Disturbance]:
    """Laws of the channels that forces move, as a model has them on these data."""
    clock, system = float(model.clock_scale), model.system
    sigma = model.h(model.eta(system.features(left.states.float()))).square().mean(0).sqrt()
    sensor = model.measurement_std
    forces = {}
    for k, column in enumerate(disturbed_channels(model, left)):
        tau = float(model.tau[k])
        std = float(sigma[system.nx + k]) * math.sqrt(0.5 * tau / clock)
        forces[int(left.rows[column])] = (std, tau)
    return {
        int(row): Disturbance(
            float(sigma[row]) / math.sqrt(clock), *forces.get(int(row), (0.0, 1.0)), float(sensor[row])
        )
        for row in left.rows
    }


def _nats(change: Array, left: Residuals, law: Disturbance) -> float:
    """Whittle log likelihood [nat/s] of residuals (N, 1)."""
    seen = spectrum(change, left.series, left.dt)
    s = np.maximum(density(law, seen.angle, left.dt), 1e-300)
    return float(-(seen.count * (np.log(s) + seen.power / s)).sum() / (len(left.series) * left.dt))


def one_step_table(steps: Mapping[str, Mapping[str, Any]]) -> str:
    """What a person reads of it."""
    rows = [
        [
            f"{name} [{c['unit']}]",
            number(c["measured"]),
            number(c["residual"]),
            f"{c['explained']:.1%}",
            "-" if c["nats_per_s"] is None else f"{c['nats_per_s']:.2f}",
        ]
        for name, c in steps.items()
    ]
    return table(
        ["held-out rate of, means over 0.25 s", "measured", "left", "explained", "one-step nat/s"], rows
    )
