"""The test of feedback in a diagnosis: its content, its lines, its part of the report (see `loop_test`)."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from nsde_torch.data import Run
from nsde_torch.learning.identify.identify import Regression
from nsde_torch.learning.identify.loop_test import tested


def feedback_content(regression: Regression, runs: Sequence[Run]) -> dict[str, Any]:
    """What the key `feedback` of `diagnosis.json` holds.

    Args:
        regression: Of the physics with what was found.
        runs: The runs that it was fitted to.
    """
    return tested(regression, runs).as_dict()


def feedback_lines(content: Mapping[str, Any]) -> list[str]:
    """Lines of text, an empty one first."""
    found = _findings(content)
    return ["", *(f"feedback: {sentence}" for sentence in found)] if found else []


def feedback_html(content: Mapping[str, Any]) -> str:
    """A section of the report."""
    found = _findings(content)
    return "<h2>Feedback</h2>" + "".join(f"<p>{escape(_capital(s))}.</p>" for s in found) if found else ""


def _findings(content: Mapping[str, Any]) -> Sequence[str]:
    found: Sequence[str] = content.get("feedback", {}).get("findings", [])
    return found


def _capital(sentence: str) -> str:
    return sentence[:1].upper() + sentence[1:]
