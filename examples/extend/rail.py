"""A system of one's own, with its simulated machine: a carriage that a belt drives along a rail.

    p'' = -c p' + k V + what else pushes        V the voltage of the motor

The friction -c p' is an effect of the catalogue. The simulated carriage has a dry friction that is not declared.
"""

from collections.abc import Mapping
from typing import final

import torch
from torch import Tensor

from nsde_torch.effects import Parameter, Port
from nsde_torch.systems import Defaults, ErrorGroup, Gust, Machine, ResidualPort, System
from nsde_torch.systems.machine import Excitation


@final
class Rail(System):
    """A carriage on a rail, states p [m] and p_dot [m/s], input V [V]."""

    name = "rail"
    state_names = ("p", "p_dot")
    state_units = ("m", "m/s")
    input_names = ("voltage",)
    input_units = ("V",)
    position_derivatives = (("p", "p_dot", "world"),)
    sensor_noise = True

    # Physics: what is declared, where more may push, what is fitted.
    declared = ("viscous_friction",)
    ports = {Port.FORCE: 1}
    residual_ports = {Port.FORCE: ResidualPort(1, 0.5, "m/s2")}
    PARAMETERS = {"gain": Parameter(1.0, "m/(s2 V)", low=0.0, help="acceleration per volt")}

    # Step [s], steps of a window, largest diffusion of each state, radius and weight of a loss, integrator.
    defaults = Defaults(0.02, 25, (0.001, 0.05), 0.1, 1.0, "euler_maruyama")
    error_names = state_names
    error_groups = (ErrorGroup("position", (0,), "m"), ErrorGroup("velocity", (1,), "m/s"))
    feature_names = ("p_dot",)
    feature_units = ("m/s",)

    # What `nsde simulate` and `data=simulated` make runs of: true values, noise, and how the inputs swing.
    machine = Machine(
        values={"gain": 2.0, "viscous_friction.damping": 1.5},
        effects={"coulomb_friction": {"size": 0.6}},
        gusts={Port.FORCE: Gust(white=(0.02,))},
        sensor_std=(0.001, 0.005),
        limits=(-12.0, 12.0),
        dt=0.01,
        step=0.005,
        excitation=Excitation(size=(1.5,), hertz=(0.2, 2.0), durations=(12.0,) * 4),
    )

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        """Rate (N, 2) of the states (N, 2); `forces` is the sum of all effects on each port."""
        acceleration = self.value("gain") * u
        if Port.FORCE in forces:
            acceleration = acceleration + forces[Port.FORCE]
        return torch.cat((x[:, 1:], acceleration), 1)

    def features(self, x: Tensor) -> Tensor:
        """What the physics depends on: the velocity (N, 1)."""
        return x[:, 1:]
