"""What a simulated machine of a system is made of beside its equations: true values, noise, and how it is excited."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

from nsde_torch.effects.base import Port
from nsde_torch.errors import ConfigError
from nsde_torch.systems.values import Values

Limits = tuple[float, float] | Sequence[tuple[float, float]]
"""Lowest and highest command [its unit]: of all inputs, or of each."""


def ends_of(limits: Limits, inputs: Sequence[str]) -> tuple[Any, Any]:
    """Lowest and highest command: a number for all inputs, or a tuple with one for each of those named so."""
    pairs = cast("Sequence[Any]", limits)
    if not any(isinstance(pair, Sequence) for pair in pairs) and len(pairs) == 2:
        return pairs[0], pairs[1]
    if len(pairs) != len(inputs) or not all(isinstance(pair, Sequence) and len(pair) == 2 for pair in pairs):
        raise ConfigError(
            f"`limits` of a machine take a lowest and a highest command for all inputs, or such a pair for each of "
            f"{len(inputs)} ({', '.join(inputs)}); got {limits!r}."
        )
    low, high = zip(*pairs, strict=True)
    return low, high


@dataclass(frozen=True)
class Gust:
    """What pushes one port; one number for every axis, or one for each."""

    std: tuple[float, ...] = (0.0,)  # standard deviation of the coloured part [unit of the port]
    time_constant: float = 1.0  # its correlation time [s], > 0
    white: tuple[float, ...] = (0.0,)  # intensity of the white part [unit of the port times root second]


@dataclass(frozen=True)
class Excitation:
    """Runs that show what a machine does: first states drawn at random, inputs that vary about a mean.

    u_i(t) = mean_i + sum_k A_i sin(2 pi f_k t + phi_k),    f_k log-uniform between two frequencies
    """

    size: tuple[float, ...]  # standard deviation of each input about its mean [its unit]
    mean: tuple[float, ...] = ()  # mean of each input [its unit]; empty: 0
    hertz: tuple[float, float] = (0.05, 1.5)  # lowest and highest frequency [Hz]
    start: tuple[tuple[float, float], ...] = ()
    """Lowest and highest first value of each state [its unit]; empty: 0."""
    durations: tuple[float, ...] = (20.0,) * 6  # length of each run [s]


@dataclass(frozen=True)
class Machine:
    """What a plant of one system is made of."""

    values: Values  # parameters of the declared physics, `name` or `effect.name`
    dt: float  # sample [s]
    step: float  # fine step of the integration [s]
    sensor_std: tuple[float, ...]  # measurement noise, one number per error channel of the system [its unit]
    effects: Mapping[str, Values] = field(default_factory=dict)
    """Effects that the machine has beyond the declared physics, with their parameters."""
    gusts: Mapping[Port, Gust] = field(default_factory=dict)  # what pushes the ports; empty: no process noise
    limits: Limits | None = None  # lowest and highest command, one pair or one for each input, or None
    latency: float = 0.0  # time from a command to its effect [s]
    excitation: Excitation | None = None  # how runs of it are made, where it has no recording of its own
    recording: Callable[..., Any] | None = None
    """Makes runs another way: a function as `nsde_torch.simulation.excited_runs` is."""
