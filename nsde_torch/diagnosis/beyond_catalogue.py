"""The search beyond the catalogue: where structure is left, laws of the machine's own variables are tried as effects.

    select and eliminate (catalogue)  ->  structure left  ->  propose laws  ->  select and eliminate again, with them

until nothing is left, no law is new or none holds. Laws are tried first in the place of effects that may only imitate
one: where the shape of an effect ends at the largest that the data tell from another law (`bent_shape`), where one term
explains surely more (`imitation`), and where two effects are laws of one variable (a friction and a quadratic damping
for a cubic one). A law that is not chosen again in halves of the runs is taken out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

from nsde_torch.diagnosis.decision import decide, of_one_variable, set_aside
from nsde_torch.diagnosis.elimination import Retained, eliminate
from nsde_torch.diagnosis.fitted import bent_shape, effect_of, fitted_system, values_of
from nsde_torch.diagnosis.flexible_gain import FlexibleGain, flexible_gain
from nsde_torch.diagnosis.hidden import Feedback
from nsde_torch.diagnosis.imitation import a_law_is_nearer
from nsde_torch.diagnosis.law_names import named_by_the_catalogue
from nsde_torch.diagnosis.laws import (
    chosen_again,
    plain_name,
    propose,
    wanted_variables,
    with_coordinates,
)
from nsde_torch.diagnosis.left_over import variables_of
from nsde_torch.diagnosis.outcome import Outcome, base_without
from nsde_torch.diagnosis.regressors import Regressors
from nsde_torch.diagnosis.search import Base, Search
from nsde_torch.diagnosis.selection import Selection, forward_selection
from nsde_torch.effects.expression_grammar import is_law
from nsde_torch.evaluation.bootstrap import FEWEST_BLOCKS


def with_laws(
    search: Search, chosen: Selection, kept: Retained, outcome: Outcome, feedback: Feedback
) -> Outcome:
    """The outcome with laws that no catalogue has, where structure is left and such laws explain it.

    Args:
        search: Data and settings.
        chosen: What forward selection added of the catalogue.
        kept: What elimination kept.
        outcome: What was concluded of it.
        feedback: What is asked of the loop.
    """
    # the user says what may be tried; and in logs of many rows a box noise models learn what laws would then explain
    if search.candidates is not None or search.box > 1 or not search.budgets.law_rounds:
        return outcome
    decisions, names = search.decisions, [f.name for f in outcome.found]
    bent = [(name,) for name in names if bent_shape(kept.final.regression, name)]
    near = [(name,) for name in names if (name,) not in bent and a_law_is_nearer(search, chosen, kept, name)]
    alike = [pair for pair in combinations(names, 2) if of_one_variable(*pair)]
    likelier, as_good = decisions.alike_nats, -decisions.wider_nats
    for replaced, least in (
        *((one, likelier) for one in (*bent, *near)),
        *((pair, as_good) for pair in alike),
    ):
        other = _in_place_of(search, chosen, kept, feedback, replaced)
        fewer = len(other.found) <= len(names) - len(replaced) + 1 and other.found
        if fewer and other.final.score.fitted > outcome.final.score.fitted + least:
            return other
    return _with_laws(search, chosen, kept, outcome, feedback)


def _in_place_of(
    search: Search, chosen: Selection, kept: Retained, feedback: Feedback, names: Sequence[str]
) -> Outcome:
    """The outcome with laws tried where effects were that may stand for one."""
    base = kept.final
    for name in names:
        base = base_without(search, base, chosen.declared, name)
    others = [f for f in kept.found if f.name not in names]
    without = replace(kept, found=others, final=base)
    some = replace(chosen, names=[f.name for f in others], final=base)
    return _with_laws(search, some, without, decide(search, some, without, feedback), feedback)


def _with_laws(
    search: Search, chosen: Selection, kept: Retained, outcome: Outcome, feedback: Feedback
) -> Outcome:
    """The outcome with laws, round by round."""
    for _ in range(search.budgets.law_rounds):
        left, base = outcome.structured, kept.final
        if left:  # a law may show as one moment where it is largest, or as a drift
            channels = [d.channel for d in left]
            wanted = wanted_variables(base.regression, left, outcome.after, outcome.variables)
        else:  # noise models may have learned it, where no test of one variable shows it
            outcome = _beside_a_flexible_model(search, base, outcome)
            if outcome.beside is None or not outcome.beside.more:
                break
            channels, wanted = list(outcome.beside.by_channel), _told(outcome.beside, outcome.variables)
            base = _weighed(base, outcome.beside)
        new = propose(search, base, list(dict.fromkeys(channels)), wanted, outcome.variables)
        if not new and base is kept.final:
            break
        more = forward_selection(search, chosen.declared, after=chosen, final=base)
        if not _news(more.names, kept):
            break
        now = _stable(search, more, set_aside(search, more, eliminate(search, more), feedback))
        if not _news([*(f.name for f in now.found), *(h.name for h in now.hidden)], kept):
            break
        now = named_by_the_catalogue(search, more, now)
        chosen, kept = replace(more, names=[f.name for f in now.found]), now
        outcome = decide(search, more, now, feedback)
        if not any(is_law(f.name) for f in now.found):  # what feedback may hide is told, and not named
            break
    return outcome


def _news(names: Sequence[str], kept: Retained) -> bool:
    """Whether there is an effect or a law among some names that was not kept, nor set aside, before."""
    return not {*names} <= {*(f.name for f in kept.found), *(h.name for h in kept.hidden)}


def _beside_a_flexible_model(search: Search, base: Base, outcome: Outcome) -> Outcome:
    """The outcome, with what a flexible model wins beside its physics; as it is where such a model would not tell."""
    blocks = int(base.block.max()) + 1
    tells = search.budgets.flexible_turns and search.inputs and not base.regression.arithmetic
    if not tells or blocks < FEWEST_BLOCKS:
        return outcome
    won = flexible_gain(base, outcome.variables, outcome.test, search.decisions, search.budgets)
    return replace(outcome, beside=won)


def _told(found: FlexibleGain, variables: Regressors) -> list[str]:
    """Variables that a flexible model needs, the most important first, with the places of speeds and so on."""
    names = dict.fromkeys(plain_name(t.variable) for t in found.telling)
    known = [v for v in names if v in variables.columns][: variables.budgets.law_variables]
    return with_coordinates(found.base.regression.vector.system, known, variables)


def _weighed(base: Base, found: FlexibleGain) -> Base:
    """Physics whose rows are weighed by the noise that a flexible model leaves: its own may have learned the law."""
    regression = base.regression
    for channel, law in found.noises.items():
        regression = regression.under(channel, law)
    return replace(base, regression=regression)


def _stable(search: Search, chosen: Selection, kept: Retained) -> Retained:
    """What elimination kept, without laws that are not chosen again in halves of the runs."""
    for f in list(kept.found):
        if not is_law(f.name):
            continue
        without = base_without(search, kept.final, chosen.declared, f.name)
        variables = variables_of(search, without)
        values = values_of(effect_of(fitted_system(kept.final.regression), f.name))
        shapes = {k: float(v) for k, v in values.items() if k != "c1" and isinstance(v, float)}
        if chosen_again(search, without, f.name, shapes, variables) < search.decisions.law_share:
            kept = replace(kept, found=[g for g in kept.found if g is not f], final=without)
    return kept
