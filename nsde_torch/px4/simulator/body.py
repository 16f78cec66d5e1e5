"""The machine of a simulated autopilot: a plant of the package, one machine, cheap enough for real time.

The rigid body with its motors' lag is stepped in plain floats,

    motors: m' = (u(t - latency) - m) / tau, exactly;      p, v by the midpoint rule;      q by the exponential map

and what else the plant holds, gusts and effects of any kind, is the difference of the plant's own drift to that of
the rigid body, computed every 10 ms and held:  z' = rigid(z, u) + [plant(z_k, u_k) - rigid(z_k, u_k)].

The ground is a plane at height 0 that carries what does not lift itself, without bounce or slip.
"""

from collections import deque
from dataclasses import KW_ONLY, dataclass
from math import exp
from typing import final

import numpy as np
import torch

from nsde_torch.effects import Port
from nsde_torch.errors import ConfigError
from nsde_torch.px4.flight.cascade import GRAVITY
from nsde_torch.px4.link.vectors import Quat, Vec, parts, plus, rotate, rotate_back, turned_by_rates
from nsde_torch.rotation import euler_coupling
from nsde_torch.simulation.battery import ENDURANCE, FULL, HOVER, LOAD, SWING
from nsde_torch.simulation.plant import Gusts
from nsde_torch.systems import Multirotor
from nsde_torch.systems.machines import Effects, machine, make_plant_system, named_effects
from nsde_torch.systems.parameters import frozen

HELD = 0.01  # interval at which gusts and effects beyond the rigid body are computed [s]
_NATIVE = {"motor_lag", "linear_drag"}


