"""An extended Kalman filter over all chunks of a log at once, linearised about states already found.

    delta_{k+1} = F_k delta_k + c_k + noise,    e_k = (y_k - x_k) - delta_k,      c_k = step(x_k) - x_{k+1}

x are the states of a `Linearisation`: first the measured ones, then those that the pass before found from the rows
until then. After three or four passes delta is 0, and this is the filter of the nonlinear machine, without a call of
the machine inside the loop over rows.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from nsde_torch.inference.levels import Levels
from nsde_torch.inference.state_space import StateSpace

_SLAB = 20  # steps whose transitions are worked out at once


@dataclass(frozen=True)
class Start:
    """Where the filter of each chunk starts."""

    x: Tensor  # states (C, nx)
    std: Tensor
    """What is not known of each error channel (ne,); of a measured one its sensor's noise is taken."""


@dataclass(frozen=True)
class Linearisation:
    """What the filter is linearised about: rows (T, C, ...)."""

    x: Tensor  # states (nx)
    slopes: Tensor  # of the step from each in errors and disturbances (ne, n)
    missed: Tensor  # c, by how much that step misses the next row's state (ne)
    seen: Tensor  # what was measured less the state, in measured channels (m)
    first: Tensor  # error of each chunk's start (C, ne)
    measured: Tensor | None = None
    """Whether a row measures each of these channels (m); None where all do."""

    def of(self, some: Tensor) -> "Linearisation":
        """That of some chunks."""
        x, slopes, missed, seen = (part[:, some] for part in (self.x, self.slopes, self.missed, self.seen))
        measured = None if self.measured is None else self.measured[:, some]
        return Linearisation(x, slopes, missed, seen, self.first[some], measured)


@dataclass(frozen=True)
class Pass:
    """What a pass left, rows (T, C, ...)."""

    errors: Tensor  # innovations (m)
    whitening: Tensor  # L^-1 of the covariance L L' of each (m, m); of the first row that of white noise
    gain: Tensor  # Kalman gain (n, m)
    delta: Tensor  # errors of the states of the linearisation that the rows until then tell (n)
    rows: Tensor  # log likelihood of each row, 0 of those that do not count
    covariance: Tensor | None = None  # of delta (n, n), where it was asked for

    def of(self, some: Tensor) -> "Pass":
        """That of some chunks."""
        parts = (self.errors, self.whitening, self.gain, self.delta, self.rows)
        errors, whitening, gain, delta, rows = (part[:, some] for part in parts)
        covariance = None if self.covariance is None else self.covariance[:, some]
        return Pass(errors, whitening, gain, delta, rows, covariance)

    @property
    def total(self) -> float:
        """Log likelihood [nats]; minus infinity where the filter diverged."""
        return float(self.rows.sum().nan_to_num(-torch.inf, -torch.inf, -torch.inf))

    @property
    def white(self) -> Tensor:
        """Innovations in standard deviations (T, C, m)."""
        return (self.whitening @ self.errors[..., None])[..., 0]


@torch.no_grad()
def linearised_about(space: StateSpace, x: Tensor, start: Start) -> Linearisation:
    """The linearisation about some states (T, C, nx), with the parameters in use."""
    system = space.vector.system
    slopes, after = space.linearised(x)
    return Linearisation(
        x,
        slopes,
        space.missed(x, after),
        system.error(space.chunks.y, x)[..., space.observed],
        system.error(start.x, x[0]),
        space.measured,
    )


@torch.no_grad()
def with_parameters(space: StateSpace, about: Linearisation) -> Linearisation:
    """The same states and slopes with other parameters in use."""
    missed = space.missed(about.x, space.after(about.x))
    return replace(about, missed=missed)


def forced(space: StateSpace, about: Linearisation, disturbance: int, force: Tensor) -> Tensor:
    """What forces do to the steps (T, C, ne, ...).

    Args:
        space: The machine.
        about: Its linearisation.
        disturbance: Number of the disturbance that acts where the force does.
        force: The force in the middle of the step from each row (T, C, ...), of what is known at its start
            (`StateSpace.midway`): a force of the state or the input after it would explain what was just measured.
    """
    slopes = about.slopes[..., space.ne + disturbance]
    return space.passed(slopes.view(*slopes.shape, *(1,) * (force.dim() - 2)) * force[:, :, None])


def transitions(space: StateSpace, levels: Levels, slopes: Tensor) -> tuple[Tensor, Tensor]:
    """Transition (..., n, n) of errors over steps with slopes (..., ne, n), and the covariance of what strikes."""
    ne, n, h = space.ne, space.n, space.h
    keep = levels.keep(h)
    push = slopes[..., ne:]
    shape = slopes.shape[:-2]
    forward = slopes.new_zeros(*shape, n, n)
    forward[..., :ne, :] = slopes
    at = torch.arange(ne, n)
    forward[..., at, at] = keep
    noise = slopes.new_zeros(*shape, n, n)
    noise[..., :ne, :ne] = (push * (torch.exp(2.0 * levels.white) / h)) @ push.transpose(-1, -2)
    noise[..., at, at] = torch.exp(2.0 * levels.gust) * (1.0 - keep.square())
    return forward, noise


