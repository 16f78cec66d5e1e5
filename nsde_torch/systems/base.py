"""Systems: names, units, frames, declared physics and projection of one machine.

    dx/dt = dynamics(t, x, u + sum of effects on the input, sum of effects on each force port)

Kinematics are exact and belong to the system; everything that pushes is an effect on a port.
"""

import copy
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from functools import partial
from itertools import accumulate
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from nsde_torch.columns import join_columns, split_columns
from nsde_torch.effects import (
    Coordinate,
    Effect,
    Parametrised,
    Port,
    canonical_name,
    effect_class,
    effects_of,
)
from nsde_torch.effects.by_run import target_of
from nsde_torch.effects.coordinates import Bound
from nsde_torch.effects.expression import expression_at
from nsde_torch.effects.expression_grammar import is_law
from nsde_torch.effects.one_input import Input, single_inputs
from nsde_torch.errors import ConfigError, ShapeError
from nsde_torch.systems import coordinates as coordinates_of
from nsde_torch.systems.in_run import OVER_MASS, in_its_run, row_by_row
from nsde_torch.systems.machine import Machine
from nsde_torch.systems.values import Defaults, ErrorGroup, ResidualPort, Values, split_values
from nsde_torch.systems.vocabulary import given, vocabulary

MEMORY_S = 0.5
"""Time before a start that inputs are taken from [s]: ten time constants of motors; four fifths of one of 0.3 s."""
_PARTS = 10  # of a step, of memory that is not exact over whole ones


