"""Settings of a flight on PX4, and of a simulated vehicle; light to import, so that keys can be listed."""

from __future__ import annotations

from dataclasses import dataclass
from math import radians

from nsde_torch.errors import ConfigError
from nsde_torch.options import Checked, check, documented, key
from nsde_torch.px4.link.vectors import Vec


@documented
@dataclass(frozen=True)
class FlightOptions(Checked):
    """How a flight goes."""

    height: float = key(1.5, "height of take-off", unit="m", above=0)
    climb_past: float = key(
        1.8,
        "height that is climbed past before the reference, below the fence's top: PX4 resets its heading at 1.5 m",
        unit="m",
        low=0,
    )
    climb: float = key(0.8, "speed of take-off", unit="m/s", above=0, high=3)
    hold: float = key(2.0, "time of hovering before the reference", unit="s", low=0)
    approach: float = key(1.0, "speed at which the start of the reference is flown to", unit="m/s", above=0)
    come_back: bool = key(False, "after the reference fly back, and land at the place of take-off")
    only_check: bool = key(
        False, "say what is not fit to fly, with the lines that mend it, and do nothing else"
    )
    takeover: bool = key(
        False,
        "fly a vehicle that is in the air in HOLD already, about the place where PX4 says that it took off",
    )
    safe_hold: float = key(2.0, "time of hovering before landing when something is wrong", unit="s", low=0)
    connect: float = key(10.0, "longest wait for the vehicle", unit="s", low=0)
    checks: float = key(10.0, "longest wait for the checks to pass", unit="s", low=0)
    confirm: float = key(
        5.0, "longest wait for a step to be confirmed; PX4's heartbeats come once a second", unit="s", low=0
    )
    idle: float = key(1.0, "time of streaming before OFFBOARD", unit="s", low=0)
    spool: float = key(0.7, "time in which the throttle rises before the climb", unit="s", low=0)
    lift: float = key(6.0, "longest time from arming to being in the air", unit="s", low=0)
    landing: float = key(40.0, "longest wait for a landing", unit="s", low=0)
    dead: float = key(
        10.0, "silence after which the link is called dead, and no longer waited on", unit="s", low=1
    )
    watch: float = key(40.0, "how long a vehicle that is not ours any more is watched", unit="s", low=0)


@documented
@dataclass(frozen=True)
class Limits:
    """When something is wrong."""

    fence: tuple[tuple[float, float], tuple[float, float], tuple[float, float]] = key(
        ((-6.0, 6.0), (-6.0, 6.0), (-0.5, 6.0)),
        "lowest and highest x, y, z from the place of take-off",
        unit="m",
    )
    speed: float = key(7.0, "largest speed", unit="m/s", above=0)
    tilt: float = key(65.0, "largest tilt", unit="deg", above=0, high=89)
    battery: float = key(0.15, "lowest charge, as a share", low=0, high=1)
    voltage: float = key(0.0, "lowest voltage of the battery; 0: none", unit="V", low=0)
    estimate: float = key(0.2, "oldest state", unit="s", above=0, high=1)
    silence: float = key(1.0, "longest time without any message", unit="s", above=0, high=5)
    heartbeat: float = key(3.5, "longest time without a heartbeat", unit="s", above=0)
    solver: float = key(0.3, "oldest plan", unit="s", above=0, high=2)
    without_plans: float = key(
        3.0,
        "how long, in all, the built-in cascade flies the reference while the newest plan is older than limits.solver",
        unit="s",
        low=0,
    )
    tracking_error: float = key(
        0.6,
        "largest distance from the reference that may last for tracking_time; beyond, the controller or its model does "
        "not suit the machine",
        unit="m",
        above=0,
    )
    tracking_time: float = key(
        0.5, "how long a larger distance from the reference than tracking_error may last", unit="s", low=0
    )
    tipped_plans: int = key(
        3, "most plans within 5 s that tilt beyond limits.tilt, and are made anew instead of flown", low=0
    )
    innovation: float = key(
        1.0,
        "largest innovation ratio of the vehicle's estimator (ESTIMATOR_STATUS: velocity, position, height) that may "
        "last for innovation_time; above 1 it rejects what its sensors measure",
        above=0,
    )
    innovation_time: float = key(
        1.0, "how long a larger innovation ratio than innovation may last", unit="s", low=0
    )
    accuracy: float = key(
        1.5,
        "largest standard deviation of the estimated position, horizontal or vertical (ESTIMATOR_STATUS)",
        unit="m",
        above=0,
    )
    jump: float = key(
        0.5, "largest step of the position that its velocity does not explain", unit="m", above=0
    )
    velocity_jump: float = key(
        1.0, "largest step of the velocity that no thrust explains", unit="m/s", above=0
    )
    patience: float = key(0.08, "how long a state must be wrong", unit="s", low=0)

    def outside(self, p: Vec, home: Vec) -> bool:
        """Whether a position [m] is outside the fence about a place of take-off [m]."""
        return any(not low <= c - h <= high for c, h, (low, high) in zip(p, home, self.fence, strict=True))


