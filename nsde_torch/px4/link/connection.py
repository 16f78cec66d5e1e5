"""The link: an endpoint on a transport, with a thread that receives.

with open_link("udpin:127.0.0.1:14540") as link:
    link.wait_for_vehicle(10.0)
    link.endpoint.state
"""

from __future__ import annotations

import ipaddress
import os
import select
import socket
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, final

from nsde_torch.errors import NsdeError
from nsde_torch.px4.link.endpoint import Endpoint

# Which threads the system runs first on a computer whose cores are all busy.
#
# Measured on two cores with four processes of nice -4 beside a flight at 3.4 m/s: 2.9 cm off the path as
# real-time threads, and ended 38 cm off by late plans at normal priority. Setpoints were up to 14 and 102 ms
# apart beside two processes of nice -8. Where it is not allowed (`ulimit -r` is 0, and the user is not root)
# all stays as it is.

STREAM, PLANS = 2, 1
"""Priorities: setpoints and hearing before plans, which take longer, and both before all that is not real-time."""


@contextmanager
def urgent(priority: int) -> Iterator[bool]:
    """Run this thread before those of a lower priority (SCHED_RR), as far as the system allows that; gives whether.

    `PLANS`, which may take a whole core, are not urgent where there is only one: what carries the link runs on others.
    """
    asked = False
    with suppress(OSError, AttributeError):  # not allowed, or not Linux
        if priority == STREAM or len(os.sched_getaffinity(0)) > 1:
            os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
            asked = True
    try:
        yield asked
    finally:
        if asked:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


POLL = 0.05  # time between looks at what is due to be said [s]


class Connection(ABC):
    """An endpoint and the clock that it lives on; a context manager."""

    endpoint: Endpoint  # says and hears
    live = True  # whether something flies that must be landed when it is asked to stop

    @abstractmethod
    def now(self) -> float:
        """Our clock [s]."""

    @abstractmethod
    def pause(self, seconds: float) -> None:
        """Let time pass."""

    def __enter__(self) -> Connection:
        return self

    def __exit__(self, *error: object) -> None:  # noqa: B027
        """Release what it holds."""


@final
class Link(Connection):
    """A connection to one vehicle, over bytes in and out (else see `Endpoint`); a context manager."""

    def __init__(self, transport: Transport, **known: Any) -> None:
        self._transport = transport
        self.endpoint = Endpoint(transport.send, stream=transport.stream, **known)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._receive, name="mavlink", daemon=True)
        self.fault: Exception | None = None

    def __enter__(self) -> Link:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stop.set()
        self._thread.join(1.0)
        self._transport.close()

    def now(self) -> float:
        return time.monotonic()

    def pause(self, seconds: float) -> None:
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
            except Exception as error:  # a fault of ours must not end the hearing; the flight is informed
                self.fault = error
                time.sleep(0.001)

    def wait_for_vehicle(self, timeout: float) -> None:
        """Wait for the first state; after `timeout` [s] without any, a LinkError says what was heard."""
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
    url: str, *, expose: bool = False, system: int = 245, target: int | None = None, key: bytes | None = None
) -> Link:
    """A link to what a url names (`transport`; see `Endpoint`); LinkError where it is no url, or cannot be opened."""
    return Link(open_transport(url, expose=expose), system=system, target=target, key=key)


# Ways for bytes: UDP (in and out), TCP (client and server), serial.
#
#     udpin:127.0.0.1:14540     wait for the vehicle there        tcp:127.0.0.1:4560    connect
#     udpout:127.0.0.1:14580    send to the vehicle there         tcpin:127.0.0.1:4560  wait for a connection
#     serial:/dev/ttyACM0:921600
#
# What waits does so on the loopback interface by default: MAVLink without signing lets anyone fly.

_BUFFER = 1 << 20
TAKEOVER = 2.0  # silence of the vehicle after which another port of the same host may take its place [s]


class LinkError(NsdeError, OSError):
    """A link cannot be opened or is lost; the message names the address and the remedy."""


class Transport(ABC):
    """Bytes in and out."""

    stream: bool = False  # whether frames may come in pieces

    def receive(self, timeout: float) -> bytes:
        """The next bytes, empty after `timeout` [s] without any."""
        try:
            if select.select([self._source()], [], [], timeout)[0]:
                return self._read()
        # nobody is there, it was unplugged, or another thread closed it
        except (OSError, ValueError, TypeError):
            time.sleep(min(timeout, 0.001))
        return b""

    @abstractmethod
    def _source(self) -> Any:
        """What is waited on until there is something to read."""

    @abstractmethod
    def _read(self) -> bytes:
        """Bytes that are there."""

    @abstractmethod
    def send(self, data: bytes) -> None:
        """Send at once, or not at all: never waits."""

    @abstractmethod
    def close(self) -> None:
        """Let go of the address."""

    @property
    def connected(self) -> bool:
        """Whether there is another side, as far as this kind of link can show."""
        return True

    def trust(self) -> None:  # noqa: B027
        """What was received last came from the vehicle: stay with its address."""


