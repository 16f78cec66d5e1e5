"""The server of the application: waitress on an address of this machine.

waitress takes the whole body of a request before it calls the application. So the parser of requests asks for the token
as soon as it has the header: a body without it is not read.
"""

import json
import socket
from collections.abc import Callable, Iterable
from typing import Any

from waitress.channel import HTTPChannel
from waitress.parser import HTTPRequestParser
from waitress.server import create_server
from waitress.utilities import Error

from nsde_torch.errors import ConfigError

from .app import NO_TOKEN, TOKEN, is_token

WSGI = Callable[[Any, Any], Iterable[bytes]]


class _KeylessError(Error):
    """The answer to a body without the token."""

    code, reason = 401, "Unauthorized"

    def to_response(self, ident: str | None = None) -> tuple[str, list[tuple[str, str]], bytes]:
        headers = [("Content-Type", "application/json")]
        return f"{self.code} {self.reason}", headers, json.dumps({"error": self.body}).encode()


def _channel(token: str) -> type[HTTPChannel]:
    """A connection that reads no body without the token."""

    class Parser(HTTPRequestParser):
        error: Error | None = None

        def received(self, data: bytes) -> int:
            before = self.headers_finished
            consumed: int = super().received(data)
            if self.headers_finished and not before and self.body_rcv is not None and self.error is None:
                given = self.headers.get(TOKEN.upper().replace("-", "_"), "")
                if not is_token(given, token):
                    self.error, self.completed, self.expect_continue = _KeylessError(NO_TOKEN), True, False
            return consumed

    class Channel(HTTPChannel):
        parser_class = Parser

    return Channel


def serve(sock: socket.socket, application: WSGI, *, token: str, largest: int, threads: int) -> None:
    """Answer requests of `largest` bytes at most, until Ctrl-C or SIGTERM."""
    server = create_server(
        application,
        sockets=[sock],
        threads=threads,
        max_request_body_size=largest,
        clear_untrusted_proxy_headers=True,
        ident=None,
    )
    server.channel_class = _channel(token)
    try:
        server.run()
    finally:
        server.close()


def listen(host: str, port: int) -> socket.socket:
    """Bind a port, 0 for any that is free; ConfigError where it is taken, or may not be bound."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        sock.bind((host, port))
        sock.listen()  # from here on a browser waits, though nothing answers yet
    except OSError as error:
        sock.close()
        raise ConfigError(
            f"`port`: {host}:{port} cannot be bound ({error.strerror}); another page may run there: port=0 takes any "
            "that is free."
        ) from error
    return sock
