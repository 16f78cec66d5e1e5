"""What is left over: everything a residual may depend on, and the tests that find it beyond chance."""

from collections.abc import Mapping, Sequence

from nsde_torch.diagnosis.dependence import Dependence
from nsde_torch.diagnosis.multiplicity import bonferroni
from nsde_torch.diagnosis.regressors import Regressors, regressors
from nsde_torch.diagnosis.search import Base, Search


def variables_of(search: Search, base: Base) -> Regressors:
    """What the residuals of physics may depend on.

    Args:
        search: Data and settings.
        base: The physics, fitted.
    """
    return regressors(
        base.regression,
        inputs=search.inputs,
        moved=search.moved,
        decisions=search.decisions,
        budgets=search.budgets,
    )


def beyond_chance(
    tests: Sequence[Dependence], allowed: Mapping[str, float], *, alpha: float
) -> list[Dependence]:
    """Tests that find something after correction for their number, what explains most first.

    Args:
        tests: All tests.
        allowed: Likelihood ratio that feedback may hide, by channel (`hidden`).
        alpha: Significance level of the stage.
    """
    found = (
        d
        for d in tests
        if bonferroni(d.p, len(tests)) < alpha and d.excess > 0.5 * allowed.get(d.channel, 0.0)
    )
    return sorted(found, key=lambda d: -d.excess)
