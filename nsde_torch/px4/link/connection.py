"""The link: an endpoint on a transport, with a thread that receives.

with open_link("udpin:127.0.0.1:14540") as link:
    link.wait_for_vehicle(10.0)
    link.endpoint.state
"""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from types import TracebackType
from typing import final

from nsde_torch.px4.link.endpoint import Endpoint
from nsde_torch.px4.link.transport import LinkError, Transport, open_transport
from nsde_torch.px4.link.urgent import STREAM, urgent

POLL = 0.05
"""Time between looks at what is due to be said [s]."""


class Connection(ABC):
    """An endpoint and the clock that it lives on; a context manager.

    Attributes:
        endpoint: Says and hears.
        live: Whether something flies that must be landed when it is asked to stop.
    """

    endpoint: Endpoint
    live: bool = True

    @abstractmethod
    def now(self) -> float:
        """Our clock [s]."""

    @abstractmethod
    def pause(self, seconds: float) -> None:
        """Let time pass."""

    def __enter__(self) -> Connection:
        return self

    def __exit__(  # noqa: B027
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Let go of what it holds."""


@final
class Link(Connection):
    """A connection to one vehicle; a context manager.

    Args:
        transport: Bytes in and out.
        system: See `Endpoint`.
        target: See `Endpoint`.
        key: See `Endpoint`.

    Attributes:
        endpoint: Says and hears.
    """

    def __init__(
        self, transport: Transport, *, system: int = 245, target: int | None = None, key: bytes | None = None
    ) -> None:
        self._transport = transport
        self.endpoint = Endpoint(
            transport.send, system=system, target=target, key=key, stream=transport.stream
        )
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._receive, name="mavlink", daemon=True)
        self.fault: Exception | None = None

    def __enter__(self) -> Link:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stop.set()
        self._thread.join(1.0)
        self._transport.close()

    def now(self) -> float:
        """See `Connection.now`."""
        return time.monotonic()

    def pause(self, seconds: float) -> None:
        """See `Connection.pause`."""
        time.sleep(seconds)

    @urgent(STREAM)
    def _receive(self) -> None:
        polled = 0.0
        while not self._stop.is_set():
            try:
                data = self._transport.receive(POLL)
                now = time.monotonic()
                if data and self.endpoint.receive(data, now):
                    self._transport.trust()
                if now - polled >= POLL:
                    polled = now
                    self.endpoint.poll(now)
            except Exception as error:  # a fault of ours must not end the hearing; the flight is told of it
                self.fault = error
                time.sleep(0.001)

    def wait_for_vehicle(self, timeout: float) -> None:
        """Wait for the first state.

        Raises:
            LinkError: nothing, or no state, within `timeout` [s]; says what was heard.
        """
        end = time.monotonic() + timeout
        while time.monotonic() < end:
            if self.endpoint.state is not None:
                return
            time.sleep(0.01)
        raise LinkError(why_no_state(self.endpoint, timeout))


def why_no_state(endpoint: Endpoint, timeout: float) -> str:
    """What is missing where no state came."""
    counts = endpoint.codec.counts
    if endpoint.target is not None:
        return (
            f"the vehicle (system {endpoint.target}) is heard, but no state came within {timeout:g} s: neither "
            "ODOMETRY nor ATTITUDE_QUATERNION with LOCAL_POSITION_NED. Has its estimator a position?"
        )
    if counts["unsigned"] or counts["signature"]:
        return (
            f"messages come, but they are not signed with our key ({counts['unsigned']} unsigned, "
            f"{counts['signature']} with another key). Give the vehicle's key, or none."
        )
    if counts:
        heard = ", ".join(f"{n} {word}" for word, n in counts.most_common(4))
        return f"bytes come, but no heartbeat of an autopilot within {timeout:g} s ({heard})."
    return f"nothing was heard within {timeout:g} s. Is the vehicle on, and does it send to this address?"


def open_link(
    url: str,
    *,
    expose: bool = False,
    system: int = 245,
    target: int | None = None,
    key: bytes | None = None,
) -> Link:
    """A link to what a url names; see `transport` and `Endpoint`.

    Raises:
        LinkError: the url is not understood or cannot be opened.
    """
    return Link(open_transport(url, expose=expose), system=system, target=target, key=key)
