"""What lies between a command and the force that it makes.

(Tao, Kokotovic, "Adaptive Control of Systems with Actuator and Sensor Nonlinearities", 1996, for dead band,
saturation and play.)
"""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from math import exp, floor, pi

import torch
from torch import Tensor

from nsde_torch.effects.base import Effect, Parameter, Port, Size, elapsed

BOOK = "Tao, Kokotovic, Adaptive Control of Systems with Actuator and Sensor Nonlinearities (1996)"
FLYING = ("hexacopter", "quadrotor")
NONE = 1e6
"""A level of saturation that no command reaches."""
_SHORTEST_S = 1e-6  # time of a memory: that of an amplifier's current, logged at 10 kHz, is 0.3 ms
_QUICK_S = 0.002  # in which play is taken up where no step is known [s]


class InputMemory(Effect):
    """An effect on the inputs with states of each, the first of which follows it and begins there, the others at 0."""

    port = Port.INPUT
    states = 1  # of each input

    @property
    def n_memory(self) -> int:
        return self.states * self.n_inputs

    def own(self, u: Tensor) -> Tensor:
        """The inputs (N, n_inputs), from `u` of `forward`."""
        return u[:, : self.n_inputs]

    def memory_start(self, x: Tensor, u: Tensor) -> Tensor:
        own = self.own(u)
        return own if self.states == 1 else torch.cat((own, torch.zeros_like(own)), 1)


class _Cut(Effect):
    """Commands within two ends and beyond are treated unlike; a number for both ends, or one for each."""

    port = Port.INPUT
    stage = 1
    source = BOOK

    def cut(self, u: Tensor) -> Tensor:
        """Commands cut to the ends."""
        ends = [self.value(name) for name in self.PARAMETERS]
        return torch.minimum(torch.maximum(u, -ends[-1]), ends[0])


# A pure delay of the inputs, as a rational approximation with two states a, b per input.
#
#     exp(-s T)  ~  (1 - s T / 3) / (1 + 2 s T / 3 + (s T)^2 / 6)                          (Pade, order [1/2])
#
#     da/dt = b / T,   db/dt = (6 u - 6 a - 4 b) / T,   u_eff = a - b / 3
#
# It is strictly proper, so that a step of the input does not jump through, and right to the third order in s
# T: the phase is within 0.01 rad up to s T = 1. Where inputs are held over steps, as a log has them, the mean
# of what arrives over step k is exact: T = (n + r) h gives (1 - r) u_{k-n} + r u_{k-n-1}.
#
# An integrator whose steps of h are longer than T / 2 gets just that. With q = h / T and r = T / h - 1 (not
# below 0), v1 and v2 are the inputs of the two steps before, less u. Memory holds them so that what is still
# to arrive and the slope of the input mean the same as in the formula: it may be handed from a fine grid to a
# coarse one.
#
#     a + b / 6 - u = (v1 + r v2) / (1 + r),   b = (v1 - v2) / q
#
# With shorter steps it gets the exact solution for held inputs, c = exp(-2 q) cos(w q), s = exp(-2 q) sin(w
# q) / w and w^2 = 2, and the mean of u_eff over the step, which follows from u_eff = u - T d(a + b / 6)/dt:
#
#     da = (c - 1 + 2 s) (a - u) + s b,   db = -6 s (a - u) + (c - 1 - 2 s) b,   mean = u - (da + db / 6) / q


