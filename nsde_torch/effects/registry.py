"""Effects by name: those of the catalogue, and `package.module:Class` of the user's own."""

from collections.abc import Collection, Mapping

from nsde_torch.effects.actuators import ActuatorDeadband, ActuatorGainDrift, ActuatorSaturation
from nsde_torch.effects.base import Effect, Port
from nsde_torch.effects.cartpole import (
    AngleBias,
    CartCoulombFriction,
    CartViscousFriction,
    PoleCoulombFriction,
    PoleViscousFriction,
    TrackTilt,
)
from nsde_torch.effects.delay import InputDelay
from nsde_torch.effects.forces import ConstantForce, PeriodicForce
from nsde_torch.effects.friction import (
    AsymmetricFriction,
    CoulombFriction,
    QuadraticDamping,
    StribeckFriction,
    ViscousFriction,
)
from nsde_torch.effects.lag import ActuatorLag, MotorLag
from nsde_torch.effects.multirotor_drag import ConstantWind, LinearDrag, QuadraticDrag
from nsde_torch.effects.multirotor_forces import ConstantWorldForce, GroundEffect, ThrustMisalignment
from nsde_torch.effects.multirotor_frame import FrameMisalignment
from nsde_torch.effects.multirotor_moments import (
    AngularDamping,
    ComOffset,
    FlappingMoment,
    GyroscopicMoment,
    InertiaCoupling,
)
from nsde_torch.effects.multirotor_thrust import BatteryVoltage, MotorEfficiencyLoss, ThrustCurve, ThrustSag
from nsde_torch.effects.stiffness import CubicStiffness, LinearSpring
from nsde_torch.errors import ConfigError
from nsde_torch.lookup import class_by_name, did_you_mean

EFFECTS: dict[str, type[Effect]] = {
    cls.name: cls
    for cls in (
        # any system
        ConstantForce,
        PeriodicForce,
        CoulombFriction,
        AsymmetricFriction,
        StribeckFriction,
        ViscousFriction,
        QuadraticDamping,
        LinearSpring,
        CubicStiffness,
        InputDelay,
        ActuatorLag,
        ActuatorDeadband,
        ActuatorSaturation,
        ActuatorGainDrift,
        # cart and pole
        CartCoulombFriction,
        CartViscousFriction,
        PoleCoulombFriction,
        PoleViscousFriction,
        TrackTilt,
        AngleBias,
        # multirotors
        LinearDrag,
        QuadraticDrag,
        ConstantWind,
        ConstantWorldForce,
        GroundEffect,
        ThrustMisalignment,
        FrameMisalignment,
        AngularDamping,
        ComOffset,
        GyroscopicMoment,
        FlappingMoment,
        InertiaCoupling,
        MotorLag,
        MotorEfficiencyLoss,
        ThrustSag,
        BatteryVoltage,
        ThrustCurve,
    )
}


_OWN: dict[str, type[Effect]] = {}
"""Effects of the user's own that `register` made known."""


def register(name: str) -> str:
    """Make an effect known by its own name, so that `effects_of` lists it and a diagnosis tries it.

    Args:
        name: `package.module:Class` of the user's own.

    Returns:
        The effect's own name.

    Raises:
        ConfigError: as `effect_class`, or another effect has that name.
    """
    cls = effect_class(name)
    if _known().get(cls.name, cls) is not cls:
        raise ConfigError(
            f"effect {name!r}: another effect is called {cls.name!r}; give it a `name` of its own."
        )
    if EFFECTS.get(cls.name) is not cls:
        _OWN[cls.name] = cls
    return cls.name


def key_of(cls: type[Effect]) -> str:
    """What names an effect in any process: its name in the catalogue, or `module:Class`."""
    return cls.name if EFFECTS.get(cls.name) is cls else f"{cls.__module__}:{cls.__qualname__}"


def _known() -> dict[str, type[Effect]]:
    return {**EFFECTS, **_OWN}


def effect_class(name: str) -> type[Effect]:
    """Class of an effect: a key of `EFFECTS`, or `package.module:Class` of the user's own.

    Raises:
        ConfigError: unknown name (lists the choices), no such module or class, or not an Effect.
    """
    return class_by_name(name, _known(), Effect, kind="effect", home="nsde_torch.effects")


def make_effect(
    name: str,
    *,
    system: str,
    ports: Collection[Port],
    n_inputs: int,
    values: Mapping[str, float | list[float]] | None = None,
) -> Effect:
    """Make an effect by name.

    Args:
        name: Key in `EFFECTS`, or `package.module:Class`.
        system: Name of the system that it will act on, for the message.
        ports: Ports of that system.
        n_inputs: Number of inputs of that system.
        values: Initial values of its parameters.

    Raises:
        ConfigError: unknown name, or an effect that is not for that system; lists the choices.
    """
    known = effects_of(system, ports)
    if ":" not in name and name not in known:
        what = f"does not act on system {system!r}" if name in _known() else "is not in the catalogue"
        raise ConfigError(
            f"effect {name!r} {what}; choose among: {', '.join(sorted(known)) or 'none'}.{did_you_mean(name, known)}"
        )
    cls = effect_class(name)
    if not cls.fits(system, ports):
        raise ConfigError(
            f"effect {name!r} acts on the port {cls.port.value!r} and does not fit system {system!r}, whose ports "
            f"are {', '.join(sorted(p.value for p in ports))}."
        )
    return cls(values, n_inputs=n_inputs)


def effects_of(system: str, ports: Collection[Port]) -> dict[str, type[Effect]]:
    """The effects of the catalogue, and those registered, that a system of this name and these ports can have."""
    return {name: cls for name, cls in _known().items() if cls.fits(system, {*ports, Port.INPUT})}
