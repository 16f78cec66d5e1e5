"""Sizes of effects: an amplitude such that the effect is a given share of what moves the machine.

    share = max over channels of rms(f_with - f_without) / std(f_without)

along runs of the machine without it. What enters nonlinearly (widths, times, levels, places) is drawn first, from
ranges relative to what these runs hold.
"""

from collections.abc import Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from nsde_torch.effects import Effect
from nsde_torch.simulation import simulate
from nsde_torch.simulation.battery import COLUMN
from nsde_torch.systems import System, make_plant_system

Values = dict[str, float | list[float]]

TIMES = {"mass_spring_damper": (0.01, 0.3), "cartpole": (0.01, 0.1), "hexacopter": (0.01, 0.1)}
"""Shortest and longest lag or delay [s]."""


class Nominal(NamedTuple):
    """Runs of a machine with its declared physics alone, all rows together."""

    system: System  # the machine
    t: Tensor  # times (N,) [s]
    x: Tensor  # states (N, nx)
    u: Tensor  # inputs and the battery's voltage (N, nu + 1), or inputs (N, nu)

    def size(self, column: int) -> float:
        """95 % quantile of the absolute value of a state."""
        return float(self.x[:, column].abs().quantile(0.95))


@cache
def nominal(system: str) -> Nominal:
    """Runs with noise as weak as it gets, of a seed of its own."""
    flying = system == "hexacopter"
    quiet = {"seed": 987_654, "sensor_noise": 0.0, "declared_only": True, "battery": flying}
    more = {"durations": [30.0, 30.0], "options": {"variants": 6, "rounds": 1}} if flying else {}
    made = simulate(system, **quiet, **more)
    extra = [np.column_stack([run.u, *run.extra.values()]) for run in made.runs]
    t, x, u = (np.concatenate(part) for part in ([r.t for r in made.runs], [r.x for r in made.runs], extra))
    plant = make_plant_system(system, declared_only=True).double()
    return Nominal(plant, torch.from_numpy(t), torch.from_numpy(x), torch.from_numpy(u))


@torch.no_grad()
def share_of(effect: Effect, system: str) -> float:
    """Share of what moves the machine that an effect without memory is."""
    base = nominal(system)
    assert not effect.n_memory
    nu = base.system.nu
    if effect.exogenous not in ((), (COLUMN,)):
        raise ValueError(f"{effect.name} reads {effect.exogenous}")
    plain = base.system.drift(base.t, base.x, base.u[:, :nu])
    held = base.system.with_effects(effect.double()).drift(base.t, base.x, base.u)
    scale = plain.std(0)
    moving = scale > 1e-3 * scale.max()
    return float(((held - plain).square().mean(0).sqrt() / scale)[moving].max())


def shapes(cls: type[Effect], system: str, rng: np.random.Generator) -> Values:
    """Parameters of an effect that it is not linear in, drawn."""
    base = nominal(system)

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    times = TIMES[system]
    speed, place = base.size(1), base.size(0)
    command = float(base.u[:, : base.system.nu].abs().quantile(0.95))

    def wind() -> list[float]:
        size, v = between(1.0, 4.0), rng.standard_normal(2)
        return [float(w) for w in size * v / np.linalg.norm(v)]

    drawn: dict[str, Any] = {
        "width": lambda: between(0.01, 0.05) * (base.size(3) if "pole" in cls.name else speed),
        "speed": lambda: between(0.1, 0.4) * speed,
        "frequency": lambda: between(0.4, 5.0),
        **dict.fromkeys(("time_constant", "rising", "falling"), lambda: between(*times)),
        "delay": lambda: between(*times),
        **dict.fromkeys(
            ("level", "level_forward", "level_backward"), lambda: command * rng.uniform(0.45, 0.97)
        ),
        "height": lambda: between(0.1, 0.3),
        "wind": wind,
        "half_gap": lambda: between(0.05, 0.4) * command,
        "reach": lambda: between(0.05, 0.4) * place,
        "length": lambda: place,
        "pitch": lambda: between(0.2, 0.8) * place,
        "moment": lambda: rng.uniform(0.3, 0.7) * float(base.t.max()),
        "place": lambda: [float(v) for v in rng.uniform(-1.0, 1.0, 2)],
        "order": lambda: float(rng.integers(1, 13)),
        "radius": lambda: between(0.4, 1.0),
        "weight": lambda: between(0.3, 1.2),
    }
    if cls.name in ("actuator_deadband", "asymmetric_deadband"):
        drawn = dict.fromkeys(cls.PARAMETERS, lambda: between(0.003, 0.4) * command)
    elif cls.name in ("burst", "gust_burst"):
        drawn["width"] = lambda: between(0.1, 0.6)
    return {name: drawn[name]() for name in cls.PARAMETERS if name not in cls.amplitudes}


def amplitudes(
    cls: type[Effect], system: str, shape: Mapping[str, Any], share: float, rng: np.random.Generator
) -> Values:
    """Amplitudes of an effect that make it this share of what moves the machine; signs and axes are drawn."""
    n_inputs = nominal(system).system.nu
    unit: Values = {}
    for name in cls.amplitudes:
        spec = cls.PARAMETERS[name]
        positive = spec.low is not None and spec.low >= 0.0
        if spec.per_input:
            row = [1e-6] * n_inputs
            row[int(rng.integers(n_inputs))] = 0.1
            unit[name] = row
        elif isinstance(spec.initial, tuple):
            row = [float(v) for v in rng.uniform(0.4, 1.0, len(spec.initial))]
            unit[name] = row if positive else [v * float(rng.choice((-1.0, 1.0))) for v in row]
        else:
            size = float(np.exp(rng.uniform(-0.7, 0.7))) if len(cls.amplitudes) > 1 else 1.0
            size *= 0.1 if spec.high is not None else 1.0  # of a share: it is scaled below
            unit[name] = size if positive else size * float(rng.choice((-1.0, 1.0)))
    effect = cls({**shape, **unit}, n_inputs=n_inputs)
    if effect.n_memory:  # a memory of size 1: the term is as large as its amplitude
        base = nominal(system)
        now = 1.0 / float(base.system.drift(base.t, base.x, base.u[:, :n_inputs]).detach()[:, 1].std())
    else:
        now = share_of(effect, system)
    out: Values = {}
    for name, value in unit.items():
        row = [float(v) * share / now for v in (value if isinstance(value, list) else [value])]
        if cls.PARAMETERS[name].high is not None:  # a share
            row = [float(np.clip(v, -0.5, 0.5)) for v in row]
        out[name] = row if isinstance(value, list) else row[0]
    return out
