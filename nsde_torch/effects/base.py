"""Effects: physical terms that act on a system through a port. Declared physics is a sum of them.

An effect returns what it adds at its port: mass-normalised force [m/s2], inertia-normalised torque [rad/s2], a wrench
of both; on the port `input` a change of the input, on `rate` a rate of the state. An effect with memory (a lag) carries
`n_memory` states m with dm/dt = memory_rate(t, x, u, m).

Effects on the input act one after another, in the order of their `stage`: delay, then what limits a command, then
lag, then what changes the strength. Effects on the other ports see the input that comes out of it.
"""

from __future__ import annotations

import copy
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from itertools import product
from typing import Any, ClassVar, overload

import torch
from torch import Tensor, nn

from nsde_torch.errors import ConfigError


def copied(module: nn.Module, memo: dict[int, Any]) -> Any:
    """A deep copy of a module, for its `__deepcopy__`; a diagnosis copies systems by the thousand.

    Without the dozen empty tables of hooks that `copy.deepcopy` takes apart in every one.
    """
    out = memo[id(module)] = type(module).__new__(type(module))
    for name, value in vars(module).items():
        vars(out)[name] = _copied(value, memo)
    return out


def _copied(value: Any, memo: dict[int, Any]) -> Any:
    if value is None or type(value) in (bool, int, float, str):
        return value
    known = memo.get(id(value))
    if known is not None:
        return known
    if isinstance(value, (nn.ModuleList, nn.ParameterDict)):
        return copied(value, memo)
    if type(value) is dict:
        table = memo[id(value)] = {}
        table.update((key, _copied(one, memo)) for key, one in value.items())
        return table
    if isinstance(value, dict) and not value:
        memo[id(value)] = value.copy()  # `copy.copy` takes an ordered one apart, ten times as slow
        return memo[id(value)]
    return copy.deepcopy(value, memo)


PACE = "pace"
"""Of the sizes of the data: what times that are usual for drives and vehicles are multiplied by."""
STRICTLY = 1e-6
"""Share of its typical size by which a value is inside its bounds."""


class Port(str, Enum):
    """Where a term enters a system.

    A system of the user's own may have a port of its own: `Port("tail_force")` is the same object everywhere. On
    `input`, `rate` and `position` an effect can act whatever the system: `rate` adds to the rate of the whole state,
    (N, nx) in the units of the states per second; leave the columns of the kinematics at zero. `position` adds to the
    state (N, nx) at which all physics is worked out: what a sensor reads too much, with the other sign. `inertia` adds
    a share (N, nx) of the rate of the state that all else makes. `parameter` is that of what differs between runs
    (`by_run`).
    """

    FORCE = "force"
    TORQUE = "torque"
    WORLD_FORCE = "world_force"
    BODY_FORCE = "body_force"
    BODY_MOMENT = "body_moment"
    BODY_WRENCH = "body_wrench"
    MOTOR_THRUST = "motor_thrust"
    POSITION = "position"
    PARAMETER = "parameter"
    INPUT = "input"
    RATE = "rate"
    INERTIA = "inertia"

    @classmethod
    def _missing_(cls, value: object) -> Port | None:
        if not (isinstance(value, str) and value.isidentifier()):
            return None
        made = str.__new__(cls, value)
        made._name_, made._value_ = value.upper(), value
        return cls._value2member_map_.setdefault(value, made)  # type: ignore[return-value]


@dataclass(frozen=True)
class Parameter:
    """A physical parameter with bounds; the optimiser sees an unbounded number.

    As an attribute of a class it is one of its `PARAMETERS`, and of an object its value: `drag = Parameter(...)`,
    `self.drag`.
    """

    initial: float | tuple[float, ...]  # first value, one number or one per axis, strictly inside the bounds
    unit: str
    low: float | None = None
    high: float | None = None
    scale: float | None = None
    """Size of a typical change; sets the speed of learning (default: |initial|, at least 0.1)."""
    help: str = ""  # what it is, one line
    per_input: bool = False  # one number per input of the system; `initial` is then that of each

    def __set_name__(self, owner: type, name: str) -> None:
        if vars(self).setdefault("_name", name) != name:
            raise TypeError(
                f"{owner.__name__}: {name!r} and {vars(self)['_name']!r} are one Parameter; write two."
            )

    @overload
    def __get__(self, at: None, of: type) -> Parameter: ...
    @overload
    def __get__(self, at: Parametrised, of: type) -> Tensor: ...
    def __get__(self, at: Parametrised | None, of: type) -> Parameter | Tensor:
        return self if at is None else at.value(vars(self)["_name"])

    def __deepcopy__(self, memo: dict[int, object]) -> Parameter:
        """Itself: nothing of it can change, and systems are copied by the hundred."""
        return self


