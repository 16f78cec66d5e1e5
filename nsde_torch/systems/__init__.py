"""Machines: states, inputs, units, frames and declared physics."""

from typing import TYPE_CHECKING

from nsde_torch.lazy import resolver

if TYPE_CHECKING:
    from nsde_torch.systems.base import System
    from nsde_torch.systems.cartpole import Cartpole
    from nsde_torch.systems.constants import Defaults, ErrorGroup, ResidualPort
    from nsde_torch.systems.machine import Excitation, Gust, Machine
    from nsde_torch.systems.machines import MACHINES, make_plant_system
    from nsde_torch.systems.multirotor import Hexacopter, Multirotor, Quadrotor
    from nsde_torch.systems.one_dof import MassSpringDamper, OneDegreeOfFreedom
    from nsde_torch.systems.options import SystemOptions
    from nsde_torch.systems.registry import SYSTEMS, make_system, system_class

__all__ = [
    "MACHINES",
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
    "OneDegreeOfFreedom",
    "Quadrotor",
    "ResidualPort",
    "System",
    "SystemOptions",
    "make_plant_system",
    "make_system",
    "system_class",
]

__getattr__ = resolver(
    __name__,
    {
        "MACHINES": "machines",
        "SYSTEMS": "registry",
        "Cartpole": "cartpole",
        "Defaults": "constants",
        "ErrorGroup": "constants",
        "Excitation": "machine",
        "Gust": "machine",
        "Hexacopter": "multirotor",
        "Machine": "machine",
        "MassSpringDamper": "one_dof",
        "Multirotor": "multirotor",
        "OneDegreeOfFreedom": "one_dof",
        "Quadrotor": "multirotor",
        "ResidualPort": "constants",
        "System": "base",
        "SystemOptions": "options",
        "make_plant_system": "machines",
        "make_system": "registry",
        "system_class": "registry",
    },
)
