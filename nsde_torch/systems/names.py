"""The systems of the package: a file each, and a line here. Listing them imports none."""

SYSTEM_HOMES: dict[str, str] = {
    "mass_spring_damper": "nsde_torch.systems.one_dof:MassSpringDamper",
    "cartpole": "nsde_torch.systems.one_dof:Cartpole",
    "hexacopter": "nsde_torch.systems.multirotor:Hexacopter",
    "quadrotor": "nsde_torch.systems.multirotor:Quadrotor",
}
"""Name of a system -> `module:Class`."""

MIXED = ("collective", "roll_command", "pitch_command", "yaw_command")
"""Sums of the inputs of a machine with motors, by the rows of its `mixing`."""
