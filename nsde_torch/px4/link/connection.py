"""The link: an endpoint on a transport, with a thread that receives.

with open_link("udpin:127.0.0.1:14540") as link:
    link.wait_for_vehicle(10.0)
    link.endpoint.state
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import final

from nsde_torch.px4.link.endpoint import Endpoint
from nsde_torch.px4.link.transport import LinkError, Transport, open_transport

# Which threads the system runs first on a computer whose cores are all busy.
#
# Measured on two cores with four processes of nice -4 beside a flight at 3.4 m/s: 2.9 cm off the path as
# real-time threads, and ended 38 cm off by late plans at normal priority. Setpoints were up to 14 and 102 ms
# apart beside two processes of nice -8. Where it is not allowed (`ulimit -r` is 0, and the user is not root)
# all stays as it is.

STREAM, PLANS = 2, 1
"""Priorities: setpoints and hearing before plans, which take longer, and both before all that is not real-time."""


@contextlib.contextmanager
def urgent(priority: int) -> Iterator[bool]:
    """Run this thread before those of a lower priority (SCHED_RR), as far as the system allows that; gives whether.

    `PLANS`, which may take a whole core, are not urgent where there is only one: what carries the link runs on others.
    """
    asked = False
    with contextlib.suppress(OSError, AttributeError):  # not allowed, or not Linux
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

    def __init__(
        self, transport: Transport, *, system: int = 245, target: int | None = None, key: bytes | None = None
    ) -> None:
        self._transport, stream = transport, transport.stream
        self.endpoint = Endpoint(transport.send, system=system, target=target, key=key, stream=stream)
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
