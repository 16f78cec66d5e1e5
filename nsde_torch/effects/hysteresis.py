"""Laws that remember the way a machine came: hysteresis of a coordinate, play between an input and what it moves.

    hysteresis    F = -s z,   dz/dt = (v - (|v| z + v |z|) / 2) / d      z in [-1, 1]
    play          u_eff stays where it is until the command has moved by the gap: |u - u_eff| <= w

(Bouc, Modele mathematique d'hysteresis, Acustica 24 (1971); Wen, Method for random vibration of hysteretic systems,
Journal of the Engineering Mechanics Division 102 (1976), with exponent 1 and equal weights. Tao, Kokotovic, Adaptive
Control of Systems with Actuator and Sensor Nonlinearities (1996), for play.) Where d goes to nothing, hysteresis is dry
friction.
"""

from __future__ import annotations

from math import exp
from typing import final

import torch
from torch import Tensor

from nsde_torch.effects.actuators import BOOK
from nsde_torch.effects.base import Effect, Parameter, Port
from nsde_torch.effects.law import Law

_QUICK_S = 0.002  # in which play is taken up where no step is known [s]


@final
class Hysteresis(Law):
    """A force that depends on the way it came: a spring that yields, rubber, cables, presliding friction (Bouc-Wen)."""

    name = "hysteresis"
    reads_position = True
    formula = "-s z, dz/dt = (v - (|v| z + v |z|) / 2) / d"
    source = "Bouc, Acustica 24 (1971); Wen, J. Eng. Mech. Div. 102 (1976)"
    PARAMETERS = {
        "size": Parameter(0.1, "force", low=0.0, help="force where it yields"),
        "reach": Parameter(0.05, "position", low=0.0, help="way in which it builds up"),
    }
    null = {"size": 0.0}
    amplitudes = ("size",)
    shapes = {"reach": (0.05, 0.2, 0.6)}
    relative = {"reach": "position"}
    includes = ("coulomb_friction",)
    sentence = (
        "The force on {it} remembers the way it came (hysteresis): it builds up within {reach} after each turn and "
        "yields at {size}."
    )
    separate = "move to and fro slowly, with small and large strokes: friction turns at once, hysteresis over its reach"

    @property
    def n_memory(self) -> int:
        """The share z of the force at which it yields."""
        return 1

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Law.term`."""
        return -self.value("size") * memory

    def memory_rate(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.memory_rate`."""
        v, z = self.v(x), memory.clamp(-1.0, 1.0)
        return (v - 0.5 * (v.abs() * z + v * z.abs())) / self.value("reach")

    def followed(self, x: Tensor, dt: float) -> Tensor:
        """See `Effect.followed`: while v keeps its sign, z is a line or an exponential of the way."""
        v, reach = self.v(x)[:, 0], float(self.value("reach").detach())
        ways = torch.cat((0.5 * (v[1:] + v[:-1]), v[-1:])) * (dt / reach)
        z = float(v[0].sign())
        ends = [z]
        for way in ways.tolist():
            side = 1.0 if way > 0 else -1.0
            z, left = side * z, abs(way)
            straight = min(left, max(-z, 0.0))  # up to nothing
            z, left = z + straight, left - straight
            z = side * (1.0 - (1.0 - z) * exp(-left) if left > 0 else z)
            ends.append(z)
        along = torch.tensor(ends, dtype=x.dtype)[:, None]
        return 0.5 * (along[1:] + along[:-1])

    def memory_start(self, x: Tensor, u: Tensor) -> Tensor:
        """See `Effect.memory_start`: it has come this way for long."""
        return self.v(x).sign()


@final
class InputPlay(Effect):
    """Play (backlash) between an input and what it moves: after a turn nothing moves until the gap is taken up."""

    name = "input_play"
    port = Port.INPUT
    stage = 1
    whole_steps = True
    jumps = True
    excludes = (Port.BODY_MOMENT,)  # rotors have none
    formula = "u_eff = m, |u - m| <= w"
    source = BOOK
    PARAMETERS = {"gap": Parameter(0.1, "input", low=0.0, scale=0.1, help="half the play")}
    null = {"gap": 0.0}
    shapes = {"gap": (0.05, 0.2, 0.5)}
    relative = {"gap": "input"}
    sentence = (
        "Between the input and what it moves there is play: it remembers the way it came, and after a turn nothing "
        "moves until the input has gone back by twice {gap}."
    )
    separate = (
        "give slow triangles of the input, small and large: a delay shifts them in time, play cuts their tops"
    )

    @property
    def n_memory(self) -> int:
        """One state per input: what acts."""
        return self.n_inputs

    def _taken_up(self, u: Tensor, memory: Tensor) -> Tensor:
        own, gap = u[:, : self.n_inputs], self.value("gap")
        return torch.minimum(torch.maximum(memory, own - gap), own + gap)

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.forward`."""
        return self._taken_up(u, memory) - u[:, : self.n_inputs]

    def memory_rate(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """See `Effect.memory_rate`."""
        return (self._taken_up(u, memory) - memory) / (self.step or _QUICK_S)

    def held(self, u: Tensor, dt: float) -> Tensor:
        """See `Effect.held`."""
        own, gap = u[:, : self.n_inputs].numpy(), float(self.value("gap").detach())
        out = torch.empty_like(u[:, : self.n_inputs])
        for k in range(self.n_inputs):
            acts, rows = float(own[0, k]), []
            for command in own[:, k].tolist():
                acts = min(max(acts, command - gap), command + gap)
                rows.append(acts)
            out[:, k] = torch.tensor(rows, dtype=u.dtype)
        return out

    def memory_start(self, x: Tensor, u: Tensor) -> Tensor:
        """See `Effect.memory_start`: in the middle of the play."""
        return u[:, : self.n_inputs]
