"""States of a log as the filter finds them at given physics, each from its row and those before it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nsde_torch.arrays import Array
from nsde_torch.data import Run
from nsde_torch.inference.estimate import LogLikelihood
from nsde_torch.inference.filtering import Linearisation, Pass, filtered
from nsde_torch.inference.levels import Levels
from nsde_torch.inference.steps import data_sizes
from nsde_torch.systems.parameters import ParameterVector

_PASSES = 3  # until the states have settled


@dataclass(frozen=True)
class Filtered:
    """A log under physics with their present values."""

    of: LogLikelihood  # the likelihood, with these values in use
    levels: Levels  # noise levels, from differences of the residuals of the physics
    about: Linearisation  # what the pass is linearised about
    at: Pass  # the pass, with the covariances of the states

    def states(self, runs: Sequence[Run]) -> list[Array]:
        """States of each run (n, nx); as they were read in rows that no stretch holds."""
        space, steps, chunks = self.of.space, self.of.space.steps, self.of.space.chunks
        x = space.shifted(self.about.x, self.at.delta[..., : space.ne])[..., : runs[0].x.shape[1]].numpy()
        out = [np.array(run.x) for run in runs]
        begun = np.array([a for a, _ in steps.segments])
        for c in reversed(range(chunks.count)):  # where two overlap, that which has forgotten its start
            first = int(chunks.row[0, c])
            k = int(np.searchsorted(begun, first, side="right")) - 1
            (a, b), n = steps.segments[k], steps.runs[k]
            row = int(np.searchsorted(runs[n].t, float(steps.t[a]))) + first - a
            count = min(chunks.size, b + 1 - first)
            out[n][row : row + count] = x[:count, c]
        return out

    def square(self) -> Tensor:
        """Mean square of the whitened innovations of each measured channel (m,)."""
        return self.at.white[self.of.space.chunks.counted].square().mean(0)

    def unknown(self) -> Tensor:
        """What is not known of each error channel (ne,), as a standard deviation over the log."""
        assert self.at.covariance is not None
        variances = self.at.covariance.diagonal(dim1=-2, dim2=-1)[..., : self.of.space.ne]
        return variances[self.of.space.chunks.counted].mean(0).sqrt()


@torch.no_grad()
def filtered_at(of: LogLikelihood) -> Filtered:
    """A log under the first values of its physics; of positions alone best that of `states=True`."""
    system = of.vector.at_first()
    wide = ParameterVector(system)  # a friction narrower than all speeds has slopes that no step follows
    wide.limit(data_sizes(wide.system, of.space.steps))
    levels, about = of.first(of.vector.inside(wide.inside(wide.start)))
    about, _ = of.settled(levels, about, of.filtered(levels, about), _PASSES)
    at = filtered(of.space, levels, about, of.space.chunks.counted, covariances=of.space.n)
    return Filtered(of, levels, about, at)
