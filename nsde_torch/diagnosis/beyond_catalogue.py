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
from nsde_torch.diagnosis.hidden import Feedback
from nsde_torch.diagnosis.imitation import a_law_is_nearer
from nsde_torch.diagnosis.law_names import named_by_the_catalogue
from nsde_torch.diagnosis.laws import chosen_again, propose
from nsde_torch.diagnosis.left_over import variables_of
from nsde_torch.diagnosis.outcome import Outcome, base_without
from nsde_torch.diagnosis.search import Search
from nsde_torch.diagnosis.selection import Selection, forward_selection
from nsde_torch.effects.expression_grammar import is_law


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
        left = outcome.structured  # a law may show as one moment where it is largest, or as a drift
        if not left or not propose(search, kept.final, left, outcome.after, outcome.variables):
            break
        more = forward_selection(search, chosen.declared, after=chosen, final=kept.final)
        if not any(map(is_law, more.names)):
            break
        now = _stable(search, more, set_aside(search, more, eliminate(search, more), feedback))
        if not any(is_law(name) for name in (*(f.name for f in now.found), *(h.name for h in now.hidden))):
            break
        now = named_by_the_catalogue(search, more, now)
        chosen, kept = replace(more, names=[f.name for f in now.found]), now
        outcome = decide(search, more, now, feedback)
        if not any(is_law(f.name) for f in now.found):  # what feedback may hide is told, and not named
            break
    return outcome


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
