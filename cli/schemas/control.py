"""Keys of the groups `plant` of a flight, `mpc` and `link`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from nsde_torch.control.options import EstimatorOptions, ProblemOptions, SafetyOptions, SolverOptions
from nsde_torch.px4.flight.options import Limits, SetpointLimits

from ..keys import key, mirrors, of


@mirrors(Limits, without=("heartbeat", "patience"))
class LimitsConfig:
    """When something is wrong in flight; what is done about it is in the documentation of nsde fly."""

    fence: Any = of(Limits, "fence")
    rate: float = of(SetpointLimits, "rate")
    yaw_rate: float = of(SetpointLimits, "yaw_rate")
    throttle: list[float] = of(SetpointLimits, "throttle")


@dataclass
class FlownPlantConfig:
    """The machine that is flown."""

    kind: str = key("simulated", "set by plant=", choices=("simulated", "learned"))
    system: str | None = key(None, "name of a system that has a plant; null: that of the model")
    run: str | None = key(
        None, "run directory of the model that is flown with plant=learned; null: that of run=", file=True
    )
    effects: Any = key(
        [],
        "effects that the model does not declare, beside the machine's own: as in nsde simulate",
        file=True,
    )
    declared_only: bool = key(False, "leave out the undeclared effects that the machine has anyway")
    process_noise: float = key(1.0, "strength of the gusts, relative to the machine's own", low=0)
    sensor_noise: float = key(1.0, "strength of the measurement noise, relative to the machine's own", low=0)
    latency: float = key(0.02, "time from a command to its effect, beside the motors' lag", unit="s", low=0)
    state_latency: float = key(0.0, "age of a state when the controller gets it", unit="s", low=0)
    dt: float | None = key(None, "sample of the plant; null: the machine's", unit="s", above=0)


_WEIGHTS = "Q of each error channel; null: the supplement's, and 10 for positions, 0.1 for velocities"


@dataclass
class MpcConfig:
    """The controller. Where null says two values, the first is a multirotor's."""

    solver: str = of(SolverOptions, "name")
    iterations: int = of(SolverOptions, "iterations")
    tolerance: float = of(SolverOptions, "tolerance")
    deadline: float | None = of(SolverOptions, "deadline")
    compile: str = of(SolverOptions, "compile")
    cache: str | None = of(SolverOptions, "cache")
    horizon: float = of(ProblemOptions, "horizon")
    steps: int = of(ProblemOptions, "steps")
    period: float = key(0.02, "time between plans, a multiple of the plant's sample", unit="s", above=0)
    state_weights: list[float] | None = of(ProblemOptions, "state_weights", default=None, help=_WEIGHTS)
    input_weight: Any = of(
        ProblemOptions,
        "input_weight",
        default=None,
        help="R, of every input, or [1,2] with a number for each; null: 1, and 0.1 at its end",
    )
    input_centre: Any = of(
        ProblemOptions,
        "input_centre",
        default=None,
        help="input that R measures from, or a number for each; null: 0, and the middle",
    )
    low: Any = of(
        ProblemOptions,
        "low",
        default=None,
        help="lowest input, or [-50,-20] with a number for each; null: 0, and what the machine says",
    )
    high: Any = of(
        ProblemOptions,
        "high",
        default=None,
        help="highest input, or a number for each; null: 1, and what the machine says",
    )
    rate_weight: float = of(ProblemOptions, "rate_weight")
    speed_limit: float | None = of(ProblemOptions, "speed_limit", default=None)
    tilt_limit: float | None = of(ProblemOptions, "tilt_limit", default=None)
    fence: Any = of(ProblemOptions, "fence")
    limit_weight: float = of(ProblemOptions, "limit_weight")
    uncertainty_weight: float = of(ProblemOptions, "uncertainty_weight")
    particles: int = of(ProblemOptions, "particles")
    motor_latency: float | None = key(
        None,
        "time that motors add to the latency that is made up for; too little of it makes fast flights oscillate; "
        "null: 0.02, or 0 for a model that has the lag of its motors",
        unit="s",
        low=0,
    )
    force_time: float = of(EstimatorOptions, "force_time")
    moment_time: float = of(EstimatorOptions, "moment_time")
    keep: float = of(SafetyOptions, "keep")
    jump: float = of(SafetyOptions, "jump")


@dataclass
class LinkConfig:
    """How the vehicle is reached."""

    url: str = key(
        "udpin:127.0.0.1:14540",
        "udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT, tcpin:HOST:PORT or serial:DEVICE:BAUD",
    )
    expose: bool = key(
        False, "listen on an interface that other machines reach; without a key anyone may fly"
    )
    key_file: str | None = key(
        None,
        "file with the signing key (64 hexadecimal digits, or a passphrase); null: no signing",
        file=True,
    )
    system: int | None = key(
        None,
        "MAVLink system id of the vehicle; null: the first that is heard (nsde vehicle: 1)",
        low=1,
        high=250,
    )
