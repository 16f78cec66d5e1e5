"""The machines that are simulated: constants, undeclared effects, noise and rates.

Hexacopter: DJI F550 frame (550 mm motor to motor, supplement D), mass m = 2.3 kg with battery, computer and
flight controller (take-off mass of the kit: 1.2 to 2.4 kg, DJI F550 manual); six motors with controller of
90 g on arms of L = 0.275 m round a body of 1.76 kg, taken as a cylinder of radius 0.1 m and height 0.12 m:

    Jz = 6 * 0.09 L^2 + 1.76 * 0.1^2 / 2 = 0.050 kg m2,
    Jx = Jy = 3 * 0.09 L^2 + 1.76 (3 * 0.1^2 + 0.12^2) / 12 = 0.027 kg m2

A 920KV motor with a 10 inch propeller gives about 10 N at full command on four cells (makers' tables); with a
thrust line T = 10.6 N u - 0.38 N a motor the machine hovers at u = 0.39. Over mass and inertia:

    thrust_gain = 10.6 / m = 4.6,  thrust_offset = -6 * 0.38 / m = -1.0,  roll_gain = 10.6 L / Jx = 108,
    yaw_gain = 10.6 c / Jz = 3.4 with c = 0.016 m (drag to thrust of a 10 inch propeller)

Quadrotor: the 3DR Iris of the second published set, 1.5 kg, 0.25 m arms at 45 degrees; Jx 0.029, Jz 0.055
kg m2 (values of the PX4 simulation model), thrust 9.6 N u - 0.3 N a motor.

Undeclared in both: rotor drag of 0.15 1/s sideways (measured on the published flights), motors that lag by
50 ms, gusts. Sensor noise is that of an EKF with motion capture: 1 mm, 1 cm/s, 0.2 deg, 0.02 rad/s, taken
as white.

Cart and pole: the gym task's constants (cart 1 kg, pole 0.1 kg, half-length 0.5 m, g 9.8), force within 25
N, 50 Hz. Mass-spring-damper: m = 1, b = 0.5, k = 1, noise [0.005, 0.01] (supplement B), 100 Hz, no process
noise.
"""

from collections.abc import Mapping, Sequence
from math import radians
from typing import Any

from nsde_torch.effects import Port, effect_class
from nsde_torch.effects.files import is_file, read_for
from nsde_torch.errors import ConfigError
from nsde_torch.systems.base import System
from nsde_torch.systems.machine import Gust, Machine
from nsde_torch.systems.registry import SYSTEMS, make_system, system_class
from nsde_torch.systems.values import Numbers, Values

Effects = Sequence[str | Mapping[str, Values | None]] | Mapping[str, Any]
"""Effects as a user names them: `name`, `{name: {parameter: value}}` or a file `effects.yaml` of a diagnosis, in a list
or as one of them."""

_MULTIROTOR: dict[str, Any] = {
    "dt": 0.01,
    "step": 0.01,
    "sensor_std": (*(1e-3,) * 3, *(1e-2,) * 3, *(radians(0.2),) * 3, *(0.02,) * 3),
    "effects": {"linear_drag": {"drag": [0.15, 0.15, 0.05]}, "motor_lag": {"time_constant": 0.05}},
    "gusts": {
        Port.WORLD_FORCE: Gust(std=(0.15, 0.15, 0.1), time_constant=0.7, white=(0.01,)),
        Port.BODY_MOMENT: Gust(std=(0.6, 0.6, 0.15), time_constant=0.1, white=(0.05, 0.05, 0.02)),
    },
    "limits": (0.0, 1.0),
}

MACHINES: dict[str, Machine] = {
    "hexacopter": Machine(
        values={
            **{"thrust_gain": 4.6, "thrust_offset": -1.0, "yaw_gain": 3.4},
            **dict.fromkeys(("roll_gain", "pitch_gain"), 108.0),
            **dict.fromkeys(("inertia_x", "inertia_y"), 0.54),
        },
        **_MULTIROTOR,
    ),
    "quadrotor": Machine(
        values={
            **{"thrust_gain": 6.4, "thrust_offset": -0.8, "yaw_gain": 2.8},
            **dict.fromkeys(("roll_gain", "pitch_gain"), 58.0),
            **dict.fromkeys(("inertia_x", "inertia_y"), 0.53),
        },
        **_MULTIROTOR,
    ),
    "cartpole": Machine(
        values={"force_gain": 1.0 / 1.1, "pole_share": 0.1 / 1.1, "half_length": 0.5},
        dt=0.02,
        step=0.005,
        # a tenth of the published noise, whose variances are 0.005, 0.01, 0.09 and 0.17
        sensor_std=(0.0071, 0.01, 0.03, 0.0412),
        gusts={Port.FORCE: Gust(white=(0.02,)), Port.TORQUE: Gust(white=(0.02,))},
        limits=(-25.0, 25.0),
    ),
    "mass_spring_damper": Machine(
        values={"linear_spring.stiffness": 1.0, "viscous_friction.damping": 0.5, "force_gain": 1.0},
        dt=0.01,
        step=0.005,
        sensor_std=(0.005, 0.01),
    ),
}


