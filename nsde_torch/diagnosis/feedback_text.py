"""The test of feedback in a diagnosis: its content, its lines, its part of the report (see `loop_test`)."""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any


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
