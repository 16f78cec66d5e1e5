"""A line between PX4 and `nsde fly` that can be cut, thinned and spoken on: two UDP sockets and a thread.

PX4 -> udp 14540 (here) -> udp 14541 (`nsde fly`), and back
"""

from __future__ import annotations

import select
import socket
import threading
import time
from collections.abc import Iterator
from typing import final

from nsde_torch.px4.link import dialect as d
from nsde_torch.px4.link.codec import Codec
from nsde_torch.px4.link.dialect import Mode, mavlink
from nsde_torch.px4.link.endpoint import NUMBERS

STATES = frozenset(NUMBERS[n] for n in ("ODOMETRY", "ATTITUDE_QUATERNION", "LOCAL_POSITION_NED"))
_OPERATOR = 255
"""System id of a ground station."""


def _frames(data: bytes) -> Iterator[bytes]:
    """MAVLink 2 frames of a datagram; what is none comes as it is."""
    at = 0
    while at < len(data):
        if data[at] != 0xFD or len(data) - at < 12:
            yield data[at:]
            return
        size = 12 + data[at + 1] + (13 if data[at + 2] & 1 else 0)
        yield data[at : at + size]
        at += size


@final
class Line:
    """The line, between the port to which PX4 sends its offboard link and that on which `nsde fly` waits.

    Nothing passes while it is `cut`, and no states while it is `stale`; `mode`, `armed` and the time `heard` [s] are
    those of PX4's last heartbeat.
    """

    def __init__(self, outer: int, inner: int) -> None:
        self._outer = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._outer.bind(("127.0.0.1", outer))
        self._inner = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._inner.bind(("127.0.0.1", 0))
        self._fly, self._px4 = ("127.0.0.1", inner), ("", 0)
        self._reader = Codec(_OPERATOR, 190, wanted=frozenset({NUMBERS["HEARTBEAT"]}))
        self._writer = Codec(_OPERATOR, 190)
        self._system = 1
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self.cut = self.stale = self.armed = False
        self.mode, self.heard = d.UNKNOWN, 0.0

    def __enter__(self) -> Line:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stop.set()
        self._thread.join(2.0)
        self._outer.close()
        self._inner.close()

    def ask(self, mode: Mode) -> None:
        """Ask PX4 for a mode, as another client would."""
        if not self._px4[1]:
            return  # it was never heard
        message = mavlink.MAVLink_command_long_message(
            self._system, 1, d.SET_MODE, 0, 1, mode.main, mode.sub, 0, 0, 0, 0
        )
        self._outer.sendto(self._writer.pack(message), self._px4)

    def wait_until_disarmed(self, longest: float) -> bool:
        """Whether PX4 says within a time [s] that it is disarmed; a heartbeat that comes now counts."""
        begun = time.monotonic()
        while time.monotonic() - begun < longest:
            if self.heard > begun and not self.armed:
                return True
            time.sleep(0.1)
        return False

    def _run(self) -> None:
        while not self._stop.is_set():
            for ready in select.select([self._outer, self._inner], [], [], 0.05)[0]:
                try:
                    data, source = ready.recvfrom(65536)
                except OSError:  # the other side is not there yet
                    continue
                if ready is self._outer:
                    self._px4 = source
                    self._listen(data)
                    if not self.cut:
                        self._pass_down(data)
                elif not self.cut and self._px4[1]:
                    self._outer.sendto(data, self._px4)

    def _listen(self, data: bytes) -> None:
        for message in self._reader.unpack(data, time.monotonic()):
            if message.autopilot == d.AUTOPILOT_PX4:
                self._system = message.get_srcSystem()
                self.mode, self.armed = Mode.of(message.custom_mode), bool(message.base_mode & d.ARMED_FLAG)
                self.heard = time.monotonic()

    def _pass_down(self, data: bytes) -> None:
        if self.stale:
            data = b"".join(f for f in _frames(data) if int.from_bytes(f[7:10], "little") not in STATES)
        if data:
            self._inner.sendto(data, self._fly)
