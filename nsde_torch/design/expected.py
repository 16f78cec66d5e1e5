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

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from nsde_torch.design.members import Branch, Member, width_columns
from nsde_torch.design.rollout import as_run
from nsde_torch.errors import ConfigError
from nsde_torch.inference.posterior import LogWithPrior

Array = NDArray[np.float64]
_PASSES = 1  # simulated states are without noise: further ones moved expected evidence by less than 0.1 %


@final
@dataclass
class Separation:
    """Expected evidence for one member against another."""

    truth: Member  # the member that is true
    other: Member  # the one that is fitted instead

    def __post_init__(self) -> None:
        truth, other = self.truth, self.other
        # how the fit of the other moves with the truth's parameters in the runs there are (k_other, k_truth)
        log = LogWithPrior(other.log.runs, other.theta, other.known)
        both = other.posteriors.cross_information(log, truth.system, other.log.run_in)
        self._follow = np.asarray(np.linalg.solve(other.known, both))
        if len(truth.branches) > 1:  # widths are followed by branches
            self._follow[:, width_columns(truth.vector)] = 0.0
        if len(other.branches) > 1:
            self._follow[width_columns(other.vector)] = 0.0

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
        found = b.posteriors.at_centres(problems, passes=_PASSES)
        left = np.array([b.posteriors.left_by_refit(here) for here in found])
        left = left.reshape(len(b.branches), *states.shape[:2])
        # a width that explains the runs worse has that to make good
        worse = np.array([branch.nats - b.nats for branch in b.branches])[:, None, None]
        nearer = np.array([own.nats - self.truth.nats for own in near])[:, None]
        return np.asarray((left - worse).min(0) + nearer)

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
@dataclass(frozen=True)
class Precision:
    """Expected standard errors of parameters."""

    member: Member  # physics that has them
    columns: list[int]  # their numbers
    sizes: Array  # what a good standard error is small beside (len(columns),)

    @classmethod
    def of(cls, member: Member, labels: Sequence[str]) -> Precision:
        """That of the parameters of these labels, or vectors of them, beside what they usually are."""
        v, columns = member.vector, list[int]()
        for label in labels:
            at = [i for i, own in enumerate(v.labels) if own == label or own.startswith(f"{label}[")]
            if not at:
                raise ConfigError(f"`parameters` names {label!r}; the physics has: {', '.join(v.labels)}.")
            columns += at
        return cls(member, columns, np.maximum(v.scale[columns], np.abs(member.theta[columns])))

    def errors(self, states: Array, inputs: Array, theta: Array) -> Array:
        """Standard errors of all parameters (C, k) after experiments with the runs there are; see `Separation.nats`."""
        m = self.member
        runs = [as_run(x, u, m.log.logged_dt) for x, u in zip(states, inputs, strict=True)]
        problems = [LogWithPrior((run,), theta, m.known) for run in runs]
        found = m.posteriors.at_centres(problems, passes=_PASSES)
        return np.array([here.standard_errors for here in found])


def _width(member: Member, theta: Array) -> float:
    """Geometric mean of the widths of a member."""
    return float(np.exp(np.log(theta[width_columns(member.vector)]).mean()))


def nearest(member: Member, theta: Array) -> Branch:
    """The branch of a member whose widths are the nearest to those of some parameters (k,)."""
    columns = width_columns(member.vector) if len(member.branches) > 1 else []
    away = [float(np.abs(np.log(b.theta[columns] / theta[columns])).sum()) for b in member.branches]
    return member.branches[int(np.argmin(away))]
