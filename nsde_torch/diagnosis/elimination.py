"""Each effect that was added, looked at again with the others present: kept, dropped or exchanged; and its ties.

An effect that was added first may have stood in for two that came later: each is left out in turn, dropped if it is no
longer needed, and compared with every other candidate in its place. Candidates whose held-out log-likelihood differs
from the chosen one's by less than chance are indistinguishable from it (a tie).
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

import numpy as np

from nsde_torch.diagnosis.fitted import effect_of, fitted_system, without_effect
from nsde_torch.diagnosis.hidden import Hidden
from nsde_torch.diagnosis.joint_selection import JointSelection
from nsde_torch.diagnosis.left_over import structure_returns
from nsde_torch.diagnosis.outcome import Found
from nsde_torch.diagnosis.rounds import Round, look
from nsde_torch.diagnosis.screening import joined
from nsde_torch.diagnosis.search import Base, Search
from nsde_torch.diagnosis.selection import Selection
from nsde_torch.diagnosis.trials import Trial, accept, fit_candidate, surely_above
from nsde_torch.effects import effect_class
from nsde_torch.effects.expression_grammar import is_law
from nsde_torch.effects.law import AND
from nsde_torch.errors import NsdeError
from nsde_torch.sysid.loop_test import LoopTest
from nsde_torch.systems import System
from nsde_torch.systems.parameters import own_name


@dataclass(frozen=True)
class Retained:
    """Effects that stay."""

    found: list[Found]  # the effects, in the order in which they were added
    final: Base  # the physics with them, fitted
    hidden: tuple[Hidden, ...] = ()  # effects that are not named because feedback may have made them
    feedback: LoopTest = field(default_factory=LoopTest)
    """What the data say of the loop that they were recorded in, by `final`."""


def eliminate(search: Search, chosen: Selection, *, also: Collection[str] = ()) -> Retained:
    """The effects that stay, with their ties, and the physics with them.

    Args:
        search: Data and settings.
        chosen: What forward selection added; looks at the catalogue that exchange one are appended to its rounds.
        also: Candidates for the place of each, beside those that were there when it was chosen.
    """
    declared, base, rounds, names = chosen.declared, chosen.final, chosen.rounds, list(chosen.names)
    if not names:
        return Retained([], search.narrower(base))
    found: list[Found] = []
    i = 0
    while i < len(names):
        name = names[i]
        rest = without_effect(fitted_system(base.regression), declared.system, name)
        contained = effect_class(name).includes
        now, without = _looked_before(rest, name, rounds), search.base(rest, warm=True, like=base.regression)
        # a noise model that was found with the effect may have been what made the difference
        if now is None or without.score.fitted > now.base.score.fitted + search.decisions.alike_nats:
            now = look(
                search,
                without,
                only={name, *contained, *_rivals(search, name, rounds), *also},
                called=f"looking again at {name}",
            )
        else:
            without = now.base.restored()
        this = next((t for t in now.trials if t.name == name), None)
        if this is None or not (accept(search, this) or _learned_by_noise(search, base, without, this)):
            # the others explain it, or it says no more than what it contains
            simpler = next((t for t in now.trials if t.name in contained and accept(search, t)), None)
            names[i : i + 1] = [] if simpler is None else [simpler.name]
            base, found, i = without if simpler is None else search.grown(simpler.regression), [], 0
            continue
        best = next((t for t in now.trials if accept(search, t)), this)
        if best.name != name and (best.name in contained or surely_above(best, this, search.decisions)):
            names[i] = best.name
            base, found, i = search.grown(best.regression), [], 0
            if names.count(best.name) > 1 or len(rounds) > search.budgets.exchanges:
                break
            rounds.append(now)
            continue
        found.append(Found(name, this, _ties(search, without, this, now, names, rounds)))
        i += 1
    return Retained(found, search.narrower(base))


def _learned_by_noise(search: Search, base: Base, without: Base, trial: Trial) -> bool:
    """Whether an effect that is there for sure brings no likelihood because the noise model without it learned it."""
    return trial.p_corrected < search.level("effects") and structure_returns(
        search, base, without, trial.name
    )


def _looked_before(rest: System, name: str, rounds: Sequence[Round]) -> Round | None:
    """The look at the catalogue that chose an effect beside the physics without it, if there was one."""
    return next(
        (
            one
            for one in rounds
            if one.chosen is not None and one.chosen.name == name and set(one.added) == set(rest.effect_names)
        ),
        None,
    )


def _ties(
    search: Search, without: Base, own: Trial, this: Round, names: Sequence[str], rounds: Sequence[Round]
) -> tuple[str, ...]:
    """What explains the data as well as an effect that was found: in its place, or in that of a part of it."""
    ties = _in_its_place(search, own, this.trials)
    others = _rivals(search, own.name, rounds) - {*ties, *effect_class(own.name).includes, *names}
    part = _in_part(search, without, own, sorted(others), max(len(this.screened), 1))
    return (*ties, *part, *_by_two(search, own.name, rounds))


def _in_its_place(search: Search, chosen: Trial, trials: Sequence[Trial]) -> list[str]:
    """Names of candidates that explain the data as well as the chosen one; what contains it is none."""
    out = []
    for t in trials:
        contains = chosen.name in effect_class(t.name).includes
        if is_law(t.name) and not is_law(chosen.name):
            continue  # there is always a formula that looks like an effect of the catalogue
        if (
            t.name != chosen.name
            and not contains
            and accept(search, t)
            and not surely_above(chosen, t, search.decisions)
        ):
            out.append(t.name)
    return out


def _in_part(search: Search, without: Base, own: Trial, names: Sequence[str], among: int) -> list[str]:
    """Effects that explain the data as well with a part of the one that was found as all of it does.

    Air that moves is drag and a steady push; a tilted thrust pushes steadily too.
    """
    out: list[str] = []
    for name in names:
        if own.name in effect_class(name).includes or is_law(name):
            continue
        search.say(f"looking for what may stand in for a part of {own.name}", len(out), len(names))
        try:
            other = _shared(search, without, own, name, among=among)
        except (NsdeError, np.linalg.LinAlgError):
            continue
        if other is not None and accept(search, other) and not surely_above(own, other, search.decisions):
            out.append(name)
    return out


def _by_two(search: Search, name: str, rounds: Sequence[Round]) -> list[str]:
    """Pairs that explain the data as well: what an effect contains, and one more beside it, as it was chosen.

    A friction that is stronger one way is a plain one and a steady push, as long as the machine moves.
    """
    out: list[str] = []
    for one in rounds:
        if one.chosen is None or one.chosen.name != name:
            continue
        for simple in (set(effect_class(name).includes) & set(one.added)) - set(rounds[0].added):  # declared
            out += [
                f"{simple}{AND}{t.name}"
                for t in one.trials
                if simple not in effect_class(t.name).includes
                and not is_law(t.name)
                and accept(search, t)
                and not surely_above(one.chosen, t, search.decisions)
            ]
    return list(dict.fromkeys(out))


def _rivals(search: Search, name: str, rounds: Sequence[Round]) -> set[str]:
    """Candidates that were there too when an effect was chosen, as far as chance goes."""
    return {
        t.name
        for one in rounds
        if one.chosen is not None and one.chosen.name == name
        for t in one.trials
        if accept(search, t)
    }


def _shared(search: Search, without: Base, own: Trial, name: str, *, among: int) -> Trial | None:
    """Another effect that takes over a part of one that was found, beside the rest of it; None where it does not.

    Args:
        search: Data and settings.
        without: The physics without the effect.
        own: The effect.
        name: Of the other.
        among: Number of candidates.
    """
    effect = type(effect_of(fitted_system(own.regression), own.name))
    alone = dict(zip(own.regression.vector.labels, own.regression.theta.tolist(), strict=True))
    joint = search.quick(joined(fitted_system(own.regression), name, {}), warm=True)
    strong = [
        j
        for j in joint.vector.of(own.name)
        if own_name(joint.vector.labels[j]) in (*effect.amplitudes, *effect.smooth)
    ]
    gone = [
        j
        for j in strong
        if own_name(joint.vector.labels[j]) in effect.smooth
        or abs(joint.theta[j]) < search.decisions.taken_over_share * abs(alone[joint.vector.labels[j]])
    ]
    if not 0 < len(gone) < len(strong):
        return None
    theta = joint.theta.copy()
    theta[gone] = 0.0
    rest = fitted_system(joint)
    joint.vector.write(rest, theta)
    held = tuple(joint.vector.labels[j] for j in gone)
    return fit_candidate(search, without, rest, name, among=among, held=held)


def as_selected(search: Search, joint: JointSelection, system: System) -> tuple[Selection, Retained]:
    """What the joint likelihood selected, as selection and elimination by the regression say it.

    Args:
        search: Data and settings.
        joint: What was selected.
        system: The declared physics with first values.
    """
    declared = search.base(system)
    names = list(joint.selected)
    if not names:
        return Selection(declared, declared, [], [_round(search, declared, joint, [])], ()), Retained(
            [], declared
        )
    among, found = max(len(joint.screened), 1), []
    for name in names:
        rest = without_effect(joint.system, declared.system, name)
        without = declared if len(names) == 1 else search.base(rest, warm=True, like=declared.regression)
        trial = joint.evidence(search, fit_candidate(search, without, joint.system, name, among=among))
        own = joint.selected[name]
        found.append(Found(name, trial, (*own.ties, *([own.law] if own.law else []))))
    final = search.narrower(search.base(joint.system, warm=True, like=found[-1].trial.regression))
    first = _round(search, declared, joint, [f.trial for f in found])
    first.chosen = found[0].trial
    return Selection(declared, final, names, [first], ()), Retained(found, final)


def _round(search: Search, declared: Base, joint: JointSelection, trials: list[Trial]) -> Round:
    return Round(declared.concluded(), trials, dict(joint.screened), dict(joint.errors))
