"""Machines: states, inputs, units, frames and declared physics."""

from typing import TYPE_CHECKING

from nsde_torch.lazy import names, resolver

if TYPE_CHECKING:
    from nsde_torch.systems.base import System
    from nsde_torch.systems.machine import Excitation, Gust, Machine
    from nsde_torch.systems.machines import MACHINES, make_plant_system
    from nsde_torch.systems.multirotor import Hexacopter, Multirotor, Quadrotor
    from nsde_torch.systems.one_dof import Cartpole, MassSpringDamper, OneDegreeOfFreedom
    from nsde_torch.systems.options import SystemOptions
    from nsde_torch.systems.registry import SYSTEMS, make_system, system_class
    from nsde_torch.systems.values import Defaults, ErrorGroup, ResidualPort

__all__ = names(__name__)

__getattr__ = resolver(__name__)
