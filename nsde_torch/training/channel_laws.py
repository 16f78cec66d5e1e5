"""From the laws of residuals to the diffusion, the disturbances and the sensors of a neural SDE."""

import math

import numpy as np
import torch
from torch import Tensor

from nsde_torch.evaluation.residuals import Residuals, disturbed_channels
from nsde_torch.evaluation.spectra import Disturbance, fit, spectrum
from nsde_torch.models.neural_sde import NeuralSDE
from nsde_torch.rotation import rotation_between
from nsde_torch.sysid.physics import Physics

_LEAST = 1e-7  # a diffusion or a sensor that is nothing, in the units of the state


def channel_laws(physics: Physics, found: Residuals, model: NeuralSDE) -> dict[str, Disturbance]:
    """Laws of what is left of every channel, by the name of the state.

    Args:
        physics: Names and attitudes.
        found: Residuals with the networks.
        model: Says which ports are disturbed, and the least correlation time.
    """
    system, q, left = model.system, model.system.quaternion, found.change
    lasting = {int(found.rows[c]) for c in disturbed_channels(model, found)}
    forced = set(found.rows.tolist())
    shortest = 2.0 * model.spec.dt * float(model.clock_scale)
    out: dict[str, Disturbance] = {}
    for i, name in enumerate(system.state_names):
        if q is not None and q.start <= i < q.stop:
            continue
        seen = spectrum(left[:, [i]], found.series, found.dt)
        law = fit([seen], lasting=i in forced, shortest=shortest)
        # a force that lasts, of a model that has no state for it, is as much diffusion over a window
        out[name] = law if i in lasting else law.without_memory(model.spec.horizon * shortest / 2.0)
    if q is not None:
        attitude = physics.attitude
        turn = rotation_between(attitude, attitude + torch.as_tensor(left[:, q])).numpy()
        law = fit([spectrum(turn, found.series, found.dt)], lasting=False, shortest=shortest)
        half = Disturbance(
            0.5 * law.diffusion, 0.0, law.tau, 0.5 * law.sensor
        )  # a rotation is twice its quaternion
        out.update(dict.fromkeys(system.state_names[q], half))
    if physics.turned is not None:  # measured in the world, told in the body
        names = system.state_names[physics.turned]
        sensor, diffusion = (
            math.sqrt(np.mean([getattr(out[n], part) ** 2 for n in names]))
            for part in ("sensor", "diffusion")
        )
        out.update({n: Disturbance(diffusion, out[n].std, out[n].tau, sensor) for n in names})
    return out


@torch.no_grad()
def set_laws(model: NeuralSDE, laws: dict[str, Disturbance], found: Residuals, features: Tensor) -> None:
    """Give a model diffusion, disturbances and sensors, so that their mean over the data is that of the laws.

    Args:
        model: Changed in place; its distance is fitted.
        laws: Of every state.
        found: Says which channels the disturbances move.
        features: Features of the data (N, nf).
    """
    system, clock = model.system, float(model.clock_scale)
    names = system.state_names
    sigma = [laws[n].diffusion * math.sqrt(clock) for n in names]
    channels = [laws[names[int(found.rows[c])]] for c in disturbed_channels(model, found)]
    sigma += [law.std * math.sqrt(2.0 * clock / law.tau) for law in channels]
    own = torch.tensor(sigma, dtype=torch.float64).clamp_min(_LEAST)
    if model.h.log_sigma_max.requires_grad:
        declared = torch.tensor(system.defaults.sigma_max, dtype=torch.float64) * math.sqrt(clock)
        least = torch.cat((declared, torch.zeros(len(channels), dtype=torch.float64)))
        model.h.through(model.eta(features), own, least)
    if channels:
        tau = torch.tensor([law.tau for law in channels]) - 2.0 * model.spec.dt
        model.log_tau.copy_(tau.clamp_min(1e-4).log())
    if model.spec.measurement:
        sensors = torch.tensor([laws[n].sensor for n in names]).clamp_min(_LEAST)
        model.log_measurement_std.copy_(sensors.log())
