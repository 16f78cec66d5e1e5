"""What a simulated machine of a system is made of beside its equations: true values, noise, and how it is excited."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from nsde_torch.effects.base import Port


@dataclass(frozen=True)
class Gust:
    """What pushes one port; one number for every axis, or one for each.

    Args:
        std: Standard deviation of the coloured part [unit of the port].
        time_constant: Its correlation time [s], > 0.
        white: Intensity of the white part [unit of the port times root second].
    """

    std: tuple[float, ...] = (0.0,)
    time_constant: float = 1.0
    white: tuple[float, ...] = (0.0,)


@dataclass(frozen=True)
class Excitation:
    """Runs that show what a machine does: first states drawn at random, inputs that vary about a mean.

        u_i(t) = mean_i + sum_k A_i sin(2 pi f_k t + phi_k),    f_k log-uniform between two frequencies

    Args:
        size: Standard deviation of each input about its mean [its unit].
        mean: Mean of each input [its unit]; empty: 0.
        hertz: Lowest and highest frequency [Hz].
        start: Lowest and highest first value of each state [its unit]; empty: 0.
        durations: Length of each run [s].
    """

    size: tuple[float, ...]
    mean: tuple[float, ...] = ()
    hertz: tuple[float, float] = (0.05, 1.5)
    start: tuple[tuple[float, float], ...] = ()
    durations: tuple[float, ...] = (20.0,) * 6


@dataclass(frozen=True)
class Machine:
    """What a plant of one system is made of.

    Args:
        values: Parameters of the declared physics, `name` or `effect.name`.
        dt: Sample [s].
        step: Fine step of the integration [s].
        sensor_std: Measurement noise, one number per error channel of the system [its unit].
        effects: Effects that the machine has beyond the declared physics, with their parameters.
        gusts: What pushes the ports; empty: no process noise.
        limits: Lowest and highest command, or None.
        latency: Time from a command to its effect [s].
        excitation: How runs of it are made, where it has no recording of its own.
        recording: Makes runs another way: a function as `nsde_torch.simulation.excited_runs` is.
    """

    values: Mapping[str, float | list[float]]
    dt: float
    step: float
    sensor_std: tuple[float, ...]
    effects: Mapping[str, Mapping[str, float | list[float]]] = field(default_factory=dict)
    gusts: Mapping[Port, Gust] = field(default_factory=dict)
    limits: tuple[float, float] | None = None
    latency: float = 0.0
    excitation: Excitation | None = None
    recording: Callable[..., Any] | None = None
