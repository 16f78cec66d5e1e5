"""Specification tests: their size where nothing is missing, and their power at alternatives of known size.

The innovations of a spring are drawn anew, with what a push does to them.
"""

import numpy as np
import pytest

from nsde_torch.diagnosis.residual_tests import Dependence, beyond_chance, dependences
from tests.helpers.residuals import made_residuals

NULLS, SHAPED = 8, 5


@pytest.fixture(scope="module")
def nulls() -> list[list[Dependence]]:
    return [dependences(made_residuals().made(seed=seed)) for seed in range(NULLS)]


# ---- size -------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_noise_has_no_structure_beyond_chance(nulls: list[list[Dependence]]) -> None:
    # eight data sets at a chance of one in ten: four or more of them would be one case in two hundred
    assert sum(bool(beyond_chance(tests, {}, alpha=0.1)) for tests in nulls) <= 3
    assert not any(beyond_chance(tests, {}, alpha=1e-3) for tests in nulls)


def test_p_values_of_all_tests_of_noise_are_none_too_small(nulls: list[list[Dependence]]) -> None:
    p = np.array([d.p for tests in nulls for d in tests])
    assert len(p) > 150
    for level in (0.01, 0.05, 0.1, 0.2, 0.5):
        assert (p < level).mean() <= level + 3 * (level * (1 - level) / len(p)) ** 0.5


# ---- power ------------------------------------------------------------------------------------------------


def test_a_friction_is_found_on_its_variable_as_what_it_is() -> None:
    for seed in range(SHAPED):
        first = beyond_chance(
            dependences(made_residuals().made(lambda q, v, t, run: -0.01 * np.sign(v), seed)), {}, alpha=0.01
        )[0]
        assert (first.channel, first.variable, first.run) == ("q_dot", "q_dot", None)
        assert first.odd > 0.8


@pytest.mark.parametrize("run", [1, 3])
def test_a_single_push_is_found_at_its_moment(run: int) -> None:
    made = made_residuals().made(
        lambda q, v, t, of: np.where(of == run, 0.3 * np.exp(-np.square((t - 4) / 0.1)), 0.0)
    )
    moment = next(d for d in dependences(made) if d.moment is not None)
    assert moment.p < 1e-3
    assert (moment.run, moment.moment) == (run, pytest.approx(4.0, abs=0.4))