@documented
@dataclass(frozen=True)
class SetpointLimits:
    """Bounds of the commands that are sent."""

    rate: float = key(6.0, "largest roll and pitch rate that is sent", unit="rad/s", above=0)
    yaw_rate: float = key(2.5, "largest yaw rate that is sent", unit="rad/s", above=0)
    throttle: tuple[float, float] = key(
        (0.05, 0.9), "lowest and highest throttle that is sent in flight", low=0, high=1
    )
    tilt: float = key(radians(60.0), "tilt beyond which rates may only level", unit="rad", above=0)


# What the sensors of a simulated vehicle get wrong. Without `--hil` no estimator runs, so that the stand-in's own
# estimate bears an error as noisy sensors leave it,
#
#     v_error' = -v_error / T + white noise,    p_error' = v_error - p_error / T
#     std p_error = std v_error T / sqrt(2)


@documented
@dataclass(frozen=True)
class SensorErrors:
    """Errors of the sensors; three numbers are along forward, right, down of the body, or north, east, down."""

    accelerometer: Vec = key((0.03, 0.03, 0.03), "noise of a sample, 250 in a second", unit="m/s2", low=0)
    accelerometer_bias: Vec = key((0.0, 0.0, 0.0), "constant error of the accelerometer", unit="m/s2")
    gyroscope: Vec = key((0.003, 0.003, 0.003), "noise of a sample, 250 in a second", unit="rad/s", low=0)
    gyroscope_bias: Vec = key((0.0, 0.0, 0.0), "constant error of the gyroscope", unit="rad/s")
    magnetometer: Vec = key(
        (0.0015, 0.0015, 0.0015), "noise of a sample, 62 in a second", unit="gauss", low=0
    )
    barometer: float = key(0.01, "noise of a sample, 50 in a second; 0.12 hPa are a metre", unit="hPa", low=0)
    gps: Vec = key((0.05, 0.05, 0.1), "noise of a position fix, 10 in a second", unit="m", low=0)
    gps_velocity: Vec = key((0.03, 0.03, 0.03), "noise of a velocity fix", unit="m/s", low=0)
    gps_delay: float = key(
        0.01,
        "age of a fix when it is sent; PX4 takes it for SENS_GPS0_DELAY (EKF2_GPS_DELAY), 10 ms in its simulation",
        unit="s",
        low=0,
        high=1,
    )
    estimate: Vec = key(
        (0.0, 0.0, 0.0),
        "slow error of the estimated position without --hil, where no estimator runs: standard deviation",
        unit="m",
        low=0,
    )
    estimate_time: float = key(3.0, "time constant of that error", unit="s", above=0)

    def __post_init__(self) -> None:
        check(type(self), vars(self))
        for name, value in vars(self).items():
            if isinstance(value, (list, tuple)) and len(value) != 3:
                raise ConfigError(f"`sensors.{name}` takes three numbers; got {value}.")


CLOCK = 0.993  # seconds of its clock in one of ours: PX4's own simulator was seen to run 0.6 to 0.8 % slow
