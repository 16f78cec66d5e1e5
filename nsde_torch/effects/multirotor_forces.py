"""Forces and moments on a multirotor: drag, thrust, frame, motors."""

import torch
from torch import Tensor

from nsde_torch.columns import columns, split_columns, stack_columns
from nsde_torch.effects.actuators import EfficiencyLoss, Lag
from nsde_torch.effects.base import Effect, Parameter, Port, Size, elapsed
from nsde_torch.effects.forces import HiddenSwing
from nsde_torch.rotation import axis_up, cross, euler_coupling, matrix, rate_products, rotate_back, turned

GRAVITY = 9.81
TWO_SPEEDS = "fly at two more speeds, in several directions"


def body_velocity(x: Tensor) -> Tensor:
    """Velocity in the body frame (N, 3) [m/s] of multirotor states (N, 13)."""
    _, v, q, _ = split_columns(x, 3, 3, 4, 3)
    return rotate_back(q, v)


class LinearDrag(Effect):
    """Rotor drag: in proportion to body velocity, one coefficient per axis."""

    port = Port.BODY_FORCE
    formula = "-d * v_body"
    source = "Faessler, Franchi, Scaramuzza, IEEE RA-L 3 (2018)"
    drag = Size((0.1, 0.1, 0.1), "1/s", low=0.0, help="drag over mass, body x y z")
    along = "speed"
    sentence = "The air brakes in proportion to the speed: rotor drag of {drag} along forward, left and up."
    separate = TWO_SPEEDS

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return -self.drag * body_velocity(x)


class QuadraticDrag(Effect):
    """Body drag: in proportion to speed times body velocity."""

    port = Port.BODY_FORCE
    formula = "-d * |v| v_body"
    source = "aerodynamic drag of a bluff body"
    drag = Size((0.02, 0.02, 0.02), "1/m", low=0.0, help="drag over mass, body x y z")
    along = "speed"
    sentence = "The air brakes with the square of the speed: {drag} along forward, left and up."
    separate = TWO_SPEEDS

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        v = body_velocity(x)
        return -self.drag * v * torch.sqrt((v * v).sum(1, keepdim=True) + 1e-12)


class RotorDrag(Effect):
    """Drag of the rotors alone: in proportion to their speed, and to body velocity.

    Near hover it is a linear drag, which is preferred where the data do not tell.
    """

    port = Port.BODY_FORCE
    quantities = {"thrust": 1}
    formula = "-d * sqrt(T / g) v_body"
    source = "Svacha, Mohta, Kumar, ICUAS (2017); rotor speed in proportion to the root of the thrust"
    drag = Size((0.1, 0.1, 0.1), "1/s", low=0.0, help="drag over mass at the thrust of hover, body x y z")
    along = "speed"
    includes = ("linear_drag",)
    sentence = (
        "The rotors brake with their own speed times that of flight: {drag} at hover, forward, left and up."
    )
    separate = "fly fast curves, for thrust far from that of hover at speed"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        speed = torch.sqrt(self.channel("thrust", u).clamp_min(0.0) / GRAVITY + 1e-12)
        return -self.drag * speed * body_velocity(x)


class TranslationalLift(Effect):
    """More thrust in forward flight, where the rotors meet air that has not been moved yet."""

    port = Port.BODY_FORCE
    formula = "k (v_x^2 + v_y^2), along body z"
    source = "Svacha, Mohta, Kumar, ICUAS (2017), eq. of thrust with k_h"
    lift = Size(0.01, "1/m", low=0.0, help="k over mass")
    sentence = (
        "In forward flight the rotors lift more: by {lift} times the square of the speed in their plane."
    )
    separate = "fly level at two more speeds, forwards and sideways"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        v_x, v_y, _ = columns(body_velocity(x))
        lift = self.lift * (v_x * v_x + v_y * v_y)
        return stack_columns((torch.zeros_like(lift), torch.zeros_like(lift), lift))


class TrackedPoint(Effect):
    """Position and velocity are those of a point beside the centre of mass: an IMU, a reflector.

    A point at r in the body has the velocity v + R (omega x r), whose derivative is that of v with what turning adds.
    """

    port = Port.BODY_FORCE
    quantities = {"angular_acceleration": 3}
    formula = "domega/dt x r + omega x (omega x r)"
    source = "acceleration of a point of a rigid body"
    offset = Size(
        (0.0, 0.0, 0.0),
        "m",
        scale=0.02,
        help="of the point from the centre of mass, forward, left and up",
    )
    sentence = "Position and velocity are of a point {offset} forward, left and up of the centre of mass."
    separate = "turn sharply about each axis on the spot"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        r, omega = self.offset, x[:, 10:13]
        return cross(self.channel("angular_acceleration", u), r) + cross(omega, cross(omega, r))


