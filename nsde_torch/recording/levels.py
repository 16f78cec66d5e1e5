"""Significance levels of the stages of a diagnosis, from one alpha: the fallback procedure.

    level_k = alpha / K + (level_{k-1} where stage k - 1 found something, else 0)

The K stages are asked in order. Whatever is missing, the chance that any stage finds what is not there is at most
alpha: a stage that finds nothing has spent its share, one that finds something hands its level on (Wiens,
Pharmaceutical Statistics 2 (2003)). It finds all that Bonferroni's correction over the stages finds, and may find more.
"""

from collections.abc import Collection

STAGES = ("clock", "lateness", "biases", "effects", "structure")
"""In order. The first three are faults of the recording chain, `structure` the tests of what is left."""


def level(stage: str, alpha: float, found: Collection[str] = ()) -> float:
    """Significance level of a stage, which p values corrected within the stage are compared with.

    Args:
        stage: One of `STAGES`.
        alpha: Chance that any stage finds something where nothing is there.
        found: Earlier stages that found something.
    """
    place = STAGES.index(stage)
    shares = 1
    while shares <= place and STAGES[place - shares] in found:
        shares += 1
    return alpha * shares / len(STAGES)
