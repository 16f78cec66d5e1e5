"""What the sensors of a simulated vehicle get wrong.

Without `--hil` no estimator runs, so that the stand-in's own estimate bears an error as noisy sensors leave it,

    v_error' = -v_error / T + white noise,    p_error' = v_error - p_error / T,    std p_error = std v_error T / sqrt(2)
"""

from __future__ import annotations

from dataclasses import dataclass

from nsde_torch.errors import ConfigError
from nsde_torch.options import check, documented, key
from nsde_torch.px4.link.vectors import Vec


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


# --- the clock; here, so that listing the keys of a command imports no vehicle --------------------------------------

CLOCK = 0.993  # seconds of its clock in one of ours: PX4's own simulator was seen to run 0.6 to 0.8 % slow
