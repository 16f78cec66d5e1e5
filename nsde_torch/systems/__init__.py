"""Machines: states, inputs, units, frames and declared physics."""

from typing import TYPE_CHECKING

from nsde_torch.lazy import resolver

if TYPE_CHECKING:
    from nsde_torch.systems.base import Defaults, ErrorGroup, ResidualPort, System
    from nsde_torch.systems.cartpole import Cartpole
    from nsde_torch.systems.machine import Excitation, Gust, Machine
    from nsde_torch.systems.multirotor import Hexacopter, Multirotor, Quadrotor
    from nsde_torch.systems.one_dof import MassSpringDamper
    from nsde_torch.systems.options import SystemOptions
    from nsde_torch.systems.registry import SYSTEMS, make_system, system_class

__all__ = [
    "SYSTEMS",
    "Cartpole",
    "Defaults",
    "ErrorGroup",
    "Excitation",
    "Gust",
    "Hexacopter",
    "Machine",
    "MassSpringDamper",
    "Multirotor",
    "Quadrotor",
    "ResidualPort",
    "System",
    "SystemOptions",
    "make_system",
    "system_class",
]

__getattr__ = resolver(
    __name__,
    {
        "SYSTEMS": "registry",
        "Cartpole": "cartpole",
        "Defaults": "base",
        "ErrorGroup": "base",
        "Excitation": "machine",
        "Gust": "machine",
        "Hexacopter": "multirotor",
        "Machine": "machine",
        "MassSpringDamper": "one_dof",
        "Multirotor": "multirotor",
        "Quadrotor": "multirotor",
        "ResidualPort": "base",
        "System": "base",
        "SystemOptions": "options",
        "make_system": "registry",
        "system_class": "registry",
    },
)
