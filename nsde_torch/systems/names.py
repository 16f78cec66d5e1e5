"""The systems of the package: a file each, and a line here. Listing them imports none."""

SYSTEM_HOMES: dict[str, str] = {
    "mass_spring_damper": "nsde_torch.systems.one_dof:MassSpringDamper",
    "cartpole": "nsde_torch.systems.cartpole:Cartpole",
    "hexacopter": "nsde_torch.systems.multirotor:Hexacopter",
    "quadrotor": "nsde_torch.systems.multirotor:Quadrotor",
}
"""Name of a system -> `module:Class`."""
