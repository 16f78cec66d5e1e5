"""What tests of the loop and instruments found, and what follows from it, in words."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from nsde_torch.sysid.instrumented import Instrumented
    from nsde_torch.sysid.loop_statistics import Answer
    from nsde_torch.sysid.loop_test import LoopTest

FACTOR = 3.0
"""How much more inputs may know of their own step than they are seen to know of later ones (see `in_loop`)."""

NO_INPUT = "no input moves"
_EITHER = (
    "either the controller saw more than was logged (a faster rate, other sensors) or the inputs act in a way that is "
    "not declared (a lag, a delay). Gains are biased in both cases. Declare the lag (system.effects=[...]; `nsde "
    "diagnose` names what is missing) and see whether this remains; signals from outside the loop "
    "(data.instruments=[...]) tell the two apart"
)
_SAW = "the controller saw noise that the log no longer holds"
_SHOWN = 3  # answers that a sentence names


def sentences(found: "LoopTest") -> list[str]:
    """One sentence per finding; the first says whether the loop is closed."""
    from nsde_torch.sysid.loop_statistics import ALPHA

    if found.why_not == NO_INPUT:
        return [f"{NO_INPUT}, so that there is no loop to test"]
    out = [f"input {name} never moves: the data say nothing of what it does" for name in found.still]
    if found.why_not:
        return [*out, f"feedback was not tested: {found.why_not}"]
    answers = _surely(found.answers, ALPHA)
    if answers:
        told = "; ".join(
            f"{a.input} answers what the physics leaves unexplained of {a.channel} within "
            f"{1e3 * a.within_s:.0f} ms ({_percent(a.share)} of what is new in it)"
            for a in answers[:_SHOWN]
        )
        rest = f"; {len(answers) - _SHOWN} further pairs" if len(answers) > _SHOWN else ""
        out.append(
            f"the loop is closed: {told}{rest}; errors of predictions over many steps under these inputs do not tell "
            "what an input does"
        )
    elif found.closed:
        out.append(
            "the loop is closed: inputs together answer what the physics leaves unexplained of what they drive; errors "
            "of predictions over many steps under these inputs do not tell what an input does"
        )
    elif found.open:
        out.append(
            "the loop is open as far as the data show: no input answers what the physics leaves unexplained"
        )
    else:
        out.append("no input answers what the physics leaves unexplained, yet the loop may be closed")
    foretold = _surely(found.knowledge, ALPHA)
    if foretold:
        told = "; ".join(
            f"{a.input} foretells {a.share:.1%} of what is new in {a.channel}" for a in foretold[:_SHOWN]
        )
        lost = [c for c in found.smoothed if c in {a.channel for a in foretold}]
        why = (
            f"the states of {' and '.join(lost)} were smoothed before they were logged, and {_SAW}; or "
            if lost
            else ""
        )
        out.append(f"inputs know what the log does not: {told}; {why}{_EITHER}")
    elif found.other_sensors:
        out.append(
            f"the inputs that move {' and '.join(found.other_sensors)} hardly answer the noise of the logged "
            "measurement: the controller had other sensors or another rate there, and may know what the log does not. "
            "Gains may be biased; signals from outside the loop (data.instruments=[...]) take most of that out"
        )
    elif found.closed and not found.functions_of_state:
        out.append(
            "inputs know nothing that the log does not: one-step estimates are right under this feedback"
        )
    for name in found.functions_of_state:
        out.append(
            f"{name} is nearly a function of the logged state ({1 - found.new[name]:.0%} of it): what it does "
            f"cannot be told from what {' and '.join(found.driven[name])} would do anyhow, and its gain is not "
            "identifiable; move the sticks more, or add a test signal"
        )
    return out


def _percent(share: float) -> str:
    return f"{share:.0%}" if share >= 0.01 else f"{share:.1%}"


def _surely(answers: Sequence["Answer"], alpha: float) -> list["Answer"]:
    return sorted((a for a in answers if a.chance < alpha), key=lambda a: -a.share)


def of_instruments(found: "Instrumented", adopted: bool) -> list[str]:
    """What instruments say."""
    from nsde_torch.sysid.instrumented import MISSING

    out = [f"instrument {name} is not used: {why}" for name, why in found.refused.items()]
    if not found.names:
        return out
    names = ", ".join(found.names)
    if found.between_rows:
        out.append(
            "what the instruments do is explained with inputs that move between the rows of the log, not held"
        )
    moved = [n for n, m in zip(found.labels, found.moved, strict=True) if m]
    if not moved:
        return [
            *out,
            f"the instruments ({names}) are too weak to show any parameter; ordinary estimates are printed",
        ]
    apart = [
        f"{label} {found.ordinary[i]:.4g} becomes {found.values[i]:.4g}"
        for i, label in enumerate(found.labels)
        if found.difference[i] < 0.05
    ]
    if apart:
        out.append(
            f"by the instruments ({names}) estimates surely differ from ordinary ones: {', '.join(apart)}"
        )
    else:
        out.append(f"by the instruments ({names}) no estimate surely differs from the ordinary one")
    if adopted and found.unexplained >= MISSING and apart:
        out.append(
            "the declared physics explains all that the instruments do: what bends ordinary estimates is a controller "
            "that saw more than the log"
        )
    if found.unexplained < MISSING:
        out.append(
            "the declared physics does not explain all that the instruments do "
            f"(p = {found.unexplained:.1g}): an effect is missing (a lag, a delay), or an instrument is not exogenous; "
            "neither estimate is right before it is declared"
        )
    out.append(
        f"printed by the instruments: {', '.join(moved)}" if adopted else "printed: ordinary estimates"
    )
    weak = [n for n, m, f in zip(found.labels, found.moved, found.strength, strict=True) if not m and f == f]
    if weak:
        out.append(f"not shown by the instruments, ordinary estimates: {', '.join(weak)}")
    return out


def widened(
    labels: Sequence[str],
    doubt: "NDArray[np.float64] | None",
    errors: "NDArray[np.float64]",
    moved: "NDArray[np.bool_] | None",
) -> list[str]:
    """Which intervals of which parameters `doubt` widens, and why.

    `moved` are those that are printed by instruments.
    """
    if doubt is None:
        return []
    wide = [i for i in range(len(labels)) if errors[i] == errors[i] and doubt[i] > 0.5 * errors[i]]
    by = [labels[i] for i in wide if moved is not None and moved[i]]
    rest = [labels[i] for i in wide if moved is None or not moved[i]]
    out = []
    if by:
        out.append(
            f"intervals of {', '.join(by)} are widened: the data do not tell how inputs move between rows of the log; "
            "log faster"
        )
    if rest:
        out.append(
            f"intervals of {', '.join(rest)} are widened by what feedback may hide: inputs may know {FACTOR:g} times "
            "as much of a step as they can be seen to know of later ones; without signals from outside the loop no "
            "data can say more"
        )
    return out