class System(Parametrised, ABC):
    """One machine. Subclasses set the class attributes and write `dynamics` and `features`.

    Args:
        effects: Effects beyond the declared ones, by name or as objects.
        declared: Declared effects; None takes the system's own.
        values: Initial values of parameters; `name` for the system's, `effect.name` for an effect's.
    """

    name: ClassVar[str]  # key in `SYSTEMS`, or the user's own
    state_names: ClassVar[tuple[str, ...]]  # columns of the state
    state_units: ClassVar[tuple[str, ...]]
    input_names: ClassVar[tuple[str, ...]]  # columns of the input
    input_units: ClassVar[tuple[str, ...]]
    ports: ClassVar[Mapping[Port, int]]  # width of each force port
    residual_ports: ClassVar[Mapping[Port, ResidualPort]]  # ports that get a residual network
    defaults: ClassVar[Defaults]  # constants of the supplement
    error_names: ClassVar[tuple[str, ...]]  # error channels; those of the state unless it says otherwise
    error_groups: ClassVar[tuple[ErrorGroup, ...]]  # how they are reported; by default a group for each unit
    feature_names: ClassVar[tuple[str, ...]]  # columns of `features`; by default those of the state
    feature_units: ClassVar[tuple[str, ...]]
    coordinates: ClassVar[tuple[Coordinate, ...]] = ()
    """The ways in which the machine can move, each with its columns and its port; laws of the catalogue are effects on
    each. Empty: that of the one pair of `position_derivatives`, where there is one force port."""
    older_names: ClassVar[Mapping[str, str]] = {}  # names that effects once had -> those that they have
    declared: ClassVar[tuple[str, ...]] = ()  # names of the effects that are part of the declared physics
    residual_names: ClassVar[tuple[str, ...]] = ()  # columns of `residual_features`; empty: of `features`
    places: ClassVar[tuple[int, ...]] = ()
    """Columns of states beside these that a residual network sees where the data show that a force depends on them."""
    quantities: ClassVar[Mapping[str, int]] = {}
    """What effects on force ports may read beside state and input, name -> columns."""
    disturbed_ports: ClassVar[tuple[Port, ...]] = ()  # those that carry a lasting disturbance (gusts)
    sensor_noise: ClassVar[bool] = False  # whether the state has noise that a model should learn
    quaternion: ClassVar[slice | None] = None  # columns of the unit quaternion, or None
    position_derivatives: ClassVar[tuple[tuple[str, str, str], ...]] = ()
    """(position, velocity, frame) triples that kinematics ties together."""
    optional_inputs: ClassVar[tuple[str, ...]] = ()  # inputs that a file may lack, and that are then zero
    over_mass: ClassVar[tuple[str, ...]] = ()
    """Parameters that go with 1 / mass, as a gain of the input: a mass that differs between runs changes them, and the
    forces of effects."""
    machine: ClassVar[Machine | None] = None  # what a simulated one is made of; None: nothing is simulated

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        coordinates_of.describe(cls)

    def __init__(
        self,
        effects: Sequence[str | Effect] = (),
        *,
        declared: Sequence[str] | None = None,
        values: Values | None = None,
    ) -> None:
        own, given = split_values(values or {})
        super().__init__(own)
        of_effects = {self.effect_key(name): v for name, v in given.items()}
        names = [*(self.declared if declared is None else declared), *effects]
        made = coordinates_of.all_made(self, names, of_effects)
        twice = sorted({e.name for e in made if [m.name for m in made].count(e.name) > 1})
        if twice:
            raise ConfigError(f"effects {twice} are named twice for system {self.name!r}; name each once.")
        if of_effects:
            raise ConfigError(
                f"`parameters` names effects that system {self.name!r} does not have: {sorted(of_effects)}; "
                f"it has: {', '.join(e.name for e in made) or 'none'}."
            )
        self._arrange(made)

    _channels: tuple[str, ...] = ()  # of `reading`

    @classmethod
    def bound_coordinates(cls) -> tuple[Bound, ...]:
        """The coordinates by columns of the state; a ConfigError where one names what the system does not have."""
        return coordinates_of.bound_coordinates(cls)

    @classmethod
    def single_inputs(cls) -> tuple[Input, ...]:
        """The inputs that effects may be on alone (see `effects.one_input`)."""
        return single_inputs(cls.input_names, cls.input_units, cls.ports)

    @classmethod
    def able_effects(cls) -> dict[str, type[Effect]]:
        """The effects of the catalogue, and those registered, that the machine can have, by their names on it."""
        return effects_of(cls.name, cls.ports, cls.bound_coordinates(), cls.single_inputs())

    @classmethod
    def effect_key(cls, name: str) -> str:
        """What an effect is called on this machine: `coulomb_friction[q2]`, plain where there is one coordinate."""
        return canonical_name(name, cls.bound_coordinates(), cls.older_names)

    @classmethod
    def effect_class(cls, name: str) -> type[Effect]:
        """Class of an effect as it is on this machine: with its columns, units and words."""
        if is_law(name):
            return expression_at(name, vocabulary(cls))
        return effect_class(cls.effect_key(name), cls.bound_coordinates(), cls.single_inputs())

    def make_effect(self, name: str, values: Values | None = None) -> Effect:
        """An effect for this machine, by name, with first values of its parameters (see `effects.make_effect`)."""
        return coordinates_of.made(self, self.effect_key(name), values)

    def _arrange(self, effects: Sequence[Effect]) -> None:
        """Take these effects, and work out their order and where each finds its memory and its columns."""
        self.effects = nn.ModuleList(effects)
        self._own = tuple(effects)  # a list of modules makes a text of each number that it is asked for
        self._parts = (self.nx, *(effect.n_memory for effect in effects))
        on_input = [k for k, effect in enumerate(effects) if effect.port is Port.INPUT]
        self._on_input = tuple(sorted(on_input, key=lambda k: (effects[k].stage, k)))
        self._on_position = tuple(k for k, effect in enumerate(effects) if effect.port is Port.POSITION)
        self._on_parameter = tuple(k for k, effect in enumerate(effects) if effect.port is Port.PARAMETER)
        elsewhere = (*on_input, *self._on_position, *self._on_parameter)
        self._on_force = tuple(k for k in range(len(effects)) if k not in elsewhere)
        columns = {name: self.nu + k for k, name in enumerate(self.exogenous)}
        self._read = tuple(tuple(columns[name] for name in effect.exogenous) for effect in effects)

    def set_step(self, dt: float) -> None:
        """Tell the effects the step of the integrator [s] (see `Effect.whole_steps`); 0: as their formulas say."""
        for effect in self._own:
            effect.step = float(dt)

    @property
    def step(self) -> float:
        """Step that the effects were given [s]; 0: none."""
        return self._own[0].step if self._own else 0.0

    @property
    def whole_steps(self) -> bool:
        """Whether every memory knows whole steps of held inputs exactly, once given the step."""
        return all(effect.whole_steps for effect in self._own if effect.n_memory)

    @property
    def estimated_effects(self) -> tuple[str, ...]:
        """Names of the effects whose memory a filter estimates with the state (see `Effect.estimated`)."""
        return tuple(effect.name for effect in self._own if effect.estimated)

    def memory_columns(self, names: Collection[str]) -> tuple[int, ...]:
        """Columns of the memory of some effects among that of all."""
        ends = accumulate((effect.n_memory for effect in self._own), initial=0)
        parts = [range(a, a + e.n_memory) for a, e in zip(ends, self._own, strict=False) if e.name in names]
        return tuple(column for part in parts for column in part)

    @property
    def held_columns(self) -> tuple[int, ...]:
        """Columns of (state, memory) whose rate is that of a whole step: memory of effects that know the step."""
        ends = list(accumulate(self._parts))
        return tuple(
            column
            for effect, start, stop in zip(self._own, ends[:-1], ends[1:], strict=True)
            if effect.step and effect.whole_steps
            for column in range(start, stop)
        )

    def inner(self, z: Tensor, y: Tensor) -> Tensor:
        """The state `y` (N, nz) at which a step from `z` (N, nz) evaluates the drift again.

        Memory whose rate is that of a whole step stays as it was at the start: every stage then has the mean input
        over the step, and the memory comes out exact, whatever the method.
        """
        columns = self.held_columns
        if not columns:
            return y
        if len(columns) == self.nz - self.nx:
            parts = (self.nx, len(columns))
            return join_columns((split_columns(y, *parts)[0], split_columns(z, *parts)[1]))
        keep = torch.zeros(self.nz, dtype=torch.bool, device=z.device)
        keep[list(columns)] = True
        return torch.where(keep, z, y)

    def with_effects(self, *effects: Effect) -> "System":
        """A copy of the machine, with its present values, that has further effects.

        A ConfigError where one is there already, or reads what the system does not offer.
        """
        for effect in effects:
            coordinates_of.check_effect(self, effect)
        twice = [e.name for e in effects if e.name in self.effect_names]
        if twice:
            raise ConfigError(f"system {self.name!r} has the effects {twice} already.")
        out = copy.deepcopy(self)
        out._arrange([*out._own, *(copy.deepcopy(e) for e in effects)])
        return out

    def reading(self, *names: str) -> "System":
        """A copy of the machine that is given further logged columns, whether an effect reads them or not."""
        out = copy.deepcopy(self)
        out._channels = tuple(dict.fromkeys((*self.exogenous, *names)))
        out._arrange(out._own)
        return out

    def without_effects(self, *names: str) -> "System":
        """A copy of the machine, with its present values, without some of its effects and what differs in these."""
        out = copy.deepcopy(self)
        of_these = {n for n in self.effect_names if target_of(n).partition("/")[0] in names}
        out._arrange([e for e in out._own if e.name not in {*names, *of_these}])
        return out

    @property
    def nx(self) -> int:
        """Number of states."""
        return len(self.state_names)

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return len(self.input_names)

    @property
    def nz(self) -> int:
        """Number of states with the memory of the effects."""
        return sum(self._parts)

    @property
    def exogenous(self) -> tuple[str, ...]:
        """Logged columns behind the inputs: those of `reading`, then what other effects read."""
        return tuple(dict.fromkeys((*self._channels, *(n for e in self._own for n in e.exogenous))))

    @property
    def effect_names(self) -> tuple[str, ...]:
        """Names of all effects, declared and added."""
        return tuple(e.name for e in self._own)

    @property
    def physics_ports(self) -> set[Port]:
        """Ports that declared physics act on; the residual network of any other is all that is known of it."""
        return set(self.residual_ports)

    @abstractmethod
    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        """Rate of the state dx/dt (N, nx), at a time [s] and states (N, nx).

        `u` is the input after the effects on it (N, nu), `forces` the sum of effects and residuals on each port that
        has any (N, width of the port).
        """

    def features(self, x: Tensor) -> Tensor:
        """Features (N, nf) of which the distance eta is a function; the state by default."""
        return x

    def residual_features(self, x: Tensor) -> Tensor:
        """Features (N, nr) that the residual networks see; default: `features`."""
        return self.features(x)

    def network_features(self, x: Tensor) -> Tensor:
        """`residual_features` and the places (N, nr + np) that networks may see."""
        own = self.residual_features(x)
        return join_columns((own, *(x[:, k : k + 1] for k in self.places))) if self.places else own

    @property
    def network_names(self) -> tuple[str, ...]:
        """Names of the columns of `network_features`."""
        return (*(self.residual_names or self.feature_names), *(self.state_names[k] for k in self.places))

    def error(self, predicted: Tensor, measured: Tensor) -> Tensor:
        """Predicted minus measured state in error channels, (..., n_error); the difference by default."""
        return predicted - measured

    def project(self, z: Tensor) -> Tensor:
        """The nearest valid state (N, nz); the identity by default."""
        return z

    def width_of(self, port: Port) -> int:
        """Columns of what acts on a port: one of its own, or one that every machine has; 0 where it has none."""
        of_states = dict.fromkeys((Port.RATE, Port.INERTIA, Port.POSITION), self.nx)
        return {**self.ports, Port.INPUT: self.nu, **of_states}.get(port, 0)

    def start_values(
        self, x: NDArray[np.float64], u: NDArray[np.float64], dt: float
    ) -> dict[str, list[float]]:
        """First values of parameters from states (n, nx) and inputs (n, nu) of one continuous stretch, `dt` [s] apart.

        Nothing by default.
        """
        return {}

    def drift(
        self, t: float | Tensor, z: Tensor, u: Tensor, residual: Mapping[Port, Tensor] | None = None
    ) -> Tensor:
        """Rate of state and memory (N, nz) at a time [s], with learned contributions (`residual`) by port.

        `u` are input and exogenous channels (N, nu + n_exogenous).
        """
        if not self._on_parameter:
            return self._drift(t, z, u, residual)
        with in_its_run(self, self._on_parameter, u) as lighter:
            return self._drift(t, z, u, residual, lighter)

    def _drift(
        self,
        t: float | Tensor,
        z: Tensor,
        u: Tensor,
        residual: Mapping[Port, Tensor] | None,
        lighter: Tensor | None = None,
    ) -> Tensor:
        """See `drift`; forces over the mass are `lighter` (N, 1) times as large."""
        x, *memories = split_columns(z, *self._parts)
        x = self._as_it_is(t, x, u)
        forces: dict[Port, Tensor] = dict(residual or {})
        rates: dict[int, Tensor] = {}
        command = self._applied(t, x, u, memories, rates)
        for k in self._on_force:
            effect, own = self._own[k], self._seen(k, x, command, u)
            term = effect(t, x, own, memories[k])
            if lighter is not None and effect.port in OVER_MASS:
                term = term * lighter
            forces[effect.port] = forces[effect.port] + term if effect.port in forces else term
            if effect.n_memory:
                rates[k] = effect.memory_rate(t, x, own, memories[k])
        if not self.in_run:
            rate = self.dynamics(t, x, command, forces)
        elif isinstance(t, Tensor) and t.dim():
            rate = row_by_row(self, self.dynamics, t, x, command, forces)
        else:
            rate = row_by_row(self, partial(self.dynamics, t), x, command, forces)
        if Port.INERTIA in forces:
            rate = rate + rate * forces[Port.INERTIA]
        if Port.RATE in forces:
            rate = rate + forces[Port.RATE]
        return join_columns((rate, *(rates[k] for k in sorted(rates)))) if rates else rate

    def memory_rate(self, t: float | Tensor, z: Tensor, u: Tensor) -> Tensor:
        """Rate of the memory of the effects alone (N, nz - nx), as `drift` has it."""
        x, *memories = split_columns(z, *self._parts)
        x = self._as_it_is(t, x, u)
        rates: dict[int, Tensor] = {}
        command = self._applied(t, x, u, memories, rates)
        for k in self._on_force:
            if self._own[k].n_memory:
                rates[k] = self._own[k].memory_rate(t, x, self._seen(k, x, command, u), memories[k])
        return join_columns(tuple(rates[k] for k in sorted(rates))) if rates else z[:, :0]

    def augment(self, x: Tensor, u: Tensor) -> Tensor:
        """State with the memory of the effects (N, nz), stationary under the input `u` (N, nu + n_exogenous)."""
        if self.nz == self.nx:
            return x
        starts, command = dict[int, Tensor](), u[:, : self.nu]
        for k in (*self._on_input, *self._on_force):
            effect = self._own[k]
            if effect.n_memory or effect.port is Port.INPUT:
                own = self._seen(k, x, command, u)
                starts[k] = effect.memory_start(x, own)
                if effect.port is Port.INPUT:
                    command = command + effect(0.0, x, own, starts[k])
        return join_columns((x, *(starts[k] for k in sorted(starts))))

    def remembered(self, x: Tensor, u: Tensor, u_before: Tensor | None, *, dt: float) -> Tensor:
        """State with the memory that the inputs until now have left (N, nz); differentiable.

        Of states now (N, nx), inputs from now on (N, nu + n_exogenous) and those held during the steps of `dt` [s]
        before, oldest first (N, K, nu + n_exogenous), or None. Memory is stationary under the first of all these
        inputs, and the state is held at `x` while it moves: assumed. Memory of inputs (lags, delays) does not read it,
        and that of other effects is right only as far as the state stays where it is. Effects of `whole_steps` are
        exact for inputs that are held over each step, however long it is. Others are followed by Runge and Kutta's
        method in shorter steps.
        """
        if u_before is None or self.nz == self.nx:
            return self.augment(x, u)
        if u_before.ndim != 3 or u_before.shape[::2] != (len(x), u.shape[-1]) or not u_before.shape[1]:
            raise ShapeError(
                f"`u_before` must be (batch={len(x)}, steps, nu={u.shape[-1]}) with at least one step; got "
                f"{tuple(u_before.shape)}."
            )
        memory = split_columns(self.augment(x, u_before[:, 0]), self.nx, self.nz - self.nx)[1]
        parts = 1 if self.whole_steps else _PARTS
        h, before = dt / parts, self.step
        self.set_step(h)
        try:
            for held in u_before.unbind(1):
                for _ in range(parts):
                    memory = self._advanced(x, memory, held, h)
        finally:
            self.set_step(before)
        return join_columns((x, memory))

    def _advanced(self, x: Tensor, memory: Tensor, u: Tensor, h: float) -> Tensor:
        """Memory after a step (Euler's where that is exact, else Runge and Kutta's of fourth order)."""
        start = join_columns((x, memory))

        def rate(m: Tensor) -> Tensor:
            return self.memory_rate(0.0, self.inner(start, join_columns((x, m))), u)

        k1 = rate(memory)
        if self.whole_steps:
            return memory + h * k1
        k2 = rate(memory + 0.5 * h * k1)
        k3 = rate(memory + 0.5 * h * k2)
        k4 = rate(memory + h * k3)
        return memory + (h / 6.0) * (k1 + 2.0 * (k2 + k3) + k4)

    def held_memory(self, t: Tensor, x: Tensor, u: Tensor, dt: float) -> tuple[Tensor, Tensor, Tensor]:
        """What effects know of their memory over steps (see `Effect.held`, `Effect.followed`).

        Of starts (n,) [s] of consecutive steps of a length `dt` [s], states there (n, nx), and inputs and exogenous
        channels held over each (n, nu + n_exogenous): memory at the start and at the end of each step, or its mean over
        it for both, (n, nz - nx) each, and whether each column is known (nz - nx,). What comes after an effect that
        does not know is not known.
        """
        ends = list(accumulate((effect.n_memory for effect in self._own), initial=0))
        memory, command = x.new_zeros(len(x), ends[-1]), u[:, : self.nu]
        known, after = torch.zeros(ends[-1], dtype=torch.bool), torch.zeros_like(memory)
        for k in self._on_input:
            effect, own = self._own[k], self._seen(k, x, command, u)
            columns = slice(ends[k], ends[k + 1])
            mean = memory[:, columns]
            if effect.n_memory:
                held = effect.held(own, dt)
                if held is None:
                    break
                pair = (held[:-1], held[1:]) if effect.estimated else (held, held)
                memory[:, columns], after[:, columns] = pair
                mean, known[columns] = 0.5 * (pair[0] + pair[1]), True
            command = command + effect(t, x, own, mean)
        for k, effect in enumerate(self._own):
            followed = effect.followed(x, dt) if k not in self._on_input else None
            if followed is None:
                continue
            columns, pair = slice(ends[k], ends[k + 1]), (followed[:-1], followed[1:])
            mean = 0.5 * (pair[0] + pair[1])
            memory[:, columns], after[:, columns] = pair if effect.estimated else (mean, mean)
            known[columns] = True
        return memory, after, known

    def quantity(self, name: str, x: Tensor, u: Tensor) -> Tensor:
        """One of `quantities` (N, its columns), from state and applied input."""
        raise KeyError(name)

    def applied(self, t: float | Tensor, z: Tensor, u: Tensor) -> Tensor:
        """Input after the effects on it (N, nu), from state and memory `z` (N, nz) and `u` as `drift` has it."""
        x, *memories = split_columns(z, *self._parts)
        return self._applied(t, x, u, memories, {})

    def _applied(
        self, t: float | Tensor, x: Tensor, u: Tensor, memories: Sequence[Tensor], rates: dict[int, Tensor]
    ) -> Tensor:
        """Input after the effects on it (N, nu), one after another; writes the rates of their memory."""
        command = u[:, : self.nu]
        for k in self._on_input:
            effect, own = self._own[k], self._seen(k, x, command, u)
            if effect.n_memory:
                rates[k] = effect.memory_rate(t, x, own, memories[k])
            command = command + effect(t, x, own, memories[k])
        return command

    def _as_it_is(self, t: float | Tensor, x: Tensor, u: Tensor) -> Tensor:
        """The state (N, nx) of which `x` is read."""
        for k in self._on_position:
            x = x + self._own[k](t, x, self._seen(k, x, u[:, : self.nu], u), x[:, :0])
        return x

    def _seen(self, k: int, x: Tensor, command: Tensor, u: Tensor) -> Tensor:
        """What effect k is given as its input: the command so far, its logged columns, its quantities."""
        return given(self, self._own[k], self._read[k], x, command, u)

    def all_declared(self) -> dict[str, tuple[Tensor, str]]:
        """Declared parameters of the system and of its effects: name -> (value (k,), unit)."""
        out = dict(self.declared_parameters())
        for effect in self._own:
            out |= {f"{effect.name}.{k}": v for k, v in effect.declared_parameters().items()}
        return out

    def check_rows(self, name: str, tensor: Tensor, width: int) -> None:
        """Refuse a tensor whose last axis is not `width`, by its name and the columns that were expected."""
        if tensor.shape[-1] != width:
            columns = ", ".join(self.state_names if width == self.nx else self.input_names)
            raise ShapeError(f"`{name}` must have {width} columns ({columns}); got {tensor.shape[-1]}.")