@final
@dataclass(eq=False)
class Body:
    """One multirotor.

    ConfigError: no multirotor plant of that name, or an effect that reads a channel that is not there.
    """

    name: str  # of a multirotor; as `effects` and `declared_only` see `make_plant_system`
    _: KW_ONLY
    seed: int  # of the gusts
    effects: Effects = ()
    declared_only: bool = False
    process_noise: float = 1.0  # factor on the gusts
    latency: float = 0.0  # time from a command to its effect [s]; an effect `input_delay` adds to it
    dt: float = 0.004  # step [s]

    def __post_init__(self) -> None:
        name, dt, latency = self.name, self.dt, self.latency
        spec, asked = machine(name), named_effects(self.effects, name)
        delay = asked.pop("input_delay", None)
        if delay is not None:
            latency += float(delay.get("delay", 0.02))  # type: ignore[arg-type]
        system = make_plant_system(name, effects=asked, declared_only=self.declared_only)
        if not isinstance(system, Multirotor):
            raise ConfigError(
                f"the vehicle must be a multirotor (hexacopter, quadrotor); got system {name!r}."
            )
        if set(system.exogenous) - {"battery_voltage"}:
            raise ConfigError(
                f"effects read {system.exogenous}; a simulated vehicle has battery_voltage only."
            )
        self.system, self._spec = system, spec
        self._full = frozen(system).double()
        declared = {k: v for k, (v, _) in system.declared_parameters().items() if v.numel() == 1}
        self._gain, self._offset = float(declared["thrust_gain"]), float(declared["thrust_offset"])
        self._gains = tuple(float(declared[f"{k}_gain"]) for k in ("roll", "pitch", "yaw"))
        self._coupling = euler_coupling(float(declared["inertia_x"]), float(declared["inertia_y"]))
        self._mix = tuple(tuple(row) for row in system.mixing)
        self.allocation = np.linalg.pinv(np.asarray(system.mixing)).T
        self.allocation /= np.array([self._gain, *self._gains])[:, None]
        names = set(system.effect_names)
        values = {k: v.tolist() for k, (v, _) in system.all_declared().items()}
        self._tau = values["motor_lag.time_constant"][0] if "motor_lag" in names else 0.0
        self._keep = exp(-dt / self._tau) if self._tau > 0 else 0.0
        self._drag: Vec = tuple(values["linear_drag.drag"]) if "linear_drag" in names else (0.0,) * 3
        self._lag: slice | None = None  # of the motors, in the plant's memory
        at = 13
        for effect in system.effects:
            count = int(effect.n_memory)  # type: ignore[arg-type]
            self._lag = slice(at, at + count) if effect.name == "motor_lag" else self._lag
            at += count
        self._others = bool(names - _NATIVE) or system.thrust_degree > 1
        random = torch.Generator().manual_seed(self.seed)
        self._gusts = Gusts(spec.gusts, system.ports, dt=HELD, scale=self.process_noise, generator=random)
        self._gusts.reset(1)
        self._delay = round(latency / dt)
        nu = system.nu
        self._commands: deque[tuple[float, ...]] = deque([(0.0,) * nu] * (self._delay + 1), self._delay + 1)
        self.nu = nu
        # the true state, ENU and FLU
        self.p: Vec = (0.0, 0.0, 0.0)
        self.v: Vec = (0.0, 0.0, 0.0)
        self.q: Quat = (1.0, 0.0, 0.0, 0.0)
        self.w: Vec = (0.0, 0.0, 0.0)
        self.motors: tuple[float, ...] = (0.0,) * nu  # what the motors do, 0 to 1
        self.on_ground = True  # whether the ground carries it
        self.used = 0.0  # share of the battery's charge that is spent
        self.time = 0.0
        self._memory: torch.Tensor | None = None
        self._memory_rate = torch.zeros(0)
        self._push: Vec = (0.0, 0.0, 0.0)
        self._twist: Vec = (0.0, 0.0, 0.0)
        self._motor_push: tuple[float, ...] = (0.0,) * nu
        self._held_until = 0.0

    @property
    def voltage(self) -> float:
        """Of the battery [V]."""
        return FULL - SWING * self.used - LOAD * sum(self.motors) / self.nu

    def hover_throttle(self) -> float:
        """Mean command that carries the machine."""
        return (GRAVITY - self._offset) / (self._gain * self.nu)

    def step(self, u: tuple[float, ...]) -> None:
        """Advance by `dt` under motor commands."""
        dt = self.dt
        self._commands.append(tuple(min(max(c, 0.0), 1.0) for c in u))
        command = self._commands[0]
        if self.time >= self._held_until - 1e-9:
            self._hold(command)
            self._held_until += HELD
        keep = self._keep
        self.motors = tuple(
            c + keep * (m - c) + dt * r
            for m, c, r in zip(self.motors, command, self._motor_push, strict=True)
        )
        self.used = min(self.used + dt / (HOVER * ENDURANCE) * sum(self.motors) / self.nu, 1.0)
        acceleration, twist = self._rigid(self.v, self.q, self.w)
        lift = rotate_back(self.q, (0.0, 0.0, 1.0))[2] * self._thrust()
        if self.on_ground and lift <= GRAVITY:
            self.v = self.w = (0.0, 0.0, 0.0)
            self.time += dt
            return
        self.on_ground = False
        # midpoint for the rates, whose gyroscopic terms are quadratic; all else is smooth over a step
        middle = plus(self.w, twist, 0.5 * dt)
        v, q = plus(self.v, acceleration, 0.5 * dt), turned_by_rates(self.q, self.w, 0.5 * dt)
        acceleration, twist = self._rigid(v, q, middle)
        self.q = turned_by_rates(self.q, middle, dt)
        self.p = plus(plus(self.p, self.v, dt), acceleration, 0.5 * dt * dt)
        self.v, self.w = plus(self.v, acceleration, dt), plus(self.w, twist, dt)
        if self._memory is not None:
            self._memory = self._memory + dt * self._memory_rate
        self.time += dt
        if self.p[2] <= 0.0 and self.v[2] <= 0.0:
            self._touch()

    def _touch(self) -> None:
        w, _, _, z = self.q
        n = (w * w + z * z) ** 0.5 or 1.0
        self.q = (w / n, 0.0, 0.0, z / n)
        self.p, self.on_ground = (self.p[0], self.p[1], 0.0), True
        self.v = self.w = (0.0, 0.0, 0.0)

    def _thrust(self) -> float:
        """Thrust over mass; none where the motors stand still."""
        total = sum(self.motors)
        return max(self._gain * total + self._offset, 0.0) if total > 0.0 else 0.0

    def _rigid(self, v: Vec, q: Quat, w: Vec) -> tuple[Vec, Vec]:
        """Accelerations in the world and in the body, with what is held."""
        acceleration, twist = self._bare(v, q, w)
        return plus(acceleration, self._push), plus(twist, self._twist)

    def _bare(self, v: Vec, q: Quat, w: Vec) -> tuple[Vec, Vec]:
        b = rotate_back(q, v)
        d = self._drag
        f = rotate(q, (-d[0] * b[0], -d[1] * b[1], self._thrust() - d[2] * b[2]))
        moments = [sum(s * m for s, m in zip(row, self.motors, strict=True)) for row in self._mix[1:]]
        g, c = self._gains, self._coupling
        twist = (
            g[0] * moments[0] + c[0] * w[1] * w[2],
            g[1] * moments[1] + c[1] * w[2] * w[0],
            g[2] * moments[2] + c[2] * w[0] * w[1],
        )
        return (f[0], f[1], f[2] - GRAVITY), twist

    @torch.no_grad()
    def _hold(self, command: tuple[float, ...]) -> None:
        """Gusts and effects beyond the rigid body, held from now on."""
        forces = {port: row[0].tolist() for port, row in self._gusts.draw().items()}
        push = tuple(forces.get(Port.WORLD_FORCE, (0.0, 0.0, 0.0)))
        if Port.BODY_FORCE in forces:
            push = plus(push, rotate(self.q, tuple(forces[Port.BODY_FORCE])))
        twist: Vec = tuple(forces.get(Port.BODY_MOMENT, (0.0, 0.0, 0.0)))
        if self._others and not self.on_ground:
            row = torch.tensor([[*self.p, *self.v, *self.q, *self.w]], dtype=torch.float64)
            u = [*command, *([self.voltage] if self.system.exogenous else [])]
            inputs = torch.tensor([u], dtype=torch.float64)
            z = self._full.augment(row, inputs)
            if self._memory is not None:
                z[:, 13:] = self._memory
            if self._lag is not None:
                z[:, self._lag] = torch.tensor([self.motors], dtype=torch.float64)
            rate = self._full.drift(self.time, z, inputs)
            bare, spin = self._bare(self.v, self.q, self.w)
            _, a, _, turn = parts(tuple(rate[0, :13].tolist()))
            push = plus(push, plus(a, bare, -1.0))
            twist = plus(twist, plus(turn, spin, -1.0))
            self._memory, self._memory_rate = z[:, 13:], rate[:, 13:]
            if self._lag is not None:
                # what effects before the lag (a dead band, a limit) add to the motors' rates
                self._motor_push = tuple(
                    r - (c - m) / self._tau
                    for r, c, m in zip(rate[0, self._lag].tolist(), command, self.motors, strict=True)
                )
        self._push, self._twist = push, twist