def open_transport(url: str, *, expose: bool = False, name: str = "link.url") -> Transport:
    """The way for bytes that a url names (see the module's text), which was given by a key of that name.

    LinkError for a url that is not understood, an address that cannot be had, or another interface than loopback to
    wait on without `expose`.
    """
    kinds: dict[str, Callable[[str, int], Transport]]
    kinds = {"udpin": UdpIn, "udpout": UdpOut, "tcp": Tcp, "tcpin": TcpIn, "serial": Serial}
    kind, _, rest = url.partition(":")
    where, _, number = rest.rpartition(":")
    if kind not in kinds or not where or not number.isdigit():
        raise LinkError(
            f"`{name}`: {url!r} is not understood; expected udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT, "
            "tcpin:HOST:PORT or serial:DEVICE:BAUD."
        )
    port = int(number)
    if kind != "serial" and not 0 <= port <= 65535:
        raise LinkError(f"`{name}`: port {port} of {url!r} is not 0 to 65535.")
    if kind in ("udpin", "tcpin") and not expose and not _loopback(where):
        raise LinkError(
            f"`{name}`: {url!r} would listen on an interface that others reach, and MAVLink lets anyone fly. Use "
            "127.0.0.1, or add link.expose=true, best with link.key_file."
        )
    try:
        return kinds[kind](where, port)
    except OSError as error:
        raise LinkError(f"`{name}`: {url!r} cannot be opened ({error}). Is another program on it?") from error


def _loopback(host: str) -> bool:
    with suppress(ValueError):
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    return False


class _Udp(Transport):
    """A socket for datagrams, which waits at an address or sends to it."""

    listens: bool

    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        self._socket.setblocking(False)
        try:
            (self._socket.bind if self.listens else self._socket.connect)((host, port))
        except OSError:
            self._socket.close()
            raise

    def _source(self) -> socket.socket:
        return self._socket

    def close(self) -> None:
        self._socket.close()


@final
class UdpIn(_Udp):
    """Waits for the vehicle; answers to the address from which its first good message came."""

    listens = True

    def __init__(self, host: str, port: int) -> None:
        super().__init__(host, port)
        self.address: tuple[str, int] = self._socket.getsockname()
        self._peer: tuple[str, int] | None = None
        self._last: tuple[str, int] | None = None
        self._heard, self.foreign = 0.0, 0

    def _read(self) -> bytes:
        data, source = self._socket.recvfrom(65536)
        now = time.monotonic()
        if self._peer is not None and source != self._peer:
            # a restarted vehicle has another port; a stranger does not get in while ours is heard
            if source[0] != self._peer[0] or now - self._heard < TAKEOVER:
                self.foreign += 1
                return b""
        else:
            self._heard = now
        self._last = source
        return data

    def trust(self) -> None:
        if self._last is not None and self._last != self._peer:
            self._peer, self._heard = self._last, time.monotonic()

    def send(self, data: bytes) -> None:
        if self._peer is not None:
            with suppress(OSError):  # nobody there, or no room: the next one is due in milliseconds
                self._socket.sendto(data, self._peer)


@final
class UdpOut(_Udp):
    """Sends to an address and hears only it."""

    listens = False

    def _read(self) -> bytes:
        return self._socket.recv(65536)

    def send(self, data: bytes) -> None:
        with suppress(OSError):
            self._socket.send(data)


class _Connected(Transport):
    """A TCP connection; when it is lost, nothing is received or sent."""

    stream = True

    def __init__(self) -> None:
        self._connection: socket.socket | None = None

    @property
    def connected(self) -> bool:
        return self._connection is not None

    def _use(self, connection: socket.socket) -> None:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setblocking(False)
        self._connection = connection

    def _source(self) -> socket.socket | None:
        return self._connection

    def _read(self) -> bytes:
        if self._connection is None:  # dropped by another thread just now
            return b""
        try:
            data = self._connection.recv(65536)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._drop()
        return data

    def send(self, data: bytes) -> None:
        if self._connection is None:
            return
        try:
            if self._connection.send(data) < len(data):
                self._drop()  # half a frame went out: nothing after it would be understood
        except BlockingIOError:
            return
        except OSError:
            self._drop()

    def _drop(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def close(self) -> None:
        self._drop()


@final
class Tcp(_Connected):
    """A connection made by us."""

    def __init__(self, host: str, port: int) -> None:
        super().__init__()
        self._use(socket.create_connection((host, port), timeout=5.0))


@final
class TcpIn(_Connected):
    """A connection made by the other side, one at a time."""

    def __init__(self, host: str, port: int) -> None:
        super().__init__()
        self._server = socket.create_server((host, port))
        self._server.setblocking(False)
        self.address: tuple[str, int] = self._server.getsockname()

    def _source(self) -> socket.socket:
        return self._connection or self._server

    def _read(self) -> bytes:
        if self._connection is not None:
            return super()._read()
        self._use(self._server.accept()[0])
        return b""

    def close(self) -> None:
        super().close()
        self._server.close()


@final
class Serial(Transport):
    """A serial port."""

    stream = True

    def __init__(self, device: str, baud: int) -> None:
        import serial

        self._port: Any = serial.Serial(device, baud, timeout=0.0, write_timeout=0.0)

    def _source(self) -> Any:
        return self._port

    def _read(self) -> bytes:
        data: bytes = self._port.read(4096)
        return data

    def send(self, data: bytes) -> None:
        with suppress(OSError, ValueError):
            self._port.write(data)

    def close(self) -> None:
        self._port.close()