class Size(Parameter):
    """A parameter that the term of an effect is linear in: without effect it is 0."""


class Parametrised(nn.Module):
    """A module with declared physical parameters, kept inside their bounds by construction.

    Bounded below: value = low + softplus; on both sides: a logistic; free: value = raw * scale.
    `self.value(name)` is differentiable.
    """

    PARAMETERS: ClassVar[Mapping[str, Parameter]] = {}
    """By name: those of the class, then those that it inherits. Written as attributes, or as one mapping of all."""
    _declared: ClassVar[Mapping[str, Parameter]] = {}  # as they are written

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        own = {name: spec for name, spec in vars(cls).items() if isinstance(spec, Parameter)}
        if own or "PARAMETERS" in vars(cls):
            cls._declared = own | {
                k: p for k, p in vars(cls).get("PARAMETERS", cls._declared).items() if k not in own
            }
            cls.PARAMETERS = cls._declared

    def __init__(self, values: Mapping[str, float | list[float]] | None = None) -> None:
        super().__init__()
        self._specs = dict(self.PARAMETERS)
        self._scales = {name: _scale(spec) for name, spec in self._specs.items()}
        self.raw = nn.ParameterDict()
        self.in_run: dict[str, Callable[[Tensor], Tensor]] = {}
        """By name of a parameter that differs between runs, while a rate is worked out: from its value (k,) to those of
        the rows (N, k)."""
        for name, spec in self._specs.items():
            initial = torch.as_tensor(spec.initial, dtype=torch.float64).reshape(-1)
            self.raw[name] = nn.Parameter(torch.zeros(len(initial)))
            self.set_value(name, initial)
        for name, value in (values or {}).items():
            self.set_value(name, value)

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        return copied(self, memo)

    def value(self, name: str) -> Tensor:
        """Value of a declared parameter, (k,), in its unit."""
        value = self._value(name)
        return self.in_run[name](value) if name in self.in_run else value

    def _value(self, name: str) -> Tensor:
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

    def set_value(self, name: str, value: Tensor | float | list[float]) -> None:
        """Set a declared parameter to a value (k,) in its unit, or one number for all axes.

        Raises:
            ConfigError: unknown name, no number, wrong length, or out of bounds.
        """
        if name not in self._specs:
            known = ", ".join(self._specs) or "none"
            raise ConfigError(f"{type(self).__name__} has no parameter {name!r}; it has: {known}.")
        spec, raw = self._specs[name], self.raw[name]
        try:
            if any(isinstance(one, bool) for one in (value if isinstance(value, list) else [value])):
                raise TypeError
            v = torch.as_tensor(value, dtype=torch.float64).reshape(-1)
        except (TypeError, ValueError):  # text, lists in a list, `yes` of YAML
            raise ConfigError(
                f"parameter {name!r} [{spec.unit}] of {type(self).__name__} takes numbers; got {value!r}."
            ) from None
        if v.numel() not in (1, raw.numel()):
            raise ConfigError(f"parameter {name!r} takes {raw.numel()} number(s); got {v.numel()}.")
        if not bool(torch.isfinite(v).all()):
            raise ConfigError(f"parameter {name!r} [{spec.unit}] must be finite; got {v.tolist()}.")
        v = v.expand(raw.numel())
        low, high, scale = spec.low, spec.high, self._scales[name]
        if (low is not None and bool((v <= low).any())) or (high is not None and bool((v >= high).any())):
            ends = [f"{word} {end:g}" for word, end in (("above", low), ("below", high)) if end is not None]
            raise ConfigError(
                f"parameter {name!r} [{spec.unit}] must be {' and '.join(ends)}; got {v.tolist()}."
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


def _widened(spec: Parameter, n_inputs: int) -> Parameter:
    """The parameter with one value per input, where it is one per input."""
    if not spec.per_input or isinstance(spec.initial, tuple):
        return spec
    return replace(spec, initial=(spec.initial,) * n_inputs)


def _inverse_softplus(y: Tensor) -> Tensor:
    return y + torch.log(-torch.expm1(-y))


class Effect(Parametrised, ABC):
    """One physical term on one port.

    Args:
        values: First values of parameters.
        n_inputs: Number of inputs of the system, for effects with memory or parameters per input.
    """

    name: ClassVar[
        str
    ]  # key in `EFFECTS`; by default that of the class in small letters, `linear_drag` of `LinearDrag`
    port: ClassVar[Port]  # where it enters
    formula: ClassVar[str]  # the term, in words that fit on one line
    source: ClassVar[str]  # where it comes from
    systems: ClassVar[tuple[str, ...]] = ()
    """Names of the systems that it is for; empty: every system with the ports."""
    needs: ClassVar[tuple[Port, ...]] = ()  # ports that a system must have beside `port`
    excludes: ClassVar[tuple[Port, ...]] = ()  # ports that it must not have
    stage: ClassVar[int] = 3  # on the port `input`: effects of a lower stage act first
    exogenous: ClassVar[tuple[str, ...]] = ()  # logged columns that it reads beside the inputs
    quantities: ClassVar[Mapping[str, int]] = {}
    """What it reads of the system's own working, name -> columns (see `System.quantities`)."""
    null: ClassVar[Mapping[str, float]] = {}
    """Values at which it adds nothing (a bound may mean "arbitrarily close to"). Parameters left out are without effect
    at these values. Those of `amplitudes` are 0 unless it says otherwise."""
    amplitudes: ClassVar[tuple[str, ...]] = ()  # parameters that the term is linear in: each `Size`
    shapes: ClassVar[Mapping[str, tuple[float | tuple[float, ...], ...]]] = {}
    """First values to try for parameters that it is not linear in; a vector parameter takes one number for all axes or
    a tuple."""
    fitted_from: ClassVar[Sequence[Mapping[str, float]]] = ()
    """Values from which fits begin, each with the first values of all other parameters, where a linearised step from no
    effect shows nothing: a resonance is a sharp line, and noise levels learn what oscillates."""
    smooth: ClassVar[tuple[str, ...]] = ()
    """Parameters of `shapes` that one linear step fits again to some of the runs, as it does amplitudes."""
    relative: ClassVar[Mapping[str, str]] = {}
    """Parameters whose `shapes` are multiples of a size of the data: `input`, `speed`, `rate` or `position` (95 %
    quantile of the absolute value that the effect sees), `step` (time between samples), or `spectrum` (frequencies are
    taken from the data, `shapes` has none). Other times [s], frequencies [Hz] and rates of an input [input/s] are
    those of drives and vehicles, and of slower machines slower (`nsde_torch.data.pace`)."""
    ends: ClassVar[tuple[str, ...]] = ()  # `shapes` at whose lower bound it is another law, too
    states: ClassVar[int] = 0  # extra states, its memory, if their number is always the same
    resolved: ClassVar[Mapping[str, float]] = {}
    """Times of a memory -> the least multiple of a step at which explicit steps follow it."""
    includes: ClassVar[tuple[str, ...]] = ()
    """Simpler effects that it contains as special cases; it stands in for them, not beside them."""
    same: ClassVar[Mapping[str, str]] = {}
    """Its parameters that are equal to one of a contained effect where the two are alike, own name -> theirs;
    parameters of the same name are alike without a word."""
    along: ClassVar[str] = ""
    """The one variable that it is a law of (`speed`, `position`), if there is one: two of one variable on one port may
    together represent a third that nobody listed."""
    each_input: ClassVar[bool] = False
    """Whether one input of several may have it alone (see `effects.one_input`)."""
    around_zero: ClassVar[bool] = False
    """Whether it is about inputs near zero. Of inputs that stay far from it, a dead band is an offset."""
    both_signs: ClassVar[bool] = False  # whether of inputs of one sign it is another effect
    local: ClassVar[bool] = False
    """Whether it acts in one place alone. The data may never have reached it: that they do not show it says nothing."""
    drifts: ClassVar[bool] = False  # whether it grows with the time of the log
    not_of: ClassVar[Mapping[str, str]] = {}
    """Systems whose diagnoses do not try it -> why (another effect is the same term, say)."""
    sentence: ClassVar[str] = ""
    """What it means, for who runs the machine; {parameter} is replaced by a value with its unit."""
    separate: ClassVar[str] = ""  # the experiment that would distinguish it from similar effects
    estimated: ClassVar[bool] = False
    """Whether a filter estimates its memory with the state. Others follow what was measured, and take its noise up."""
    whole_steps: ClassVar[bool] = False
    """Whether, with a `step`, `memory_rate` is the mean rate over a step that starts from a memory, and `forward` the
    mean term over it, for inputs that are held: what they are given is then of its start."""
    jumps: ClassVar[bool] = False
    """Whether, of `whole_steps`, its memory jumps or stops within a step, so that it has a rate over a step alone."""

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        if "name" not in cls.__dict__:
            cls.name = re.sub(r"(?<=[^_])(?=[A-Z])", "_", cls.__name__).lower()
        sizes = tuple(name for name, spec in cls.PARAMETERS.items() if isinstance(spec, Size))
        if sizes and sizes != cls.amplitudes and "amplitudes" not in cls.__dict__:
            cls.amplitudes = sizes
        if "amplitudes" in cls.__dict__ and "null" not in cls.__dict__:
            cls.null = dict.fromkeys(cls.amplitudes, 0.0)

    def __init__(self, values: Mapping[str, float | list[float]] | None = None, *, n_inputs: int = 1) -> None:
        self.n_inputs = n_inputs
        self.row_s = 0.0
        """Time between the rows that a likelihood predicts [s], which memory moves no faster than; 0: it may."""
        self.step = 0.0
        """Step of the integrator [s], for effects of `whole_steps`. 0: rate and term are those of the instant."""
        self.PARAMETERS = {k: _widened(p, n_inputs) for k, p in self.PARAMETERS.items()}  # type: ignore[misc]
        super().__init__(values)

    @classmethod
    def fits(cls, system: str, ports: Collection[Port]) -> bool:
        """Whether the effect is meant for a system of this name and these ports."""
        named = not cls.systems or system in cls.systems
        has = {*ports, Port.INPUT, Port.RATE, Port.INERTIA, Port.POSITION}
        return named and {cls.port, *cls.needs} <= has and not set(cls.excludes) & set(ports)

    @classmethod
    def no_candidate(cls, system: str) -> str:
        """Why a diagnosis of this system does not try it; empty: it does."""
        return cls.not_of.get(system, "")

    @classmethod
    def size_names(cls) -> tuple[str, ...]:
        """Parameters that say how strong it is: at nothing, it does nothing."""
        return cls.amplitudes or tuple(cls.null)

    @classmethod
    def shared(cls, simpler: type[Effect]) -> dict[str, str]:
        """Its parameters that are one of an effect that it contains, own name -> name there (see `same`)."""
        names = {name: cls.same.get(name, name) for name in cls.PARAMETERS}
        return {own: theirs for own, theirs in names.items() if theirs in simpler.PARAMETERS}

    @classmethod
    def starts(
        cls, sizes: Mapping[str, float], frequencies: Sequence[float] = ()
    ) -> list[dict[str, float | list[float]]]:
        """Values to start a fit from: no effect, at every point of the grid of `shapes`; strictly inside the bounds.

        `sizes` are those of the data that `relative` may ask for, in their units; `frequencies` where the residual has
        lines in its spectrum [Hz], for parameters relative to `spectrum`.

        Raises:
            KeyError: a size that is asked for is not given.
        """
        grids: list[list[float | tuple[float, ...]]] = []
        for name, values in cls.shapes.items():
            kind = cls.relative.get(name)
            size = 1.0 if kind in (None, "spectrum") else sizes[str(kind)]
            size *= cls.paced(name, sizes)
            own = tuple(frequencies) if kind == "spectrum" else values
            grids.append([tuple(size * w for w in v) if isinstance(v, tuple) else size * v for v in own])
        points = product(*grids)
        return [cls._inside({**cls.null, **dict(zip(cls.shapes, point, strict=True))}) for point in points]

    @classmethod
    def paced(cls, name: str, sizes: Mapping[str, float]) -> float:
        """Factor of the values of `shapes` in data of these sizes, by their pace: of times, frequencies and rates."""
        return 1.0 if cls.relative.get(name) in ("step", "spectrum") else cls._of_pace(name, sizes)

    @classmethod
    def _of_pace(cls, name: str, sizes: Mapping[str, float]) -> float:
        pace = sizes.get(PACE, 1.0)
        return {"s": pace, "Hz": 1.0 / pace, "input/s": 1.0 / pace}.get(cls.PARAMETERS[name].unit, 1.0)

    @classmethod
    def fits_from(cls, sizes: Mapping[str, float]) -> list[dict[str, float]]:
        """Values of `fitted_from` in data of these sizes."""
        return [{k: v * cls._of_pace(k, sizes) for k, v in at.items()} for at in cls.fitted_from]

    @classmethod
    def at_null(cls) -> dict[str, float | list[float]]:
        """Values of `null`, strictly inside the bounds."""
        return cls._inside(cls.null)

    @classmethod
    def _inside(cls, values: Mapping[str, float | tuple[float, ...]]) -> dict[str, float | list[float]]:
        """Values on a bound moved inside, by a millionth of their scale."""
        out: dict[str, float | list[float]] = {}
        for name, value in values.items():
            spec = cls.PARAMETERS[name]
            low, high, margin = spec.low, spec.high, STRICTLY * _scale(spec)
            row = list(value) if isinstance(value, tuple) else [value]
            row = [low + margin if low is not None and v <= low else v for v in row]
            row = [high - margin if high is not None and v >= high else v for v in row]
            out[name] = row if len(row) > 1 else row[0]
        return out

    def channel(self, name: str, u: Tensor) -> Tensor:
        """A column (N, 1) of `exogenous`, or the columns (N, k) of one of `quantities`, from `u` of `forward`."""
        widths = {**dict.fromkeys(self.exogenous, 1), **self.quantities}
        start = u.shape[1] - sum(widths.values())
        for key, width in widths.items():
            if key == name:
                return u[:, start : start + width]
            start += width
        raise KeyError(name)

    @property
    def n_memory(self) -> int:
        """Number of extra states."""
        return self.states

    @abstractmethod
    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """What the effect adds at its port.

        Args:
            t: Time [s].
            x: State (N, nx).
            u: Inputs (N, nu + ...): as they reach this effect on the port `input`, as they act on the other ports; then
                a column for each of `exogenous` and the columns of `quantities` (see `channel`).
            memory: Extra states of this effect (N, n_memory).

        Returns:
            Contribution (N, width of the port).
        """

    def memory_rate(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """Rate of the extra states (N, n_memory) [1/s]."""
        return memory

    def held(self, u: Tensor, dt: float) -> Tensor | None:
        """Memory with which `forward` gives the exact mean over each step; None where there is no such thing.

        Args:
            u: Inputs of consecutive steps, held over each (n, nu).
            dt: Length of a step [s].

        Returns:
            One memory per step (n, n_memory), to be held over it in place of the result of `memory_rate`; of one that a
            filter estimates, that at the start of each step and at the end of the last (n + 1, n_memory).
        """
        return None

    def followed(self, x: Tensor, dt: float) -> Tensor | None:
        """Memory along measured states, known without `memory_rate`; None: it is not.

        Args:
            x: States at the starts of consecutive steps (n, nx).
            dt: Length of a step [s].

        Returns:
            Memory at the start of each step, and at the end of the last (n + 1, n_memory).
        """
        return None

    def memory_start(self, x: Tensor, u: Tensor) -> Tensor:
        """Extra states at the start of a rollout (N, n_memory): the stationary ones under `u`."""
        return x[:, :0]


def in_row(term: Tensor, row: int, width: int) -> Tensor:
    """A term (N, 1) in one row of a port of a width (N, width), nothing in the others."""
    if width == 1:
        return term
    none = torch.zeros_like(term)
    return torch.cat([term if k == row else none for k in range(width)], 1)


def elapsed(t: float | Tensor, x: Tensor) -> float | Tensor:
    """Time [s] as a number or a column (N, 1) or (1, 1) that multiplies rows of `x`; its precision is kept."""
    return t.reshape(-1, 1).to(x.device) if isinstance(t, Tensor) else t
