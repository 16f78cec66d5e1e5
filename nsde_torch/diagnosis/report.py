"""`report.html`: one self-contained page that a field engineer reads in two minutes."""

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

from nsde_torch.diagnosis.diagnose import Diagnosis
from nsde_torch.diagnosis.text import lines


def write_report(path: Path, found: Diagnosis, content: Mapping[str, Any]) -> None:
    """Write the page."""
    text = escape("\n".join(lines(content)))
    path.write_text(
        f"<!doctype html><meta charset=utf-8><title>Diagnosis</title><pre>{text}</pre>", encoding="utf-8"
    )
