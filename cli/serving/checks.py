"""Who may ask: pages of this server alone, under its own name, with its token.

A page of another site can make a browser send requests to this machine. It cannot read the answers, but it could start
work, and under a name of its own that leads here (DNS rebinding) it could read them too. So the names of the server
are checked, where a request comes from, and the token, which is only in the address that the command prints.
"""

from __future__ import annotations

import hmac
from collections.abc import Collection

from werkzeug.wrappers import Request

from .refused import RefusedError

TOKEN = "X-Nsde-Token"
"""Header that holds the token."""
NO_TOKEN = "Open the address that `nsde serve` printed: it holds the key to this page."
_SAFE = ("GET", "HEAD")
_OWN = (None, "same-origin", "none")


def check_place(request: Request, hosts: Collection[str]) -> None:
    """Refuse requests under another name, or from the page of another site.

    Args:
        request: The request.
        hosts: `name:port` of this server.

    Raises:
        RefusedError: it is one.
    """
    if request.headers.get("Host") not in hosts:
        raise RefusedError(f"This page is at {sorted(hosts)[0]} alone.", 421)
    origin = request.headers.get("Origin")
    if origin is not None and origin not in {f"http://{host}" for host in hosts}:
        raise RefusedError("Requests of other sites are refused.", 403)
    page = request.method in _SAFE and request.path == "/"
    if not page and request.headers.get("Sec-Fetch-Site") not in _OWN:
        raise RefusedError("Requests of other sites are refused.", 403)


def check_token(request: Request, token: str) -> None:
    """Refuse requests without the token.

    Args:
        request: The request.
        token: That of the server.

    Raises:
        RefusedError: it is not the one.
    """
    if not is_token(request.headers.get(TOKEN, ""), token):
        raise RefusedError(NO_TOKEN, 401)


def is_token(given: str, token: str) -> bool:
    """Whether what a request holds is the token; the time that this takes says nothing of it."""
    return hmac.compare_digest(given.encode(), token.encode())
