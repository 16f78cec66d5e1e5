"""An extended Kalman filter over all chunks of a log at once, linearised about states already found.

    delta_{k+1} = F_k delta_k + c_k + noise,    e_k = (y_k - x_k) - delta_k,      c_k = step(x_k) - x_{k+1}

x are the states of a `Linearisation`: first the measured ones, then those that the pass before found from the rows
until then. After three or four passes delta is 0, and this is the filter of the nonlinear machine, without a call of
the machine inside the loop over rows.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from nsde_torch.inference import kernels
from nsde_torch.inference.levels import Levels
from nsde_torch.inference.state_space import StateSpace


@dataclass(frozen=True)
class Start:
    """Where the filter of each chunk starts."""

    x: Tensor  # states of the machine (C, k)
    std: Tensor
    """What is not known of its error channels (e,); of a measured one its sensor's noise is taken."""
    memory_std: Tensor  # what is not known of estimated memory (C, q)
    memory: Tensor | None = None  # estimated memory (C, q); None: as it follows measured states

    def of(self, some: Tensor) -> "Start":
        """That of some chunks."""
        memory = None if self.memory is None else self.memory[some]
        return Start(self.x[some], self.std, self.memory_std[some], memory)


@dataclass(frozen=True)
class Linearisation:
    """What the filter is linearised about: rows (T, C, ...)."""

    x: Tensor  # states (nx)
    slopes: Tensor  # of the step from each in errors and disturbances (ne, n)
    after: Tensor  # states an undisturbed step later (nx)
    missed: Tensor  # c, by how much that step misses the next row's state (ne)
    seen: Tensor  # what was measured less the state, in measured channels (m)
    first: Tensor  # error of each chunk's start (C, ne)
    unknown: Tensor  # its standard deviation, where no sensor measures it (C, ne)
    measured: Tensor | None = None  # whether a row measures each of these channels (m); None where all do

    def of(self, some: Tensor) -> "Linearisation":
        """That of some chunks."""
        rows = {
            k: part[:, some]
            for k, part in vars(self).items()
            if k not in ("first", "unknown") and part is not None
        }
        return replace(self, first=self.first[some], unknown=self.unknown[some], **rows)


@dataclass(frozen=True)
class Pass:
    """What a pass left, rows (T, C, ...)."""

    errors: Tensor  # innovations (m)
    white: Tensor  # the same in standard deviations (m)
    whitening: Tensor  # L^-1 of the covariance L L' of each (m, m); of the first row that of white noise
    gain: Tensor  # Kalman gain (n, m)
    delta: Tensor  # errors of the states of the linearisation, estimated from the rows until then (n)
    rows: Tensor  # log likelihood of each row, 0 of those that do not count
    covariance: Tensor | None = None  # of delta with its last channels (n, q), where they were asked for

    def of(self, some: Tensor) -> "Pass":
        """That of some chunks."""
        return replace(self, **{name: part[:, some] for name, part in vars(self).items() if part is not None})

    @property
    def total(self) -> float:
        """Log likelihood [nats]; minus infinity where the filter diverged."""
        return float(self.rows.sum().nan_to_num(-torch.inf, -torch.inf, -torch.inf))


@torch.no_grad()
def linearised_about(space: StateSpace, x: Tensor, start: Start) -> Linearisation:
    """The linearisation about some states (T, C, nx), with the parameters in use."""
    slopes, after = space.linearised(x)
    return Linearisation(
        x, slopes, after, space.missed(x, after), space.seen(x), *_first(space, x, start), space.measured
    )


@torch.no_grad()
def moved_to(space: StateSpace, about: Linearisation, x: Tensor, start: Start) -> Linearisation:
    """The linearisation about other states (T, C, nx), its slopes those that it had."""
    after, (first, unknown) = space.after(x), _first(space, x, start)
    there = replace(about, first=first, unknown=unknown)
    return replace(there, x=x, after=after, missed=space.missed(x, after), seen=space.seen(x))


@torch.no_grad()
def with_parameters(space: StateSpace, about: Linearisation, start: Start) -> Linearisation:
    """The same states and slopes with other parameters in use."""
    after = space.after(about.x)
    first, _ = _first(space, about.x, start)
    return replace(about, after=after, missed=space.missed(about.x, after), first=first)


