"""Gains of inputs that a fit in a closed loop leaves at nothing.

Where inputs answer the states, they can cancel what the physics lacks so nearly that no gain is seen at all (`gone`).
A fit whose gain stands at the bound 0 has not measured that the input does nothing: no interval is given for it, and
what acts on inputs beside such a gain (a lag, a delay, a loss) is seen in part, and is a lead. In an open loop a gain
of nothing is what was measured.
"""

from nsde_torch.diagnosis.fitted import at_bounds
from nsde_torch.diagnosis.outcome import Outcome
from nsde_torch.effects import Port, effect_class
from nsde_torch.sysid.regression import Regression


def gains_at_nothing(regression: Regression) -> frozenset[str]:
    """Labels of the machine's own parameters that stand at the bound 0; those of effects may well be nothing."""
    v, bound = regression.vector, at_bounds(regression)
    return frozenset(
        label
        for j, label in enumerate(v.labels)
        if bound[j] and "." not in label and v.low[j] == 0.0 and regression.theta[j] < 0.5 * v.scale[j]
    )


def not_measured(outcome: Outcome) -> frozenset[str]:
    """Labels of gains at nothing that a closed loop may hide."""
    return gains_at_nothing(outcome.final.regression) if outcome.test.closed_loop else frozenset()


def beside_gains_at_nothing(outcome: Outcome) -> Outcome:
    """The outcome, effects on inputs provisional beside gains that a closed loop may hide."""
    gone = not_measured(outcome)
    if not gone:
        return outcome
    reason = f"{', '.join(sorted(gone))} went to nothing, which the loop may hide: what acts on inputs is seen in part"
    return outcome.provisional(lambda f: reason if effect_class(f.name).port is Port.INPUT else "")