class ConstantWind(Effect):
    """Rotor drag in air that moves: in proportion to the velocity relative to the air."""

    port = Port.BODY_FORCE
    formula = "-d * R^T (v - w)"
    source = "Tomic, Schmid, Lutz, Mathers, Haddadin, IROS (2016): drag on the velocity relative to the air"
    drag = Size((0.1, 0.1, 0.1), "1/s", low=0.0, help="drag over mass, body x y z")
    wind = Parameter((0.0, 0.0), "m/s", scale=1.0, help="velocity of the air, east and north")
    shapes = {"wind": ((2.0, 0.0), (-2.0, 0.0), (0.0, 2.0), (0.0, -2.0))}
    smooth = ("wind",)
    includes = ("linear_drag",)
    sentence = "The air moves with {wind} to east and north and drags with {drag} along forward, left and up."
    separate = "fly the same path twice, the second time turned by a quarter"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        wind = self.wind
        air = torch.cat((wind, torch.zeros_like(wind[..., :1])), -1)
        return -self.drag * rotate_back(x[:, 6:10], x[:, 3:6] - air)


class SlungLoad(HiddenSwing):
    """A load on a cable below the centre of mass that is not in the log; it swings by small angles.

    Up and down it moves with the machine, so that thrust over mass T is that over both masses, and the cable holds T_z.
    Of m y'' the machine feels what the thrust that is counted in T does not give: nothing where it hovers level.
    """

    port = Port.WORLD_FORCE
    needs = (Port.BODY_FORCE,)
    quantities = {"thrust": 1}
    formula = "m (T - y''), y'' = (T_z / l) (p - y) + 2 d sqrt(g / l) (v - y'), east and north"
    source = "to first order; Goodarzi, Lee, Lee, American Control Conference (2014)"
    mass = Size(0.1, "1", low=0.0, help="mass of the load over that of the machine")
    length = Parameter(1.0, "m", low=0.05, high=50.0, scale=0.5, help="from the centre of mass to the load")
    states = 4
    shapes = {"length": (0.5, 2.0), "damping": (0.02, 0.1)}
    fitted_from = tuple({"length": length} for length in (0.35, 0.8, 1.8))
    sentence = "A load of {mass} of the machine's mass swings {length} below it, at {damping} of the critical damping."
    separate = "fly to and fro at the pace at which it swings, and at half and twice that"

    def swing(self) -> Tensor:
        return (GRAVITY / self.length).sqrt()

    def velocity(self, x: Tensor) -> Tensor:
        # to east and north
        return x[:, 3:5]

    def acceleration(self, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        ahead, speed = memory.split(2, 1)
        rub = 2.0 * self.damping * self.swing()
        return -self._lift(x, u)[:, 2:] / self.length * ahead - rub * (speed - self.velocity(x))

    def _lift(self, x: Tensor, u: Tensor) -> Tensor:
        """Thrust over mass in the world (N, 3)."""
        return self.channel("thrust", u) * axis_up(x[:, 6:10])

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        pull = self.pull(x, u, memory) + self.value("mass") * self._lift(x, u)[:, :2]
        return torch.cat((pull, torch.zeros_like(pull[:, :1])), 1)


class ConstantWorldForce(Effect):
    """A force that never changes in the world, as a cable's."""

    port = Port.WORLD_FORCE
    needs = (Port.BODY_FORCE,)
    formula = "c"
    source = "a lasting disturbance force; Tomic, Ott, Haddadin, IEEE T-RO 33 (2017)"
    acceleration = Size((0.0, 0.0, 0.0), "m/s2", scale=0.1, help="force over mass, east north up")
    sentence = "A force that never changes pushes with {acceleration} to east, north and up."
    separate = (
        "hover with the nose in several directions: a force of the world stays, one of the body turns with it"
    )

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return self.acceleration.expand(x.shape[0], 3)


class GroundEffect(Effect):
    """More thrust near the ground, which is where p_z = 0."""

    port = Port.BODY_FORCE
    quantities = {"thrust": 1}
    formula = "T a / (p_z^2 + h^2), along body z"
    source = (
        "Cheeseman, Bennett, ARC R&M 3021 (1955), 1 / (1 - (R / 4 z)^2) to first order, softened within h"
    )
    area = Size(0.01, "m2", low=0.0, help="a = (R / 4)^2 of a rotor of radius R")
    height = Parameter(0.2, "m", low=0.0, help="h, height below which it grows no more")
    shapes = {"height": (0.1, 0.3)}
    sentence = (
        "Near the ground the rotors lift more: by {area} over height squared, softened within {height}."
    )
    separate = "hover at several heights, from a quarter of a metre to two"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        z, h = x[:, 2:3], self.height
        lift = self.channel("thrust", u) * self.area / (z * z + h * h)
        return torch.cat((torch.zeros_like(lift), torch.zeros_like(lift), lift), 1)


class ThrustMisalignment(Effect):
    """The thrust axis is tilted against the body axis of the log."""

    port = Port.BODY_FORCE
    quantities = {"thrust": 1}
    formula = "T (a_x, a_y, 0)"
    source = "small rotation of the thrust vector; mounting of motors or of the flight controller"
    tilt = Size((0.0, 0.0), "rad", scale=0.01, help="tilt of the thrust towards body x and y")
    sentence = "The thrust does not point along the body's axis: it is tilted by {tilt} to forward and left."
    separate = "hover with the nose in several directions: a tilted thrust turns with the body, a wind stays"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        sideways = self.tilt * self.channel("thrust", u)
        return torch.cat((sideways, torch.zeros_like(sideways[:, :1])), 1)


# The body axes of the log are not those of the machine: a flight controller that is mounted askew.
#
# With R the turn from the machine's axes to the log's, the log has omega = R^T omega_m, and the attitude of
# its own axes. Velocity and position are the world's. What the machine does, seen in the axes of the log:
#
#     force_log = R^T T e_z          angular_log = R^T a_m,      a_m = gains * moments + c * (w_y w_z, w_z w_x, w_x w_y)
#
# with the products of omega_m = R omega_log and c of the inertia (`systems.multirotor`).


class FrameMisalignment(Effect):
    """The axes of the log are turned against those of the machine."""

    port = Port.BODY_WRENCH
    quantities = {"thrust": 1, "angular_acceleration": 3, "inertia": 2}
    formula = "R^T (T e_z, a) - (T e_z, a), R = exp(turn)"
    source = "change of axes in Newton's and Euler's equations; mounting of the flight controller"
    turn = Parameter(
        (0.0, 0.0, 0.0), "rad", scale=0.02, help="rotation vector from the machine's axes to the log's"
    )
    null = {"turn": 0.0}
    sentence = "The axes of the log are turned against those of the machine, by {turn} about x, y and z."
    separate = (
        "roll, pitch and yaw sharply, one axis at a time: turned axes show in the moments as in the thrust"
    )

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        thrust, omega = self.channel("thrust", u), x[:, 10:13]
        turn = self.turn.to(x)[None]
        level = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).to(x)
        r = matrix(turned(level, turn))[0]  # a row times r is turned back
        coupling = stack_columns(euler_coupling(*columns(self.channel("inertia", u))))
        seen = self.channel("angular_acceleration", u)
        own = seen + coupling * (rate_products(omega @ r.T) - rate_products(omega))
        up = torch.tensor([[0.0, 0.0, 1.0]]).to(x)
        return torch.cat((thrust * (up @ r - up), own @ r - seen), 1)


