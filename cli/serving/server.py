"""The server of the application: waitress on an address of this machine."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterable
from typing import Any

from waitress.server import create_server

from nsde_torch.errors import ConfigError

WSGI = Callable[[Any, Any], Iterable[bytes]]


class PageServer:
    """A socket that listens, and what answers there.

    Args:
        sock: Bound to an address.
        largest: Most bytes of a request.
        threads: Requests at a time.
    """

    def __init__(self, sock: socket.socket, *, largest: int, threads: int) -> None:
        self.socket, self._largest, self._threads = sock, largest, threads
        self.port: int = sock.getsockname()[1]

    def run(self, application: WSGI) -> None:
        """Answer until Ctrl-C or SIGTERM.

        Args:
            application: What answers.
        """
        server = create_server(
            application,
            sockets=[self.socket],
            threads=self._threads,
            max_request_body_size=self._largest,
            clear_untrusted_proxy_headers=True,
            ident=None,
        )
        try:
            server.run()
        finally:
            server.close()


def listen(host: str, port: int, *, largest: int, threads: int) -> PageServer:
    """Bind a port.

    Args:
        host: Address of this machine.
        port: 0: any that is free.
        largest: Most bytes of a request.
        threads: Requests at a time.

    Raises:
        ConfigError: it is taken, or may not be bound.
    """
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
    return PageServer(sock, largest=largest, threads=threads)
