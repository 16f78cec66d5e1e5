"""The comparison itself sees what differs, and nothing else."""

from typing import Any

import pytest

from tests.golden.kept import differences


@pytest.mark.parametrize(
    ("got", "want", "count"),
    [
        ({"a": 1.0001, "b": [1, None]}, {"a": 1.0, "b": [1, None]}, 0),
        ({"a": 1.1}, {"a": 1.0}, 1),
        ({"a": 1, "b": 2}, {"a": 1}, 1),
        ([1, 2], [1], 1),
        (True, 1.5, 1),
        ("size 0.301 m", "size 0.3 m", 0),
        ("size 0.4 m", "size 0.3 m", 1),
        ("size 0.3 m", "width 0.3 m", 1),
        (None, 0.0, 1),
    ],
)
def test_differences(got: Any, want: Any, count: int) -> None:
    assert len(list(differences(got, want, rel=1e-3, abs=1e-9))) == count
