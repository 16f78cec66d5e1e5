"""Experiments rehearsed: simulated with noise for each member in turn, and fitted as a measured one will be.

What a fit says of a tie after an experiment is a random number; rehearsals say of which size. The evidence that an
experiment brings to a member is by how much the log-likelihood of its fit grows with the experiment's run, noise models
of one kind for all members; what it brings beyond another member's is what it tells.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nsde_torch.data import Run
from nsde_torch.design.filtering import Filter, FilterProblem, stretches
from nsde_torch.design.flyable import Draw
from nsde_torch.design.limits import ExperimentLimits
from nsde_torch.design.members import Member, log_likelihood
from nsde_torch.design.noise_units import NoiseUnits
from nsde_torch.design.rollout import Drive, Rollouts, disturbances
from nsde_torch.diagnosis.options import Options
from nsde_torch.diagnosis.search import search_in
from nsde_torch.systems import System

Array = NDArray[np.float64]
_ITERATIONS = 5


@dataclass(frozen=True)
class Fits:
    """All members fitted to the runs there are and an experiment.

    Args:
        brought: Growth of each member's log-likelihood (M,) [nats].
        thetas: Parameters of each member.
        errors: Their standard errors.
        excess: Mean square of what the best member leaves, in units of the noise.
        moved: How far its parameters are from what the runs say [standard errors of these].
    """

    brought: Array
    thetas: tuple[Array, ...]
    errors: tuple[Array, ...]
    excess: float
    moved: float

    def against(self, truth: int) -> float:
        """Evidence for a member against the best of the others [nats]."""
        others = np.delete(self.brought, truth)
        return float(self.brought[truth] - others.max()) if len(others) else 0.0


@dataclass(frozen=True)
class Rehearsed:
    """One plan rehearsed with one member true.

    Args:
        evidence: For that member against the best of the others (R,) [nats]; empty with one member.
        errors: Of the fitted parameters (R, k).
        use: Largest share of each state's range (R, nx).
        states: True states (R, N + 1, nx).
        inputs: Inputs (R, N, nu).
    """

    evidence: Array
    errors: Array
    use: Array
    states: Array
    inputs: Array


def fit_all(declared: System, members: Sequence[Member], each: Sequence[Run], *, clock: float) -> list[Fits]:
    """Fit all members to the runs there are and to one of several experiments beside them.

    Args:
        declared: Declared physics.
        members: Members, fitted to the runs there are.
        each: The experiments.
        clock: Physical seconds per logged second.
    """
    found = [
        _by_filter(m, m.filter, each) if m.filter is not None else _by_steps(declared, m, each, clock)
        for m in members
    ]
    out = []
    for fits in zip(*found, strict=True):
        best = max(fits, key=lambda f: f[0])
        out.append(
            Fits(
                np.array([nats for nats, *_ in fits]),
                tuple(f[1] for f in fits),
                tuple(np.sqrt(np.diag(cov).clip(0.0)) for _, _, cov, *_ in fits),
                best[3],
                best[4],
            )
        )
    return out


_Fit = tuple[float, Array, Array, float, float]


def _by_filter(member: Member, own: Filter, each: Sequence[Run]) -> list[_Fit]:
    """Growth of the log-likelihood, parameters, covariance and mean square of what is left, by the member's filter."""
    problems = [FilterProblem(*stretches([run]), b.theta, b.known) for run in each for b in member.branches]
    worse, found = [b.nats - member.nats for b in member.branches], own.solve(problems)
    out: list[_Fit] = []
    for first in range(0, len(found), len(worse)):
        fits = zip(found[first : first + len(worse)], worse, strict=True)
        nats, f = max(((f.nats + nats, f) for f, nats in fits), key=lambda pair: pair[0])
        covariance = np.asarray(np.linalg.inv(f.information), dtype=np.float64)
        out.append((nats, f.theta, covariance, f.excess, f.moved))
    return out


def _by_steps(declared: System, member: Member, each: Sequence[Run], clock: float) -> list[_Fit]:
    """The same by regressions of the experiment's residuals of steps, with what the runs say as a quadratic."""
    out: list[_Fit] = []
    v, units = member.regression.vector, NoiseUnits(member.regression)
    for run in each:
        search = search_in(declared, [run], clock, Options(), channels=True)
        fit = search.regression(member.system, member.regression)
        theta, best = member.theta, (-np.inf, fit, member.theta)
        for _ in range(_ITERATIONS):
            fit = fit.at(theta)
            away = theta - member.theta
            nats = log_likelihood(fit) - 0.5 * float(away @ member.known @ away)
            if nats < best[0] + 0.02:
                break
            best = (nats, fit, theta)
            flat = fit.slopes.reshape(-1, len(theta))
            info = flat.T @ flat + member.known
            pull = flat.T @ fit.white.reshape(-1) - member.known @ away
            theta = v.inside(theta + np.linalg.solve(info, pull))
        nats, fit, theta = best
        cov = np.asarray(np.linalg.inv(fit.information() + member.known), dtype=np.float64)
        # by the noise of the runs before: the experiment's own has learned what no parameter explains
        left = np.square(units.residual(fit.physics, fit.physics.residual(theta)))
        away = theta - member.theta
        out.append((nats, theta, cov, float(np.mean(left)), float(away @ member.known @ away) ** 0.5))
    return out


def rehearse(
    declared: System,
    members: Sequence[Member],
    tables: Array,
    *,
    truth: int,
    count: int,
    start: Array,
    limits: ExperimentLimits,
    drive: Callable[[Array], Drive],
    draw: Draw = Member.draws,
    rng: np.random.Generator,
) -> list[Rehearsed]:
    """Rehearse plans with one member true.

    Args:
        declared: Declared physics.
        members: What may be true.
        tables: Plans (P, N, m).
        truth: Number of the member that is true.
        count: Rehearsals of each plan; the parameters are drawn for each.
        start: First state (nx,).
        limits: Limits.
        drive: Makes the inputs of a batch of tables.
        draw: Draws the parameters, the fitted ones first.
        rng: Source of everything random.
    """
    member, plans = members[truth], len(tables)
    steps = member.regression.physics.steps
    whole = np.repeat(tables, count, 0)
    true, seen, inputs = Rollouts(member.system, dt=steps.dt).run(
        np.tile(draw(member, count + 1, rng)[1:], (plans, 1)),
        np.tile(start, (len(whole), 1)),
        drive(whole),
        tables.shape[1],
        disturbances(member.regression, len(whole), tables.shape[1], rng),
    )
    fine = np.isfinite(seen).all((1, 2)) & np.isfinite(inputs).all((1, 2))
    evidence, errors = np.zeros(len(whole)), np.full((len(whole), len(member.theta)), np.nan)
    dt, logged = steps.dt, steps.logged_dt
    kept = np.flatnonzero(fine)  # a run that is not finite tells nothing
    fits = fit_all(declared, members, [as_run(seen[i], inputs[i], logged) for i in kept], clock=dt / logged)
    for i, fit in zip(kept, fits, strict=True):
        evidence[i], errors[i] = fit.against(truth), fit.errors[truth]
    use = limits.use(true)
    return [
        Rehearsed(*(part[p * count : (p + 1) * count] for part in (evidence, errors, use, true, inputs)))
        for p in range(plans)
    ]


def as_run(states: Array, inputs: Array, dt: float, name: str = "experiment") -> Run:
    """An experiment as a run: the last input is held."""
    u = np.concatenate((inputs, inputs[-1:]))
    return Run(name, dt * np.arange(len(u), dtype=np.float64), states, u)
