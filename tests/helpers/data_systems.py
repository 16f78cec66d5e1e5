"""Systems as the data layer sees them: names and pairs only, so that data tests need no physics."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Stub:
    """The smallest object that satisfies `nsde_torch.data.SystemInfo`."""

    name: str
    state_names: tuple[str, ...]
    state_units: tuple[str, ...]
    input_names: tuple[str, ...]
    quaternion: slice | None = None
    position_derivatives: tuple[tuple[str, str, str], ...] = ()
    exogenous: tuple[str, ...] = ()
    optional_inputs: tuple[str, ...] = ()

    @property
    def input_units(self) -> tuple[str, ...]:
        return ("1",) * len(self.input_names)


def multirotor(name: str, motors: int, exogenous: tuple[str, ...] = ()) -> Stub:
    """State of a multirotor with so many motors."""
    names = ("p_x", "p_y", "p_z", "v_x", "v_y", "v_z", "q_w", "q_x", "q_y", "q_z", "w_x", "w_y", "w_z")
    units = ("m",) * 3 + ("m/s",) * 3 + ("1",) * 4 + ("rad/s",) * 3
    pairs, inputs = (
        tuple((f"p_{a}", f"v_{a}", "world") for a in "xyz"),
        tuple(f"u_{k + 1}" for k in range(motors)),
    )
    return Stub(name, names, units, inputs, slice(6, 10), pairs, exogenous)


HEXACOPTER = multirotor("hexacopter", 6)
QUADROTOR = multirotor("quadrotor", 4)
RAIL, TURN, SPRING = (("x", "x_dot", "world"), ("theta", "theta_dot", "world"), ("q", "q_dot", "world"))
ALL = ("x", "x_dot", "theta", "theta_dot")
CARTPOLE = Stub("cartpole", ALL, ("m", "m/s", "rad", "rad/s"), ("force",), None, (RAIL, TURN))
MSD = Stub("mass_spring_damper", ("q", "q_dot"), ("m", "m/s"), ("force",), None, (SPRING,), (), ("force",))
