"""What an experiment would tell, without noise and fits: expected evidence between members, expected standard errors.

Member A is true, with parameters a. What B leaves of A's experiment, in units of the noise, is d: innovations of B's
filter. B's parameters may move, at the price of what the runs there are say of them (information M, about b(a), where
B's fit goes when A's parameters are a),

    2 nats = min_b |d - J b|^2 + b' M b = d'd - g' (J'J + M)^-1 g,        g = J'd

the likelihood ratio of two regressions with known noise (Atkinson and Fedorov, The design of experiments for
discriminating between two rival models, Biometrika 62 (1975), with what a refit takes away linearised). A difference
that a refit takes away tells nothing. The standard errors of A's own parameters are those of J'J + M.
"""

from __future__ import annotations

from typing import final

import numpy as np
from numpy.typing import NDArray

from nsde_torch.design.members import Branch, Member, width_columns
from nsde_torch.design.rollout import as_run
from nsde_torch.inference.posterior import LogWithPrior

Array = NDArray[np.float64]
_PASSES = 1  # simulated states are without noise: further ones moved expected evidence by less than 0.1 %


@final
class Separation:
    """Expected evidence for one member against another.

    Args:
        truth: The member that is true.
        other: The one that is fitted instead.
    """

    def __init__(self, truth: Member, other: Member) -> None:
        self.truth, self.other = truth, other
        self._follow = _follow(truth, other)

    def nats(self, states: Array, inputs: Array, thetas: Array) -> Array:
        """Expected evidence (S, C) of experiments in which the truth has parameters `thetas` (S, k).

        Of true states (S, C, N + 1, nx) and inputs (S, C, N, nu).
        """
        b = self.other
        dt = b.log.logged_dt
        near = [nearest(self.truth, theta) for theta in thetas]
        problems = [
            LogWithPrior((as_run(x, u, dt),), self._there(branch, theta, own.theta), branch.known)
            for branch in b.branches
            for theta, own, xs, us in zip(thetas, near, states, inputs, strict=True)
            for x, u in zip(xs, us, strict=True)
        ]
        left = np.array(
            [b.posteriors.left_by_refit(here) for here in b.posteriors.at_centres(problems, passes=_PASSES)]
        )
        left = left.reshape(len(b.branches), *states.shape[:2])
        # a width that explains the runs worse has that to make good
        worse = np.array([branch.nats - b.nats for branch in b.branches])[:, None, None]
        return np.asarray(
            (left - worse).min(0) + np.array([own.nats - self.truth.nats for own in near])[:, None]
        )

    def _there(self, branch: Branch, theta: Array, near: Array) -> Array:
        """Where the other member's fit of the runs there are goes when the truth has some parameters (k,)."""
        a, b = self.truth, self.other
        there = branch.theta + self._follow @ (theta - near)
        if len(a.branches) > 1 and len(b.branches) > 1:
            # runs that leave the widths of both open let a fit have that of the truth, which no branch may have
            width, columns = _width(a, theta), width_columns(b.vector)
            if branch is min(b.branches, key=lambda own: abs(np.log(_width(b, own.theta) / width))):
                there[columns] *= width / _width(b, there)
        return b.vector.inside(there)


@final
class Precision:
    """Expected standard errors of parameters.

    Args:
        member: Physics that has them.
        columns: Their numbers.
        sizes: What a good standard error is small beside (len(columns),).
    """

    def __init__(self, member: Member, columns: list[int], sizes: Array) -> None:
        self.member, self.columns, self.sizes = member, columns, sizes

    def errors(self, states: Array, inputs: Array, theta: Array) -> Array:
        """Standard errors of all parameters (C, k) after experiments with the runs there are; see `Separation.nats`."""
        m = self.member
        dt = m.log.logged_dt
        problems = [
            LogWithPrior((as_run(x, u, dt),), theta, m.known) for x, u in zip(states, inputs, strict=True)
        ]
        found = m.posteriors.at_centres(problems, passes=_PASSES)
        return np.array([here.standard_errors for here in found])


def _follow(truth: Member, other: Member) -> Array:
    """How the fit of the other member moves with the truth's parameters in the runs there are (k_other, k_truth)."""
    log = LogWithPrior(other.log.runs, other.theta, other.known)
    both = other.posteriors.cross_information(log, truth.system, other.log.run_in)
    out = np.asarray(np.linalg.solve(other.known, both))
    if len(truth.branches) > 1:  # widths are followed by branches
        out[:, width_columns(truth.vector)] = 0.0
    if len(other.branches) > 1:
        out[width_columns(other.vector)] = 0.0
    return out


def _width(member: Member, theta: Array) -> float:
    """Geometric mean of the widths of a member."""
    return float(np.exp(np.log(theta[width_columns(member.vector)]).mean()))


def nearest(member: Member, theta: Array) -> Branch:
    """The branch of a member whose widths are the nearest to those of some parameters (k,)."""
    columns = width_columns(member.vector) if len(member.branches) > 1 else []
    away = [float(np.abs(np.log(b.theta[columns] / theta[columns])).sum()) for b in member.branches]
    return member.branches[int(np.argmin(away))]