class InputDelay(InputMemory):
    """The inputs act some time after they were logged."""

    each_input = True
    states = 2
    stage = 0
    whole_steps = True
    formula = "u_eff(t) = u(t - T), by a rational approximation"
    source = "Pade approximant [1/2] of exp; Golub, Van Loan, Matrix Computations, section 9.3"
    delay = Parameter(0.02, "s", low=_SHORTEST_S, scale=0.02, help="time from log to effect")
    null = {"delay": 0.0}
    resolved = {"delay": 0.1}
    # a delay by another whole number of steps is another input: what is tried must lie within a step of the truth
    shapes = {"delay": (0.5, 1.5, 2.5, 3.5, 4.5, 6.0, 8.0, 11.0, 15.0, 20.0)}
    relative = {"delay": "step"}
    sentence = "The inputs act {delay} after the log says so."
    separate = "give steps of the input: a lag rounds their corner, a delay moves it"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        a, b = memory[:, : self.n_inputs] - self.own(u), memory[:, self.n_inputs :]
        if not self.step:
            return a - b / 3.0
        steps = self.delay / self.step
        da, db = _solved(steps, a, b)
        shifted = steps.clamp_max(1.0) * (a + b / 6.0) - _beyond(steps).square() * b
        return torch.where(steps < 2.0, shifted, -steps * (da + db / 6.0))

    def memory_rate(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        a, b = memory[:, : self.n_inputs] - self.own(u), memory[:, self.n_inputs :]
        delay = self.delay
        if not self.step:
            return torch.cat((b, -6.0 * a - 4.0 * b), 1) / delay
        steps = delay / self.step
        first = a + b / 6.0 + _beyond(steps) / steps * b  # v1, which is v2 a step later
        shifted = torch.cat(((_beyond(steps) + steps / 6.0) * first - a, -steps * first - b), 1)
        return torch.where(steps < 2.0, shifted, torch.cat(_solved(steps, a, b), 1)) / self.step

    def held(self, u: Tensor, dt: float) -> Tensor:
        steps = float(self.delay) / dt
        whole = floor(steps)
        rows = torch.arange(len(u), device=u.device) - whole
        now, before = u[rows.clamp_min(0), : self.n_inputs], u[(rows - 1).clamp_min(0), : self.n_inputs]
        arriving = now + (steps - whole) * (before - now)
        return torch.cat((arriving, torch.zeros_like(arriving)), 1)


def _beyond(steps: Tensor) -> Tensor:
    """Share of a delay that is beyond one step, r / (1 + r)."""
    return (steps - 1.0).clamp_min(0.0) / steps


def _solved(steps: Tensor, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Changes of both states over a step, from their distances to rest; `steps` is the delay in steps."""
    q, w = 1.0 / steps, 2.0**0.5
    decay = torch.exp(-2.0 * q)
    s = decay * torch.sin(w * q) / w
    c = torch.expm1(-2.0 * q) - 2.0 * decay * torch.sin(0.5 * w * q).square()  # no difference of near numbers
    return (c + 2.0 * s) * a + s * b, (c - 2.0 * s) * b - 6.0 * s * a


# Actuators that follow their command with a first-order lag; each input carries one state m.
#
# u_eff = m,   dm/dt = (u - m) / tau
#
# An integrator whose steps of h hold the input gets the exact memory after each, and the exact mean of m over
# it:
#
# m' = m + (u - m) (1 - e),   mean = u + (m - u) (1 - e) tau / h,   e = exp(-h / tau)


class _AnyLag(InputMemory):
    """A first-order lag on every input, whose time constant may depend on where the input is from the memory."""

    stage = 2
    whole_steps = True
    separate = "give steps of the input: a lag rounds their corner, a delay moves it"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        late = memory - self.own(u)
        if not self.step:
            return late
        time_constant = self._time_constant(-late)
        return late * self._goes(time_constant) * (time_constant / self.step)

    def memory_rate(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        late = self.own(u) - memory
        time_constant = self._time_constant(late)
        return late * (self._goes(time_constant) / self.step) if self.step else late / time_constant

    @abstractmethod
    def _time_constant(self, late: Tensor) -> Tensor:
        """Time constants of inputs that are so far above their memory (N, nu), or of all [s]."""

    def _goes(self, time_constant: Tensor) -> Tensor:
        """Share of the remaining difference that a step closes."""
        return -torch.expm1(-self.step / time_constant)


class Lag(_AnyLag):
    """A first-order lag on every input."""

    formula = "u_eff = m, dm/dt = (u - m) / tau"
    time_constant = Parameter(0.05, "s", low=_SHORTEST_S, help="time to reach 63 %")
    null = {"time_constant": 0.0}
    shapes = {"time_constant": (0.02, 0.06, 0.2)}
    resolved = {"time_constant": 0.5}  # Runge-Kutta 4 is stable up to 2.8 time constants a step

    def _time_constant(self, late: Tensor) -> Tensor:
        return self.time_constant

    def held(self, u: Tensor, dt: float) -> Tensor:
        from scipy.signal import lfilter  # half a second to import, and only identification needs it

        own = self.own(u)
        ratio = float(self.time_constant) / dt
        stays = exp(-1.0 / ratio)
        above = (own - own[:1]).numpy()  # it starts at rest at the first input
        memory = own[:1] + torch.from_numpy(lfilter([0.0, 1.0 - stays], [1.0, -stays], above, axis=0)).to(own)
        return own + (memory - own) * ((1.0 - stays) * ratio)


class ActuatorLag(Lag):
    """The actuator follows its command with a first-order lag; each input carries one state."""

    each_input = True
    source = (
        "first-order actuator dynamics; Franklin, Powell, Emami-Naeini, Feedback Control of Dynamic Systems"
    )
    excludes = (Port.BODY_MOMENT,)  # there it is motor_lag
    sentence = (
        "The actuator follows its command late, with a time constant of {time_constant}, or all states went through "
        "such a filter before they were logged."
    )


class AsymmetricLag(_AnyLag):
    """Actuators that follow a command upwards faster or slower than one downwards; each input carries one state.

    Propellers are sped up by a motor and slow down by their drag.
    """

    each_input = True
    formula = "u_eff = m, dm/dt = (u - m) / (tau_rising if u > m else tau_falling)"
    source = "time constants up and down of motors in simulators (Furrer et al., RotorS, 2016)"
    rising = Parameter(0.05, "s", low=_SHORTEST_S, help="time to reach 63 % of a higher input")
    falling = Parameter(0.05, "s", low=_SHORTEST_S, help="time to reach 63 % of a lower input")
    null = {"rising": 0.0, "falling": 0.0}
    shapes = {"rising": (0.02, 0.06, 0.2), "falling": (0.02, 0.06, 0.2)}
    resolved = {"rising": 0.5, "falling": 0.5}
    includes = ("motor_lag", "actuator_lag")
    same = {"rising": "time_constant", "falling": "time_constant"}
    sentence = (
        "The actuators follow higher commands with a time constant of {rising}, lower ones with {falling}."
    )
    separate = "give steps of the input up and down: each rounds its own corner"

    @classmethod
    def starts(
        cls, sizes: Mapping[str, float], frequencies: Sequence[float] = ()
    ) -> list[dict[str, float | list[float]]]:
        """Both alike, which takes a third of the time: a fit tells them apart."""
        return [one for one in super().starts(sizes, frequencies) if one["rising"] == one["falling"]]

    def _time_constant(self, late: Tensor) -> Tensor:
        return torch.where(late > 0, self.rising, self.falling)

    def held(self, u: Tensor, dt: float) -> Tensor:
        from nsde_torch.effects.recursions import two_lags

        own = self.own(u)
        ratios = [float(self.value(name)) / dt for name in ("rising", "falling")]
        stays = [exp(-1.0 / ratio) for ratio in ratios]
        late = own - torch.from_numpy(two_lags(own.double().contiguous().numpy(), *stays)).to(own)
        rising, falling = ((1.0 - stay) * ratio for stay, ratio in zip(stays, ratios, strict=True))
        return own - late * torch.where(late > 0, rising, falling)


class ActuatorRateLimit(_AnyLag):
    """An actuator that follows its command at a limited rate; each input carries one state.

    A drive of 25 N/s on a spring was a lag of 0.137 s, surely (docs/content/results/diagnosis.md).
    """

    each_input = True
    formula = "u_eff = m, dm/dt = rate sign(u - m)"
    source = BOOK
    # it stops where it meets the command; at an instant, without a step, it nears it with a time constant of 10 ms
    jumps = True
    excludes = (Port.BODY_MOMENT,)  # motors follow by a lag
    rate = Parameter(10.0, "input/s", low=0.0, scale=1.0, help="fastest change that is followed")
    null = {"rate": NONE}
    shapes = {"rate": (1.0, 3.0, 10.0, 30.0)}
    relative = {"rate": "input"}
    sentence = "The actuator changes by {rate} at most, whatever is commanded."
    separate = (
        "give steps of the input, small and large: a lag takes as long for both, a limited rate does not"
    )

    def _time_constant(self, late: Tensor) -> Tensor:
        return (late.abs() / self.rate).clamp_min(0.01)

    def _mean(self, late: Tensor, step: float) -> Tensor:
        """Mean over a step of how far memory is behind an input that it is so far behind at the start."""
        steps = late.abs() / (self.rate * step)  # that it takes to be there
        return late * torch.where(steps > 1.0, 1.0 - 0.5 / steps.clamp_min(1.0), 0.5 * steps)

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        late = self.own(u) - memory
        return -self._mean(late, self.step) if self.step else -late

    def memory_rate(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        late = self.own(u) - memory
        if not self.step:
            return late / self._time_constant(late)
        return late.clamp(-self.rate * self.step, self.rate * self.step) / self.step

    def held(self, u: Tensor, dt: float) -> Tensor:
        from nsde_torch.effects.recursions import rate_limited

        own = self.own(u)
        memory = rate_limited(own.double().contiguous().numpy(), float(self.rate) * dt)
        return own - self._mean(own - torch.from_numpy(memory).to(own), dt)


class ActuatorResonance(InputMemory):
    """Second-order dynamics between a command and what acts: a servo, a motor behind a shaft or a rope that gives.

    The rope of a lift that gives at 2.3 Hz was `unexplained` after ten minutes.
    """

    each_input = True
    states = 2
    stage = 2
    formula = "u_eff = m, m'' = w^2 (u - m) - 2 d w m', w = 2 pi / period"
    source = (
        "second-order actuator dynamics; Franklin, Powell, Emami-Naeini, Feedback Control of Dynamic Systems"
    )
    excludes = (Port.BODY_MOMENT,)  # motors follow by a lag
    # it may move as a recording begins: of a servo at 1.5 Hz a hidden mass did what that did
    estimated = True
    period = Parameter(0.2, "s", low=_SHORTEST_S, scale=0.1, help="natural, without damping")
    damping = Parameter(0.5, "1", low=0.005, high=1.0, scale=0.1, help="share of the critical one")
    null = {"period": 0.0}
    shapes = {"period": (8.0, 20.0, 60.0, 150.0), "damping": (0.1, 0.7)}
    relative = {"period": "step"}
    fitted_from = tuple({"period": 2.5 / 2.0 ** (0.5 * k)} for k in range(9))
    resolved = {"period": 3.0}  # Runge-Kutta 4 is stable up to 2.25 steps, at the critical damping
    sentence = (
        "The actuator follows its command as an oscillator does, with a natural period of {period} and {damping} of "
        "the critical damping."
    )
    separate = (
        "give steps of the input: what follows swings about the new value, a lag nears it from one side"
    )

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return memory[:, : self.n_inputs] - self.own(u)

    def memory_rate(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        follows, rate = memory[:, : self.n_inputs], memory[:, self.n_inputs :]
        w = 2.0 * pi / self.period
        pulled = self.own(u) - follows - 2.0 * self.damping * rate
        return torch.cat((w * rate, w * pulled), 1)

    def held(self, u: Tensor, dt: float) -> Tensor:
        import numpy as np
        from scipy.linalg import expm

        from nsde_torch.effects.recursions import second_order

        w, damping = 2.0 * pi / float(self.period), float(self.damping)
        own = self.own(u).double().numpy()
        rates = np.zeros((4, 4))  # of what follows, its rate over w, the command and its slope
        rates[:2, :3] = [[0.0, w, 0.0], [-w, -2.0 * damping * w, w]]
        start, still = np.stack((own[0], np.zeros_like(own[0]))), np.zeros_like(own)
        return torch.from_numpy(second_order(expm(rates * dt)[:2], start, own, still)).to(u.dtype)


class ActuatorDeadband(_Cut):
    """Commands near zero do nothing, and larger ones lose as much."""

    around_zero = True
    each_input = True
    formula = "u_eff = u - clip(u, -w, w)"
    width = Parameter(0.1, "input", low=0.0, scale=0.1, help="smallest command that does something")
    null = {"width": 0.0}
    shapes = {"width": (0.05, 0.15, 0.4)}
    relative = {"width": "input"}
    sentence = "Commands below {width} do nothing, and larger ones lose as much."
    not_of = dict.fromkeys(
        FLYING, "motors in flight are far above it, and what they lose is an offset of the thrust"
    )
    separate = "give slow small inputs through zero, and large ones"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return -self.cut(u)


class AsymmetricDeadband(_Cut):
    """Commands near zero do nothing, over another width on each side of zero."""

    around_zero = True
    excludes = (Port.BODY_MOMENT,)  # motors in flight are far above it
    formula = "u_eff = u - clip(u, -w-, w+)"
    width_forward = Parameter(
        0.1, "input", low=0.0, scale=0.1, help="smallest positive command that does something"
    )
    width_backward = Parameter(
        0.1, "input", low=0.0, scale=0.1, help="smallest negative command that does something, positive"
    )
    null = {"width_forward": 0.0, "width_backward": 0.0}
    shapes = {"width_forward": (0.05, 0.2), "width_backward": (0.05, 0.2)}
    relative = {"width_forward": "input", "width_backward": "input"}
    includes = ("actuator_deadband",)
    same = {"width_forward": "width", "width_backward": "width"}
    sentence = (
        "Commands between -{width_backward} and {width_forward} do nothing, and larger ones lose as much."
    )
    separate = "give slow small inputs through zero, and large ones of both signs"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return -self.cut(u)


class AsymmetricGain(Effect):
    """An input that acts more strongly in one direction than in the other."""

    both_signs = True
    each_input = True
    port = Port.INPUT
    stage = 1
    excludes = (Port.BODY_MOMENT,)  # commands of motors have one sign
    formula = "u_eff = u + a |u|"
    source = "the even part of a gain that depends on the sign of its input"
    asymmetry = Size(
        0.0, "1", low=-0.9, high=0.9, scale=0.1, help="half the difference of the gains of both signs"
    )
    sentence = "Positive commands act 1 + {asymmetry} times, negative ones 1 - {asymmetry} times."
    separate = "give inputs of both signs and of several sizes, at rest in between"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return self.asymmetry * u.abs()


class ActuatorSaturation(_Cut):
    """Commands beyond a level are cut."""

    each_input = True
    formula = "u_eff = clip(u, -level, level)"
    level = Parameter(0.5, "input", low=0.0, scale=0.5, help="largest command that acts in full")
    null = {"level": NONE}
    shapes = {"level": (0.5, 0.75, 0.95, 1.15)}  # above the quantile commands are rare, not absent
    relative = {"level": "input"}
    sentence = "Commands beyond {level} are cut to it."
    separate = "give inputs of several amplitudes, the largest far beyond the usual ones"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return self.cut(u) - u


class AsymmetricSaturation(_Cut):
    """Commands beyond a level are cut, at another level for each sign."""

    excludes = (Port.BODY_MOMENT,)  # commands of motors have one sign
    formula = "u_eff = clip(u, -level-, level+)"
    level_forward = Parameter(
        0.5, "input", low=0.0, scale=0.5, help="largest positive command that acts in full"
    )
    level_backward = Parameter(
        0.5, "input", low=0.0, scale=0.5, help="largest negative command that acts in full, positive"
    )
    null = {"level_forward": NONE, "level_backward": NONE}
    shapes = {"level_forward": (0.5, 0.9), "level_backward": (0.5, 0.9)}
    relative = {"level_forward": "input", "level_backward": "input"}
    includes = ("actuator_saturation",)
    same = {"level_forward": "level", "level_backward": "level"}
    sentence = "Commands above {level_forward} or below -{level_backward} are cut."
    separate = "give inputs of several amplitudes and both signs, the largest far beyond the usual ones"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return self.cut(u) - u


class InputPlay(InputMemory):
    """Play (backlash) between an input and what it moves: after a turn nothing moves until the gap is taken up."""

    each_input = True
    stage = 1
    whole_steps = True
    jumps = True
    excludes = (Port.BODY_MOMENT,)  # rotors have none
    formula = "u_eff = m, |u - m| <= w"
    source = BOOK
    half_gap = Parameter(0.1, "input", low=0.0, scale=0.1, help="half the play")
    null = {"half_gap": 0.0}
    shapes = {"half_gap": (0.05, 0.2, 0.5)}
    relative = {"half_gap": "input"}
    sentence = (
        "Between the input and what it moves there is play: it remembers the way it came, and after a turn nothing "
        "moves until the input has gone back by twice {half_gap}."
    )
    separate = (
        "give slow triangles of the input, small and large: a delay shifts them in time, play cuts their tops"
    )

    def _taken_up(self, u: Tensor, memory: Tensor) -> Tensor:
        own, gap = self.own(u), self.half_gap
        return torch.minimum(torch.maximum(memory, own - gap), own + gap)

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return self._taken_up(u, memory) - self.own(u)

    def memory_rate(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return (self._taken_up(u, memory) - memory) / (self.step or _QUICK_S)

    def held(self, u: Tensor, dt: float) -> Tensor:
        from nsde_torch.effects.recursions import play

        own = self.own(u)
        return torch.from_numpy(play(own.double().numpy(), float(self.half_gap.detach()))).to(own)


class EfficiencyLoss(Effect):
    """Single inputs give less than the others."""

    port = Port.INPUT
    formula = "u_eff,i = u_i (1 - l_i)"
    source = "actuator effectiveness factor; Zhang, Jiang, Annual Reviews in Control 32 (2008)"
    loss = Size(1e-3, "1", low=-0.3, high=1.0, scale=0.1, help="share lost, one per input", per_input=True)

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return -self.loss * u


class ActuatorEfficiencyLoss(EfficiencyLoss):
    """Single actuators give less than the others: a worn propeller, a slipping wheel, a weak motor of an arm."""

    excludes = (Port.BODY_MOMENT,)  # there it is motor_efficiency_loss
    sentence = "Actuators have lost {loss} of their strength (one number per input, in their order)."
    separate = "drive each input by itself, and all of them together"


class ActuatorGainDrift(Effect):
    """The strength of the actuator changes with time."""

    each_input = True
    drifts = True
    port = Port.INPUT
    formula = "u_eff = u (1 + r t)"
    source = "warming or wear of an actuator, first order in time"
    rate = Size(0.0, "1/s", scale=0.01, help="relative change of strength per second")
    sentence = "The actuator's strength changes by {rate}, counted from the start of the clock."
    not_of = dict.fromkeys(FLYING, "thrust_sag is the same term")
    separate = "repeat the same inputs early and late in a long run"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return (self.rate * elapsed(t, x)).to(u.dtype) * u
