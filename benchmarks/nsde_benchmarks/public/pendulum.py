"""A pendulum with a geared motor at its joint (Wiebe et al., Journal of Open Source Software 7 (2022) 3884).

    J theta'' = tau - m g l sin(theta) - F_v theta' - F_c sign(theta') - offset,      theta = 0 hanging

The repository publishes parameters and recorded swing-ups, and no score. Identified is on one swing-up (DDP); another
(direct collocation) is predicted over half a second from every tenth of a second. The published parameters are
simulated in the same way.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, final

import numpy as np
import torch
from torch import Tensor

from nsde_torch.arrays import Array
from nsde_torch.data.raw import RawRun
from nsde_torch.effects import Parameter, Port
from nsde_torch.errors import DataError
from nsde_torch.systems import Defaults, ResidualPort, System

from .benchmark import BenchmarkMetric, BenchmarkOutcome, PublicBenchmark, Trace
from .files import Work, long_enough, table
from .named import diagnosed, words_of
from .output_error import Stretches, machine, output_error, rms, simulated, times, windows

STEP = 0.004  # both runs are brought to it: they have 2 and 3 ms
SECONDS = 0.5
STRIDE = 25
LEAST = 300
PUBLISHED = {"inertia": 0.06259, "moment": 0.1022, "viscous": 0.04707, "dry": 0.1839, "offset": -0.07586}
"""J [kg m2], m l [kg m], F_v [N m s], F_c [N m] and offset [N m] of results/control_method_pd/system_identification."""
GRAVITY = 9.81
WEIGHTS = np.array([1 / 0.1, 1 / 1.0])


@final
class MotorPendulum(System):
    """A pendulum that a torque drives; weight and viscous friction are declared. The angle is 0 hanging."""

    name = "motor_pendulum"
    state_names = ("theta", "theta_dot")
    state_units = ("rad", "rad/s")
    input_names = ("torque",)
    input_units = ("N m",)
    position_derivatives = (("theta", "theta_dot", "world"),)
    sensor_noise = True
    declared = ("viscous_friction",)
    ports = {Port.TORQUE: 1}
    residual_ports = {Port.TORQUE: ResidualPort(1, 1.0, "rad/s2")}
    PARAMETERS = {
        "torque_gain": Parameter(10.0, "1/(kg m2)", low=0.0, help="1 / inertia"),
        "weight": Parameter(20.0, "1/s2", low=0.0, help="m g l / inertia"),
    }
    defaults = Defaults(STEP, 25, (0.001, 0.5), 0.1, 1.0, "euler_maruyama")
    feature_names = ("sin_theta", "cos_theta", "theta_dot")
    feature_units = ("1", "1", "rad/s")

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        acceleration = self.value("torque_gain") * u - self.value("weight") * torch.sin(x[:, :1])
        if Port.TORQUE in forces:
            acceleration = acceleration + forces[Port.TORQUE]
        return torch.cat((x[:, 1:], acceleration), 1)

    def features(self, x: Tensor) -> Tensor:
        """Sine and cosine of the angle, and the rate (N, 3)."""
        return torch.cat((torch.sin(x[:, :1]), torch.cos(x[:, :1]), x[:, 1:]), 1)


@final
class TorqueLimitedPendulum(PublicBenchmark):
    name = "pendulum"
    title = "a pendulum with a geared motor, swinging up"
    repository = "dfki-ric-underactuated-lab/torque_limited_simple_pendulum"
    files = (
        "results/control_method_ddp/data_measured.csv",
        "results/control_method_direct_collocation/data_measured.csv",
    )
    protocol = (
        "Identified on the swing-up by DDP, predicted open loop over 0.5 s from every 0.1 s of the swing-up by direct "
        "collocation with the measured torque; root mean squares over all steps. The protocol is ours: the repository "
        "publishes parameters and no score."
    )
    metrics = (BenchmarkMetric("angle", "rad"), BenchmarkMetric("rate", "rad/s"))
    published = ()
    minutes = 1

    def run(self, paths: Sequence[Path], work: Work) -> BenchmarkOutcome:
        (x, u), (x_test, u_test) = (_read(path) for path in paths)
        log = RawRun("ddp", times(len(x), STEP), x, u)
        first = work.stage("diagnosis", lambda: diagnosed([log], system=MotorPendulum, say=work.say))

        def identified(more: Mapping[str, Any]) -> System:
            return machine(MotorPendulum, first["effects"], {**first["values"], **more})

        def fitted() -> dict[str, Any]:
            how: dict[str, Any] = {"weights": WEIGHTS, "stage": "fitting to rollouts", "say": work.say}
            return {"values": output_error(identified({}), _cut(x, u), **how).values}

        second = work.stage("output_error", fitted)["values"]
        test = _cut(x_test, u_test)
        models = {
            "published parameters, simulated here": _published(),
            "ours, diagnosis": identified({}),
            "ours, output error": identified(second),
        }
        rows, traces = {}, []
        for name, system in models.items():
            path = simulated(system, test.x[:, 0], test.u, dt=STEP)
            rows[name] = {m.key: rms((path - test.x)[:, 1:, k]) for k, m in enumerate(self.metrics)}
        every = round(SECONDS / STEP) // STRIDE  # stretches that follow one another without overlap
        t = times(len(test.x[::every]) * round(SECONDS / STEP), STEP)
        for k, (title, label) in enumerate((("angle", "angle [rad]"), ("rate", "rate [rad/s]"))):
            measured, predicted = (rows[::every, :-1, k].ravel() for rows in (test.x, path))
            traces.append(Trace(f"{title}, restarted every 0.5 s", label, t, measured, predicted))
        return BenchmarkOutcome(
            rows,
            first["added"],
            {**first["parameters"], "inertia": {"value": 1.0 / second["torque_gain"], "unit": "kg m2"}},
            words_of(first["added"], "the pendulum with viscous friction"),
            traces,
            {"output_error": second},
        )


def _published() -> System:
    """The pendulum with the parameters that the repository states."""
    p, inertia = PUBLISHED, PUBLISHED["inertia"]
    values = {
        "torque_gain": 1.0 / inertia,
        "weight": p["moment"] * GRAVITY / inertia,
        "viscous_friction.damping": p["viscous"] / inertia,
        "coulomb_friction.size": 0.5 * np.pi * p["dry"] / inertia,  # stated as F_c atan(100 theta')
        "coulomb_friction.width": 0.01,
        "constant_force.acceleration": -p["offset"] / inertia,
    }
    effects = ("coulomb_friction", "constant_force")
    return machine(MotorPendulum, effects, values)


def _read(path: Path) -> tuple[Array, Array]:
    """States (n, 2) and torque (n, 1) of a run on one step."""
    held = table(path, ("time", "position", "velocity", "torque"), what="the pendulum")
    t = held["time"]
    long_enough(len(t), LEAST, path)
    if not (np.diff(t) > 0).all():
        raise DataError(f"{path}: the time does not rise throughout. Fetch it again.")
    grid = np.arange(t[0], t[-1], STEP)
    x = np.stack([np.interp(grid, t, held[name]) for name in ("position", "velocity")], 1)
    return x, np.interp(grid + 0.5 * STEP, t, held["torque"])[:, None]


def _cut(x: Array, u: Array) -> Stretches:
    return windows([x], [u], dt=STEP, length=round(SECONDS / STEP), stride=STRIDE)
