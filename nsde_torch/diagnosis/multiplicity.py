"""How many comparisons a finding is the best of: Bonferroni's correction, stage by stage.

    p_corrected = min(1, p M),      found where p_corrected < level of the stage (`recording.fault`)

M counts candidates of the catalogue times the starts of each, tests of structure, or frequencies of a spectrum.
docs/content/theory/evidence.md lists the stages.
"""

from collections.abc import Sequence
from math import prod

from nsde_torch.diagnosis.candidates import alone
from nsde_torch.effects import effect_class


def bonferroni(p: float, comparisons: float) -> float:
    """p value of the best of so many comparisons.

    Args:
        p: Of that one alone.
        comparisons: Their number, at least 1.
    """
    return min(1.0, p * comparisons)


def frequencies_in(steps: int) -> float:
    """Number of independent frequencies of a stretch of so many steps, at least 1."""
    return max(1.0, 0.5 * steps)


def has_frequency(effect: str) -> bool:
    """Whether an effect has a frequency of its own, which the spectrum proposes."""
    return "spectrum" in effect_class(effect).relative.values()


def starts_of(effect: str, labels: Sequence[str], steps: int) -> float:
    """How many starts the best of which was taken: frequencies of the spectrum, or shapes, each for every input.

    Args:
        effect: Name of the effect.
        labels: Of its parameters.
        steps: Length of the longest stretch of the data.
    """
    if has_frequency(effect):
        return frequencies_in(steps)
    grid = prod(len(values) for values in effect_class(effect).shapes.values())
    return float(grid * len(alone(effect, labels)))
