"""What an effect or a dependence has to explain beyond what feedback may hide.

Where a controller saw more than the log holds, its inputs know of a step what the log does not, and any term that
correlates with inputs explains a part of it: a damping where none is. With z_i as in `sysid.in_loop` such a
term can bring at most

    2 log L = z_i^2

of channel i, and no more of it than the share by which the effect leans along linear functions of inputs and states
(`lengths_of_parameters`). An effect counts by what it brings beyond that on the channels
that it moves, and so does what is left over. An effect that does not reach it is not named; it is set aside with its
reason, unless signals from outside the loop show it (`sysid.instruments`).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from nsde_torch.sysid.loop_test import LoopTest, leaning
from nsde_torch.sysid.regression import Regression
from nsde_torch.sysid.result import Identification
from nsde_torch.systems import System

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Feedback:
    """What is asked of the loop that the data were recorded in."""

    test: Callable[[Regression], LoopTest]  # tests the loop by a regression that has settled
    shown: Callable[[System, str], bool]
    """Whether signals from outside the loop show an effect of a system with fitted values."""
    hangs: Callable[[Regression], NDArray[np.float64]]
    """How far parameters of a regression hang on the band up to which smoothed states were restored (k,)."""


@dataclass(frozen=True)
class Hidden:
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


def lengths_of_parameters(test: LoopTest, regression: Regression) -> dict[str, Array]:
    """Standard errors (k,) by which inputs that know more than the log may bend each parameter, by channel.

    What they know of a step, and what they do between rows, is as in a loop that is linear within a row: a linear
    function of states and of the inputs of neighbouring rows. It bends a parameter as far as its estimate leans along
    these (`sysid.loop_test`).

    Args:
        test: What the data say of the loop.
        regression: The same physics at its optimum.
    """
    if not test.not_from_the_log:
        return {}
    lean = leaning(regression)
    rows = {regression.physics.names[c]: i for i, c in enumerate(regression.rows)}
    most = test.hidden
    return {c: lean[rows[c]] * most.get(c, 0.0) for c in test.not_from_the_log}


def allowances(lengths: Mapping[str, Array], own: Sequence[int]) -> dict[str, float]:
    """Likelihood ratio (2 log L) that feedback may hide of an effect, by channel; where it may hide nothing, none.

    Of inputs of an open loop, what they foretell is physics that is missing, and has to be looked for; so it is in a
    closed one until effects have been looked for, and what they foretell of the last fit is what they know.

    Args:
        lengths: Of parameters (`lengths_of_parameters`).
        own: Numbers of the effect's parameters.
    """
    return {c: float(np.square(z[own]).max(initial=0.0)) for c, z in lengths.items()}


def allowances_of_tests(test: LoopTest) -> dict[str, float]:
    """The same for what specification tests find.

    A state that was smoothed before it was logged, and restored, lacks what the controller saw of its noise. What
    inputs foretell of its channel may be that.
    """
    return {c: z**2 for c, z in test.hidden_from_tests.items()}


def likelihood_ratios(nats: Mapping[str, float]) -> dict[str, float]:
    """Log-likelihood differences [nats] as the statistics 2 log L that a chi-squared distribution judges."""
    return {channel: 2.0 * value for channel, value in nats.items()}


def chance_beyond(
    gained: Mapping[str, float], moved: Sequence[str], allowed: Mapping[str, float], count: int
) -> float:
    """Chance of what an effect explains beyond what feedback may hide.

    Args:
        gained: Likelihood ratio (2 log L) that it brings, by channel.
        moved: Names of the channels that it moves.
        allowed: What feedback may hide, by channel.
        count: Number of its parameters.
    """
    beyond = sum(max(gained[c] - allowed.get(c, 0.0), 0.0) for c in moved)
    return float(chi2.sf(beyond, max(count, 1)))


def shown_by_instruments(found: Identification, effect: str, alpha: float) -> bool:
    """Whether estimates by instruments show an effect: some parameter of it is surely not nothing.

    Args:
        found: Of physics with the effect, by `identify_in_loop`.
        effect: Its name.
        alpha: Chance of showing one that is not there.
    """
    i = found.instrumented
    if i is None:
        return False
    own = [j for j, label in enumerate(i.labels) if label.partition(".")[0] == effect and i.moved[j]]
    if not own:
        return False
    half = i.half_widths(1.0 - alpha / len(own))
    return bool((np.abs(i.values[own]) > half[own]).any())
