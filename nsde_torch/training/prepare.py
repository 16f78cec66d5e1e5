"""What is set from the training data without any gradient step."""

from collections.abc import Collection, Sequence

import numpy as np
import torch
from torch import Tensor

from nsde_torch.data import Run, Windows
from nsde_torch.errors import ConfigError
from nsde_torch.evaluation.metrics import thinned
from nsde_torch.models.networks import InputFilter
from nsde_torch.models.neural_sde import NeuralSDE

_ROWS = 20_000
_BLIND = 1e30  # a scale beyond which a column says nothing
_HOLD_SHARE = 0.35  # a useful model's error, as a share of that of holding the state


def blind_to_places(model: NeuralSDE) -> None:
    """Let residual networks see no place: a fit without evidence for it would learn where the data were."""
    count = len(model.system.places)
    if count:
        model.residual_inputs.scale[-count:] = _BLIND


def prepare(
    model: NeuralSDE, runs: Sequence[Run], windows: Windows, *, clock_scale: float, given: Collection[str]
) -> None:
    """Set standardisation, first sigma, clock and first values of declared parameters of a model, changed in place.

    Windows are those of its training runs; parameters that are `given` keep the value they have.
    """
    x, u, _ = windows.batch(thinned(torch.arange(len(windows)), _ROWS // (windows.horizon + 1) + 1))
    rows = x.reshape(-1, x.shape[-1])
    with torch.no_grad():
        model.residual_inputs.fit(model.system.network_features(rows))
        blind_to_places(model)
        model.eta.standardise.fit(model.system.features(rows))
        model.clock_scale.fill_(clock_scale)
        if model.black_box is not None:
            model.black_box.fit(x, u, windows.dt_model * clock_scale)
        bend = torch.diff(x, n=min(2, windows.horizon), dim=1)
        variance = bend.reshape(-1, x.shape[-1]).var(0)
        if model.spec.measurement and windows.horizon > 1:
            # white noise s of the sensors alone curves a path by 6 s^2; what is left may be diffusion
            variance = torch.maximum(variance - 6.0 * sensor_std(runs).to(x) ** 2, 1e-3 * variance)
        sigma = 0.5 * (variance / windows.dt_model).sqrt()
        if model.h.log_sigma_max.requires_grad:
            model.h.log_sigma_max[: len(sigma)].copy_((4.0 * sigma).clamp_min(1e-6).log())
        if model.spec.measurement:
            model.log_measurement_std.copy_(sensor_std(runs).clamp_min(1e-6).log().to(x))
    if model.spec.physics:
        longest = max(runs, key=lambda run: run.duration)
        a, b = max(longest.segments, key=lambda s: s[1] - s[0])
        values = model.system.start_values(
            np.asarray(longest.x[a:b]), np.asarray(longest.u[a:b]), longest.dt * clock_scale
        )
        for name, value in values.items():
            if name in given:
                continue
            try:
                model.system.set_value(name, torch.tensor(value))
            except ConfigError:
                continue  # out of bounds: the data mislead, the default stays


def sensor_std(runs: Sequence[Run]) -> Tensor:
    """Standard deviation of white sensor noise (nx,), from fourth differences, which a smooth motion lacks."""
    squares, count = 0.0, 0
    for run in runs:
        for a, b in run.segments:
            d = np.diff(run.x[a:b], 4, axis=0)
            squares = squares + (d**2).sum(0)
            count += len(d)
    if count == 0:
        return torch.full((runs[0].x.shape[1],), 1e-6, dtype=torch.float64)
    return torch.as_tensor(np.sqrt(np.asarray(squares) / count / 70.0))  # 70 = C(8, 4)


def error_scale(model: NeuralSDE, windows: Windows) -> Tensor:
    """Scale of the error channels (n_error,): a share of the error of holding the state, one per group."""
    x, _, _ = windows.batch(thinned(torch.arange(len(windows)), 2000))
    held = model.system.error(x[:, :1].expand_as(x[:, 1:]), x[:, 1:])
    rms = held.reshape(-1, held.shape[-1]).square().mean(0).sqrt()
    scale = torch.ones_like(rms)
    for group in model.system.error_groups:
        at = list(group.channels)
        size = rms[at].square().mean().sqrt() * _HOLD_SHARE
        scale[at] = torch.where(size > 1e-9, size, torch.ones_like(size))  # a channel that never moves
    return scale


@torch.no_grad()
def fit_filter(target: InputFilter, logged: Sequence[Run], restored: Sequence[Run], n_inputs: int) -> None:
    """Set the weights of a filter by least squares: logged inputs come nearest to restored ones, in means over steps.

    `restored` are the logged runs with inputs as they acted.
    """
    reach, rows, wanted = target.reach, [], []
    stride = max(1, round(target.dt / logged[0].dt))
    for before, after in zip(logged, restored, strict=True):
        for a, b in before.segments:
            count = (b - a) // stride
            u, v = (
                run.u[a : a + count * stride, :n_inputs].reshape(count, stride, n_inputs).mean(1)
                for run in (before, after)
            )
            if len(u) <= 2 * reach:
                continue
            parts = [u[reach + lag : len(u) - reach + lag] for lag in range(-reach, reach + 1)]
            rows.append(np.stack(parts, 2).reshape(-1, 2 * reach + 1))
            wanted.append((v - u)[reach : len(u) - reach].reshape(-1))
    if not rows:
        return
    x, y = np.concatenate(rows), np.concatenate(wanted)
    centred = x - x.mean(1, keepdims=True)  # the weights' mean does not count
    ridge = 1e-6 * np.trace(centred.T @ centred) / len(centred.T) * np.eye(len(centred.T))
    weights = np.linalg.solve(centred.T @ centred + ridge, centred.T @ y)
    target.weights.copy_(torch.as_tensor(weights - weights.mean()))
