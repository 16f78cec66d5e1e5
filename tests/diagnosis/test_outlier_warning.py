"""Rows that the likelihood leaves out are said, with their run and time."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

from nsde_torch.diagnosis.result import outlier_warnings


def found(times: dict[int, list[float]]) -> Any:
    joint = SimpleNamespace(final=SimpleNamespace(at=SimpleNamespace(outlier_times=times)))
    return SimpleNamespace(outcome=SimpleNamespace(joint=joint), runs=("first", "second"))


def test_rows_that_were_left_out_are_said_with_their_run_and_time() -> None:
    (warning,) = outlier_warnings(cast(Any, found({1: [22.41, 22.42, 22.5]})))
    assert "3 of 'second', from t = 22.41 to 22.5 s" in warning["sentence"]
    assert warning["kind"] == "outliers"


def test_nothing_is_said_of_a_log_without_any() -> None:
    assert outlier_warnings(found({})) == []
