"""A neural SDE, or the neural ODE that it is without diffusion, fitted to runs."""

import torch

from nsde_torch.data import Windows
from nsde_torch.learning.confidence import declared_confidence
from nsde_torch.learning.fitting import Fit
from nsde_torch.learning.prepare import error_scale, prepare
from nsde_torch.learning.task import Fitted, Parameters, Task
from nsde_torch.models.neural_sde import NeuralSDE, SDESpec

_BLOCK_S = 4.0


def fit_sde(task: Task) -> Fitted:
    """Fit by gradient steps on windows.

    Raises:
        NonFiniteError: the optimisation left the finite numbers.
    """
    spec = task.spec
    assert isinstance(spec, SDESpec)
    model = NeuralSDE(spec, generator=torch.Generator().manual_seed(task.seed), values=task.values)
    model = model.to(device=task.device, dtype=task.dtype)
    windows = Windows(
        task.runs,
        spec.dt,
        spec.horizon,
        dtype=task.dtype,
        device=task.device,
        denoise=task.loss.kind == "default" and (spec.measurement or model.system.sensor_noise),
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
        loss=task.loss,
        options=task.options,
        seed=task.seed,
        identity=task.identity,
    )
    fit.run(title=task.name, checkpoint=task.checkpoint, log=task.log)

    def parameters() -> Parameters:
        return declared_confidence(model, train, scale) if spec.physics else {}

    return Fitted(model, fit.progress, parameters)
