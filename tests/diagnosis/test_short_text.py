"""What `nsde diagnose` prints at its end: a screen of what matters, with the digits that intervals have."""

import json
import math
from pathlib import Path
from typing import Any

import pytest

from nsde_torch.diagnosis.text import lines, short_lines
from nsde_torch.evaluation.report import between_ends, number


@pytest.fixture
def content() -> dict[str, Any]:
    path = Path(__file__).parents[1] / "golden" / "diagnosis.json"
    return dict(json.loads(path.read_text(encoding="utf-8")))


def test_the_short_text_fits_a_screen_and_has_every_finding_with_its_interval(
    content: dict[str, Any],
) -> None:
    text = short_lines(content)
    assert len(text) <= 20 < len("\n".join(lines(content)).splitlines())
    assert text[0] == f"verdict: {content['verdict']}"
    for name in content["told"]["few"]:
        own = next(line for line in text if line.startswith(f"{name}: "))
        for key, p in content["parameters"].items():
            if key.startswith(f"{name}.") and p["interval_90"] and not p["bound"]:
                assert between_ends(p["interval_90"]) in own
    assert any(line.startswith("these data cannot show: ") for line in text) == bool(content["not_shown"])


def test_warnings_are_in_the_short_text(content: dict[str, Any]) -> None:
    content["warnings"] = [{"sentence": "The mass is negative", "remedy": "look at the sign of the input"}]
    assert "warning: The mass is negative. Look at the sign of the input." in short_lines(content)


def test_values_of_least_squares_are_in_the_short_text_where_they_are_to_be_used(
    content: dict[str, Any],
) -> None:
    content["guard"]["to_use"] = {"gain": {"value": 1.23456, "interval_90": [1.1, 1.3], "unit": "1"}}
    assert "values of least squares, to be used: gain 1.23 (1.10 to 1.30)" in short_lines(content)


@pytest.mark.parametrize(
    ("value", "width", "text"),
    [
        (0.397312, 0.0079, "0.3973"),
        (4.6, 0.1386, "4.600"),
        (1034.2, 240.0, "1030"),
        (0.02, 3.0, "0"),
        (-0.0000123456, 0.000002, "-1.23e-05"),
        (7.0, math.inf, "7"),
        (0.0, 0.0, "0"),
        (123456.0, 20.0, "1.23456e+05"),
    ],
)
def test_a_value_has_the_digits_that_half_of_its_interval_has(value: float, width: float, text: str) -> None:
    assert number(value, width) == text
