"""Which motor is which: how firmwares number the motors of an X frame, against PX4's numbers.

Sources: PX4 airframe reference (quad-x, hexa-x), ArduPilot's motor diagrams (the same numbers for these two frames),
Betaflight's mixer tables (QUAD X, HEX X), Crazyflie's diagram (M1 front right, then clockwise).
"""

from __future__ import annotations

from nsde_torch.errors import ConfigError

NUMBERINGS: dict[str, dict[int, tuple[int, ...]]] = {
    "px4": {4: (1, 2, 3, 4), 6: (1, 2, 3, 4, 5, 6)},
    "ardupilot": {4: (1, 2, 3, 4), 6: (1, 2, 3, 4, 5, 6)},
    # 1 rear right, 2 front right, 3 rear left, 4 front left, 5 right, 6 left
    "betaflight": {4: (2, 3, 4, 1), 6: (5, 6, 4, 1, 2, 3)},
    # 1 front right, 2 rear right, 3 rear left, 4 front left
    "crazyflie": {4: (1, 3, 4, 2)},
}
"""Numbers of a firmware's motors in the order of PX4's: quadrotors front right, rear left, front left, rear right;
hexacopters right, left, front left, rear right, front right, rear left."""


def order(numbering: str, motors: int) -> tuple[int, ...]:
    """Places, from 0, of a firmware's motors in the order of PX4's.

    Raises:
        ConfigError: an unknown numbering, or one without a frame of so many motors.
    """
    if numbering not in NUMBERINGS:
        raise ConfigError(f"`numbering` must be one of {', '.join(NUMBERINGS)}; got {numbering!r}.")
    frames = NUMBERINGS[numbering]
    if motors not in frames:
        raise ConfigError(
            f"the numbering {numbering!r} is known of {' and '.join(map(str, frames))} motors; got {motors}. List the "
            "motors in the order of PX4's, and leave `numbering` out."
        )
    return tuple(number - 1 for number in frames[motors])
