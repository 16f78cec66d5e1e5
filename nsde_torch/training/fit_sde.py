"""A neural SDE, or the neural ODE that it is without diffusion, fitted to runs."""

import copy
import math
from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor, nn

from nsde_torch.data import Windows
from nsde_torch.errors import NonFiniteError
from nsde_torch.evaluation.metrics import thinned
from nsde_torch.models.model import inputs_before, normal
from nsde_torch.models.neural_sde import NeuralSDE, SDESpec
from nsde_torch.sde import brownian
from nsde_torch.training.fit_innovations import fit_innovations
from nsde_torch.training.loop import Loop
from nsde_torch.training.losses import data_loss, distance_terms
from nsde_torch.training.options import LossOptions
from nsde_torch.training.prepare import error_scale, prepare
from nsde_torch.training.task import Fitted, Parameters, Task

_FAST = ("filter.", "h.", "log_", "system.")
_FAST_RATE = 3.0
_ALIKE = 5e-4  # scores as near as this are equal: where sensor noise rules them, the later weights are the better ones
_FAR = 0.1  # weight of the declared sigma_max as the least diffusion away from the data
_SAID_EVERY = 5  # validations between lines where there is no terminal to draw a bar on
_VALIDATION_WINDOWS, _VALIDATION_PARTICLES = 256, 8
_BLOCK_S = 4.0
_NO_INTERVAL = (
    "no interval: errors over many steps under the log's own inputs do not tell what an input does if a controller "
    "made them; take loss=default"
)