# Moments on multirotors over inertia [rad/s2], body axes; T is the thrust over mass of the declared physics.
#
# Blade flapping and rotor gyroscopics: Mahony, Kumar, Corke, "Multirotor aerial vehicles", IEEE Robotics and
# Automation Magazine 19 (2012).
TUTORIAL = "Mahony, Kumar, Corke, IEEE Robotics and Automation Magazine 19 (2012)"


class AngularDamping(Effect):
    """A moment against the body rates."""

    port = Port.BODY_MOMENT
    formula = "-d * omega"
    source = "blade flapping and inflow, first order in the rates"
    damping = Size((0.1, 0.1, 0.1), "1/s", low=0.0, help="damping over inertia, x y z")
    sentence = "Turning is braked in proportion to its rate: {damping} in roll, pitch and yaw."
    separate = "turn at several rates about each axis"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return -self.damping * x[:, 10:13]


class ComOffset(Effect):
    """The centre of mass lies off the axis of the thrust, which then turns the machine."""

    port = Port.BODY_MOMENT
    quantities = {"thrust": 1}
    formula = "T (-o_y, o_x, 0), o = c m / J"
    source = "moment -c x F of the thrust about a centre of mass at c"
    offset = Size((0.0, 0.0), "1/m", scale=0.1, help="offset forward and left, times mass over inertia")
    sentence = "The centre of mass is off the middle of the rotors: {offset} forward and left, times mass over inertia."
    separate = "climb and sink: the moment of an offset follows the thrust, that of a weak motor its command"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        o_x, o_y = self.offset.unbind(0)
        thrust = self.channel("thrust", u)[:, 0]
        return stack_columns((-o_y * thrust, o_x * thrust, torch.zeros_like(thrust)))


