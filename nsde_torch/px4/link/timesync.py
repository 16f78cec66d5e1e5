"""The autopilot's clock on ours, by TIMESYNC and by the fastest message.

We send (0, t1); the autopilot answers (tc, t1) at its time tc; at t2 we know

    tc = t + o(t) at t = (t1 + t2) / 2,      error <= (t2 - t1) / 2,      o(t) = a + b t

A clock drifts: that of a simulator by a per cent, which is tens of milliseconds in a few seconds. So `a` and `b` are
fitted to the answers of the last seconds, each with a weight by how much longer than the shortest its round trip
was (Mills, RFC 5905, "clock filter", which takes the shortest alone, has the offset of when that was). Without answers,
the message that came soonest after its stamp bounds the offset from one side.
"""

from __future__ import annotations

from collections import deque
from typing import final

LONGEST = 1.0  # round trip from which on an answer is not used [s]
JUMP = 0.5  # disagreement with the messages' own stamps from which on the clock has jumped [s]
PERIOD = 0.1  # time between questions [s]
WINDOW = 4.0  # time over which answers are accepted [s]
SLACK, ODD = 0.02, 3
"""Disagreement of an answer with the line, beyond its own error [s], and how many of them in a row set a clock anew."""
SPREAD = 1e-3  # round trips that are this much longer than the shortest have a quarter of its weight [s]
FEWEST, SHORTEST = 8, 0.5  # answers, and time that they span [s], from which a drift is fitted
STEEPEST = 0.1  # largest drift that is accepted


@final
class TimeSync:
    """Offset between two clocks."""

    def __init__(self) -> None:
        self._answers: deque[tuple[float, float, float]] = deque()
        self._soonest: deque[float] = deque(maxlen=50)
        self._line, self._odd = (0.0, 0.0), 0
        self.round_trip: float | None = None  # shortest of the answers that are used [s]; None without any
        self.late: float | None = None
        """Round trip of an answer that came too late to be used [s]; None where the newest did not."""
        self.drift = 0.0  # seconds that their clock gains in one of ours

    def reset(self) -> None:
        """Forget all: the autopilot restarted, or its clock was set."""
        self._answers.clear()
        self._soonest.clear()
        self.round_trip, self.drift = None, 0.0

    def answered(self, theirs: float, sent: float, received: float) -> None:
        """Take an answer to a TIMESYNC of ours; all times in s."""
        trip = received - sent
        self.late = trip if trip >= LONGEST else None
        if not 0.0 <= trip < LONGEST:
            return
        middle = 0.5 * (sent + received)
        strange = bool(self._answers) and abs(theirs - middle - self.offset(middle)) > 0.5 * trip + SLACK
        self._odd = self._odd + 1 if strange else 0
        self._answers.append((middle, theirs - middle, trip))
        if self._odd >= ODD:  # the clock was set
            self._answers = deque(list(self._answers)[-ODD:])
            self._odd = 0
        while self._answers[0][0] < middle - WINDOW:
            self._answers.popleft()
        self._fit()

    def _fit(self) -> None:
        shortest = min(trip for _, _, trip in self._answers)
        weights = [(1.0 + (trip - shortest) / SPREAD) ** -2 for _, _, trip in self._answers]
        total = sum(weights)
        rows = list(zip(weights, self._answers, strict=True))
        t = sum(w * a[0] for w, a in rows) / total
        offset = sum(w * a[1] for w, a in rows) / total
        self.drift = 0.0
        if len(rows) >= FEWEST and self._answers[-1][0] - self._answers[0][0] >= SHORTEST:
            spread = sum(w * (a[0] - t) ** 2 for w, a in rows)
            slope = sum(w * (a[0] - t) * (a[1] - offset) for w, a in rows) / spread
            self.drift = slope if abs(slope) <= STEEPEST else 0.0
        self._line, self.round_trip = (t, offset), shortest

    def arrived(self, stamp: float, received: float) -> None:
        """Take a stamped message."""
        self._soonest.append(stamp - received)
        # a stamp from the future, or one that is late by far: the answers are of another clock
        offset = self.offset(received)
        if self._answers and abs(stamp - received - offset) > JUMP and len(self._soonest) >= 10:
            recent = list(self._soonest)[-10:]
            if max(recent) - min(recent) < 0.1 and abs(recent[-1] - offset) > JUMP:
                self.reset()
                self._soonest.extend(recent)

    def offset(self, time: float) -> float:
        """Their clock minus ours at a time of ours [s]; 0 while nothing is known."""
        if self._answers:
            return self._line[1] + self.drift * (time - self._line[0])
        return max(self._soonest) if self._soonest else 0.0

    def ours(self, stamp: float) -> float:
        """A time of theirs on our clock [s]."""
        if not self._answers:
            return stamp - self.offset(0.0)
        t, offset = self._line
        return t + (stamp - offset - t) / (1.0 + self.drift)
