"""Parts of a log as the filter predicts them by parameters that were fitted to the rest.

    theta_f = theta + (A - A_f)^-1 (b - b_f),      A = J' J,   b = J' e

With the Gram matrices of all blocks of time at the optimum (`nsde_torch.inference.sensitivity`), leaving out those of a
fold costs a step of Gauss and Newton and no fit. All folds are then predicted in one pass of the filter, each with its
own theta_f. Noise levels stay those of all rows: physics that are compared have as many of them, and the poorer one
gains more by it (of 1013 nats that a dry friction brings with levels of the other runs, 1009 are left).

The density of a row is the product of those of its channels, each given the ones before it. A velocity in the world
and its position are turned into the body first, so that thrust is one channel and forces sideways are others.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from nsde_torch.arrays import Array, Labels, Mask
from nsde_torch.data.system_info import rate_columns, rate_pairs
from nsde_torch.inference.estimate import Optimum, bounded_change
from nsde_torch.inference.filtering import Linearisation, Pass, with_gains, with_parameters
from nsde_torch.inference.sensitivity import Grams, grams
from nsde_torch.inference.state_space import StateSpace
from nsde_torch.rotation import matrix
from nsde_torch.systems import System
from nsde_torch.systems.parameters import ParameterVector

_KNOWN = 1e-3  # share of the information of all rows on a parameter below which those of the other folds do not move it


@dataclass(frozen=True)
class Folds:
    """What is left out together, the rest being fitted."""

    number: Labels  # fold of each run (R,), 0 and up
    begin: Array
    """Time from which rows of each run are left out (R,) [s]; all folds are fitted to those before."""

    def of(self, run: Labels, t: Array) -> Labels:
        """Fold of rows from their runs and times [s]; -1 for those that all folds are fitted to."""
        return np.where(t >= self.begin[run], self.number[run], -1)

    @property
    def count(self) -> int:
        """Number of folds."""
        return int(self.number.max()) + 1


@dataclass(frozen=True)
class LeftOut:
    """Physics on rows that it was not fitted to."""

    vector: ParameterVector  # its parameters
    theta: Array  # values fitted without each fold (F, k)
    names: tuple[str, ...]  # of the states whose rates the physics gives
    density: Array  # log density of each row given those before (N, names), less constants [nats]
    run: Labels
    t: Array  # run, t: run and time [s] of each row (N,), in order of time within a run


@torch.no_grad()
def left_out(optimum: Optimum, folds: Folds, still: Mask | None = None) -> LeftOut:
    """What the filter predicts of each fold by the other ones.

    All folds take the parameters `still` (k,) from all rows: shapes, in which steps are far from linear.
    """
    space, about, kept = optimum.of.space, optimum.about, optimum.at
    steps, chunks, vector = space.steps, space.chunks, space.vector
    columns = space.columns(about.x, about.slopes, range(len(vector)), about.after)
    held = grams(space, optimum.levels, about, kept, columns)
    owner, first = chunks.places()
    of_block = folds.of(owner, steps.t.numpy()[first])
    ends = steps.t[[b - 1 for _, b in steps.segments]].numpy()
    of_chunk = folds.of(np.array(steps.runs), ends)[chunks.stretch.numpy()]
    known = np.diag(np.concatenate(([0.0], _KNOWN * np.diag(held.total)[1:])))
    moves = np.ones(len(known)) if still is None else np.concatenate(([1.0], ~still))
    start, theta = np.asarray(space.theta.numpy()), []
    missed, begun = about.missed.clone(), about.first.clone()
    for f in range(folds.count):
        blocks = np.stack([held.blocks[of_block != f].sum(0), known]) * moves * moves[:, None]
        rest = Grams(blocks, held.rows, held.parameters)
        theta.append(start + bounded_change(vector, rest, start))
        some = torch.from_numpy(np.flatnonzero(of_chunk == f))
        if len(some):
            there = space.some(some)
            there.use(theta[-1])
            here = with_parameters(there, about.of(some), optimum.of.start.of(some))
            missed[:, some], begun[some] = here.missed, here.first
    vector.use(space.theta)
    about = replace(about, missed=missed, first=begun)
    at = with_gains(space, optimum.levels, about, kept.whitening, kept.gain, chunks.counted)
    names, density = _densities(space, about, at)
    run = np.array(steps.runs)[chunks.stretch.numpy()].repeat(chunks.size)
    t, live = chunks.t.T.flatten().numpy(), chunks.counted.T.flatten().numpy()
    live &= folds.of(run, t) >= 0
    each = density.transpose(0, 1).flatten(0, 1).numpy()
    return LeftOut(vector, np.array(theta), names, each[live], run[live], t[live])


def _densities(space: StateSpace, about: Linearisation, at: Pass) -> tuple[tuple[str, ...], Tensor]:
    """States whose rates the physics gives, and log densities (T, C, names): of each with the states that it moves."""
    system = space.vector.system
    whitening, errors = at.whitening, at.errors[..., None]
    if about.measured is not None:  # what a row does not measure has no density
        whitening = whitening + torch.diag_embed(1.0 - about.measured.to(whitening.dtype))
        errors = errors * about.measured[..., None]
    triangle = torch.linalg.inv(whitening)
    for group in _in_the_world(system):
        if set(group) <= set(space.observed):
            rows = [space.observed.index(i) for i in group]
            back = matrix(about.x[..., system.quaternion]).transpose(-1, -2)
            triangle[..., rows, :] = back @ triangle[..., rows, :]
            errors = errors.index_copy(2, torch.tensor(rows), back @ errors[..., rows, :])
    triangle = torch.linalg.cholesky_ex(triangle @ triangle.transpose(-1, -2))[0]
    white = torch.linalg.solve_triangular(triangle, errors, upper=False)[..., 0]
    each = -0.5 * white.square() - torch.log(triangle.diagonal(dim1=-2, dim2=-1))
    moves = _moved_by_rates(system)
    rates = [i for i in range(len(system.error_names)) if i not in moves]
    owners = [moves.get(i, i) for i in space.observed]
    whose = torch.tensor([[float(o == r) for r in rates] for o in owners], dtype=each.dtype)
    return tuple(system.error_names[i] for i in rates), each @ whose


def _in_the_world(system: System) -> list[list[int]]:
    """Positions and velocities in the world, as error channels, of a system that knows its attitude."""
    if system.quaternion is None:
        return []
    at, tied = system.error_names.index, system.position_derivatives
    pairs = [(at(position), at(velocity)) for position, velocity, frame in tied if frame == "world"]
    return [list(group) for group in zip(*pairs, strict=True)] if len(pairs) == 3 else []


def _moved_by_rates(system: System) -> dict[int, int]:
    """Error channels that a rate moves by kinematics alone, and the channel of that rate."""
    names, states = system.error_names, system.state_names
    out = {names.index(states[i]): names.index(states[j]) for i, j in rate_pairs(system)}
    rates, q = rate_columns(system), system.quaternion
    if rates is not None and q is not None:
        out |= {q.start + k: names.index(states[rates.start + k]) for k in range(3)}
    return out
