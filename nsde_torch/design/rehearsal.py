"""Experiments rehearsed: simulated with noise for each member in turn, and fitted as a measured one will be.

The evidence that an experiment brings to a member is the density that it had for the run before it was flown: the
likelihood averaged over what the runs there are leave open of the parameters theta_0 with information K, by Laplace's
rule,

    ln p(run) = max_theta [ln p(run | theta) - d' K d / 2] + ln |K| / 2 - ln |K + J'J| / 2,      d = theta - theta_0

(MacKay, Bayesian interpolation, Neural Computation 4 (1992)), noise models of one kind for all members. The
determinants lower the density of a member that fits any run.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data import Run
from nsde_torch.design.limits import ExperimentLimits
from nsde_torch.design.members import Drive, Member, Rollouts, as_run
from nsde_torch.design.paths import Draw
from nsde_torch.inference.posterior import LogWithPrior, Posterior
from nsde_torch.threads import one_thread


@dataclass(frozen=True)
class Fits:
    """All members fitted to the runs there are and an experiment."""

    brought: Array  # logarithm of the density of the experiment under each member (M,) [nats]
    thetas: tuple[Array, ...]  # parameters of each member
    errors: tuple[Array, ...]  # their standard errors
    excess: float  # mean square of the best member's residual, in units of the noise
    moved: float  # how far its parameters are from what the runs say [standard errors of these]


@dataclass(frozen=True)
class Rehearsed:
    """One plan rehearsed with one member true."""

    evidence: Array  # for that member against the best of the others (R,) [nats]; empty with one member
    errors: Array  # of the fitted parameters (R, k)
    use: Array  # largest share of each state's range (R, nx)
    states: Array  # true states (R, N + 1, nx)


def fit_all(members: Sequence[Member], each: Sequence[Run]) -> list[Fits]:
    """Fit all members to the runs there are and to one of several experiments beside them."""
    out = []
    for fits in zip(*(_fits(m, each) for m in members), strict=True):
        best = max(fits, key=lambda f: f[0])[1]
        brought = np.array([nats for nats, _ in fits])
        thetas, errors = zip(*((p.theta, p.standard_errors) for _, p in fits), strict=True)
        out.append(Fits(brought, thetas, errors, best.excess, best.moved))
    return out


def against(brought: Array, number: int) -> float:
    """What one of several densities (M,) is larger than the largest of the others [nats]; 0 without others."""
    others = np.delete(brought, number)
    return float(brought[number] - others.max()) if len(others) else 0.0


def density(nats: float, before: Array, after: Array) -> float:
    """A likelihood at its best averaged over the parameters [nats], by information about them before and after."""
    return nats + 0.5 * float(np.linalg.slogdet(before)[1] - np.linalg.slogdet(after)[1])


def _fits(member: Member, each: Sequence[Run]) -> list[tuple[float, Posterior]]:
    """Density of each experiment, that of all branches with the weights that they are drawn with; and the likeliest."""
    branches = member.branches
    problems = [LogWithPrior((run,), b.theta, b.known) for run in each for b in branches]
    weights = np.array([b.nats for b in branches])
    weights -= np.logaddexp.reduce(weights)
    found, out = member.posteriors.modes(problems), []
    for first in range(0, len(found), len(branches)):
        fits = found[first : first + len(branches)]
        both = zip(fits, branches, strict=True)
        nats = weights + [density(f.nats, b.known, f.information) for f, b in both]
        out.append((float(np.logaddexp.reduce(nats)), fits[int(nats.argmax())]))
    return out


@one_thread()
def rehearse(
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
        tables: Plans (P, N, m).
        count: Rehearsals of each plan; the parameters are drawn for each.
    """
    member, plans = members[truth], len(tables)
    whole, thetas = np.repeat(tables, count, 0), draw(member, count + 1, rng)[1:]
    begun, steps = np.tile(start, (len(whole), 1)), tables.shape[1]
    noise, rollouts = member.noise.drawn(len(whole), steps, rng), Rollouts(member.system, dt=member.log.dt)
    true, seen, inputs = rollouts.run(np.tile(thetas, (plans, 1)), begun, drive(whole), steps, noise)
    fine = np.isfinite(seen).all((1, 2)) & np.isfinite(inputs).all((1, 2))
    evidence, errors = np.zeros(len(whole)), np.full((len(whole), len(member.theta)), np.nan)
    kept = np.flatnonzero(fine)  # a run that is not finite has no evidence
    fits = fit_all(members, [as_run(seen[i], inputs[i], member.log.logged_dt) for i in kept])
    for i, fit in zip(kept, fits, strict=True):
        evidence[i], errors[i] = against(fit.brought, truth), fit.errors[truth]
    use = limits.use(true)
    return [
        Rehearsed(*(part[p * count : (p + 1) * count] for part in (evidence, errors, use, true)))
        for p in range(plans)
    ]
