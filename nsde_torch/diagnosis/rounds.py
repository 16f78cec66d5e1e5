"""One round of the search: every candidate of the catalogue screened, the most promising fitted and ranked.

A first linearised step says roughly what a candidate is worth (`screening`); the most promising are iterated, and the
best of them get noise models of their own (`trials`).
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

import numpy as np

from nsde_torch.diagnosis.candidates import alone, candidate_names
from nsde_torch.diagnosis.multiplicity import has_frequency
from nsde_torch.diagnosis.screening import joined, likeliest, screen, starts
from nsde_torch.diagnosis.search import Base, Search
from nsde_torch.diagnosis.spectrum import lines
from nsde_torch.diagnosis.trials import Trial, finished, fit_candidate, simplest_first
from nsde_torch.effects import effect_class
from nsde_torch.errors import NsdeError
from nsde_torch.inference.sizes import data_sizes
from nsde_torch.systems import System
from nsde_torch.systems.parameters import ParameterVector


@dataclass
class Round:
    """One look at the catalogue."""

    base: Base  # the physics that candidates were put beside, concluded
    trials: list[Trial]  # candidates that were iterated, best first
    screened: dict[str, float]  # log-likelihood difference of every candidate at its first step [nats]
    errors: dict[str, dict[str, float]] = field(default_factory=dict)
    """By candidate: standard errors of what is nothing without it, by label; infinite where no data show it."""
    failed: dict[str, str] = field(default_factory=dict)  # candidates that could not be fitted, and why
    chosen: Trial | None = None  # the one that was added, or None

    @property
    def added(self) -> tuple[str, ...]:
        """Effects that the physics had already."""
        return self.base.system.effect_names


@dataclass(frozen=True)
class _Start:
    """Where the fit of a candidate starts: physics with it, and labels of its parameters that stay at nothing."""

    system: System
    held: tuple[str, ...]


def look(
    search: Search, base: Base, *, only: Collection[str] | None = None, called: str = "looking again"
) -> Round:
    """Fit and rank the candidates beside the physics of `base`.

    A candidate that contains an effect which was added before stands in for it.

    Args:
        search: Data and settings.
        base: Where the round starts.
        only: Candidates to look at; None for all. p values count all.
        called: What the look is called while it goes on.
    """
    names = candidate_names(base.system, search.candidates)
    among = max(len(names), 1)
    if only is not None:
        names = [n for n in names if n in only]
    out = Round(base=base, trials=[], screened={})
    peaks = lines(base.regression, decisions=search.decisions, budgets=search.budgets)
    best = _screened(search, base, names, [peak.frequency for peak in peaks], out, called)
    # from without what it contains, a first step says nothing of a candidate that stands in for it
    sure = [n for n in best if set(effect_class(n).includes) & set(base.system.effect_names)]
    # nor of a sinusoid at a line of the spectrum: the noise model has learned the line
    if peaks and peaks[0].p < search.level("effects"):
        sure += [n for n in best if has_frequency(n)]
    _fit_promising(search, base, best, sure, among, out, called)
    _finish_best(search, base, among, out, called)
    base.forget()
    out.base = base.concluded()
    return out


def _screened(
    search: Search, base: Base, names: Sequence[str], frequencies: Sequence[float], out: Round, called: str
) -> dict[str, _Start]:
    """Screen candidates from all their starts; returns the best start of each."""
    scales = data_sizes(base.system, search.steps)
    best: dict[str, _Start] = {}
    for i, name in enumerate(names):
        search.say(f"{called}: trying {len(names)} effect{'s' if len(names) > 1 else ''}", i, len(names))
        systems = [
            joined(base.system, name, start) for start in starts(base.system, name, scales, frequencies)
        ]
        for system in likeliest(search, base, systems, search.budgets.screened_starts):
            vector = ParameterVector(system)
            labels = [vector.labels[j] for j in vector.of(name)]
            for held in alone(name, labels):
                try:
                    nats, errors = screen(search, base, system, name, held)
                except (NsdeError, np.linalg.LinAlgError) as error:
                    out.failed[name] = str(error)
                    continue
                if name not in out.screened or nats > out.screened[name]:
                    out.screened[name] = nats
                    out.errors[name] = errors
                    best[name] = _Start(system, held)
    return best


def _fit_promising(
    search: Search,
    base: Base,
    best: dict[str, _Start],
    sure: Sequence[str],
    among: int,
    out: Round,
    called: str,
) -> None:
    """Iterate the candidates whose first step promises most, and those that are sure to be fitted."""
    budgets = search.budgets
    rest = sorted((n for n in best if n not in sure), key=lambda n: -out.screened[n])
    order = [*sure, *(n for n in rest if out.screened[n] > budgets.worth_nats)]
    most = budgets.iterated_most + len(sure)  # these take no place from others
    helped = 0
    for i, name in enumerate(order):
        best_yet = max((t.nats for t in out.trials), default=0.0)
        enough = helped >= budgets.helping_fewest and out.screened[name] < budgets.close_share * best_yet
        # what is part of a candidate that was fitted may do as well as it
        part = any(name in effect_class(t.name).includes for t in out.trials)
        if (enough or i >= most) and name not in sure and not part:
            continue
        search.say(f"{called}: fitting the likeliest", i, min(len(order), most))
        start = best[name]
        try:
            trial = fit_candidate(search, base, start.system, name, among=among, held=start.held)
        except (NsdeError, np.linalg.LinAlgError) as error:
            out.failed[name] = str(error)
            continue
        out.trials.append(trial)
        helped += trial.nats > 0 and name not in sure
    out.trials.sort(key=lambda t: -t.rank_score)


def _finish_best(search: Search, base: Base, among: int, out: Round, called: str) -> None:
    """Give the best candidates noise models of their own, and rank all anew."""
    most = out.trials[0].nats if out.trials else 0.0
    for i, trial in enumerate(out.trials):
        if i < search.budgets.finished_fewest or trial.nats > search.budgets.finished_share * most:
            search.say(f"{called}: comparing the best", i, len(out.trials))
            out.trials[i] = finished(search, base, trial, among)
    out.trials = simplest_first(sorted(out.trials, key=lambda t: -t.rank_score), search.decisions)