def _first(space: StateSpace, x: Tensor, start: Start) -> tuple[Tensor, Tensor]:
    """Errors of the first of some states (T, C, nx), and what is not known of them, (C, ne) each."""
    unknown = torch.cat((start.std.expand(len(start.x), -1), start.memory_std), 1)
    begun = space.begun[0] if start.memory is None else start.memory
    return space.error(torch.cat((start.x, begun), 1), x[0]), unknown


def forced(space: StateSpace, about: Linearisation, disturbance: int, force: Tensor) -> Tensor:
    """What forces (T, C, ...) that act where a disturbance does do to the steps (T, C, ne, ...).

    They are those in the middle of the step from each row, given what is known at its start (`StateSpace.midway`): a
    force of the state or the input after it would explain what was just measured.
    """
    slopes = about.slopes[..., space.ne + disturbance]
    return space.passed(slopes.view(*slopes.shape, *(1,) * (force.dim() - 2)) * force[:, :, None])


@torch.no_grad()
def filtered(
    space: StateSpace,
    levels: Levels,
    about: Linearisation,
    live: Tensor,
    *,
    covariances: int = 0,
) -> Pass:
    """Filter chunks whose `live` rows (T, C) count.

    Covariances with so many of the last channels are kept; `level_slopes` takes those with the disturbances.
    """
    rows, count, m = about.seen.shape
    n = space.n
    new = about.seen.new_empty
    whitening, gain = new(rows, count, m, m), new(rows, count, n, m)
    left = new(rows, count, n, covariances) if covariances else new(0, 0, 0, 0)
    measured = torch.zeros(0, 0, 0, dtype=torch.bool) if about.measured is None else about.measured
    noise, filled = _noise(space, levels, about), (whitening, gain, left)
    kernels.in_parts(kernels.covariances, rows, count, about.slopes, *noise, measured, *filled)
    out = with_gains(space, levels, about, whitening, gain, live)
    return replace(out, covariance=left) if covariances else out


def _noise(space: StateSpace, levels: Levels, about: Linearisation) -> list[Tensor | list[int]]:
    """Shares of disturbances that are left after a step, variances of all noise, and numbers of measured errors."""
    h, sensor, gust = space.h, torch.exp(2.0 * levels.sensor), torch.exp(2.0 * levels.gust)
    keep = levels.keep(h)
    begun = torch.cat((about.unknown.square(), gust.expand(len(about.unknown), -1)), 1)
    begun[:, space.observed] = sensor
    white = torch.exp(2.0 * levels.white) / h
    added = gust * (1.0 - keep.square())
    return [keep, white, added, sensor, begun, space.observed]


@torch.no_grad()
def within_gate(space: StateSpace, levels: Levels, about: Linearisation, gate: float) -> Tensor:
    """Whether each row measures each channel (T, C, m) within a gate [standard deviations of an innovation].

    The filter goes on without what is beyond it, so that one outlier does not lead it astray.
    """
    every = torch.ones_like(about.seen, dtype=torch.bool)
    measured = every if about.measured is None else about.measured.clone()
    noise, seen = _noise(space, levels, about), (about.first, about.missed, about.seen)
    kernels.in_parts(kernels.gated, *seen[-1].shape[:2], about.slopes, *noise, *seen, gate, measured)
    return measured


@torch.no_grad()
def with_gains(
    space: StateSpace, levels: Levels, about: Linearisation, whitening: Tensor, gain: Tensor, live: Tensor
) -> Pass:
    """The means of a pass whose covariances, `whitening` (T, C, m, m) and `gain` (T, C, n, m), are known.

    These depend on the slopes and the noise alone, and not on what steps miss: not on a parameter that is tried.
    """
    errors, white = torch.empty_like(about.seen), torch.empty_like(about.seen)
    delta, nats = gain.new_empty(gain.shape[:-1]), gain.new_empty(gain.shape[:2])
    read = (about.slopes, levels.keep(space.h), about.first, about.missed, about.seen, space.observed, live)
    filled = (errors, white, delta, nats)
    kernels.in_parts(kernels.means, *about.seen.shape[:2], *read, whitening, gain, *filled)
    return Pass(errors, white, whitening, gain, delta, nats)
