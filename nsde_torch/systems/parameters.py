"""The declared parameters of a system as one vector theta, in their own units.

A copy of the system looks its parameters up in theta, so that a drift linear in the parameters stays linear (the raw
numbers of an optimiser distort it), derivatives in theta need no chain rule, and many thetas can be tried side by side
(torch.func.vmap over theta).
"""

import copy
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nsde_torch.arrays import Array
from nsde_torch.effects import Effect, Parametrised, Port, effect_class
from nsde_torch.effects.base import STRICTLY
from nsde_torch.effects.one_input import in_unit
from nsde_torch.errors import ConfigError
from nsde_torch.systems.base import System

# beside no drag, steps of a wind of 1e6 m/s led nowhere (tests/diagnosis/test_named.py)
_LONGEST = 10.0  # typical sizes of a parameter that one step may go
InRun = dict[str, Callable[[Tensor], Tensor]]
_AROUND = 100.0  # times that the typical size of an effect may differ from that of the data
_BEYOND = 4.0  # times the grid of a shape, at which it does not matter any more
_OUTSIDE = 1.5  # times the usual largest place: beyond, a place is in no data


@dataclass(frozen=True)
class Place:
    """Where a declared parameter stands in theta."""

    name: str  # `name` of the system's own, `effect.name` of an effect's
    unit: str
    columns: slice  # its columns of theta, one per axis


@final
class _Lookup:
    """What a module of the copy calls in place of `Parametrised.value`."""

    def __init__(self, own: dict[str, slice], theta: list[Tensor], in_run: InRun) -> None:
        self._own, self._theta, self._in_run = own, theta, in_run

    def __call__(self, name: str) -> Tensor:
        value = self._theta[0][..., self._own[name]]
        return self._in_run[name](value) if name in self._in_run else value