class GyroscopicMoment(Effect):
    """Spinning rotors resist a change of their axis; what they carry together is what the yaw commands leave over."""

    port = Port.BODY_MOMENT
    quantities = {"spin": 1}
    # a sum of the commands themselves left three laws of rates and yaw command beside it, in two simulators
    formula = "S (h_x omega_y, -h_y omega_x, 0), S = sum of signed sqrt(u_i)"
    source = TUTORIAL + "; rotor speed in proportion to the root of its thrust"
    momentum = Size(
        (1.0, 1.0),
        "1/s",
        low=0.0,
        help="angular momentum of a rotor at full command over the machine's inertia, roll and pitch",
    )
    sentence = "The spinning rotors act as a gyroscope of {momentum} (over the inertia of roll and of pitch)."
    separate = "roll and pitch fast while turning in yaw both ways"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        wx, wy, _ = columns(x[:, 10:13])
        spin = self.channel("spin", u)[:, 0]
        about_x, about_y = self.momentum.unbind(0)
        return stack_columns((about_x * spin * wy, -about_y * spin * wx, torch.zeros_like(wx)))


class FlappingMoment(Effect):
    """Blades that flap in the wind of flight tilt the machine away from where it goes."""

    port = Port.BODY_MOMENT
    formula = "(f_x v_y, -f_y v_x, 0)"
    source = TUTORIAL
    gain = Size(
        (0.0, 0.0), "rad/(m s)", scale=0.1, help="moment over inertia per body velocity, roll and pitch"
    )
    sentence = "Flight through the air turns the machine against its motion: {gain} in roll and pitch."
    separate = "fly at two more speeds with the same attitude, forwards and sideways"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        v_x, v_y, _ = columns(body_velocity(x))
        f_x, f_y = self.gain.unbind(0)
        return stack_columns((f_x * v_y, -f_y * v_x, torch.zeros_like(v_x)))


class InertiaCoupling(Effect):
    """Products of inertia: the principal axes are not the body axes of the log.

    With J = D + P, D the diagonal, P symmetric with zeros on it, to first order in P:

        J^-1 (M - omega x J omega) = a - D^-1 (P a + omega x P omega),     a = D^-1 (M - omega x D omega)
    """

    port = Port.BODY_MOMENT
    quantities = {"angular_acceleration": 3, "inertia": 2}
    formula = "-D^-1 (P a + omega x P omega), P off the diagonal of J / Jz"
    source = "Euler's equation of a rigid body with products of inertia, to first order in them"
    product = Size((0.0, 0.0, 0.0), "1", scale=0.05, help="J_xy, J_xz, J_yz over J_zz (elements of J)")
    sentence = "The masses lie askew to the axes of the log: J_xy, J_xz, J_yz are {product} of J_zz."
    separate = "roll, pitch and yaw sharply, one axis at a time"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        xy, xz, yz = self.product.unbind(0)
        ax, ay, az = columns(self.channel("angular_acceleration", u))
        jx, jy = columns(self.channel("inertia", u))
        wx, wy, wz = columns(x[:, 10:13])
        px, py, pz = xy * wy + xz * wz, xy * wx + yz * wz, xz * wx + yz * wy  # P omega
        return stack_columns(
            (
                -(xy * ay + xz * az + wy * pz - wz * py) / jx,
                -(xy * ax + yz * az + wz * px - wx * pz) / jy,
                -(xz * ax + yz * ay + wx * py - wy * px),
            )
        )


# What becomes of a motor's command before it is thrust: terms on the port `input`, after the lag.
#
# A command u_i in [0, 1] is a share of thrust here, so that thrust and moments of the motor change together.


