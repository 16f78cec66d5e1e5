"""Forward selection: look at the catalogue, add the likeliest effect, look again, until none helps.

One is added while the smallest p value of a round, corrected for the number of its comparisons (`multiplicity`), is
below the level of the stage (`recording.fault`): the one of most held-out log-likelihood, among those below alpha.

A time shorter than a step of the log (inputs that act a millisecond late) is nothing that data can name, but left out
it makes other effects look likely. Where it explains more than any of them, it joins what is declared.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from scipy.special import chdtrc

from nsde_torch.diagnosis.begun import Begun
from nsde_torch.diagnosis.candidates import candidate_names
from nsde_torch.diagnosis.evidence import score
from nsde_torch.diagnosis.fitted import effect_of, fitted_system, moved_channels, nonlinear
from nsde_torch.diagnosis.multiplicity import bonferroni
from nsde_torch.diagnosis.outcome import Found, Outcome, undecided
from nsde_torch.diagnosis.rounds import Round, look
from nsde_torch.diagnosis.search import Base, Search
from nsde_torch.diagnosis.trials import Trial, accept, below_a_step, something_is_missing
from nsde_torch.effects import effect_class
from nsde_torch.systems import System
from nsde_torch.systems.parameters import ParameterVector


@dataclass(frozen=True)
class Selection:
    """Effects that were chosen one at a time."""

    declared: Base  # the declared physics, fitted, with what is shorter than a step
    final: Base  # the physics with everything that was chosen, fitted
    names: list[str]  # effects that were chosen, in order
    rounds: list[Round]  # every look at the catalogue
    aside: tuple[str, ...]  # effects that joined what is declared because they are shorter than a step
    before: tuple[Found, ...] = ()  # what an earlier diagnosis found, of which no round tells


def forward_selection(
    search: Search, declared: Base, *, after: Selection | None = None, final: Base | None = None
) -> Selection:
    """Add effects to the declared physics until none helps.

    Args:
        search: Data and settings.
        declared: The declared physics, fitted.
        after: What was chosen before, to go on from; None starts from the declared physics.
        final: The physics with what is left of that, fitted; None takes that of `after`.
    """
    base = declared
    rounds: list[Round] = []
    names: list[str] = []
    aside: list[str] = []
    before = () if after is None else after.before
    if after is not None:
        base, rounds, aside = final or after.final, [*after.rounds], [*after.aside]
        names = [n for n in base.system.effect_names if n not in declared.system.effect_names]
    while len(names) < search.decisions.most_effects:
        now = look(search, base, called=f"round {len(rounds) + 1}")
        exact = base.regression.arithmetic
        short = None if exact else below_a_step(search, now.trials)
        if short is not None:
            aside.append(short.name)
            base = search.grown(short.regression)
            with_it = declared.system.with_effects(effect_of(base.system, short.name))
            declared = search.base(with_it, warm=True, like=declared.regression) if names else base
            continue
        rounds.append(now)
        now.chosen = None if exact else choice(search, now.trials, names)
        if now.chosen is None:
            break
        replaced = effect_class(now.chosen.name).includes
        names = [*(n for n in names if n not in replaced), now.chosen.name]
        search.held |= set(now.chosen.held)
        base = search.grown(now.chosen.regression)
        search.so_far(so_far(search, Selection(declared, base, names, rounds, tuple(aside), before)))
    return Selection(declared, base, names, rounds, tuple(aside), before)


def so_far(search: Search, chosen: Selection) -> Outcome:
    """What is known once effects were chosen, and before each is looked at again.

    Args:
        search: Data and settings.
        chosen: What was chosen.
    """
    trials = {one.chosen.name: one.chosen for one in chosen.rounds if one.chosen is not None}
    found = [f for f in chosen.before if f.name in chosen.names and f.name not in trials]
    found += [
        Found(name, trials[name], (), moved_channels(chosen.final.regression, name))
        for name in chosen.names
        if name in trials
    ]
    return undecided(search, chosen.declared, chosen.final, found, chosen.rounds, chosen.aside)


def begun_selection(search: Search, system: System, begun: Begun) -> Selection:
    """What an earlier diagnosis had selected, and what is selected beside it.

    Args:
        search: Data and settings.
        system: Declared physics with its first values.
        begun: What it had selected.
    """
    declared = search.base(system)
    physics = begun.beside(fitted_system(declared.regression))
    known = added_so_far(search, declared, physics, begun.nats)
    search.so_far(known)
    names = [f.name for f in known.found]
    final = search.base(physics, warm=True)
    after = Selection(declared, final, names, [], (), tuple(known.found))
    return forward_selection(search, declared, after=after)


def added_so_far(search: Search, declared: Base, system: System, brought: Mapping[str, float]) -> Outcome:
    """What is known of effects that were selected by other means, before each is fitted beside the others.

    Args:
        search: Data and settings.
        declared: The declared physics, fitted.
        system: The physics with the effects, its values near their optimum.
        brought: Log likelihood that each brought when it was added [nats]; of effects that it no longer has, too.
    """
    regression = search.regression(system, declared.regression, ParameterVector(system).start)
    regression.run(search.budgets.refinements)
    own = score(regression, declared.fold, declared.block, still=nonlinear(regression.vector, smooth=False))
    final = Base(system, regression, own, declared.fold, declared.block)
    concluded, spread = regression.concluded(), regression.spread()
    among = max(len(candidate_names(declared.system, search.candidates)), 1)
    found = []
    for name, nats in brought.items():
        mine = regression.vector.of(name) if name in system.effect_names else []
        if not mine:
            continue
        p = float(chdtrc(len(mine), max(2.0 * nats, 0.0)))
        trial = Trial(
            name,
            concluded,
            slice(mine[0], mine[-1] + 1),
            own,
            nats=nats,
            nats_error=0.0,
            rank_score=nats,
            p=p,
            p_corrected=bonferroni(p, among),
            spread=spread,
            nothing=False,
        )
        found.append(Found(name, trial, (), moved_channels(regression, name)))
    return undecided(search, declared, final, found)


def choice(search: Search, trials: Sequence[Trial], added: Sequence[str]) -> Trial | None:
    """The likeliest candidate; of one that contains a simpler one that is there too, the simpler.

    What contains it has to be better than it together with any other in the next round.

    Args:
        search: Data and settings.
        trials: Candidates that were fitted, best first.
        added: Names of the effects that the physics has already.
    """
    if not something_is_missing(search, trials):
        return None
    accepted = [t for t in trials if accept(search, t)]
    best = accepted[0]
    simpler = [t for t in accepted if t.name in effect_class(best.name).includes]
    if simpler:
        return simpler[0]
    # one effect in the place of another explains with fewer than two beside each other
    price = search.decisions.wider_nats
    wider = [
        t for t in accepted if set(effect_class(t.name).includes) & set(added) and best.nats < t.nats + price
    ]
    return wider[0] if wider else best
