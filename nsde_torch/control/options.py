"""Settings of model predictive control: what a plan pays for, how it is found, and which states are accepted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from typing import Any

from nsde_torch.errors import ConfigError
from nsde_torch.options import Checked, check, documented, key

STATE_WEIGHTS = (100.0, 100.0, 200.0, 5.0, 5.0, 10.0, 1.0, 1.0, 100.0, 1.0, 1.0, 1.0)  # the supplement's Q
PerInput = float | Sequence[float]
"""A number for all inputs, or one for each; options hold sequences as tuples."""


@documented
@dataclass(frozen=True)
class ProblemOptions:
    """What a plan pays for.

    Soft limits are weighed per m2/s2, per square of the cosine's excess in tilt, and per m2. More than one particle is
    sampled with the model's diffusion, the same noise in every solve.
    """

    horizon: float = key(1.0, "length of a plan", unit="s", above=0)
    steps: int = key(20, "steps of a plan", low=1)
    state_weights: tuple[float, ...] = key(
        STATE_WEIGHTS, "Q of each error channel: position, velocity, attitude, rates of a multirotor", low=0
    )
    input_weight: PerInput = key(1.0, "R, of every input, or a number for each", low=0)
    input_centre: PerInput = key(0.0, "input that R measures from, or a number for each")
    rate_weight: float = key(0.0, "weight of changes of the inputs from step to step", low=0)
    low: PerInput = key(0.0, "lowest input, or a number for each")
    high: PerInput = key(1.0, "highest input, or a number for each")
    speed_limit: float = key(inf, "speed beyond which a plan pays; null: none", unit="m/s", above=0)
    tilt_limit: float = key(inf, "tilt beyond which a plan pays; null: none", unit="deg", above=0, high=89)
    fence: tuple[tuple[float, float], ...] | None = key(
        None, "lowest and highest of each position, as p_x, p_y, p_z in [[-5,5],[-5,5],[0,4]]; null: none"
    )
    limit_weight: float = key(100.0, "weight of these soft limits", low=0)
    uncertainty_weight: float = key(0.0, "weight of the model's distance from its data", low=0)
    particles: int = key(1, "paths of a plan: 1 is the mean path, more are sampled", low=1)
    seed: int = key(0, "seed of their noise", low=0)

    def __post_init__(self) -> None:
        check(type(self), vars(self))
        for name in ("input_weight", "input_centre", "low", "high"):
            object.__setattr__(self, name, _numbers(name, getattr(self, name)))
        n = max(len(_each(end, 1)) for end in (self.low, self.high))
        if not all(a < b for a, b in zip(_each(self.low, n), _each(self.high, n), strict=False)):
            raise ConfigError(f"`low` must lie below `high`; got {self.low!r} and {self.high!r}.")
        if min(_each(self.input_weight, 1)) + self.rate_weight <= 0:
            raise ConfigError(
                "`input_weight` or `rate_weight` must be above 0: the best plan is not one else."
            )

    @property
    def dt(self) -> float:
        """Step of the plan [s]."""
        return self.horizon / self.steps

    def of_inputs(self, name: str, inputs: Sequence[str]) -> tuple[float, ...]:
        """`low`, `high`, `input_weight` or `input_centre` of each of the inputs named so.

        ConfigError: there are numbers for more or fewer inputs.
        """
        values = _each(getattr(self, name), len(inputs))
        if len(values) != len(inputs):
            raise ConfigError(
                f"`{name}` takes a number for all inputs or {len(inputs)} ({', '.join(inputs)}); got {len(values)}."
            )
        return values


def _each(value: PerInput, n: int) -> tuple[float, ...]:
    """A number n times; several as they are."""
    return tuple(value) if isinstance(value, Sequence) else (value,) * n


def _numbers(name: str, given: object) -> float | tuple[float, ...]:
    """A number, or a tuple of them; ConfigError for anything else."""
    values: tuple[Any, ...] = tuple(given) if isinstance(given, (list, tuple)) else (given,)
    if not values or not all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in values):
        raise ConfigError(f"`{name}` takes a number, or one for each input as in [1,2]; got {given!r}.")
    return tuple(map(float, values)) if isinstance(given, (list, tuple)) else float(values[0])


@documented
@dataclass(frozen=True)
class SolverOptions(Checked):
    """How plans are found."""

    name: str = key("gauss_newton", "how plans are found", choices=("gauss_newton", "apg"))
    iterations: int = key(10, "most iterations of a solve", low=1)
    tolerance: float = key(
        0.005, "a plan is good enough when this share of its cost, or less, is left", low=0
    )
    compile: str = key(
        "auto",
        "machine code of the solver, made once for a model and its settings by a C compiler, in some seconds (auto: "
        "where one machine is flown at a time)",
        choices=("auto", "on", "off"),
    )
    deadline: float | None = key(
        None, "time for a solve; then the best plan so far is taken; null: none", unit="s", above=0
    )
    cache: str | None = key(
        None, "folder that keeps it; null: NSDE_CACHE or the user's cache folder", file=True
    )


@documented
@dataclass(frozen=True)
class SafetyOptions(Checked):
    """When a controller rejects a state or a plan, and for how long it flies on."""

    jump: float = key(0.75, "step of the measured position that is not accepted at once", unit="m", above=0)
    jump_attitude: float = key(0.8, "the same for the attitude", unit="rad", above=0)
    jump_samples: int = key(3, "samples after which a new state is accepted", low=1)
    keep: float = key(
        0.5, "how long the last safe plan is flown when there is trouble; then hover", unit="s", low=0
    )
    quaternion: float = key(0.05, "largest departure of a quaternion's norm from 1", above=0)


@documented
@dataclass(frozen=True)
class EstimatorOptions(Checked):
    """What is known of times, and how fast pushes are learned in flight."""

    latency: float = key(
        0.0,
        "time from a measurement to the effect of the command that follows from it; made up for",
        unit="s",
        low=0,
    )
    force_time: float = key(
        0.5, "time constant of the push that is learned in flight, on the force; 0: none", unit="s", low=0
    )
    moment_time: float = key(0.0, "the same on the moment", unit="s", low=0)
    force_limit: float = key(4.0, "largest push on the force", unit="m/s2", above=0)
    moment_limit: float = key(20.0, "largest push on the moment", unit="rad/s2", above=0)


@documented
@dataclass(frozen=True)
class CircleOptions(Checked):
    """A circle at constant speed, while the heading turns and comes back."""

    speed: float = key(3.6, "speed after the start", unit="m/s", above=0)
    duration: float = key(35.0, "length from rest to rest", unit="s", above=0)
    radius: float = key(2.2, "radius", unit="m", above=0)
    height: float = key(1.5, "height", unit="m")
    yaw: float = key(120.0, "farthest heading", unit="deg")
    ramp: float = key(6.0, "time to reach the speed, and to lose it", unit="s", above=0)


@documented
@dataclass(frozen=True)
class LemniscateOptions(Checked):
    """A figure of eight (Gerono's lemniscate), while the heading oscillates."""

    speed: float = key(3.4, "largest speed, where the branches cross", unit="m/s", above=0)
    duration: float = key(40.0, "length from rest to rest", unit="s", above=0)
    length: float = key(1.9, "half of its extent along x", unit="m", above=0)
    width: float = key(1.75, "its extent along y", unit="m", above=0)
    height: float = key(1.5, "height", unit="m")
    yaw: float = key(13.0, "farthest heading", unit="deg")
    ramp: float = key(6.0, "time to reach the speed, and to lose it", unit="s", above=0)


@documented
@dataclass(frozen=True)
class HoverOptions(Checked):
    """Standing still."""

    duration: float = key(10.0, "how long", unit="s", above=0)
    height: float = key(1.5, "height", unit="m")
    yaw: float = key(0.0, "heading", unit="deg")


@documented
@dataclass(frozen=True)
class SetpointOptions(Checked):
    """A state to reach and to hold, of any machine."""

    duration: float = key(10.0, "how long", unit="s", above=0)


@documented
@dataclass(frozen=True)
class WaypointOptions(Checked):
    """How a path through points is flown where times are not given."""

    speed: float = key(2.0, "largest speed, where times are not given", unit="m/s", above=0)
    tilt: float = key(30.0, "largest tilt, where times are not given", unit="deg", above=0, high=79)
