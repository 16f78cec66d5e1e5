"""The optimisation loop: Adam on minibatches of windows, early stopping, checkpoints, exact resume.

What is validated and kept is a running average of the weights (Polyak and Juditsky 1992), which is less
noisy than the last iterate.
"""

import copy
import logging
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from tqdm.auto import tqdm

from nsde_torch.data import Windows
from nsde_torch.errors import CheckpointError, NonFiniteError
from nsde_torch.evaluation.before import inputs_before
from nsde_torch.models.neural_sde import NeuralSDE
from nsde_torch.progress import no_bar
from nsde_torch.sde import brownian
from nsde_torch.training.checkpoint import read_checkpoint, write_checkpoint
from nsde_torch.training.losses import data_loss, distance_losses, draw_ball, mu_weight
from nsde_torch.training.options import LossOptions, TrainerOptions
from nsde_torch.training.progress import Progress

_FAST = ("filter.", "h.", "log_", "system.")
_FAST_RATE = 3.0
_ALIKE = 5e-4  # scores as near as this are equal: where sensor noise rules them, the later weights are the better ones
_FAR = 0.1  # weight of the declared sigma_max as the least diffusion away from the data
_AVERAGE = 0.98
_SAID_EVERY = 5  # validations between lines where there is no terminal to draw a bar on
_LOG = logging.getLogger(__name__)
_VALIDATION_WINDOWS, _VALIDATION_PARTICLES = 256, 8


