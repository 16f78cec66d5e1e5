"""Hostile bytes: random ones, frames with flipped bits, frames cut short, true frames of other senders, and floods."""

import random
from collections.abc import Iterator

from nsde_torch.px4.link.codec import Codec
from nsde_torch.px4.link.dialect import mavlink

NOTHING = [float("nan")] * 21


def frames(codec: Codec, rng: random.Random, stamp: float) -> list[bytes]:
    """True frames with absurd contents."""

    def wild() -> float:
        return rng.choice((float("nan"), float("inf"), -1e30, rng.uniform(-1e3, 1e3)))

    us = int(max(stamp, 0.0) * 1e6)
    q = [rng.uniform(-1.0, 1.0) for _ in range(4)]
    made = (
        mavlink.MAVLink_odometry_message(
            us, 1, 1, wild(), wild(), wild(), q, *(wild() for _ in range(6)), NOTHING, NOTHING
        ),
        mavlink.MAVLink_heartbeat_message(
            rng.randrange(30), 12, rng.randrange(256), rng.randrange(2**32), 4, 3
        ),
        mavlink.MAVLink_statustext_message(rng.randrange(8), rng.randbytes(40)),
        mavlink.MAVLink_timesync_message(rng.randrange(2**62), rng.randrange(2**62)),
    )
    return [codec.pack(m) for m in made]


def hostile(seed: int, *, system: int = 7) -> Iterator[bytes]:
    """Datagrams without end; true frames bear the id of another system than the vehicle's."""
    rng, codec = random.Random(seed), Codec(system, 1)
    while True:
        for frame in frames(codec, rng, rng.uniform(0.0, 1e4)):
            kind = rng.randrange(5)
            if kind == 0:
                yield rng.randbytes(rng.randrange(1, 400))
            elif kind == 1:  # one bit, anywhere
                at = rng.randrange(len(frame))
                yield frame[:at] + bytes((frame[at] ^ 1 << rng.randrange(8),)) + frame[at + 1 :]
            elif kind == 2:
                yield frame[: rng.randrange(1, len(frame))]
            elif kind == 3:  # marks of frames without end
                yield bytes((rng.choice((0xFD, 0xFE)),)) * rng.randrange(1, 300)
            else:
                yield frame
