"""Red in a terminal, where that is wanted: a terminal that can, and NO_COLOR not set (no-color.org)."""

from __future__ import annotations

import os
import sys

_RED, _END = "\033[31m", "\033[0m"


def allowed() -> bool:
    """Whether standard output takes colours; FORCE_COLOR asks for them in a pipe or file too."""
    if os.environ.get("NO_COLOR"):
        return False
    if os.environ.get("FORCE_COLOR"):
        return True
    return sys.stdout.isatty() and os.environ.get("TERM") != "dumb"


def red(text: str) -> str:
    """The text in red where colours are allowed, else as it is."""
    return f"{_RED}{text}{_END}" if text and allowed() else text
