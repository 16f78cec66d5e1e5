"""Laws that the noise model has learned, and that no test of one variable shows: a flexible model says what to try."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from nsde_torch.diagnosis.decisions import BUDGETS
from nsde_torch.diagnosis.evidence import folds, score
from nsde_torch.diagnosis.fitted import fitted_system, nonlinear
from nsde_torch.diagnosis.flexible import Flexible, flexible
from nsde_torch.diagnosis.flexible_gain import flexible_gain
from nsde_torch.diagnosis.search import Base
from nsde_torch.sysid.loop_test import LoopTest
from tests.diagnosis.test_shape import pushed
from tests.helpers.diagnosed import diagnosed

SHORT: dict[str, Any] = {"durations": (8.0,) * 4, "dt": 0.02}


@pytest.mark.parametrize(("law", "size"), [("force = c1 q q_dot^2", -10.0), ("force = c1 q^2 q_dot", -10.0)])
@pytest.mark.slow
def test_a_law_of_two_variables_is_named(law: str, size: float) -> None:
    _, content = diagnosed("mass_spring_damper", {law: {"c1": size}}, **SHORT)
    assert (content["verdict"], content["added"]) == ("effect_found", [law])
    (own,) = (f for f in content["findings"] if f["name"] == law)
    assert not own["lead"]
    low, high = content["parameters"][f"{law}.c1"]["interval_90"]
    assert low - 0.5 * (high - low) <= size <= high + 0.5 * (high - low)


def ridge() -> Base:
    """A spring with a force along a line of the plane of place and speed, a tenth of the range wide."""
    r, variables = pushed(lambda q, t, run: 0.0 * q)
    q, v = (variables.values(name) for name in ("q", "q_dot"))
    across = (q / q.std() + v / v.std()) / 0.3
    r.residual[:, r.rows[0]] += 1.5 * np.exp(-(across**2)) * np.sign(q) * r.dt
    r.noises = r.own_noises()
    r.white = r.noises[0].whiten(r.residual[:, r.rows], r.series).T
    r.slopes = r.noises[0].whiten(r.jacobian[:, r.rows[0]], r.series)[None]
    fold, block = folds(r), r.whitened_rows(r.blocks)
    return Base(
        fitted_system(r), r, score(r, fold, block, still=nonlinear(r.vector, smooth=False)), fold, block
    )


@pytest.mark.slow
def test_a_ridge_across_a_plane_is_won_by_fine_functions_of_it() -> None:
    base = ridge()
    _, variables = pushed(lambda q, t, run: 0.0 * q)
    found: Flexible = flexible(base, variables, BUDGETS)
    kinds = {(p.terms[k].group.variables, p.terms[k].group.kind) for p, f in found.parts for k in f.used}
    assert (("q", "q_dot"), "fine") in kinds
    assert found.flexible_squares.mean() < 0.8 * found.plain_squares.mean()


def test_a_variable_tells_what_is_lost_without_any_function_of_it() -> None:
    r, variables = pushed(lambda q, t, run: 0.8 * np.exp(-(((q - 0.1) / 0.15) ** 2)))
    fold, block = folds(r), r.whitened_rows(r.blocks)
    base = Base(
        fitted_system(r), r, score(r, fold, block, still=nonlinear(r.vector, smooth=False)), fold, block
    )
    found = flexible_gain(base, variables, LoopTest(), variables.decisions, BUDGETS)
    assert found.more
    assert [t.variable for t in found.telling] == ["q"]
    assert set(found.by_channel) == {"q_dot"}
    assert set(found.noises) == {0}