class Fit(Loop):
    """One optimisation of one model, from windows of some runs, others of them held out, and all, for the last steps.

    `scale` is that of the error channels (n_error,).
    """

    model: NeuralSDE
    lower = "trainer.lr or the horizon"

    def __init__(
        self,
        model: NeuralSDE,
        train: Windows,
        validation: Windows,
        everything: Windows,
        *,
        scale: Tensor,
        loss: LossOptions,
        task: Task,
    ) -> None:
        named = [(n, p) for n, p in model.named_parameters() if p.requires_grad]
        groups = [
            {"params": [p for n, p in named if n.startswith(_FAST) is fast], "factor": factor}
            for fast, factor in ((False, 1.0), (True, 1.0 if loss.kind == "paper" else _FAST_RATE))
        ]
        options = task.options
        optimiser = torch.optim.Adam(groups, lr=options.lr, foreach=True)
        super().__init__(model, optimiser, task, options, said_every=_SAID_EVERY * options.validate_every)
        self.train, self.validation, self.everything = train, validation, everything
        self.scale, self.loss = scale, loss
        self.noise = torch.Generator().manual_seed(2 * task.seed + 2)
        self.compile = options.compile != "off"

    # ---- losses ---------------------------------------------------------------------------------------

    def errors(
        self,
        windows: Windows,
        indices: Tensor,
        particles: int,
        generator: torch.Generator,
        *,
        paired: bool = False,
    ) -> tuple[Tensor, Tensor]:
        """Errors of sampled paths (P, B, T, n_error) and measured states (B, T + 1, nx) of some windows.

        With `paired`, the second half of the paths has the mirrored noise of the first.
        """
        model, system = self.model, self.model.system
        x, u, t0 = windows.batch(indices)
        before = inputs_before(system, windows, indices)
        u, before = model.applied_pair(u, windows.dt_model, before)
        drawn = (particles // 2 if paired else particles, len(x), windows.horizon)
        made = {"generator": generator, "device": x.device, "dtype": x.dtype}

        def mirrored(noise: Tensor) -> Tensor:
            return torch.cat((noise, -noise)) if paired else noise

        dw = mirrored(brownian(*drawn, model.nz, dt=windows.dt_model, **made))  # type: ignore[arg-type]
        std = model.measurement_std
        start = mirrored(normal((*drawn[:2], model.n_start), generator, x)) if model.n_start else None
        path = model.paths(
            windows.initial_states(indices),
            u,
            dt=windows.dt_model,
            noise=dw,
            start=start,
            std=windows.start_share * std,
            compile=self.compile,
            check=False,
            t0=t0.to(x.dtype),
            u_before=before,
        )[:, :, 1:]
        if model.spec.measurement:
            path = path + mirrored(normal((*drawn, system.nx), generator, x)) * std
        return system.error(path, x[:, 1:]), x

    def terms(self) -> dict[str, Tensor]:
        """All losses of one minibatch, weighted; their sum is what is minimised."""
        options, model = self.loss, self.model
        source = self.everything if self.polishing else self.train
        indices = source.sample(self.options.batch, self.batches)
        paired = options.kind == "replay" and options.particles > 1
        errors, x = self.errors(source, indices, options.particles, self.noise, paired=paired)
        loss = data_loss(errors, self.scale, kind=options.kind, early=options.early, paired=paired)
        rows = x.reshape(-1, x.shape[-1])
        pick = torch.randint(len(rows), (options.points,), generator=self.batches)
        features = model.system.features(rows[pick.to(rows.device)])
        out = {"data": options.data * loss, **distance_terms(model, features, options, self.noise)}
        if options.kind == "replay" and model.h.log_sigma_max.requires_grad:
            declared = x.new_tensor(model.system.defaults.sigma_max).clamp_min(1e-12)
            far = model.h(x.new_ones(1))[0, : len(declared)]
            out["far"] = _FAR * torch.relu((declared / far).log()).square().sum()
        if options.decay:
            # a network beside declared physics is kept small; one that is all there is on its port is not
            ports = model.system.physics_ports & set(model.residual_ports)
            beside = [model.residuals[port.value] for port in ports]
            if beside:
                norms = [network.weight_norm() for network in beside]  # type: ignore[operator]
                out["decay"] = options.decay * torch.stack(norms).sum()
        return out

    @torch.no_grad()
    def validate(self) -> float:
        """Data loss on held-out windows of the training runs, always with the same windows and noise."""
        generator = torch.Generator().manual_seed(self.task.seed)
        indices = thinned(torch.arange(len(self.validation)), _VALIDATION_WINDOWS)
        particles = _VALIDATION_PARTICLES if self.loss.kind == "replay" else self.loss.particles
        errors, _ = self.errors(self.validation, indices, particles, generator)
        return float(data_loss(errors, self.scale, kind=self.loss.kind, early=self.loss.early, paired=False))

    def _clip(self) -> Tensor:
        limit = math.inf if self.options.clip is None else self.options.clip
        return nn.utils.clip_grad_norm_(self.parameters, limit)

    def _judge(self) -> float:
        progress, score = self.progress, self.validate()
        if score < progress.best_score or score - progress.best_score < _ALIKE * abs(progress.best_score):
            progress.best_score = min(score, progress.best_score)
            progress.best_step = progress.step
            self.kept = copy.deepcopy(self.model.state_dict())
        if progress.step and math.isinf(progress.best_score):
            raise NonFiniteError(
                f"the validation score is not finite at step {progress.step}: sampled paths leave the finite numbers. "
                "Lower trainer.lr or system.horizon, or look at the data summary for outliers."
            )
        return score

    def _further(self) -> dict[str, Tensor]:
        return {"noise": self.noise.get_state()}

    def _continue(self, tensors: Mapping[str, Tensor]) -> None:
        self.noise.set_state(tensors["noise"])


def fit_sde(task: Task) -> Fitted:
    """Fit by innovations, or by gradient steps on windows where that is asked for or there is no physics.

    Errors are those of `fit_innovations`; a NonFiniteError also where the optimisation leaves the finite numbers.
    """
    spec = task.spec
    assert isinstance(spec, SDESpec)
    if task.loss.kind == "innovations" and spec.physics:
        return fit_innovations(task)
    # without physics nothing can be taken out of a step: the whole drift is fitted to paths
    loss = replace(task.loss, kind="replay") if task.loss.kind == "innovations" else task.loss
    model = NeuralSDE(spec, generator=torch.Generator().manual_seed(task.seed), values=task.values)
    model = model.to(device=task.device, dtype=task.dtype)
    denoise = loss.kind == "replay" and (spec.measurement or model.system.sensor_noise)
    windows = Windows(task.runs, spec.dt, spec.horizon, dtype=task.dtype, device=task.device, denoise=denoise)
    train, held = windows.held_out(
        task.validation, _BLOCK_S * windows.pace, torch.Generator().manual_seed(task.seed)
    )
    prepare(model, task.runs, train, clock_scale=task.clock, given=task.values)
    scale = error_scale(model, train)
    fit = Fit(model, train, held, windows, scale=scale, loss=loss, task=task)
    fit.run()

    declared = model.system.all_declared() if spec.physics else {}
    parameters: Parameters = {
        name: {
            "value": value.tolist(),
            "half_width_90": [None] * value.numel(),
            "unit": unit,
            "note": _NO_INTERVAL,
        }
        for name, (value, unit) in declared.items()
    }
    return Fitted(model, fit.progress, lambda: parameters)
