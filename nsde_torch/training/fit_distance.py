"""The distance eta alone: its three losses on states of the data (see `nsde_torch.training.losses`)."""

import torch
from torch import Tensor

from nsde_torch.models.neural_sde import NeuralSDE
from nsde_torch.training.losses import distance_losses, draw_ball, mu_weight
from nsde_torch.training.options import LossOptions


def fit_distance(
    model: NeuralSDE, features: Tensor, *, loss: LossOptions, steps: int, rate: float, seed: int
) -> None:
    """Teach the distance of a model what is near and what is far.

    Args:
        model: Changed in place.
        features: Features of the data (N, nf).
        loss: Weights and sizes.
        steps: Gradient steps.
        rate: Adam's learning rate.
        seed: Seed of states and points.
    """
    generator = torch.Generator().manual_seed(seed)
    ball = loss.ball_radius or model.system.defaults.ball_radius
    optimiser = torch.optim.Adam(model.eta.parameters(), lr=rate, foreach=True)
    schedule = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, 0.1, total_iters=steps)
    weight = mu_weight(loss, model)
    for _ in range(steps):
        pick = torch.randint(len(features), (loss.points,), generator=generator)
        near = features[pick.to(features.device)]
        directions, share = draw_ball(loss.points, loss.ball_samples, near.shape[1], generator, near)
        gradient, convexity, reward = distance_losses(
            model.eta, near, directions, share, kind=loss.kind, near=ball, far=loss.far_radius
        )
        optimiser.zero_grad(set_to_none=True)
        (loss.gradient * gradient + loss.convexity * convexity + weight * reward).backward()
        optimiser.step()
        schedule.step()
