"""Effects: physical terms that act on a system through a port. Declared physics is a sum of them.

An effect returns what it adds at its port: mass-normalised force [m/s2], inertia-normalised torque [rad/s2],
or, on the port `input`, a change of the input. An effect with memory (a lag) carries `n_memory` states m with
dm/dt = memory_rate(t, x, u, m).
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import ClassVar

import torch
from torch import Tensor, nn

from nsde_torch.errors import ConfigError


class Port(str, Enum):
    """Where a term enters a system."""

    FORCE = "force"
    TORQUE = "torque"
    WORLD_FORCE = "world_force"
    BODY_FORCE = "body_force"
    BODY_MOMENT = "body_moment"
    MOTOR_THRUST = "motor_thrust"
    INPUT = "input"


@dataclass(frozen=True)
class Parameter:
    """A physical parameter with bounds; the optimiser sees an unbounded number.

    Args:
        initial: First value, one number or one per axis, strictly inside the bounds.
        unit: Unit of the value.
        low: Lower bound, or None.
        high: Upper bound, or None.
        scale: Size of a typical change; sets the speed of learning (default: |initial|, at least 0.1).
        help: What it is, one line.
    """

    initial: float | tuple[float, ...]
    unit: str
    low: float | None = None
    high: float | None = None
    scale: float | None = None
    help: str = ""


class Parametrised(nn.Module):
    """A module with declared physical parameters, kept inside their bounds by construction.

    Bounded below: value = low + softplus; on both sides: a logistic; free: value = raw * scale.
    `self.value(name)` is differentiable.
    """

    PARAMETERS: ClassVar[Mapping[str, Parameter]] = {}

    def __init__(self, values: Mapping[str, float | list[float]] | None = None) -> None:
        super().__init__()
        self._specs = dict(self.PARAMETERS)
        self._scales = {name: _scale(spec) for name, spec in self._specs.items()}
        self.raw = nn.ParameterDict()
        for name, spec in self._specs.items():
            initial = torch.as_tensor(spec.initial, dtype=torch.float64).reshape(-1)
            self.raw[name] = nn.Parameter(torch.zeros(len(initial)))
            self.set_value(name, initial)
        for name, value in (values or {}).items():
            self.set_value(name, torch.as_tensor(value, dtype=torch.float64).reshape(-1))

    def value(self, name: str) -> Tensor:
        """Value of a declared parameter, (k,), in its unit."""
        spec, raw = self._specs[name], self.raw[name]
        if spec.low is not None and spec.high is not None:
            return spec.low + (spec.high - spec.low) * torch.sigmoid(raw)
        scale = self._scales[name]
        if spec.low is not None:
            return spec.low + scale * nn.functional.softplus(raw)
        if spec.high is not None:
            return spec.high - scale * nn.functional.softplus(raw)
        return raw * scale

    def parameter(self, name: str) -> Parameter:
        """What is declared of a parameter: bounds, unit, help."""
        return self._specs[name]

    def scale_of(self, name: str) -> float:
        """Size of a typical change of a parameter, in its unit."""
        return self._scales[name]

    def set_value(self, name: str, value: Tensor) -> None:
        """Set a declared parameter to a value (k,) in its unit, or one number for all axes.

        Raises:
            ConfigError: unknown name, wrong length, or out of bounds.
        """
        if name not in self._specs:
            known = ", ".join(self._specs) or "none"
            raise ConfigError(f"{type(self).__name__} has no parameter {name!r}; it has: {known}.")
        spec, raw = self._specs[name], self.raw[name]
        v = torch.as_tensor(value, dtype=torch.float64).reshape(-1)
        if v.numel() not in (1, raw.numel()):
            raise ConfigError(f"parameter {name!r} takes {raw.numel()} number(s); got {v.numel()}.")
        if not bool(torch.isfinite(v).all()):
            raise ConfigError(f"parameter {name!r} [{spec.unit}] must be finite; got {v.tolist()}.")
        v = v.expand(raw.numel())
        low, high, scale = spec.low, spec.high, self._scales[name]
        if (low is not None and bool((v <= low).any())) or (high is not None and bool((v >= high).any())):
            raise ConfigError(
                f"parameter {name!r} [{spec.unit}] must lie strictly between {low} and {high}; got {v.tolist()}."
            )
        if low is not None and high is not None:
            share = (v - low) / (high - low)
            new = torch.log(share) - torch.log1p(-share)
        elif low is not None:
            new = _inverse_softplus((v - low) / scale)
        elif high is not None:
            new = _inverse_softplus((high - v) / scale)
        else:
            new = v / scale
        with torch.no_grad():
            raw.copy_(new.to(raw))

    def declared_parameters(self) -> dict[str, tuple[Tensor, str]]:
        """Declared parameters: name -> (value (k,), unit)."""
        return {name: (self.value(name).detach(), spec.unit) for name, spec in self._specs.items()}


def _scale(spec: Parameter) -> float:
    if spec.scale is not None:
        return spec.scale
    initial = spec.initial if isinstance(spec.initial, tuple) else (spec.initial,)
    return max(*(abs(v) for v in initial), 0.1)


def _inverse_softplus(y: Tensor) -> Tensor:
    return y + torch.log(-torch.expm1(-y))


class Effect(Parametrised, ABC):
    """One physical term on one port.

    Attributes:
        name: Key in `EFFECTS`.
        port: Where it enters.
        formula: The term, in words that fit on one line.
        source: Where it comes from.
        systems: Names of the systems that it is for; empty: every system with the port.
        n_memory: Extra states that it carries.
        exogenous: Logged columns that it reads beside the inputs.
    """

    name: ClassVar[str]
    port: ClassVar[Port]
    formula: ClassVar[str]
    source: ClassVar[str]
    systems: ClassVar[tuple[str, ...]] = ()
    exogenous: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def fits(cls, system: str) -> bool:
        """Whether the effect is meant for a system of this name."""
        return not cls.systems or system in cls.systems

    @property
    def n_memory(self) -> int:
        """Number of extra states."""
        return 0

    @abstractmethod
    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """What the effect adds at its port.

        Args:
            t: Time [s].
            x: State (N, nx).
            u: Inputs as commanded (N, nu).
            memory: Extra states of this effect (N, n_memory).

        Returns:
            Contribution (N, width of the port).
        """

    def memory_rate(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """Rate of the extra states (N, n_memory) [1/s]."""
        return memory

    def memory_start(self, x: Tensor, u: Tensor) -> Tensor:
        """Extra states at the start of a rollout (N, n_memory): the stationary ones under `u`."""
        return x[:, :0]
