"""Answers: JSON, files, and the headers that keep a browser from doing more with them than show them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from werkzeug.wrappers import Response

_PAGE = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; frame-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_SHEET = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; sandbox; frame-ancestors 'self'"
"""A report is shown without scripts, and can ask for nothing."""
TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
    ".png": "image/png",
    ".json": "application/json",
    ".yaml": "text/plain; charset=utf-8",
    ".txt": "text/plain; charset=utf-8",
}


def answer_json(content: Any, status: int = 200) -> Response:
    """Plain containers as JSON.

    Args:
        content: What to say.
        status: Of HTTP.
    """
    return Response(json.dumps(content), status=status, content_type=TYPES[".json"])


def answer_file(path: Path, *, name: str | None = None) -> Response:
    """A file, shown or, with a name, saved under it.

    Args:
        path: The file; its suffix is a key of `TYPES`.
        name: Of what is saved.
    """
    answer = Response(path.read_bytes(), content_type=TYPES[path.suffix])
    if name is not None:
        answer.headers["Content-Disposition"] = f'attachment; filename="{name}"'
    return answer


def shut_in(answer: Response, *, sheet: bool) -> Response:
    """Headers for every answer: nothing from elsewhere, nothing kept, no frame of another site.

    Args:
        answer: The answer.
        sheet: Whether it is a file of a job.
    """
    answer.headers["Content-Security-Policy"] = _SHEET if sheet else _PAGE
    answer.headers["X-Content-Type-Options"] = "nosniff"
    answer.headers["Referrer-Policy"] = "no-referrer"
    answer.headers["Cross-Origin-Resource-Policy"] = "same-origin"
    answer.headers["Cross-Origin-Opener-Policy"] = "same-origin"
    answer.headers["Cache-Control"] = "no-store"
    return answer
