"""The search beyond the catalogue: where structure is left, laws of the machine's own variables are tried as effects.

    select and eliminate (catalogue)  ->  something left  ->  propose laws  ->  select and eliminate again, with them

until nothing is left, no law is new or none holds. Laws are made of what tests of structure name. Where that brings
none, they are made of what functions are of that explain more (`learned_functions`), under the noise that these leave:
the noise model of the physics may have learned the law, and a test of one variable may not show it.

Laws are tried first in the place of effects that may only imitate one: where the shape of an effect ends at the largest
that the data tell from another law (`bent_shape`), where one term explains surely more (`imitation`), and where two
effects are laws of one variable (a friction and a quadratic damping for a cubic one). A law that is not chosen again in
halves of the runs is taken out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

from nsde_torch.diagnosis.decision import decide, of_one_variable, set_aside
from nsde_torch.diagnosis.elimination import Retained, eliminate
from nsde_torch.diagnosis.fitted import bent_shape, effect_of, fitted_system, values_of
from nsde_torch.diagnosis.hidden import Feedback
from nsde_torch.diagnosis.imitation import a_law_is_nearer
from nsde_torch.diagnosis.joint_selection import JointSelection
from nsde_torch.diagnosis.law_names import named_by_the_catalogue
from nsde_torch.diagnosis.laws import (
    chosen_again,
    propose,
    wanted_variables,
    with_coordinates,
)
from nsde_torch.diagnosis.learned_functions import function_gain
from nsde_torch.diagnosis.left_over import variables_of
from nsde_torch.diagnosis.outcome import Outcome, base_without
from nsde_torch.diagnosis.search import Base, Search
from nsde_torch.diagnosis.selection import Selection, forward_selection
from nsde_torch.effects.expression_grammar import is_law
from nsde_torch.effects.law import AND
from nsde_torch.evaluation.bootstrap import FEWEST_BLOCKS
from nsde_torch.inference import Optimum
from nsde_torch.sysid.noise import Noise


def with_laws(
    search: Search,
    chosen: Selection,
    kept: Retained,
    outcome: Outcome,
    feedback: Feedback,
    joint: JointSelection | None = None,
    at: Optimum | None = None,
) -> Outcome:
    """The outcome with laws that no catalogue has, where structure is left and such laws explain it.

    Args:
        search: Data and settings.
        chosen: What forward selection added of the catalogue.
        kept: What elimination kept.
        outcome: What was concluded of it.
        feedback: What is asked of the loop.
        joint: What the joint likelihood selected, where it did: it has held effects against laws.
        at: An optimum of the likelihood of the log, under the declared physics or more; None where there is none.
    """
    # the user says what may be tried; and in logs of many rows a box noise models learn what laws would then explain
    if search.candidates is not None or search.box > 1 or not search.budgets.law_rounds:
        return outcome
    decisions, names = search.decisions, [f.name for f in outcome.found]
    bent = [(name,) for name in names if bent_shape(kept.final.regression, name)]
    near = []
    for i, name in enumerate(names):
        search.say("holding effects against laws", i, len(names))
        nearer = a_law_is_nearer(search, chosen, kept, name) if joint is None else joint.selected[name].law
        if (name,) not in bent and nearer:
            near.append((name,))
    alike = [pair for pair in combinations(names, 2) if of_one_variable(*pair)]
    likelier, as_good = decisions.alike_nats, -decisions.wider_nats
    for replaced, least in (
        *((one, likelier) for one in (*bent, *near)),
        *((pair, as_good) for pair in alike),
    ):
        search.say(f"trying laws in the place of {AND.join(replaced)}", 0, 1)
        other = _in_place_of(search, chosen, kept, feedback, replaced, at)
        fewer = len(other.found) <= len(names) - len(replaced) + 1 and other.found
        if fewer and other.final.score.fitted > outcome.final.score.fitted + least:
            return other
    return _with_laws(search, chosen, kept, outcome, feedback, at)


def _in_place_of(
    search: Search,
    chosen: Selection,
    kept: Retained,
    feedback: Feedback,
    names: Sequence[str],
    near: Optimum | None,
) -> Outcome:
    """The outcome with laws tried where effects were that may stand for one."""
    base = kept.final
    for name in names:
        base = base_without(search, base, chosen.declared, name)
    others = [f for f in kept.found if f.name not in names]
    without = replace(kept, found=others, final=base)
    some = replace(chosen, names=[f.name for f in others], final=base)
    return _with_laws(search, some, without, decide(search, some, without, feedback), feedback, near)


@dataclass(frozen=True)
class _Lead:
    """What laws are looked for: channels in which something is left, variables, and the physics that weighs rows."""

    base: Base
    channels: Sequence[str]
    wanted: Sequence[str]


def _with_laws(
    search: Search,
    chosen: Selection,
    kept: Retained,
    outcome: Outcome,
    feedback: Feedback,
    near: Optimum | None,
) -> Outcome:
    """The outcome with laws, round by round: of what tests name, else of what functions are of that explain more."""
    for _ in range(search.budgets.law_rounds):
        found = None
        if outcome.structured:
            found = _one_round(search, chosen, kept, outcome, feedback, _of_tests(kept.final, outcome))
        if found is None:
            outcome = with_functions(search, kept.final, outcome, near)
            lead = _of_functions(outcome)
            found = None if lead is None else _one_round(search, chosen, kept, outcome, feedback, lead)
        if found is None:
            break
        more, kept = found
        chosen = replace(more, names=[f.name for f in kept.found])
        outcome = decide(search, more, kept, feedback)
        if not any(is_law(f.name) for f in kept.found):  # what feedback may hide is told, and not named
            break
    return outcome


def _one_round(
    search: Search, chosen: Selection, kept: Retained, outcome: Outcome, feedback: Feedback, lead: _Lead
) -> tuple[Selection, Retained] | None:
    """Propose laws, select and eliminate again; None where that brings nothing that was not there."""
    search.say("proposing laws for what is left", 0, 1)
    new = propose(search, lead.base, list(dict.fromkeys(lead.channels)), lead.wanted, outcome.variables)
    if not new and lead.base is kept.final:
        return None
    more = forward_selection(search, chosen.declared, after=chosen, final=lead.base)
    if not _news(more.names, kept):
        return None
    now = _stable(search, more, set_aside(search, more, eliminate(search, more), feedback))
    if not _news([*(f.name for f in now.found), *(h.name for h in now.hidden)], kept):
        return None
    return more, named_by_the_catalogue(search, more, now)


def _of_tests(base: Base, outcome: Outcome) -> _Lead:
    """What tests of structure name: a law may show as one moment where it is largest, or as a drift."""
    left = outcome.structured
    wanted = wanted_variables(base.regression, left, outcome.after, outcome.variables)
    return _Lead(base, [d.channel for d in left], wanted)


def _of_functions(outcome: Outcome) -> _Lead | None:
    """What functions are of that explain more, and rows weighed by the noise that these leave."""
    found = outcome.beside
    if found is None or not found.rows:
        return None
    variables, base = outcome.variables, found.base
    names = dict.fromkeys(name for row in found.rows for name in row.variables)
    known = [v for v in names if v in variables.columns][: variables.budgets.law_variables]
    wanted = with_coordinates(base.regression.vector.system, known, variables)
    measured = [base.regression.physics.names[c] for c in base.regression.rows]
    moved = {channel for row in found.rows for channel in row.channels}
    return _Lead(_weighed(base, found.noises(variables)), [c for c in measured if c in moved], wanted)


def _news(names: Sequence[str], kept: Retained) -> bool:
    """Whether there is an effect or a law among some names that was not kept, nor set aside, before."""
    return not {*names} <= {*(f.name for f in kept.found), *(h.name for h in kept.hidden)}


def with_functions(search: Search, base: Base, outcome: Outcome, near: Optimum | None) -> Outcome:
    """The outcome, with functions beside its physics; as it is where these would say nothing.

    Args:
        search: Data and settings.
        base: The physics.
        outcome: What was concluded.
        near: An optimum of the likelihood of the log.
    """
    if outcome.beside is not None and outcome.beside.base is base:
        return outcome
    blocks, most = int(base.block.max()) + 1, search.budgets.function_groups
    if near is None or not most or not search.inputs or base.regression.arithmetic or blocks < FEWEST_BLOCKS:
        return outcome
    search.say("functions of what was measured", 0, 1)
    return replace(outcome, beside=function_gain(base, near, outcome.test, most=most))


def _weighed(base: Base, noises: Mapping[int, Noise]) -> Base:
    """Physics whose rows are weighed by other noise models, by number of the channel among its rows."""
    regression = base.regression
    for channel, law in noises.items():
        regression = regression.under(channel, law)
    return replace(base, regression=regression)


def _stable(search: Search, chosen: Selection, kept: Retained) -> Retained:
    """What elimination kept, without laws that are not chosen again in halves of the runs."""
    for f in list(kept.found):
        if not is_law(f.name):
            continue
        without = base_without(search, kept.final, chosen.declared, f.name)
        variables = variables_of(search, without)
        # the noise of the physics without the law may have learned it
        without = _weighed(without, dict(enumerate(kept.final.regression.noises)))
        values = values_of(effect_of(fitted_system(kept.final.regression), f.name))
        shapes = {k: float(v) for k, v in values.items() if k != "c1" and isinstance(v, float)}
        if chosen_again(search, without, f.name, shapes, variables) < search.decisions.law_share:
            kept = replace(kept, found=[g for g in kept.found if g is not f], final=without)
    return kept