class Fit:
    """One optimisation of one model.

    Args:
        model: Changed in place.
        train: Training windows.
        validation: Windows of the same runs that training does not see.
        everything: All windows of these runs, for the last steps.
        scale: Scale of the error channels (n_error,).
        loss: Weights of the losses.
        options: Settings of the optimisation.
        seed: Seed of batches and noise.
        identity: Hash of all that the numbers depend on; a checkpoint of another is refused.
    """

    def __init__(
        self,
        model: NeuralSDE,
        train: Windows,
        validation: Windows,
        everything: Windows,
        *,
        scale: Tensor,
        loss: LossOptions,
        options: TrainerOptions,
        seed: int,
        identity: str = "",
    ) -> None:
        self.model, self.train, self.validation, self.everything = model, train, validation, everything
        self.source = train
        self.identity = identity
        self.scale, self.loss, self.options, self.seed = scale, loss, options, seed
        self.batches = torch.Generator().manual_seed(2 * seed + 1)
        self.noise = torch.Generator().manual_seed(2 * seed + 2)
        named = [(n, p) for n, p in model.named_parameters() if p.requires_grad]
        fast = [p for n, p in named if n.startswith(_FAST)]
        slow = [p for n, p in named if not n.startswith(_FAST)]
        self.optimiser = torch.optim.Adam(
            [
                {"params": slow, "factor": 1.0},
                {"params": fast, "factor": 1.0 if loss.kind == "paper" else _FAST_RATE},
            ],
            lr=options.lr,
            foreach=True,
        )
        self.parameters = [p for _, p in named]
        self.progress = Progress()
        self.average = [p.detach().clone() for p in self.parameters]
        self.kept: dict[str, Tensor] = copy.deepcopy(model.state_dict())
        self.ball = loss.ball_radius or model.system.defaults.ball_radius
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
        start = mirrored(_normal(generator, x, *drawn[:2], model.n_start)) if model.n_start else None
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
            path = path + mirrored(_normal(generator, x, *drawn, system.nx)) * std
        return system.error(path, x[:, 1:]), x

    def terms(self) -> dict[str, Tensor]:
        """All losses of one minibatch, weighted; their sum is what is minimised."""
        options, model = self.loss, self.model
        indices = self.source.sample(self.options.batch, self.batches)
        paired = options.kind == "replay" and options.particles > 1
        errors, x = self.errors(self.source, indices, options.particles, self.noise, paired=paired)
        loss = data_loss(errors, self.scale, kind=options.kind, early=options.early, paired=paired)
        out = {"data": options.data * loss}
        rows = x.reshape(-1, x.shape[-1])
        pick = torch.randint(len(rows), (options.points,), generator=self.batches)
        features = model.system.features(rows[pick.to(rows.device)])
        directions, share = draw_ball(
            options.points, options.ball_samples, features.shape[1], self.noise, features
        )
        gradient, convexity, reward = distance_losses(
            model.eta,
            features,
            directions,
            share,
            kind=options.kind,
            near=self.ball,
            far=options.far_radius,
        )
        out["gradient"] = options.gradient * gradient
        out["convexity"] = options.convexity * convexity
        out["mu"] = mu_weight(options, model) * reward
        if options.kind == "replay" and model.h.log_sigma_max.requires_grad:
            declared = x.new_tensor(model.system.defaults.sigma_max).clamp_min(1e-12)
            far = model.h(x.new_ones(1))[0, : len(declared)]
            out["far"] = _FAR * torch.relu((declared / far).log()).square().sum()
        if options.decay:
            # a network beside declared physics is kept small; one that is all there is on its port is not
            beside = [
                model.residuals[port.value] for port in model.system.physics_ports & set(model.residual_ports)
            ]
            if beside:
                norms = [network.weight_norm() for network in beside]  # type: ignore[operator]
                out["decay"] = options.decay * torch.stack(norms).sum()
        return out

    @torch.no_grad()
    def validate(self) -> float:
        """Data loss on held-out windows of the training runs, always with the same windows and noise."""
        generator = torch.Generator().manual_seed(self.seed)
        count = min(len(self.validation), _VALIDATION_WINDOWS)
        indices = torch.linspace(0, len(self.validation) - 1, count).round().long()
        particles = _VALIDATION_PARTICLES if self.loss.kind == "replay" else self.loss.particles
        errors, _ = self.errors(self.validation, indices, particles, generator)
        return float(data_loss(errors, self.scale, kind=self.loss.kind, early=self.loss.early, paired=False))

    # ---- loop -----------------------------------------------------------------------------------------

    def run(
        self,
        *,
        title: str,
        checkpoint: Path | None = None,
        log: Callable[[int, dict[str, float]], None] | None = None,
        quiet: bool = False,
    ) -> Progress:
        """Optimise until the steps are done or the validation score stops falling; keeps the best weights.

        Args:
            title: Name of the progress bar.
            checkpoint: File (without suffix) to write to and to resume from if it is there.
            log: Called with step and losses at each validation.
            quiet: No progress bar.

        Raises:
            NonFiniteError: the loss is not finite.
        """
        if checkpoint is not None:
            self.restore(checkpoint)
        progress, options = self.progress, self.options
        bar = tqdm(
            total=options.steps + options.polish,
            initial=progress.step + progress.polished,
            desc=title,
            unit="step",
            disable=no_bar(quiet),
            leave=False,
            mininterval=0.5,
        )
        with bar:
            if progress.step == 0:
                self._score({})
            for losses in self._steps():
                bar.update()
                if progress.polished:
                    if checkpoint is not None and progress.polished % options.checkpoint_every == 0:
                        self.save(checkpoint)
                    continue
                if progress.step % options.validate_every == 0 or progress.step == options.steps:
                    row = self._score(losses)
                    bar.set_postfix(
                        loss=f"{row.get('loss', math.nan):.4f}", validation=f"{row['validation']:.4f}"
                    )
                    if log is not None:
                        log(progress.step, row)
                    if (
                        bar.disable
                        and not quiet
                        and progress.step % (_SAID_EVERY * options.validate_every) == 0
                    ):
                        _LOG.info(
                            "%s: step %d of %d, validation %.4f",
                            title,
                            progress.step,
                            options.steps,
                            row["validation"],
                        )
                if checkpoint is not None and progress.step % options.checkpoint_every == 0:
                    self.save(checkpoint)
        if progress.polished:
            self._put(self.average)
            self.kept = copy.deepcopy(self.model.state_dict())
        self.model.load_state_dict(self.kept)
        if checkpoint is not None:
            self.save(checkpoint)
        return progress

    def _steps(self) -> Iterator[dict[str, Tensor]]:
        progress, options = self.progress, self.options
        while not progress.polished and progress.step < options.steps and not progress.stopped:
            losses = self._step(options.rate(progress.step))
            progress.step += 1
            self._follow(progress.step)
            yield losses
        if options.polish and not progress.polished:
            self.model.load_state_dict(self.kept)
            self.average = [p.detach().clone() for p in self.parameters]
            self.optimiser.state.clear()
        self.source = self.everything
        while progress.polished < options.polish:
            losses = self._step(options.lr_end)
            progress.polished += 1
            self._follow(progress.polished)
            yield losses

    def _step(self, rate: float) -> dict[str, Tensor]:
        for group in self.optimiser.param_groups:
            group["lr"] = group["factor"] * rate
        self.optimiser.zero_grad(set_to_none=True)
        losses = self.terms()
        total = torch.stack(list(losses.values())).sum()
        total.backward()
        limit = math.inf if self.options.clip is None else self.options.clip
        norm = nn.utils.clip_grad_norm_(self.parameters, limit)
        if not bool(torch.isfinite(norm)):
            raise NonFiniteError(
                f"the gradient is not finite at step {self.progress.step + 1} (loss {float(total.detach()):.4g}). "
                "Lower trainer.lr or the horizon, or look at the data summary for outliers."
            )
        self.optimiser.step()
        return {k: v.detach() for k, v in losses.items()}

    @torch.no_grad()
    def _follow(self, steps: int) -> None:
        """Move the running average of the weights, faster during its first steps."""
        keep = min(_AVERAGE, steps / (steps + 10))
        torch._foreach_lerp_(self.average, list[Tensor](self.parameters), 1 - keep)

    def _score(self, losses: dict[str, Tensor]) -> dict[str, float]:
        progress = self.progress
        current = [p.detach().clone() for p in self.parameters]
        self._put(self.average)
        score = self.validate()
        row = {"step": float(progress.step), "validation": score}
        row |= {k: float(v) for k, v in losses.items()}
        if losses:
            row["loss"] = sum(float(v) for v in losses.values())
        progress.history.append(row)
        if score < progress.best_score or score - progress.best_score < _ALIKE * abs(progress.best_score):
            progress.best_score = min(score, progress.best_score)
            progress.best_step = progress.step
            self.kept = copy.deepcopy(self.model.state_dict())
        self._put(current)
        if progress.step and math.isinf(progress.best_score):
            raise NonFiniteError(
                f"the validation score is not finite at step {progress.step}: sampled paths leave the finite numbers. "
                "Lower trainer.lr or system.horizon, or look at the data summary for outliers."
            )
        late = progress.step - progress.best_step
        if late >= self.options.patience * self.options.validate_every:
            progress.stopped = True
        return row

    @torch.no_grad()
    def _put(self, values: list[Tensor]) -> None:
        for parameter, value in zip(self.parameters, values, strict=True):
            parameter.copy_(value)

    # ---- checkpoints ----------------------------------------------------------------------------------

    def save(self, path: Path) -> None:
        """Write everything that the rest of the optimisation depends on."""
        tensors = {f"model.{k}": v for k, v in self.model.state_dict().items()}
        tensors |= {f"kept.{k}": v for k, v in self.kept.items()}
        tensors |= {"batches": self.batches.get_state(), "noise": self.noise.get_state()}
        for i, (parameter, average) in enumerate(zip(self.parameters, self.average, strict=True)):
            tensors[f"average.{i}"] = average
            for key, value in self.optimiser.state.get(parameter, {}).items():
                tensors[f"adam.{i}.{key}"] = value
        p = self.progress
        about: dict[str, Any] = {
            "identity": self.identity,
            "step": p.step,
            "best_step": p.best_step,
            "best_score": p.best_score,
            "history": p.history,
            "stopped": p.stopped,
            "polished": p.polished,
        }
        write_checkpoint(path, tensors, about)

    def restore(self, path: Path) -> bool:
        """Continue from a checkpoint if there is one.

        Raises:
            CheckpointError: the checkpoint is damaged or of another model.
        """
        found = read_checkpoint(path, self.model.state_dict())
        if found is None:
            return False
        tensors, about = found
        if about.pop("identity", "") != self.identity:
            raise CheckpointError(
                f"checkpoint {path.with_suffix('.safetensors')} is of another training: runs, seed, loss, trainer or "
                "model differ. Resume with the configuration of the run, or start a new one in another run_dir."
            )
        device = next(self.model.parameters()).device
        self.model.load_state_dict(
            {k[6:]: v.to(device) for k, v in tensors.items() if k.startswith("model.")}
        )
        self.kept = {k[5:]: v.to(device) for k, v in tensors.items() if k.startswith("kept.")}
        self.batches.set_state(tensors["batches"])
        self.noise.set_state(tensors["noise"])
        for i, parameter in enumerate(self.parameters):
            self.average[i] = tensors[f"average.{i}"].to(device)
            prefix = f"adam.{i}."
            state = {k[len(prefix) :]: v for k, v in tensors.items() if k.startswith(prefix)}
            if state:
                self.optimiser.state[parameter] = {
                    k: v if k == "step" else v.to(device) for k, v in state.items()
                }
        self.progress = Progress(**about)
        return True


def _normal(generator: torch.Generator, like: Tensor, *shape: int) -> Tensor:
    draw = torch.randn(*shape, generator=generator, device=generator.device, dtype=like.dtype)
    return draw.to(like.device)