def machine(name: str) -> Machine:
    """Machine of a system: one of `MACHINES`, or what its class says (`System.machine`); a ConfigError without any."""
    cls = system_class(name) if ":" in name or name in SYSTEMS else None
    own = MACHINES.get(name) or (cls.machine if cls is not None else None)
    if own is None and cls is not None and ":" in name:
        return _bare(cls)
    if own is None:
        raise ConfigError(
            f"system {name!r} has no plant, so there is nothing to simulate; plants exist for "
            f"{', '.join(MACHINES)}. Use measured runs: data=csv data.path=FOLDER. A class of your own has a plant "
            "where it is named as `module:Class`."
        )
    return own


def _bare(cls: type[System]) -> Machine:
    """The machine of a class that says none: first values, the model's step, no noise; a recording says the rest."""
    dt = cls.defaults.dt
    return Machine(values={}, dt=dt, step=0.25 * dt, sensor_std=(0.0,) * len(cls.error_names))


def named_effects(effects: Effects, system: str | None = None) -> dict[str, Numbers]:
    """Effects of a system (None: of any) as a mapping from name to parameter values; files are read.

    A ConfigError where an entry is no name, file of this system or `{name: {parameter: value}}`, or a name comes twice.
    """
    out: dict[str, Numbers] = {}
    for entry in [effects] if isinstance(effects, str | Mapping) else effects:
        pairs: Any = entry
        if isinstance(entry, str):
            pairs = read_for(entry, system, "plant.effects") if is_file(entry) else {entry: None}
        if not isinstance(pairs, Mapping):
            raise ConfigError(f"`effects` takes names or {{name: {{parameter: value}}}}; got {entry!r}.")
        for name, values in pairs.items():
            if not (values is None or isinstance(values, Mapping)):
                raise ConfigError(
                    f"effect {name!r} takes {{parameter: value}}; got {values!r}. "
                    f"Write {{{name}: {{parameter: {values}}}}}."
                )
            if name in out:
                raise ConfigError(f"`effects` names {name!r} twice; name it once.")
            out[str(name)] = dict(values or {})
    return out


def plant_effects(name: str, *, effects: Effects = (), declared_only: bool = False) -> dict[str, Numbers]:
    """Effects of a plant beside the declared physics, with the values that are not those of the effects themselves."""
    spec, own = machine(name), system_class(name)
    present: dict[str, Numbers] = {} if declared_only else {k: dict(v) for k, v in spec.effects.items()}
    for asked, given in named_effects(effects, name).items():
        key = own.effect_key(asked)
        cls = own.effect_class(key)
        for part in cls.includes:  # it stands in for a simpler effect, with the values of that one
            given = {**{k: v for k, v in present.pop(part, {}).items() if k in cls.PARAMETERS}, **given}
        present.setdefault(key, {}).update(given)
    return present


def make_plant_system(
    name: str, *, effects: Effects = (), declared_only: bool = False, values: Mapping[str, Any] | None = None
) -> System:
    """The machine of a plant as a system, with all its effects and the true parameters.

    `effects` are beyond those that the plant has; parameters given there also replace the plant's own, as `values` do
    those of the declared physics. `declared_only` leaves out what that does not have (`effects` are still added). A
    ConfigError where there is no plant of that name, or an effect or parameter is unknown.
    """
    spec = machine(name)
    present = plant_effects(name, effects=effects, declared_only=declared_only)
    declared = make_system(name).effect_names
    parameters: Numbers = {**spec.values, **(values or {})}
    for key, held in present.items():
        called = effect_class(key).name
        parameters.update({f"{called}.{parameter}": value for parameter, value in held.items()})
    return make_system(name, effects=[k for k in present if k not in declared], values=parameters)
