"""The verdict of a diagnosis in one or two sentences."""

from collections.abc import Sequence

from nsde_torch.diagnosis.buys import Told
from nsde_torch.diagnosis.detectability import not_shown
from nsde_torch.diagnosis.outcome import Outcome
from nsde_torch.diagnosis.shape import Shape


def summary(
    verdict: str,
    faults: Sequence[str],
    told: Told,
    outcome: Outcome,
    shapes: Sequence[Shape],
    flexible: str = "",
) -> str:
    """The verdict in one or two sentences.

    Args:
        verdict: `no_effect`, `effect_found`, `unexplained` or `undecided`.
        faults: Names of the faults of the recording chain that were found.
        told: The effects that matter, and the others.
        outcome: What was concluded.
        shapes: What the residual still depends on, in words.
        flexible: What functions that explain more are of, where no test of structure says what is missing.
    """
    if outcome.doubted:
        have = [*faults, *(f.name for f in outcome.found)]
        what = f"; {named([*faults, *told.few], told)} can be no more than leads" if have else ""
        return f"The fit is not believed, for the reason that the warning gives: what is missing cannot be told{what}."
    if verdict == "no_effect" and outcome.test.hidden:
        return (
            "Nothing is missing beyond what a controller that saw more than the log may hide: the rest of what the "
            "declared physics leaves is noise."
        )
    if verdict == "no_effect":
        unseen = not_shown(
            outcome.rounds,
            found=(),
            alpha=outcome.levels["effects"],
            decisions=outcome.decisions,
            system=outcome.declared_system,
        )
        blind = dict.fromkeys(n.effect for n in unseen if n.smallest is None)
        if blind:
            return (
                "Nothing is missing as far as these data can show: what the declared physics leaves is noise, but they "
                f"could not show {', '.join(blind)} at any size."
            )
        return "Nothing is missing: what the declared physics leaves is noise."
    added = [*faults, *told.few, *told.rest]
    if verdict == "undecided":
        return f"Found so far: {named(added, told)}." if added else "Nothing was found so far."
    names, rest = named([*faults, *told.few], told), _rest(outcome, shapes)
    provisional = {f.name for f in outcome.found if f.provisional}
    leads = [name for name in added if name in provisional]
    every = len(leads) == len(outcome.found) > 1
    take = f"ake {'all effects' if every else ', '.join(leads)} as {'leads' if len(leads) > 1 else 'a lead'}."
    if verdict == "effect_found":
        moved = {name for f in outcome.found for name in f.moves}
        elsewhere = bool(outcome.structured) and outcome.structured[0].channel not in moved
        more = f" The residual still depends ({rest})" if rest and (leads or elsewhere) else ""
        if leads:
            return f"Missing: {names}.{more}: t{take}" if more else f"Missing: {names}. T{take}"
        return f"Missing: {names}.{more}{'.' if more else ''}"
    if not added and not rest:
        return (
            "Something is missing that no test of structure names: functions predict unseen steps better than the "
            f"declared physics ({flexible})."
        )
    if not added:
        return f"Something is missing that no effect of the catalogue names: the residual depends ({rest})."
    more = f"the residual depends on more ({rest})" if rest else f"functions explain more ({flexible})"
    what = f"Something is missing that no effect names: {more} than {names} can explain"
    if len(leads) == len(added):
        return f"{what}, which {'are leads' if len(added) > 1 else 'is a lead'}."
    return f"{what}. T{take}" if leads else f"{what}."


def named(first: Sequence[str], told: Told) -> str:
    """Names of what was found, small effects by their number.

    Args:
        first: Names that are told.
        told: The effects that matter, and the others.
    """
    if not told.rest:
        return ", ".join(first)
    return f"{', '.join(first)} and {small(len(told.rest))}"


def small(count: int) -> str:
    """How many effects are small, in words."""
    words = ("", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")
    number = words[count] if count < len(words) else str(count)
    return f"{number} small one{'s' if count > 1 else ''}"


def _rest(outcome: Outcome, shapes: Sequence[Shape]) -> str:
    """What the residual still depends on most, in words."""
    left = outcome.structured
    if not shapes:
        return f"{left[0].channel} on {left[0].variable}" if left else ""
    # of those that say the same about equally surely, the one with the most to say
    best = max(shapes[:2], key=lambda s: (s.channel == left[0].channel, bool(s.note)))
    return ", ".join(part for part in (f"{best.channel} on {best.variable}", best.note) if part)
