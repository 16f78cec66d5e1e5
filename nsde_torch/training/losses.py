"""Losses over windows of the log's own inputs, and what a good distance is (loss=default: `fit_innovations`).

Data loss, loss=paper: squared error of sampled paths, L = E |x_pred - x|^2 / scale^2 (supplement A). Its minimum over
sigma is sigma = 0: a spread can only add to it, so that intervals hold a few per cent of the truth instead of 90. Where
the authors' public code departs from the supplement, and where this departs from both, is in
docs/content/theory/losses.md ("loss=paper").

Data loss, loss=replay: the continuous ranked probability score of P paths X_p, and the error of their centre,

    CRPS = mean_p |X_p - x| - E|X_p - X_q| / 2          centre = |(X_p + X_p') / 2 - x|

averaged over channels and steps, early steps weighing more (Gneiting and Raftery, JASA 102 (2007)). Paths come in pairs
p, p' with mirrored noise (antithetic variates; Hammersley and Morton 1956). E|X_p - X_q| is estimated from paths of
different pairs, as the fair form of Ferro (QJRMS 140 (2014)); one pair alone represents it with |X_p - X_p'| / sqrt 2,
which is right for Gaussian laws. The centre of a pair, the path without noise to first order, teaches the drift at
little more than the noise of the data. Validation scores independent paths by the CRPS alone.

Distance losses, for features y of the data and points y' in a ball around them:

    gradient    |dE/dy|^2                                    the data are a minimum
    convexity   max(0, E(y) + dE/dy (y' - y) + mu(y) |y' - y|^2 / 2 - E(y'))^2
    reward      1 / mu(y)

With loss=paper, E is eta itself and the ball has the supplement's radius r. Else E is the argument of eta (which is not
bounded, so that it can be convex everywhere) and the radius is drawn log-uniform between r and a multiple of the data's
own spread. There the data loss does not move eta: a distance that also had to explain noise inside the data would stop
being a distance.
"""

import torch
from torch import Tensor

from nsde_torch.evaluation.scores import crps
from nsde_torch.models.networks import Distance
from nsde_torch.models.neural_sde import NeuralSDE
from nsde_torch.training.options import LossOptions


def paired_score(errors: Tensor) -> Tensor:
    """CRPS and error of the centre of paths with mirrored noise, element by element; see the module docstring.

    Of ensemble minus truth (P, ...), in its unit: (...). P is 1, or even, path p + P / 2 with the mirrored noise of
    path p.
    """
    p = errors.shape[0]
    if p == 1:
        return errors[0].abs()
    first, mirrored = errors[: p // 2], errors[p // 2 :]
    partners = (first - mirrored).abs().sum(0)
    if p == 2:
        spread = partners * 2**-0.5
    else:
        all_pairs = (errors.abs().mean(0) - crps(errors)) * (p * (p - 1))
        spread = (all_pairs - partners) / (p * (p - 2) / 2)
    return errors.abs().mean(0) - spread / 2 + (0.5 * (first + mirrored)).abs().mean(0)


def data_loss(errors: Tensor, scale: Tensor, *, kind: str, early: float, paired: bool) -> Tensor:
    """Data loss of errors (P, B, T, n_error), without the first state, of which `scale` matter (n_error,).

    `early` is the exponent of the weights of the steps, and `paired` says that paths have mirrored noise ("replay").
    """
    relative = errors / scale
    if kind == "paper":
        return relative.square().mean()
    step = torch.arange(1, errors.shape[2] + 1, device=errors.device, dtype=errors.dtype)
    weight = step**-early
    return ((paired_score if paired else crps)(relative) * (weight / weight.mean())[:, None]).mean()


def distance_losses(
    eta: Distance, features: Tensor, directions: Tensor, share: Tensor, *, kind: str, near: float, far: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradient, convexity and reward loss of a distance, each 0-d.

    Of raw features of data (M, nf), unit vectors (M, K, nf) and uniform numbers in [0, 1) (M, K, 1). The ball has the
    radius `near`, but with "paper" up to `far` [standard deviations].
    """
    y = eta.standardise(features)
    m, k, n = directions.shape
    radius = near * share ** (1.0 / n) if kind == "paper" else near * (far / near) ** share
    offset = directions * radius
    value, slope = eta.energy_and_gradient(y)
    around = eta.energy((y[:, None] + offset).reshape(m * k, n)).reshape(m, k)
    if kind == "paper":
        slope = slope * eta.link_slope(value)[:, None]
        value, around = eta.link(value), eta.link(around)
    mu = eta.mu(y)
    bound = value[:, None] + (slope[:, None] * offset).sum(-1) + 0.5 * mu[:, None] * radius[..., 0] ** 2
    return slope.square().sum(1).mean(), torch.relu(bound - around).square().mean(), (1.0 / mu).mean()


def draw_ball(
    points: int, samples: int, width: int, generator: torch.Generator, like: Tensor
) -> tuple[Tensor, Tensor]:
    """Directions (M, K, nf) uniform on the sphere and uniform numbers (M, K, 1)."""
    made = {"generator": generator, "device": generator.device, "dtype": like.dtype}
    directions = torch.randn(points, samples, width, **made)  # type: ignore[call-overload]
    directions = directions / directions.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    share = torch.rand(points, samples, 1, **made)  # type: ignore[call-overload]
    return directions.to(like.device), share.to(like.device)


def distance_terms(
    model: NeuralSDE, features: Tensor, loss: LossOptions, generator: torch.Generator
) -> dict[str, Tensor]:
    """The distance losses at features of data (M, nf), each with its weight."""
    own = model.system.defaults
    near = loss.ball_radius or own.ball_radius
    mu = loss.mu
    if mu is None:  # the supplement's for "paper", that of the other two else
        mu = own.lambda_mu if loss.kind == "paper" else 0.01
    ball = draw_ball(len(features), loss.ball_samples, features.shape[1], generator, features)
    gradient, convexity, reward = distance_losses(
        model.eta, features, *ball, kind=loss.kind, near=near, far=loss.far_radius
    )
    return {"gradient": loss.gradient * gradient, "convexity": loss.convexity * convexity, "mu": mu * reward}


def fit_distance(
    model: NeuralSDE, features: Tensor, *, loss: LossOptions, steps: int, rate: float, seed: int
) -> None:
    """Teach the distance of a model, changed in place, what is near features of the data (N, nf) and what is far."""
    generator = torch.Generator().manual_seed(seed)
    optimiser = torch.optim.Adam(model.eta.parameters(), lr=rate, foreach=True)
    schedule = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, 0.1, total_iters=steps)
    for _ in range(steps):
        pick = torch.randint(len(features), (loss.points,), generator=generator)
        near = features[pick.to(features.device)]
        optimiser.zero_grad(set_to_none=True)
        torch.stack(list(distance_terms(model, near, loss, generator).values())).sum().backward()
        optimiser.step()
        schedule.step()
