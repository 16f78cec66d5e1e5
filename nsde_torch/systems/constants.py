"""What a class of systems says of itself beside its equations: constants, reported errors, ports that learn."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Defaults:
    """Constants of the supplement for one system.

    Args:
        dt: Step of the model [s].
        horizon: Steps of a training window.
        sigma_max: Largest diffusion, one per state [unit of the state per root second].
        ball_radius: Radius r of the ball of the convexity loss [standard deviations of the features].
        lambda_mu: Weight of the reward on strong convexity.
        step: Name of the integrator.
    """

    dt: float
    horizon: int
    sigma_max: tuple[float, ...]
    ball_radius: float
    lambda_mu: float
    step: str


@dataclass(frozen=True)
class ErrorGroup:
    """Error channels that share a unit and are reported as one norm.

    Args:
        name: For example "position".
        channels: Indices into the error channels.
        unit: Unit of the report.
        factor: From the channel's unit to that of the report (180/pi for degrees).
    """

    name: str
    channels: tuple[int, ...]
    unit: str
    factor: float = 1.0


@dataclass(frozen=True)
class ResidualPort:
    """A port that gets a learned residual network.

    Args:
        width: Outputs.
        scale: Size of a typical residual in the unit of the port.
        unit: Unit of the port.
    """

    width: int
    scale: float
    unit: str
