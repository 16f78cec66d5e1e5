"""Answers: JSON, files, and the headers that keep a browser from doing more with them than show them."""

from __future__ import annotations

import hmac
import json
from collections.abc import Collection
from pathlib import Path
from typing import Any

from werkzeug.wrappers import Request, Response

from nsde_torch.diagnosis.time_series import script_hash

from .job import RefusedError

_PAGE = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; frame-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_SHEET = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; "
    f"script-src '{script_hash()}'; sandbox allow-scripts; frame-ancestors 'self'"
)
"""A report runs the script of its time series and no other, and can ask for nothing."""
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
    """Plain containers as JSON."""
    return Response(json.dumps(content), status=status, content_type=TYPES[".json"])


def answer_file(path: Path, *, name: str | None = None) -> Response:
    """A file, whose suffix is a key of `TYPES`: shown or, with a name, saved under it."""
    answer = Response(path.read_bytes(), content_type=TYPES[path.suffix])
    if name is not None:
        answer.headers["Content-Disposition"] = f'attachment; filename="{name}"'
    return answer


def shut_in(answer: Response, *, sheet: bool) -> Response:
    """Headers for every answer: nothing from elsewhere, nothing kept, no frame of another site."""
    answer.headers["Content-Security-Policy"] = _SHEET if sheet else _PAGE
    answer.headers["X-Content-Type-Options"] = "nosniff"
    answer.headers["Referrer-Policy"] = "no-referrer"
    answer.headers["Cross-Origin-Resource-Policy"] = "same-origin"
    answer.headers["Cross-Origin-Opener-Policy"] = "same-origin"
    answer.headers["Cache-Control"] = "no-store"
    return answer


# Who may ask: pages of this server alone, under its own name, with its token.
#
# A page of another site can make a browser send requests to this machine. It cannot read the answers, but it
# could start work, and under a name of its own that leads here (DNS rebinding) it could read them too. So the
# names of the server are checked, where a request comes from, and the token, which is only in the address
# that the command prints.

TOKEN = "X-Nsde-Token"
"""Header that holds the token."""
NO_TOKEN = "Open the address that `nsde serve` printed: it holds the key to this page."
_SAFE = ("GET", "HEAD")
_OWN = (None, "same-origin", "none")


def check_place(request: Request, hosts: Collection[str]) -> None:
    """Refuse requests under another name than `hosts`, or from the page of another site."""
    if request.headers.get("Host") not in hosts:
        raise RefusedError(f"This page is at {sorted(hosts)[0]} alone.", 421)
    origin = request.headers.get("Origin")
    if origin is not None and origin not in {f"http://{host}" for host in hosts}:
        raise RefusedError("Requests of other sites are refused.", 403)
    page = request.method in _SAFE and request.path == "/"
    if not page and request.headers.get("Sec-Fetch-Site") not in _OWN:
        raise RefusedError("Requests of other sites are refused.", 403)


def check_token(request: Request, token: str) -> None:
    """Refuse requests without the token."""
    if not is_token(request.headers.get(TOKEN, ""), token):
        raise RefusedError(NO_TOKEN, 401)


def is_token(given: str, token: str) -> bool:
    """Whether what a request holds is the token; the time that this takes says nothing of it."""
    return hmac.compare_digest(given.encode(), token.encode())
