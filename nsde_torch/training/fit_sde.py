"""A neural SDE, or the neural ODE that it is without diffusion, fitted to runs."""

from dataclasses import replace

import numpy as np
import torch

from nsde_torch.data import Windows
from nsde_torch.models.neural_sde import NeuralSDE, SDESpec
from nsde_torch.training.confidence import declared_confidence
from nsde_torch.training.fit_innovations import fit_innovations
from nsde_torch.training.fitting import Fit
from nsde_torch.training.prepare import error_scale, prepare
from nsde_torch.training.task import Fitted, Parameters, Task

_BLOCK_S = 4.0
_NO_INTERVAL = (
    "no interval: errors over many steps under the log's own inputs do not tell what an input does if a controller "
    "made them; take loss=default"
)


def fit_sde(task: Task) -> Fitted:
    """Fit by innovations, or by gradient steps on windows where that is asked for or there is no physics.

    Raises:
        ConfigError: the system declares no parameter.
        DataError: a run is too short.
        NonFiniteError: the optimisation left the finite numbers.
    """
    spec = task.spec
    assert isinstance(spec, SDESpec)
    if task.loss.kind == "innovations" and spec.physics:
        return fit_innovations(task)
    # without physics nothing can be taken out of a step: the whole drift is fitted to paths
    loss = replace(task.loss, kind="replay") if task.loss.kind == "innovations" else task.loss
    model = NeuralSDE(spec, generator=torch.Generator().manual_seed(task.seed), values=task.values)
    model = model.to(device=task.device, dtype=task.dtype)
    windows = Windows(
        task.runs,
        spec.dt,
        spec.horizon,
        dtype=task.dtype,
        device=task.device,
        denoise=loss.kind == "replay" and (spec.measurement or model.system.sensor_noise),
    )
    blocks = torch.Generator().manual_seed(task.seed)
    train, held = windows.held_out(task.validation, _BLOCK_S, blocks)
    prepare(model, task.runs, train, clock_scale=task.clock, start=True, given=task.values)
    scale = error_scale(model, train)
    fit = Fit(
        model,
        train,
        held,
        windows,
        scale=scale,
        loss=loss,
        options=task.options,
        seed=task.seed,
        identity=task.identity,
    )
    fit.run(title=task.name, checkpoint=task.checkpoint, log=task.log, quiet=task.quiet)

    def parameters() -> Parameters:
        if not spec.physics:
            return {}
        found = declared_confidence(model, train, scale)
        nu = model.system.nu
        if not any(np.ptp(run.u[:, :nu], axis=0).any() for run in task.runs):
            return found
        none = {name: [None] * value.numel() for name, (value, _) in model.system.all_declared().items()}
        return {name: {**p, "half_width_90": none[name], "note": _NO_INTERVAL} for name, p in found.items()}

    return Fitted(model, fit.progress, parameters)
