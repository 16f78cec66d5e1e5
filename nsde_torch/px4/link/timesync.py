"""The autopilot's clock on ours, by TIMESYNC and by the fastest message.

We send (0, t1); the autopilot answers (tc, t1) at its time tc; at t2 we know

    offset = tc - (t1 + t2) / 2,      error <= (t2 - t1) / 2.

Of the last answers that with the shortest round trip counts (Mills, RFC 5905, "clock filter"). Without answers, the
message that came soonest after its stamp bounds the offset from one side.
"""

from __future__ import annotations

from collections import deque
from typing import final

JUMP = 0.5
"""Disagreement with the messages' own stamps from which on the clock has jumped [s]."""


@final
class TimeSync:
    """Offset between two clocks.

    Attributes:
        round_trip: Of the answer that is used [s]; None without any.
    """

    def __init__(self) -> None:
        self._answers: deque[tuple[float, float]] = deque(maxlen=16)
        self._soonest: deque[float] = deque(maxlen=200)
        self.round_trip: float | None = None

    def reset(self) -> None:
        """Forget all: the autopilot restarted, or its clock was set."""
        self._answers.clear()
        self._soonest.clear()
        self.round_trip = None

    def answered(self, theirs: float, sent: float, received: float) -> None:
        """Take an answer to a TIMESYNC of ours; all times in s."""
        trip = received - sent
        if 0.0 <= trip < 1.0:
            self._answers.append((trip, theirs - 0.5 * (sent + received)))
            self.round_trip = min(self._answers)[0]

    def arrived(self, stamp: float, received: float) -> None:
        """Take a stamped message."""
        self._soonest.append(stamp - received)
        offset = self.offset
        # a stamp from the future, or one that is late by far: the answers are of another clock
        if self._answers and abs(stamp - received - offset) > JUMP and len(self._soonest) >= 10:
            recent = list(self._soonest)[-10:]
            if max(recent) - min(recent) < 0.1 and abs(recent[-1] - offset) > JUMP:
                self._answers.clear()
                self._soonest.clear()
                self._soonest.extend(recent)
                self.round_trip = None

    @property
    def offset(self) -> float:
        """Their clock minus ours [s]; 0 while nothing is known."""
        if self._answers:
            return min(self._answers)[1]
        return max(self._soonest) if self._soonest else 0.0

    def ours(self, stamp: float) -> float:
        """A time of theirs on our clock [s]."""
        return stamp - self.offset
