"""Springs, hidden masses, stores, hysteresis, weights and stops of one coordinate, and the zero of its sensor.

q is its position, v its velocity.
"""

from abc import abstractmethod
from math import exp, expm1, pi
from typing import ClassVar

import torch
from torch import Tensor

from nsde_torch.effects.base import Effect, Parameter, Port, Size, in_row
from nsde_torch.effects.coordinates import KINDS, PLACE, STORE, Bound
from nsde_torch.effects.law import Law


class LinearSpring(Law):
    """A spring to the origin."""

    reads_position = True
    kinds = ("rail", "joint")
    formula = "-k q"
    source = "supplement B: m q'' = -b q' - k q"
    stiffness = Size(1.0, "force/position", low=0.0, help="spring constant")
    along = "position"
    sentence = "A spring pulls {it} to the origin with {stiffness}."
    separate = "push at several amplitudes"

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return -self.stiffness * self.q(x)


class CubicStiffness(Law):
    """A spring that hardens (or softens) with its extension."""

    reads_position = True
    kinds = ("rail", "joint")
    formula = "-k q^3"
    source = "Duffing (1918)"  # Erzwungene Schwingungen bei veraenderlicher Eigenfrequenz
    stiffness = Size(0.0, "force/position3", scale=1.0, help="cubic constant")
    along = "position"
    sentence = "A spring against {it} changes with extension: a force of {stiffness} times the cube of it."
    separate = "push at several amplitudes, far beyond the usual ones"

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        q = self.q(x)
        return -self.stiffness * q * q * q


