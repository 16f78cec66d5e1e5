"""What feedback may hide or make: what counts beyond it, gains that vanish, and effects behind a smoother.

Where a controller saw more than the log holds, any term that correlates with inputs explains a part of a step. With z_i
as in `sysid.identify` it can bring at most

    2 log L = z_i^2

of channel i, and no more of it than the share by which the effect lies along linear functions of inputs and states
(`lengths_of_parameters`). An effect counts by what it brings beyond that on the channels that it moves, and so does the
residual. An effect that does not reach it is kept apart with its reason, unless signals from outside the loop show it
(`sysid.instruments`).

**Vanishing gains.** Inputs that answer the states can cancel what the physics lacks so nearly that no gain is seen. A
fit whose gain stands at the bound 0 has not measured it: no interval is given for it. In an open loop it has.

**Behind smoothers.** A smoother spreads the noise of a row over its neighbours, so that an input that answers it seems
to act later than it does: on a hexacopter that lacked nothing, behind a Gaussian filter at 12.9 Hz, a delay of one row
brought 366 nats. So effects with memory that act on inputs are no candidates there. Where one of them would explain
more beside what was found, all of that is a lead (docs/content/theory/likelihood.md).
"""

from __future__ import annotations

import copy
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtrc

from nsde_torch.arrays import Array
from nsde_torch.diagnosis.candidates import candidate_names
from nsde_torch.diagnosis.joint_selection import JointSelection, looked
from nsde_torch.diagnosis.search import Search, at_bounds
from nsde_torch.effects import Port, effect_class
from nsde_torch.sysid.feedback_test import FeedbackTest, leaning
from nsde_torch.sysid.regression import Regression
from nsde_torch.sysid.result import Identification
from nsde_torch.systems import System

if TYPE_CHECKING:
    from nsde_torch.diagnosis.outcome import Outcome


@dataclass(frozen=True)
class FeedbackBiased:
    """An effect that is not named because feedback may have made it."""

    name: str  # of the effect
    channels: tuple[str, ...]  # channels that it moves, of which inputs may know more than the log

    @property
    def reason(self) -> str:
        """Why, in words."""
        return (
            f"what feedback may hide: inputs may know more of {' and '.join(self.channels)} than the log does, and the "
            "effect explains no more than that; name signals from outside the loop (data.instruments=[...]), or log "
            "what the controller saw"
        )


def lengths_of_parameters(test: FeedbackTest, regression: Regression) -> dict[str, Array]:
    """Standard errors (k,) by which inputs that know more than the log may bias each parameter, by channel.

    What they know of a step, and what they do between rows, is as in a loop that is linear within a row: a linear
    function of states and of the inputs of neighbouring rows. It biases a parameter as far as its estimate lies along
    these (`sysid.feedback_test`).
    """
    if not test.not_from_the_log:
        return {}
    lean = leaning(regression)
    rows = {regression.physics.names[c]: i for i, c in enumerate(regression.rows)}
    return {c: lean[rows[c]] * test.hidden.get(c, 0.0) for c in test.not_from_the_log}


def allowances(lengths: Mapping[str, Array], own: Sequence[int]) -> dict[str, float]:
    """Likelihood ratio (2 log L) that feedback may hide of an effect, by channel; where it may hide nothing, none.

    Of inputs of an open loop, what they predict is physics that is missing, and has to be looked for; so it is in a
    closed one until effects have been looked for, and what they predict of the last fit is what they know.
    """
    return {c: float(np.square(z[own]).max(initial=0.0)) for c, z in lengths.items()}


def allowances_of_tests(test: FeedbackTest, known: Collection[str] = ()) -> dict[str, float]:
    """The same for what specification tests find, on channels of other sensors and those of which inputs are `known`.

    A state that was smoothed before it was logged, and restored, lacks what the controller saw of its noise. What
    inputs predict of its channel may be that.
    """
    hidden = test.hidden
    return {c: hidden[c] ** 2 for c in {*test.hidden_from_tests, *known} if c in hidden}


def chance_beyond(
    gained: Mapping[str, float], moved: Sequence[str], allowed: Mapping[str, float], count: int
) -> float:
    """p value of the evidence for an effect of `count` parameters beyond what feedback may hide (chi-squared).

    The likelihood ratios (2 log L) that it brings and that feedback may hide are by channel, of which it moves some.
    """
    beyond = sum(max(gained[c] - allowed.get(c, 0.0), 0.0) for c in moved)
    return float(chdtrc(max(count, 1), beyond))


def shown_by_instruments(found: Identification, effect: str, alpha: float) -> bool:
    """Whether instruments show an effect, but for a chance of `alpha`: some parameter is surely not nothing."""
    i = found.instrumented
    if i is None:
        return False
    own = [j for j, label in enumerate(i.labels) if label.partition(".")[0] == effect and i.moved[j]]
    if not own:
        return False
    half = i.half_widths(1.0 - alpha / len(own))
    return bool((np.abs(i.values[own]) > half[own]).any())


# ---- vanishing gains -----------------------------------------------------------------------------------


def vanishing_gains(regression: Regression) -> frozenset[str]:
    """Labels of the machine's own parameters that stand at the bound 0; those of effects may well be nothing."""
    v, bound = regression.vector, at_bounds(regression)
    return frozenset(
        label
        for j, label in enumerate(v.labels)
        if bound[j] and "." not in label and v.low[j] == 0.0 and regression.theta[j] < 0.5 * v.scale[j]
    )


def unmeasured_gains(outcome: Outcome) -> frozenset[str]:
    """Labels of gains at nothing that a closed loop may hide."""
    return vanishing_gains(outcome.final) if outcome.test.closed_loop else frozenset()


# ---- behind smoothers ----------------------------------------------------------------------------------


def behind_smoothers(search: Search, system: System) -> Search:
    """The search without effects with memory that act on inputs."""
    return among(search, [n for n in candidate_names(system, search.candidates) if not _timed(system, n)])


def with_suspects(found: JointSelection, search: Search, system: System) -> JointSelection:
    """A selection, with what was no candidate and would explain more beside it."""
    if not found.selected:
        return found
    some = among(search, [n for n in candidate_names(system, search.candidates) if _timed(system, n)])
    return replace(found, suspected=tuple(p.name for p in looked(some, found.final) if p.accepted))


def not_sure_behind_smoothers(outcome: Outcome) -> Outcome:
    """The outcome, nothing sure where what is no candidate behind a smoother would explain more."""
    joint = outcome.joint
    if joint is None or not joint.suspected:
        return outcome
    why = (
        f"the states were smoothed and the inputs answer them: {joint.suspected[0]}, or what looks like it behind a "
        "smoother, may be what was found"
    )
    return outcome.provisional(lambda _: why)


def _timed(system: System, name: str) -> bool:
    """Whether an effect acts on inputs with a memory."""
    return effect_class(name).port is Port.INPUT and system.make_effect(name, {}).n_memory > 0


def among(search: Search, names: list[str]) -> Search:
    """The search among other candidates."""
    out = copy.copy(search)
    out.candidates = names
    return out
