"""A candidate fitted beside the physics of a round: its evidence, its p value, and whether it is there.

Candidates are ranked by the evidence on runs left out (`evidence`), less half the logarithm of the number of blocks of
time for each parameter (Schwarz), so that of two that explain alike the simpler one leads.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import log

from scipy.special import chdtrc

from nsde_torch.diagnosis.decisions import DECISIONS, Decisions
from nsde_torch.diagnosis.evidence import Score, p_value, score, sum_error
from nsde_torch.diagnosis.fitted import adds_nothing, nonlinear
from nsde_torch.diagnosis.multiplicity import bonferroni, has_frequency, starts_of
from nsde_torch.diagnosis.search import Base, Search
from nsde_torch.effects import effect_class
from nsde_torch.inference.spread import Spread
from nsde_torch.sysid.regression import Regression
from nsde_torch.systems import System


@dataclass(frozen=True)
class Trial:
    """A candidate, fitted."""

    name: str  # of the effect
    regression: Regression  # with it, as it was concluded: a search has dozens of them
    own: slice  # columns of theta that are the effect's
    score: Score  # on runs left out
    nats: float  # held-out log-likelihood difference to the physics without the effect [nats]
    nats_error: float  # its standard error [nats]
    rank_score: float  # what candidates are ranked by
    p: float  # chance of so large a difference if the effect did nothing, for one candidate
    p_corrected: float  # the same corrected for all starts of all candidates of the round (`multiplicity`)
    spread: Spread  # cluster-robust covariance from blocks of time, in the identifiable directions
    nothing: bool  # whether it says nothing of its own (`adds_nothing`)
    held: tuple[str, ...] = ()  # labels of parameters that were held at nothing


def simplest_first(trials: Sequence[Trial], decisions: Decisions = DECISIONS) -> list[Trial]:
    """Candidates in order, what contains another one behind it unless it is surely better."""
    out = list(trials)
    for trial in trials:
        for simple in trials:
            if simple.name not in effect_class(trial.name).includes or out.index(trial) > out.index(simple):
                continue
            more = max((trial.own.stop - trial.own.start) - (simple.own.stop - simple.own.start), 1)
            ratio = 2.0 * (trial.score.fitted - simple.score.fitted)
            if chdtrc(more, max(ratio, 0.0)) > decisions.nested_alpha or not surely_above(
                trial, simple, decisions
            ):
                out.remove(trial)
                out.insert(out.index(simple) + 1, trial)
    return out


def surely_above(better: Trial, worse: Trial, decisions: Decisions = DECISIONS) -> bool:
    """Whether the evidence for one candidate is above that for another by more than chance."""
    difference = better.score.blocks - worse.score.blocks
    return float(difference.sum()) > max(decisions.alike_nats, decisions.alike_errors * sum_error(difference))


def fit_candidate(
    search: Search, base: Base, system: System, name: str, *, among: int, held: tuple[str, ...] = ()
) -> Trial:
    """Fit a candidate beside the physics of `base`, with noise models of the same kind.

    Args:
        search: Data and settings.
        base: What it is compared with.
        system: Physics with the candidate.
        name: Of the candidate.
        among: Number of candidates.
        held: Labels of its parameters that stay at nothing.
    """
    regression = search.regression(system, base.regression, held=held)
    regression.run(search.budgets.refinements)
    if has_frequency(name):
        regression, this = search.best_noise(regression, system, base.fold, base.block, held)
    else:
        this = score(regression, base.fold, base.block, still=nonlinear(regression.vector, smooth=False))
    return _judged(search, base, regression, this, name, among, held)


def finished(search: Search, base: Base, trial: Trial, among: int) -> Trial:
    """The candidate with noise models of its own kind, if rows left out are foretold better with these.

    A model that had to stand for the effect has more orders than the noise alone. And one that remembers long is
    likelier in all rows, while a run of other speeds may be far from what the others foretell under it.
    """
    system = trial.regression.origin
    assert isinstance(system, System)
    regression, this = search.best_noise(
        trial.regression.with_residuals(), system, base.fold, base.block, trial.held, trial.score
    )
    if this is trial.score:
        return trial
    other = _judged(search, base, regression, this, trial.name, among, trial.held)
    return max(trial, other, key=lambda t: t.rank_score)


def _judged(
    search: Search,
    base: Base,
    regression: Regression,
    this: Score,
    name: str,
    among: int,
    held: tuple[str, ...],
) -> Trial:
    still = nonlinear(regression.vector)
    sure = regression.spread()
    labels = regression.vector.labels
    mine = regression.vector.of(name)
    tested = ~still
    tested[[j for j in range(len(labels)) if j not in mine]] = False
    p = p_value(regression, tested, sure, base=base.score, this=this)
    difference = this.blocks - base.score.blocks
    price = 0.5 * (len(mine) - len(held)) * log(len(difference))
    starts = starts_of(name, labels[mine[0] : mine[-1] + 1], search.longest)
    return Trial(
        name=name,
        regression=regression.concluded(),
        own=slice(mine[0], mine[-1] + 1),
        score=this,
        nats=float(difference.sum()),
        nats_error=sum_error(difference),
        rank_score=float(difference.sum()) - price,
        p=p,
        p_corrected=bonferroni(p, among * starts),
        spread=sure,
        nothing=adds_nothing(regression, name, share=search.decisions.part_share),
        held=held,
    )


def something_is_missing(search: Search, trials: Sequence[Trial]) -> bool:
    """Whether any candidate is beyond chance at the level of the stage; which one it is evidence decides."""
    level = search.level("effects")
    return any(t.p_corrected < level and accept(search, t) for t in trials)


def accept(search: Search, trial: Trial) -> bool:
    """Whether a candidate may be what is missing, as far as chance goes and the step of the data can tell.

    That anything is missing is decided at the level of the stage (`something_is_missing`). Of candidates that explain
    alike one may be there and another not by a hair: they are asked for alpha alone.
    """
    return _beyond_chance(search, trial) and not _shorter_than_a_step(search, trial) and not trial.nothing


def below_a_step(search: Search, trials: Sequence[Trial]) -> Trial | None:
    """The candidate that explains most, if it is a time shorter than a step: there, but nothing to name."""
    level = search.level("effects")
    sure = [t for t in trials if t.p_corrected < level and _beyond_chance(search, t)]
    best = max(sure, key=lambda t: t.nats, default=None)
    return best if best is not None and _shorter_than_a_step(search, best) else None


def _beyond_chance(search: Search, trial: Trial) -> bool:
    return trial.p_corrected < search.alpha and trial.nats > search.decisions.least_nats


def _shorter_than_a_step(search: Search, trial: Trial) -> bool:
    """Whether a time is a mere fraction of a step: below one, how inputs are held between samples decides."""
    vector, theta = trial.regression.vector, trial.regression.theta
    own = range(len(vector))[trial.own]
    times = [j for j in own if vector.moves_memory[j] and vector.units[j] == "s"]
    return any(theta[j] < search.decisions.resolution * search.steps.dt for j in times)
