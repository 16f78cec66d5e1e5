"""The most that an experiment within limits is worth to one who knows which member of a tie is true, and its sizes.

A longer search than a design's, with the same proposals, judged at the truth alone. Where it expects less than a tie
needs, no experiment of this length and within these limits is to be had.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nsde_torch.design import Experiment
from nsde_torch.design.members import Drive, Rollouts
from nsde_torch.design.proposals import Family, Judged, Separation, best_of_each, search
from nsde_torch.errors import ConfigError

Array = NDArray[np.float64]
Json = dict[str, Any]


class Oracle:
    """Judges experiments at the truth.

    Args:
        e: A design, for its members, limits and start.
        right: Number of the member that is true.
        theta: Its true parameters (k,).
        drive: Makes the inputs of a batch of tables.
    """

    def __init__(self, e: Experiment, right: int, theta: Array, drive: Callable[[Array], Drive]) -> None:
        member = e.members[right]
        self._theta, self.limits, self._start, self._drive = theta, e.limits, e.start, drive
        self._rollouts = Rollouts(member.system, dt=member.log.dt)
        self._pair = Separation(member, e.members[1 - right])

    def judge(self, tables: Array) -> Judged:
        """Judge experiments (C, N, m)."""
        c = len(tables)
        x, _, u = self._rollouts.run(
            np.tile(self._theta, (c, 1)), np.tile(self._start, (c, 1)), self._drive(tables), tables.shape[1]
        )
        use = self.limits.use(x)
        fine = np.nan_to_num(use, nan=np.inf).max(1) <= 1.0
        nats = np.full(c, -np.inf)
        if fine.any():
            nats[fine] = self._pair.nats(x[None, fine], u[None, fine], self._theta[None])[0]
        return Judged(nats, nats, use)


def oracle(
    e: Experiment,
    right: int,
    truth: Mapping[str, Mapping[str, Any]],
    family: Family,
    drive: Callable[[Array], Drive],
    *,
    budget: tuple[int, int],
    before: Array,
    seed: int,
) -> tuple[float, Array | None]:
    """The most that an experiment is worth [nats], and its rows.

    Args:
        e: A design, for its members, limits and start.
        right: Number of the member that is true.
        truth: Its effects with their true parameters.
        family: Makes experiments.
        drive: Makes their inputs.
        budget: Proposals and generations.
        before: Inputs or places of a run there is.
        seed: Seed of proposals.
    """
    sizes = {f"{effect}.{name}": value for effect, own in truth.items() for name, value in own.items()}
    member = e.members[right]
    theta = member.theta.copy()
    for i, label in enumerate(member.vector.labels):
        name, _, axis = (
            label.partition("[") if label.endswith("]") and label not in sizes else (label, "", "")
        )
        if name in sizes:
            value = np.atleast_1d(np.asarray(sizes[name], dtype=np.float64))
            theta[i] = value[int(axis[:-1]) if axis else 0]
    judge = Oracle(e, right, theta, drive)
    rng = np.random.default_rng([seed, 13])
    plans = best_of_each(judge, family.baselines(rng, before))
    with contextlib.suppress(ConfigError):
        plans += search(
            judge,
            family,
            proposals=budget[0],
            generations=budget[1],
            keep=1,
            rng=rng,
            say=lambda stage, done, total: None,
        )[0]
    best = max(plans, key=lambda p: p.worth, default=None)
    return (0.0, None) if best is None else (best.worth, best.table)