class HiddenSwing(Effect):
    """A mass that hangs on a machine and is not in the log: its place y follows the machine's, and pulls back.

    y'' = w^2 (q - y) + 2 d w (q' - y');  memory holds y - q and y', in one or two directions.
    """

    damping = Parameter(
        0.1, "1", low=0.005, high=1.0, scale=0.05, help="damping, as a ratio to the critical one"
    )
    states = 2  # how far it is ahead of the machine, and its velocity, in each direction
    estimated = True

    @abstractmethod
    def swing(self) -> Tensor:
        """Its frequency w [rad/s] (1,), the machine held."""

    @abstractmethod
    def velocity(self, x: Tensor) -> Tensor:
        """Velocity of the machine (N, directions), from the state."""

    def pull(self, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """Force on the machine (N, directions)."""
        return -self.value("mass") * self.acceleration(x, u, memory)

    def acceleration(self, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """y'' (N, directions)."""
        w, (ahead, speed) = self.swing(), memory.chunk(2, 1)
        return -w * (w * ahead + 2.0 * self.damping * (speed - self.velocity(x)))

    def memory_rate(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        speed = memory[:, self.states // 2 :]
        return torch.cat((speed - self.velocity(x), self.acceleration(x, u, memory)), 1)

    def followed(self, x: Tensor, dt: float) -> Tensor:
        """See `Effect.followed`; exact for a velocity that is a straight line between the rows."""
        import numpy as np
        from scipy.linalg import expm

        from nsde_torch.effects.recursions import second_order

        w, damping = float(self.swing().detach()), float(self.damping.detach())
        rub = 2.0 * damping * w
        # rates of [ahead, speed, velocity, its slope]
        rates = np.array([[0, 1, -1, 0], [-w * w, -rub, rub, 0], [0, 0, 0, 1], [0, 0, 0, 0]])
        v = self.velocity(x).double().numpy()
        slope = np.diff(v, axis=0, append=v[-1:]) / dt
        along = second_order(expm(rates * dt)[:2], np.stack((np.zeros_like(v[0]), v[0])), v, slope)
        return torch.from_numpy(along).to(x.dtype)

    def memory_start(self, x: Tensor, u: Tensor) -> Tensor:
        v = self.velocity(x)  # it moves along
        return torch.cat((torch.zeros_like(v), v), 1)


class HiddenMass(HiddenSwing, Law):
    """A further mass on a spring that is not in the log: liquid that sloshes, a flexible arm."""

    formula = "-m y'', y'' = w^2 (q - y) + 2 d w (v - y'), w = 2 pi f"
    source = "the absorber of den Hartog, Mechanical Vibrations (1934)"
    mass = Size(0.1, "force s/speed", low=0.0, help="hidden mass (over mass, where forces are)")
    frequency = Parameter(1.0, "Hz", low=0.0, scale=0.5, help="of it alone, the machine held")
    shapes = {"frequency": (0.5, 1.5, 4.5), "damping": (0.02, 0.2)}
    fitted_from = tuple({"frequency": 0.4 * 2.0 ** (0.5 * k)} for k in range(9))
    sentence = (
        "A hidden mass of {mass} swings on {it}: {frequency} if the machine is held, with {damping} of the critical "
        "damping."
    )
    separate = "stop the machine at once and hold it: what swings on is not in the log"

    def swing(self) -> Tensor:
        return 2.0 * pi * self.frequency

    def velocity(self, x: Tensor) -> Tensor:
        return self.v(x)

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return self.pull(x, u, memory)


class AddedInertia(Law):
    """What moves is heavier or longer than declared: it accelerates by a share less, whatever pushes it.

    A ball that is hollow, a pole that is longer and a rope of another length were hidden masses that hardly resonate.
    """

    port = Port.INERTIA
    formula = "-s v', of the acceleration that all else makes"
    source = "Newton's second law with another inertia"
    share = Size(0.0, "1", low=-1.0, high=0.9, scale=0.1, help="of the acceleration that is missing")
    sentence = (
        "{it} accelerates by a share of {share} less than declared (below 0: more): as if its inertia or its length "
        "were larger (smaller) by that share of what it is, or a constant of its equation is another one."
    )
    not_of = dict.fromkeys(("mass_spring_damper", "cartpole"), "its parameters are that")
    separate = "weigh and measure it, or swing it freely"

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return -self.share.expand(x.shape[0], 1)

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """The share of the rate of the whole state that it adds (N, nx)."""
        return in_row(self.term(t, x, u, memory), self.at.velocity, x.shape[1])


class _Slow(Law):
    """A law of what follows the velocity slowly: memory holds m, dm/dt = (v - m) / T."""

    time = Parameter(1.0, "s", low=0.0, help="in which it follows")
    states = 1  # what follows
    estimated = True
    # of ten steps at least: what follows at once is inertia, or a friction (a ball that is hollow)
    shapes = {"time": (40.0, 160.0, 640.0)}
    relative = {"time": "step"}
    ends = ("time",)

    def memory_rate(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return (self.v(x) - memory) / self.time

    def followed(self, x: Tensor, dt: float) -> Tensor:
        """See `Effect.followed`; exact for a velocity that is a straight line between the rows."""
        from scipy.signal import lfilter

        v, ratio = self.v(x)[:, 0].double().numpy(), dt / float(self.time.detach())
        stays = exp(-ratio)
        mean = -expm1(-ratio) / ratio  # of what stays, over a step
        start = float(self.memory_start(x[:1], x[:1])[0, 0])
        follows = (mean - stays) * v[:-1] + (1.0 - mean) * v[1:]
        rows = lfilter([1.0], [1.0, -stays], follows, zi=[stays * start])[0]
        last = stays * (rows[-1] if len(rows) else start) + (1.0 - stays) * v[-1]
        return torch.tensor([start, *rows, last], dtype=x.dtype)[:, None]


class Viscoelasticity(_Slow):
    """A spring behind a damper: rubber or a seal whose force fades where it is held."""

    formula = "-k T m, dm/dt = (v - m) / T"
    source = "Maxwell, Philosophical Transactions 157 (1867)"
    stiffness = Size(1.0, "force/position", low=0.0, help="against what is quick")
    sentence = (
        "A spring of {stiffness} holds {it}, and gives way in {time} where it is held (viscoelasticity)."
    )
    separate = "move it at once and hold it there: the force fades"

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return -self.stiffness * self.time * memory

    def memory_start(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.zeros_like(self.v(x))  # without force


class Relaxation(_Slow):
    """What is stored beside a state and comes back late: a wall's heat, a battery's second relaxation, a fluid."""

    kinds = KINDS
    formula = "c (m - v), dm/dt = (v - m) / T"
    source = "two stores in exchange; Plett, Battery Management Systems, volume 1 (2015), on pairs of R and C"
    exchange = Size(0.1, "force/speed", low=0.0, help="with what is stored")
    sentence = "Something that is not in the log follows {it} in {time}, and pulls it back with {exchange}."
    separate = "take it away quickly and hold the inputs: it then drifts back towards where it was"

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return self.exchange * (memory - self.v(x))

    def memory_start(self, x: Tensor, u: Tensor) -> Tensor:
        return self.v(x)  # in equilibrium


class Exchange(Law):
    """What a store loses to its surroundings, which stay as they are: heat to a room, a leak, self-discharge.

    Without it a reactor's loss of heat was a loss of its coolant, which is 312 to 337 K, and a slow relaxation.
    """

    kinds = (STORE,)
    formula = "a - c v"
    source = "Newton's law of cooling; a leak of a tank or a capacitor to first order"
    rate = Size(0.0, "force/speed", scale=0.1, help="share that is lost per second")
    inflow = Size(0.0, "force", scale=0.1, help="what comes in from around, `rate` times its level")
    sentence = (
        "{it} loses {rate} of what it is and gains {inflow}, in exchange with surroundings that stay as they are: at a "
        "level of the one over the other."
    )
    separate = "hold the inputs and wait: it goes to a level that the inputs do not explain"

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return self.inflow - self.rate * self.v(x)


class DriftVelocity(Law):
    """A position changes by more than the velocities say: a current under a boat, water or air that carries it along.

    Without it the current of two boats was rudders that are late and a heading whose zero changes.
    """

    kinds = (PLACE,)
    formula = "c, added to the rate of a position"
    source = (
        "Fossen, Handbook of Marine Craft Hydrodynamics and Motion Control (2011), on irrotational currents"
    )
    velocity = Size(0.0, "force", scale=0.1, help="in the direction of this position")
    sentence = "{it} changes by {velocity} more than the velocities say: a current carries the machine along."
    separate = (
        "turn the machine: a current keeps its direction in the world, a velocity that is read wrong does not"
    )

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return self.velocity.expand(x.shape[0], 1)


_FOLLOWED = 1.6  # reaches within a row, of which a step of Runge and Kutta's leaves least


class Hysteresis(Law):
    """A force that depends on the way it came: a spring that yields, rubber, cables, presliding friction (Bouc-Wen).

    Of the model with exponent 1, z in [-1, 1]: of a weight w of 1 it is Dahl's friction. Where d goes to nothing it is
    dry friction. With a weight of 0.5 alone, a piezo stage of 0.75 had six more effects that mended it.
    """

    reads_position = True
    states = 1  # the share z of the force at which it yields
    formula = "-s z, dz/dt = (v - w |v| z - (1 - w) v |z|) / d"
    source = "Bouc, Acustica 24 (1971); Wen, J. Eng. Mech. Div. 102 (1976); Dahl, AIAA Journal 14 (1976)"
    size = Size(0.1, "force", low=0.0, help="force where it yields")
    reach = Parameter(0.05, "position", low=0.0, help="way in which it builds up")
    weight = Parameter(0.5, "1", low=0.1, high=1.5, scale=0.1, help="of |v| z; the rest is of v |z|")
    shapes = {"reach": (0.05, 0.2, 0.6), "weight": (0.5,)}
    smooth = ("weight",)
    # what it is at the start is not known, and a long reach does not forget it: sizes were 2 errors off
    estimated = True
    relative = {"reach": "position"}
    includes = ("coulomb_friction",)
    sentence = (
        "The force on {it} remembers the way it came (hysteresis): it builds up within {reach} after each turn and "
        "yields at {size}."
    )
    separate = "move to and fro slowly, with small and large strokes: friction turns at once, hysteresis over its reach"

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return -self.size * memory

    def memory_rate(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        v, z = self.v(x), memory.clamp(-1.0, 1.0)
        rate = (v - self.weight * v.abs() * z - (1.0 - self.weight) * v * z.abs()) / self.reach
        if self.row_s:  # explicit steps follow it no faster: of a short reach it turns round in some rows
            rate = rate / (1.0 + (v.abs() * self.row_s / (_FOLLOWED * self.reach)) ** 4) ** 0.25
        return rate

    def followed(self, x: Tensor, dt: float) -> Tensor:
        from nsde_torch.effects.recursions import bouc_wen

        v, reach = self.v(x)[:, 0], float(self.reach.detach())
        ways = torch.cat((0.5 * (v[1:] + v[:-1]), v[-1:])) * (dt / reach)
        z = bouc_wen(ways.double().numpy(), float(v[0].sign()), float(self.weight.detach()))
        return torch.from_numpy(z)[:, None].to(x.dtype)

    def memory_start(self, x: Tensor, u: Tensor) -> Tensor:
        return self.v(x).sign()  # it has come this way for long


class _OfAngle(Law):
    """A wave of an angle."""

    kinds = ("joint", "axis")
    reads_position = True
    sine = Size(0.0, "force", scale=0.1, help="part that is nothing at the origin")
    cosine = Size(0.0, "force", scale=0.1, help="part that is largest at the origin")

    def wave(self, angle: Tensor) -> Tensor:
        return self.sine * torch.sin(angle) + self.cosine * torch.cos(angle)


class Ripple(_OfAngle):
    """A force that repeats a number of times a turn: the teeth of a motor, an axis out of balance."""

    formula = "a sin(n q) + b cos(n q)"
    source = "cogging torque, Proca et al., IEEE Transactions on Energy Conversion 18 (2003)"
    sine, cosine = _OfAngle.sine, _OfAngle.cosine
    order = Parameter(6.0, "1", low=0.5, scale=1.0, help="repeats in a turn")
    along = "position"
    # over many turns an order is not reached from the next one (tests/diagnosis/test_own_machines.py)
    shapes = {"order": tuple(map(float, range(1, 25)))}
    includes = ("gravity_torque",)
    sentence = "A force on {it} repeats {order} times a turn (sine {sine}, cosine {cosine})."
    separate = "turn slowly through the whole range, to and fro"

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return self.wave(self.order * self.q(x))


class _Stop(Law):
    """A stop: nothing on one side of its end, and a spring whose damping grows with the depth on the other.

    A spring that was slack within 0.06 m was a peak, a cube, a sign and a sine without stops, two of them sure. One
    effect with two ends found one of them (springs between stops, seeds 1 and 2 of ten).
    """

    side: ClassVar[float]  # 1 of an upper end, -1 of a lower one
    kinds = ("rail", "joint")
    reads_position = True
    source = "contact as spring and damper; Hunt, Crossley, Journal of Applied Mechanics 42 (1975)"
    stiffness = Size(1.0, "force/position", low=0.0, help="of the stop")
    damping = Size(0.1, "force/(speed position)", low=0.0, help="beyond the end, by depth")
    end = Parameter(0.0, "position", scale=0.1, help="where it begins")
    along = "position"
    local = True
    relative = {"end": "position"}
    separate = "move slowly up to the end and beyond"

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        beyond = self.side * torch.relu(self.side * (self.q(x) - self.end))
        return -self.stiffness * beyond - self.damping * beyond.abs() * self.v(x)


class StopAbove(_Stop):
    """A stop at the upper end, or one side of a spring with play."""

    side = 1.0
    formula = "-k d - b |d| v, d = max(q - end, 0)"
    shapes = {"end": (-0.4, -0.1, 0.1, 0.25, 0.4, 0.6, 0.8, 0.95)}
    sentence = "A stop holds {it} above {end}, with {stiffness} and {damping}."


class StopBelow(_Stop):
    """A stop at the lower end, or one side of a spring with play."""

    side = -1.0
    formula = "-k d - b |d| v, d = min(q - end, 0)"
    shapes = {"end": (0.4, 0.1, -0.1, -0.25, -0.4, -0.6, -0.8, -0.95)}
    sentence = "A stop holds {it} below {end}, with {stiffness} and {damping}."


class LinkWeight(_OfAngle):
    """Weight of one link of a planar chain of joints, which turns its own joint and all before it.

    The angle of each joint counts from the link before it, so that link k leans by the sum of the first k angles. An
    arm whose controller makes up for a wrong weight, or that carries a load, was five provisional terms without it.
    """

    reads_chain = True
    formula = "a sin(s) + b cos(s) on this and all joints before, s = q1 + ... + q"
    source = "gravity terms of a planar arm; Craig, Introduction to Robotics (2005), chapter 6"
    sentence = "The link of {it} weighs more or less than declared (sine {sine}, cosine {cosine})."
    separate = "hold the arm still in many postures"

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return self.wave(x[:, [position for _, position in self.at.chain]].sum(1, keepdim=True))

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        rows = torch.zeros(self.at.width, dtype=x.dtype, device=x.device)
        rows[[row for row, _ in self.at.chain]] = 1.0
        return self.term(t, x, u, memory) * rows


class GravityTorque(_OfAngle):
    """Weight beside the axis of one joint: a pendulum that is heavier or longer than declared, or of another zero.

    Of a Furuta pendulum whose weight was a fifth too small it was a `ripple` of order 0.997, provisional.
    """

    formula = "a sin(q) + b cos(q)"
    source = "gravity term of a pendulum; Craig, Introduction to Robotics (2005), chapter 6"
    along = "position"
    sentence = "A weight that is not declared turns {it} (sine {sine}, cosine {cosine})."
    not_of = {"cartpole": "gravity and track_tilt are that"}
    separate = "let it hang, and hold it in several postures"

    @classmethod
    def suits(cls, at: Bound) -> bool:
        """Whether it is an angle, and not the first of a chain, whose `link_weight` it is."""
        return super().suits(at) and dict(at.units)["position"] == "rad" and len(at.chain) != 1

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return self.wave(self.q(x))


class PositionBias(Law):
    """The sensor of a position reads too much, by the same everywhere: all physics is at the position that is."""

    port = Port.POSITION
    reads_position = True
    formula = "q - b, for all that depends on q"
    source = "zero of a rotary encoder; Craig, Introduction to Robotics (2005), on kinematic parameters"
    bias = Parameter(0.0, "position", scale=0.02, help="what is read where the position is zero")
    null = {"bias": 0.0}
    sentence = "The sensor of the position of {it} reads {bias} too much."
    separate = "let it hang at rest: what is read there is the bias"

    def term(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return -self.bias.expand(x.shape[0], 1)

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        """What is to be added to the state (N, nx)."""
        k = self.at.position
        assert k is not None
        return in_row(self.term(t, x, u, memory), k, x.shape[1])
