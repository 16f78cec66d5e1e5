"""Splits are by whole run and never let training data into the test."""

from __future__ import annotations

import numpy as np
import pytest

from nsde_torch.data import DataSet, RawRun, split
from nsde_torch.errors import DataError
from nsde_torch.recording import assemble
from tests.helpers.data_systems import MSD


def data(count: int, twins: bool = False) -> DataSet:
    t = 0.01 * np.arange(100)
    raw = [
        RawRun(
            f"run_{k}",
            t,
            np.stack([np.sin(t + k * (not twins)), np.cos(t + k * (not twins))], 1),
            np.ones((100, 1)),
        )
        for k in range(count)
    ]
    return assemble(raw, MSD, kind="test")


def test_runs_are_chosen_by_index_negative_index_digits_or_name() -> None:
    d = data(4)
    for key in (1, -3, "1", "run_1"):
        parts = split(d, [key])
        assert [r.name for r in parts.test] == ["run_1"]
        assert [r.name for r in parts.train] == ["run_0", "run_2", "run_3"]
    assert [r.name for r in split(d).test] == ["run_3"]
    assert split(d, []).test == ()
    assert [r.name for r in split(d, [0], train=["run_2"]).train] == ["run_2"]


@pytest.mark.parametrize(
    ("test", "train", "text"),
    [
        ([7], None, "no run 7; choose by index or name among the 3 runs: 0: run_0"),
        (["flight"], None, "no run 'flight'"), ([0, 1, 2], None, "no run is left for training"),
        ([1], ["run_1", 2], r"\['run_1'\] are in both"), ([1, "run_1"], None, r"\['run_1'\] more than once"),
        (1, None, "must be a list"), ([True], None, "no run True"),
    ],
)  # fmt: skip
def test_faulty_splits_are_refused(test: list, train: list | None, text: str) -> None:
    with pytest.raises(DataError, match=text):
        split(data(3), test, train=train)


def test_equal_content_on_both_sides_is_refused_under_any_name() -> None:
    with pytest.raises(DataError, match="'run_1' has the same content as the training run 'run_0'"):
        split(data(2, twins=True), [1])


def test_a_single_run_cannot_be_on_both_sides() -> None:
    with pytest.raises(DataError, match=r"holds one run .* set `test` to \[\]"):
        split(data(1))
    assert len(split(data(1), []).train) == 1


def test_every_public_name_is_what_it_says_whatever_is_imported_first() -> None:
    import nsde_torch.data as package

    for name in ("Split", *package.__all__):
        assert getattr(package, name).__class__.__name__ != "module"
    assert package.split.__name__ == "split"
