"""Groups of functions are chosen from products alone, and what is noise chooses none."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from nsde_torch.diagnosis.group_selection import Candidates, Products, weighted
from nsde_torch.diagnosis.trust import FAR, distance_from_data

Array = NDArray[np.float64]
FOLDS, ROWS, GROUPS, EACH = 4, 300, 12, 3
MEMBERS = [np.arange(EACH * g, EACH * (g + 1), dtype=np.int64) for g in range(GROUPS)]


def columns(size: float) -> tuple[list[Array], list[Array], list[Array]]:
    """Own columns, groups and a target that holds the own columns and `size` of the groups 4 and 7."""
    rng = np.random.default_rng(3)
    own = [rng.normal(size=(ROWS, 2)) for _ in range(FOLDS)]
    groups = [rng.normal(size=(ROWS, GROUPS * EACH)) for _ in range(FOLDS)]
    target = [
        j @ (2.0, -1.0) + size * (z[:, 13] - 0.5 * z[:, 22]) + rng.normal(size=ROWS)
        for j, z in zip(own, groups, strict=True)
    ]
    return own, groups, target


def products(own: list[Array], groups: list[Array], target: list[Array]) -> Products:
    whole = np.concatenate([np.column_stack(parts) for parts in zip(own, groups, target, strict=True)])
    return Products(whole.T @ whole, len(whole), 2)


def by_fold(own: list[Array], groups: list[Array], target: list[Array]) -> list[Products]:
    return [products([j], [z], [w]) for j, z, w in zip(own, groups, target, strict=True)]


def test_the_groups_that_are_there_are_chosen_without_each_fold() -> None:
    candidates = Candidates(by_fold(*columns(0.5)), MEMBERS)
    for fold in range(FOLDS):
        assert candidates.without(fold, blocks=60, most=10) == [4, 7]
    assert candidates.without(0, blocks=60, most=1) == [4]


def test_noise_chooses_no_group() -> None:
    candidates = Candidates(by_fold(*columns(0.0)), MEMBERS)
    assert [candidates.without(fold, blocks=60, most=10) for fold in range(FOLDS)] == [[]] * FOLDS


def test_columns_that_the_parameters_can_do_are_not_chosen() -> None:
    own, groups, target = columns(0.0)
    copies = [np.column_stack((j @ np.array([[1.0, 0.5], [-1.0, 2.0]]), j[:, 0])) for j in own]
    target = [w + 5.0 * j[:, 0] for w, j in zip(target, own, strict=True)]
    there = [np.concatenate((c, z[:, 3:]), 1) for c, z in zip(copies, groups, strict=True)]
    assert Candidates(by_fold(own, there, target), MEMBERS).without(0, blocks=60, most=10) == []


def test_weights_are_those_that_were_put_in_and_unused_directions_stay_small() -> None:
    found = weighted(products(*columns(0.5)), MEMBERS, [4, 7])
    assert found.mean[13] == pytest.approx(0.5, abs=0.08)
    assert found.mean[22] == pytest.approx(-0.25, abs=0.08)
    assert np.abs(np.delete(found.mean, [13, 22])).max() < 0.08
    assert set(found.at.tolist()) == {*range(12, 15), *range(21, 24)}
    error = np.sqrt(found.covariance.diagonal())
    assert ((0.5 / np.sqrt(FOLDS * ROWS) < error) & (error < 2.0 / np.sqrt(FOLDS * ROWS))).all()


def test_the_prior_takes_a_group_of_noise_away() -> None:
    with_noise = weighted(products(*columns(0.5)), MEMBERS, [4, 7, 1])
    plain = np.linalg.lstsq(*_stacked(), rcond=None)[0]
    assert np.linalg.norm(with_noise.mean[3:6]) < 0.7 * np.linalg.norm(plain[2 + 3 : 2 + 6])


def _stacked() -> tuple[Array, Array]:
    own, groups, target = (np.concatenate(parts) for parts in columns(0.5))
    return np.column_stack((own, groups)), target


def test_parameters_beside_weights_are_those_of_least_squares() -> None:
    whole = products(*columns(0.5))
    own, groups, target = (np.concatenate(parts) for parts in columns(0.5))
    weights = np.linspace(-1.0, 1.0, GROUPS * EACH)
    expected = np.linalg.lstsq(own, target - groups @ weights, rcond=None)[0]
    np.testing.assert_allclose(whole.parameters(weights), expected, rtol=1e-9)


def test_products_of_other_rows_are_a_difference() -> None:
    own, groups, target = columns(0.5)
    part = products(own[:1], groups[:1], target[:1])
    rest = products(own[1:], groups[1:], target[1:])
    left = products(own, groups, target) - part
    np.testing.assert_allclose(left.gram, rest.gram, rtol=1e-9, atol=1e-8)
    assert left.rows == rest.rows


def test_eta_is_nothing_among_the_data_and_one_far_from_them() -> None:
    rng = np.random.default_rng(0)
    data = rng.uniform(-1.0, 1.0, size=(2000, 2))
    data = data[data[:, 0] * data[:, 1] > -0.1]  # two corners are empty
    eta = distance_from_data(data, np.array([[0.5, 0.5], [-0.5, -0.5], [0.9, -0.9], [30.0, 0.0]]))
    assert (eta[:2] < 0.2).all()
    assert (eta[2:] > FAR).all()
    assert eta[3] == pytest.approx(1.0)
