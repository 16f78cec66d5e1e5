"""A machine as PX4's simulator: sensors out, motor commands in, in lockstep.

PX4 connects to us (TCP port 4560 by default), says a heartbeat, and takes its time from HIL_SENSOR. Until its first
HIL_ACTUATOR_CONTROLS we go on in real time, since PX4 cannot boot without a clock that runs; from then on, if it says
that it is in lockstep (bit 0 of `flags`),

    sensors(t_k) -> PX4 -> motors(t_k) -> machine from t_k to t_k+1,

and never faster than real time. An answer that stays out is waited for `PATIENCE` and no longer. When PX4 goes, the
machine is put back on the ground, and the next PX4 finds it new.

Motors are numbered as in PX4: channel k of the controls is motor k (`PWM_MAIN_FUNCk = 100 + k`).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from math import isfinite
from typing import final

from nsde_torch.px4.link.codec import Codec
from nsde_torch.px4.link.dialect import ARMED_FLAG
from nsde_torch.px4.link.endpoint import NUMBERS
from nsde_torch.px4.link.transport import Transport
from nsde_torch.px4.simulator.body import Body
from nsde_torch.px4.simulator.hil_sensors import RATE, HilSensors
from nsde_torch.px4.simulator.sensor_errors import SensorErrors
from nsde_torch.systems import Multirotor

PATIENCE = 0.1
"""Longest wait for the motor commands to a sample [s]."""
LONGEST = 0.1
"""Most that is made up for at once when the machine or PX4 was busy [s]."""
_FIRST = 1.0
"""First time that is told; PX4 takes 0 for no time [s]."""
_LOCKSTEP = 1


@final
class HilPlant:
    """The machine and its sensors, without a connection and without a clock.

    Args:
        body: The machine; its step must be the IMU's.
        seed: Of the sensors' noise.
        noise: Factor on it.
        errors: Of the sensors.

    Attributes:
        controls: Motor commands in force.
        answers: Messages with motor commands so far.
        lockstep: Whether PX4 says that it waits for us.
        armed: Whether PX4 says that it is armed.
    """

    def __init__(
        self, body: Body, *, seed: int, noise: float = 1.0, errors: SensorErrors | None = None
    ) -> None:
        if abs(body.dt * RATE - 1.0) > 1e-9:
            raise ValueError(f"the machine's step must be {1.0 / RATE:g} s; got {body.dt:g} s")
        self.body = body
        self.codec = Codec(1, 200, wanted=frozenset((NUMBERS["HIL_ACTUATOR_CONTROLS"],)), stream=True)
        self.controls: tuple[float, ...] = (0.0,) * body.nu
        self.answers, self.lockstep, self.armed = 0, False, False
        self._sensors = HilSensors(seed=seed, noise=noise, errors=errors)

    @property
    def time(self) -> float:
        """As PX4 is told [s]."""
        return _FIRST + self.body.time

    def sample(self) -> bytes:
        """What the sensors show now, once a step."""
        b = self.body
        found = self._sensors.messages(self.time, b.p, b.v, b.q, b.w)
        return b"".join(self.codec.pack(m) for m in found)

    def receive(self, data: bytes) -> None:
        """Take bytes of PX4."""
        for message in self.codec.unpack(data, self.time):
            controls = tuple(float(c) for c in message.controls[: self.body.nu])
            self.armed = bool(message.mode & ARMED_FLAG)
            # what is no number stops that motor; nothing is turned backwards
            self.controls = tuple(
                min(max(c, 0.0), 1.0) if isfinite(c) and self.armed else 0.0 for c in controls
            )
            self.lockstep = bool(message.flags & _LOCKSTEP)
            self.answers += 1

    def step(self) -> None:
        """Move on by one sample."""
        self.body.step(self.controls)


@final
class HilServer:
    """Serves PX4, one after another.

    Args:
        make: Makes the machine anew, on the ground.
        transport: Where PX4 connects.
        say: Takes a line when PX4 comes and goes.
        speed: Seconds of the machine's clock in a second, at most.

    Attributes:
        plant: The machine in service.
        unanswered: Samples in lockstep that PX4 did not answer in time.
    """

    def __init__(
        self,
        make: Callable[[], HilPlant],
        transport: Transport,
        *,
        say: Callable[[str], None] = lambda line: None,
        speed: float = 1.0,
    ) -> None:
        self._make, self._transport, self._say, self._speed = make, transport, say, speed
        self.plant, self.unanswered = make(), 0

    def run(self, until: Callable[[], bool] = lambda: False) -> None:
        """Serve until told to stop."""
        self._say("waiting for PX4")
        while not until():
            early = self._transport.receive(0.05)  # accepts a connection
            if not self._transport.connected:
                continue
            self._say("PX4 is here")
            self.plant.receive(early)
            self._serve(until)
            if not until():
                self._say(
                    f"PX4 went after {self.plant.time - _FIRST:.1f} s; the machine is put back on the ground"
                )
            self.plant = self._make()

    def _serve(self, until: Callable[[], bool]) -> None:
        plant, transport = self.plant, self._transport
        due = time.monotonic()
        while transport.connected and not until():
            answers, sent = plant.answers, time.monotonic()
            transport.send(plant.sample())
            due = max(due + plant.body.dt / self._speed, sent - LONGEST)
            self._hear(due, answers, sent)
            plant.step()

    def _hear(self, due: float, answers: int, sent: float) -> None:
        """Until the next sample is due and, in lockstep, this one is answered."""
        plant, transport = self.plant, self._transport
        while transport.connected:
            now = time.monotonic()
            waits = plant.lockstep and plant.answers == answers
            if now >= due and not waits:
                return
            if waits and now - sent > PATIENCE:
                self.unanswered += 1
                return
            plant.receive(transport.receive(max(due - now, 0.0) if not waits else 0.002))


def airframe(system: Multirotor, hover: float) -> dict[str, float]:
    """PX4's parameters that describe a machine: places and turns of the rotors, outputs, and the hovering throttle.

    Roll and pitch moments of a rotor over its thrust are its place, `PX = -pitch, PY = -roll`; one whose reaction turns
    the body left (FLU yaw > 0) turns clockwise itself, which is a negative KM.
    """
    _, roll, pitch, yaw = system.mixing
    out: dict[str, float] = {"CA_AIRFRAME": 0, "CA_ROTOR_COUNT": system.nu}
    for k in range(system.nu):
        out[f"CA_ROTOR{k}_PX"] = round(-pitch[k], 3) + 0.0
        out[f"CA_ROTOR{k}_PY"] = round(-roll[k], 3) + 0.0
        out[f"CA_ROTOR{k}_KM"] = round(-0.05 * yaw[k], 3) + 0.0
    out |= {f"PWM_MAIN_FUNC{k + 1}": 101 + k for k in range(system.nu)}
    return {**out, "MPC_THR_HOVER": round(hover, 2), "THR_MDL_FAC": 0}