@final
class ParameterVector:
    """Declared parameters of a system as one vector; a ConfigError where there are none.

    The system is copied in double precision, and its values are the first theta.

    Attributes:
        system: The copy, without gradients, whose parameters are those of the last `use`.
        places: One entry per declared parameter.
        labels: One name per column of theta (`drag[0]` where there are axes).
        units: One unit per column.
        start: Values of the system (k,).
        low, high: Bounds (k,), infinite where there are none.
        scale: Typical size of each (k,).
        moves_memory: Whether the parameter is one of an effect that carries memory, or of one whose output such an
            effect follows: a dead band before a lag (k,).
        raised: Whether `limit` raised the lower bound of a shape that is measured by a size of the data (k,).
        per_input: Columns of sizes of which an effect has one per input, each 0 at least (losses of motors).
    """

    def __init__(self, system: System) -> None:
        self.system = copy.deepcopy(system).double().requires_grad_(False)
        self.system.set_step(0.0)  # whatever integrator the system came from
        self._theta: list[Tensor] = []
        self.places: list[Place] = []
        self.labels: list[str] = []
        self.units: list[str] = []
        self.per_input: list[slice] = []
        rows: list[tuple[float, float, float, float, bool]] = []
        effects = [(f"{e.name}.", e) for e in self.system.effects if isinstance(e, Effect)]
        last = max((e.stage for _, e in effects if e.port is Port.INPUT and e.n_memory), default=0)
        of_inputs = {*self.system.input_units}
        of_input = of_inputs.pop() if len(of_inputs) == 1 else "input"
        for prefix, module in [("", self.system), *effects]:
            assert isinstance(module, Parametrised)
            followed = isinstance(module, Effect) and module.port is Port.INPUT and module.stage < last
            carries = isinstance(module, Effect) and (module.n_memory > 0 or followed)
            own: dict[str, slice] = {}
            for name, (value, unit) in module.declared_parameters().items():
                k, spec, unit = value.numel(), module.parameter(name), in_unit(unit, of_input)
                own[name] = slice(len(rows), len(rows) + k)
                self.places.append(Place(prefix + name, unit, own[name]))
                if isinstance(module, Effect) and spec.per_input and module.null.get(name) == 0.0:
                    self.per_input.append(own[name])
                self.labels += [prefix + name] if k == 1 else [f"{prefix}{name}[{i}]" for i in range(k)]
                self.units += [unit] * k
                low = -np.inf if spec.low is None else spec.low
                high = np.inf if spec.high is None else spec.high
                scale = module.scale_of(name)
                if not isinstance(module, Effect) and spec.scale is None:
                    # an inertia of 2e-6 kg m2 had the typical size of 0.1, and its fit did not settle
                    scale = float(np.abs(spec.initial).max()) or scale
                rows += [(v, low, high, scale, carries) for v in value.tolist()]
            module.__dict__["value"] = _Lookup(own, self._theta, module.in_run)
        if not rows:
            raise ConfigError(
                f"system {system.name!r} declares no parameter that could be identified. Add physics "
                "(system.effects=[...]), or take another model."
            )
        self.start, self.low, self.high, self.scale = (
            np.array(column, dtype=np.float64) for column in list(zip(*rows, strict=True))[:4]
        )
        self.moves_memory = np.array([row[4] for row in rows])
        self.raised = np.zeros(len(rows), dtype=np.bool_)
        self.use(torch.as_tensor(self.start, device=next(self.system.parameters()).device))

    def __len__(self) -> int:
        return len(self.start)

    def of(self, effect: str) -> list[int]:
        """Numbers of the parameters of an effect."""
        return [j for j, label in enumerate(self.labels) if label.startswith(f"{effect}.")]

    def sizes(self, effect: str) -> list[int]:
        """Numbers of those parameters of an effect that say how strong it is (`Effect.size_names`)."""
        own = effect_class(effect).size_names()
        return [j for j in self.of(effect) if own_name(self.labels[j]) in own]

    def references(self, theta: Array, known: NDArray[np.bool_]) -> list[int]:
        """Columns that are held by convention: the median size per input, where the data show none of them.

        A loss of all motors is one of all gains: only differences of losses can be shown. Of an even number the smaller
        of both in the middle, as most motors are sound. From the smallest all others were too large: of twelve motors
        of three flights, four sound ones had intervals without 0 and two weak ones without the truth.
        """
        unknown = [s for s in self.per_input if not known[s].any()]
        return [s.start + int(np.argsort(theta[s])[(s.stop - s.start - 1) // 2]) for s in unknown]

    def use(self, theta: Tensor) -> None:
        """Take these values (k,), which may carry derivatives, for every following drift of the copy.

        Or (N, k), a row for each row of the batch, for systems whose formulas only multiply and add them by columns.
        """
        self._theta[:] = [theta]

    def inside(self, theta: Array) -> Array:
        """The nearest values (k,) strictly inside the bounds, as a system takes them."""
        # bounds of tiny motions lie close
        margin = np.minimum(STRICTLY * self.scale, 1e-3 * (self.high - self.low))
        return np.clip(theta, self.low + margin, self.high - margin)

    def size(self, theta: Array) -> Array:
        """Sizes of some values (k,): the typical ones, or what they are if that is larger."""
        return np.maximum(self.scale, np.abs(theta))

    def reach(self, theta: Array) -> tuple[Array, Array]:
        """Bounds of one step from some values (k,): those of the parameters, and ten of their sizes."""
        most = _LONGEST * self.size(theta)
        low, high = (self.inside(np.full(len(theta), end)) for end in (-np.inf, np.inf))
        return np.maximum(low, theta - most), np.minimum(high, theta + most)

    def follow(self, dt: float) -> None:
        """Raise the lower bounds of times so that steps of `dt` [s] follow the memory of the effects."""
        for place, effect, own in self._of_effects():
            effect.row_s = dt
            if (share := effect.resolved.get(own)) is not None:
                self.low[place.columns] = np.maximum(self.low[place.columns], share * dt)

    @torch.no_grad()
    def measure(self, t: Tensor, x: Tensor, u: Tensor) -> None:
        """Keep typical sizes of effects within a hundred times what makes all of the rates in some rows.

        Those of data: times (N,), states (N, nx) and inputs (N, nu + n).

        A voice coil moves 3 mm: its cubic stiffness of 2e8 1/(m2 s2) had a typical size of 1. Slopes in it were
        rounding, it stayed where it began, 8 % too large, and an inertia that is not there was sure.
        """
        system, theta = self.system, torch.as_tensor(self.start)
        z = system.project(system.augment(x, u))
        rates = system.drift(t, z, u)[:, : system.nx]
        whole = rates.square().mean(0).sqrt()
        for place, effect, own in self._of_effects():
            for j in range(*place.columns.indices(len(self))) if own in effect.amplitudes else ():
                moved = theta.clone()
                moved[j] += self.scale[j]
                self.use(moved)
                share = (system.drift(t, z, u)[:, : system.nx] - rates).square().mean(0).sqrt() / whole
                most = float(share[whole > 0].max()) if bool((whole > 0).any()) else 0.0
                if 0.0 < most < np.inf:
                    nothing = self.start[j] < self.low[j] + 2.0 * STRICTLY * self.scale[j]
                    self.scale[j] = _near(self.scale[j], self.scale[j] / most)
                    self.start[j] = self.low[j] + STRICTLY * self.scale[j] if nothing else self.start[j]
        self.use(torch.as_tensor(self.start))

    def limit(self, sizes: Mapping[str, float]) -> None:
        """Narrow the bounds of shapes to a few times the grid of their effect, at these sizes of the data.

        Their typical sizes too, as `measure` does those of what effects are linear in.

        A width far below every speed, or far above, changes nothing any more: a search would not find back. A fit that
        has come as far goes on (`nsde_torch.sysid.regression`).
        """
        for place, effect, own in self._of_effects():
            kind, per = effect.relative.get(own), effect.paced(own, sizes)
            self.scale[place.columns] *= per
            size = sizes.get(kind or "", 0.0) * per
            if size:  # of a spring that is driven by 1e-7 N a saturation was three laws
                self.scale[place.columns] = _near(self.scale[place.columns], size)
            if own in effect.null or own not in effect.shapes:
                continue
            grid = np.asarray(effect.shapes[own], dtype=np.float64)
            if not grid.size or (grid.min() <= 0 if kind is None else kind not in sizes):
                continue
            size = per * (1.0 if kind is None else sizes[kind])
            if grid.min() <= 0:
                # a place: a stop at -113 m, beyond all data, was a tilt and a damping of a cart
                self.low[place.columns] = np.maximum(self.low[place.columns], -_OUTSIDE * size)
                self.high[place.columns] = np.minimum(self.high[place.columns], _OUTSIDE * size)
                continue
            least = size * grid.min() / _BEYOND
            # a pendulum that turns fast now and then is slow in most rows: without it its dry friction was surely 2 %
            # too large (tests/diagnosis/test_own_machines.py)
            if kind is not None:
                least = min(least, sizes.get(f"slow {kind}", least))
            self.raised[place.columns] = (self.low[place.columns] < least) & (kind is not None)
            self.low[place.columns] = np.maximum(self.low[place.columns], least)
            self.high[place.columns] = np.minimum(self.high[place.columns], size * grid.max() * _BEYOND)

    def _of_effects(self) -> Iterator[tuple[Place, Effect, str]]:
        """Places of parameters of effects, with the effect and the name there."""
        effects = _effects_of(self.system)
        for place in self.places:
            effect, dot, own = place.name.partition(".")
            if dot:
                yield place, effects[effect], own

    def first_values(self, known: Mapping[str, float]) -> Array:
        """First values (k,), where a label is among these the value there."""
        return np.array([known.get(*pair) for pair in zip(self.labels, self.start.tolist(), strict=True)])

    def at_first(self) -> System:
        """A system of its own with the first values."""
        return self.at(self.start)

    def at(self, theta: Array) -> System:
        """A system of its own with other values (k,), moved inside the bounds."""
        out = copy.deepcopy(self.system)
        for module in (out, *_effects_of(out).values()):
            module.__dict__.pop("value", None)
        self.write(out, theta)
        return out

    def write(self, system: System, theta: Array) -> None:
        """Set the values of a system of the same physics, moved inside the bounds."""
        values = torch.as_tensor(self.inside(theta))
        effects = _effects_of(system)
        for place in self.places:
            effect, dot, own = place.name.partition(".")
            owner: Parametrised = effects[effect] if dot else system
            owner.set_value(own if dot else place.name, values[place.columns])


def _near(scale: Array, size: float) -> Array:
    """Typical sizes, as near as they may be to one of the data."""
    return np.clip(scale, size / _AROUND, size * _AROUND)


def _effects_of(system: System) -> dict[str, Effect]:
    return {str(e.name): e for e in system.effects if isinstance(e, Effect)}


def own_name(label: str) -> str:
    """Name of a parameter within its effect, from a label: `size` of `friction.size[1]`; empty of the system's own."""
    return label.partition(".")[2].partition("[")[0]


def frozen(system: System, *, dtype: torch.dtype = torch.float64) -> System:
    """A copy with its parameters as they are now, worked out in double precision and then of a `dtype`."""
    system = copy.deepcopy(system).double().requires_grad_(False)
    for module in system.modules():
        if isinstance(module, Parametrised):
            values = {name: value.clone() for name, (value, _) in module.declared_parameters().items()}
            for name, value in values.items():
                module.register_buffer(f"frozen_{name}", value, persistent=False)
            module.__dict__["value"] = _Values(module)
    return system.to(dtype=dtype)


@final
class _Values:
    """Looks up the frozen parameters of a module, wherever they have been moved to."""

    def __init__(self, module: Parametrised) -> None:
        self._buffers = module._buffers

    def __call__(self, name: str) -> Tensor:
        value = self._buffers[f"frozen_{name}"]
        assert value is not None
        return value