@torch.no_grad()
def filtered(
    space: StateSpace,
    levels: Levels,
    about: Linearisation,
    start: Start,
    live: Tensor,
    *,
    covariances: bool = False,
) -> Pass:
    """Filter chunks.

    Args:
        space: The machine.
        levels: Noise levels.
        about: What the filter is linearised about.
        start: Where each chunk starts.
        live: Whether a row counts (T, C).
        covariances: Whether to keep those of the states, for `nsde_torch.inference.level_slopes`.
    """
    observed = space.observed
    rows, count, m = about.seen.shape
    sensor = torch.exp(2.0 * levels.sensor)
    variance = start.std.square().clone()
    variance[observed] = sensor
    covariance = torch.diag(torch.cat((variance, torch.exp(2.0 * levels.gust)))).expand(count, -1, -1)
    eye = torch.eye(m, dtype=covariance.dtype).expand(count, -1, -1)
    measured = None if about.measured is None else about.measured.to(covariance.dtype)
    inverses, gains, kept = [eye], [covariance.new_zeros(count, space.n, m)], [covariance]
    for k in range(1, rows):
        if k % _SLAB == 1:
            forwards, noises = transitions(space, levels, about.slopes[k - 1 : k - 1 + _SLAB])
            backwards = forwards.transpose(-1, -2)
        at = (k - 1) % _SLAB
        covariance = forwards[at] @ covariance @ backwards[at] + noises[at]
        seen = covariance[..., observed]
        innovation = seen[..., observed, :].clone()
        innovation.diagonal(dim1=-2, dim2=-1).add_(sensor)
        if measured is not None:  # a channel that the row does not measure is white noise of its own
            seen_here = measured[k]
            innovation = innovation * (seen_here[:, :, None] * seen_here[:, None])
            innovation.diagonal(dim1=-2, dim2=-1).add_(1.0 - seen_here)
        triangle, _ = torch.linalg.cholesky_ex(innovation)
        inverse = torch.linalg.solve_triangular(triangle, eye, upper=False)
        if measured is not None:
            inverse = inverse * seen_here[..., None]  # and neither moves the state nor counts
        half = seen @ inverse.transpose(-1, -2)
        covariance = covariance - half @ half.transpose(-1, -2)
        inverses.append(inverse)
        gains.append(half @ inverse)
        if covariances:
            kept.append(covariance)
    out = with_gains(space, levels, about, torch.stack(inverses), torch.stack(gains), live)
    return replace(out, covariance=torch.stack(kept)) if covariances else out


@torch.no_grad()
def with_gains(
    space: StateSpace, levels: Levels, about: Linearisation, whitening: Tensor, gain: Tensor, live: Tensor
) -> Pass:
    """The means of a pass, p_{k+1} = F (I - K H) p_k + F K (y - x)_k + c_k, whose covariances are known.

    They depend on the slopes and the noise alone, and not on what steps miss: not on a parameter that is tried.

    Args:
        space, levels, about, live: See `filtered`.
        whitening, gain: Of the pass (T, C, m, m) and (T, C, n, m).
    """
    observed, ne = space.observed, space.ne
    mean = gain.new_zeros(*gain.shape[1:-1])
    mean[..., :ne] = about.first
    means = [mean]
    for k in range(1, len(gain)):
        if k % _SLAB == 1:
            inner, pushed = _closed(
                space, levels, about, gain, slice(k - 1, min(k - 1 + _SLAB, len(gain) - 1))
            )
        at = (k - 1) % _SLAB
        mean = (inner[at] @ mean[..., None])[..., 0] + pushed[at]
        means.append(mean)
    predicted = torch.stack(means)
    errors = about.seen - predicted[..., observed]
    white = (whitening @ errors[..., None])[..., 0]
    scale = torch.diagonal(whitening, dim1=-2, dim2=-1)
    if about.measured is not None:
        scale = torch.where(about.measured, scale, 1.0)
    each = torch.log(scale).sum(-1) - 0.5 * white.square().sum(-1)
    delta = predicted + (gain @ errors[..., None])[..., 0]
    return Pass(errors, whitening, gain, delta, torch.where(live, each, 0.0))


def _closed(
    space: StateSpace, levels: Levels, about: Linearisation, gain: Tensor, rows: slice
) -> tuple[Tensor, Tensor]:
    """F (I - K H) (..., n, n) and F K (y - x) + c (..., n) of some rows."""
    forward = transitions(space, levels, about.slopes[rows])[0]
    back = forward @ gain[rows]
    inner = forward.clone()
    inner[..., space.observed] -= back
    pushed = (back @ about.seen[rows, ..., None])[..., 0]
    pushed[..., : space.ne] += about.missed[rows]
    return inner, pushed