class MotorLag(Lag):
    """Motors follow their command with a first-order lag; each carries one state."""

    source = "first-order motor and ESC dynamics"
    needs = (Port.BODY_MOMENT,)
    sentence = "The motors follow their commands late, with a time constant of {time_constant}."


class MotorEfficiencyLoss(EfficiencyLoss):
    """Single motors give less than the others: a chipped propeller, a worn bearing."""

    needs = (Port.BODY_MOMENT,)
    sentence = "Motors have lost {loss} of their strength (one number per motor, in their order)."
    separate = "climb, sink and yaw: a weak motor shows in the moments about all axes at once"


class ThrustSag(Effect):
    """Thrust per command falls with time, as a battery empties."""

    drifts = True
    port = Port.INPUT
    needs = (Port.BODY_MOMENT,)
    formula = "u_eff = u (1 - r t)"
    source = "falling battery voltage, first order in time"
    rate = Size(0.0005, "1/s", low=0.0, scale=0.001, help="share lost per second")
    sentence = "Thrust per command falls by {rate}, counted from the start of the clock."
    separate = "log the battery's voltage, and fly one battery longer"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return -(self.rate * elapsed(t, x)).to(u.dtype) * u


class SupplySag(Effect):
    """All motors give less the more they draw together: the voltage of the battery drops with its current.

    It drops within milliseconds, where a voltage is logged a few times a second.
    """

    port = Port.INPUT
    needs = (Port.BODY_MOMENT,)
    formula = "u_eff = u (1 - k mean(u))"
    source = "internal resistance of the battery, first order in the current"
    drop = Size(0.1, "1", low=0.0, scale=0.1, help="share lost where all motors are at full command")
    sentence = "Motors give less the more all of them draw: {drop} at full command."
    separate = "climb and sink hard, and roll and pitch while climbing"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return -self.drop * u.mean(1, keepdim=True) * u


REFERENCES = ((5.5, 4.0), (8.9, 8.0))
"""Voltages up to which a pack has one cell, and two, and at which thrust per command is then what the gains say [V]."""
REFERENCE = 16.0
"""Voltage at which thrust per command is what the declared gains say, of larger packs [V] (four cells)."""


class BatteryVoltage(Effect):
    """Thrust per command follows the logged voltage of the battery."""

    port = Port.INPUT
    needs = (Port.BODY_MOMENT,)
    exogenous = ("battery_voltage",)
    formula = "u_eff = u (1 + s (V - V_0))"
    source = "motor speed follows the voltage at a given duty; first order around 4 V (one cell), 8 V (two) or 16 V"
    sensitivity = Size(0.05, "1/V", low=0.0, scale=0.05, help="relative change of thrust per volt")
    sentence = "Thrust per command follows the battery's voltage, by {sensitivity}."
    separate = "fly the same path on a full and on an empty battery"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        voltage = self.channel("battery_voltage", u)
        reference = torch.full_like(voltage, REFERENCE)
        for most, own in reversed(REFERENCES):
            reference = torch.where(voltage < most, own, reference)
        return self.sensitivity * (voltage - reference) * u[:, : u.shape[1] - 1]


class ThrustCurve(Effect):
    """Thrust is not proportional to the command: a second degree of the thrust map."""

    port = Port.INPUT
    needs = (Port.BODY_MOMENT,)
    formula = "u_eff = u + c u^2"
    source = "supplement eq. 4: thrust map as a polynomial of the command"
    curvature = Size(0.0, "1", scale=0.1, help="second coefficient over the first")
    sentence = "Thrust grows with {curvature} times the square of the command beside the command itself."
    separate = "climb and sink hard, for commands far from hover"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return self.curvature * u * u


class AxialInflow(Effect):
    """Rotors that climb through the air give less thrust, and more where they sink."""

    port = Port.INPUT
    needs = (Port.BODY_MOMENT,)
    formula = "u_eff = u (1 - k v_z), v_z in the body"
    source = (
        "momentum theory in axial flight; Leishman, Principles of Helicopter Aerodynamics (2006), chapter 2"
    )
    loss = Size(0.02, "s/m", low=0.0, scale=0.02, help="share lost by speed along the rotors' axis")
    sentence = "Climbing costs thrust: {loss}, as a share by speed along the axis of the rotors."
    separate = "climb and sink fast, and roll, pitch and yaw meanwhile"

    def forward(self, t: float | Tensor, x: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        return -self.loss * body_velocity(x)[:, 2:] * u
