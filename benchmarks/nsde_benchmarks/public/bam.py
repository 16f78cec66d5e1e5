"""BAM: a servo that swings a pendulum, whose friction models are compared by simulated trajectories (ICRA 2025).

    (J + (m + a/3) l^2) theta'' = tau + sum of torques - (m + a/2) g l sin(theta - theta_0)
    tau = s (clip(k (goal - theta), -c, c) - e theta')         nothing while the servo is off

k [1/rad] is the gain of the servo's controller, set for each run; its duty cycle is limited to c. s is the stall torque
and e the speed constant of a direct-current motor behind its gears: s = k_t V / R, e = k_t / V. Mass m at the end of an
arm of length l and mass a are those of the run. Friction is not declared: the catalogue has it.

The recordings of that paper are not in its repository. These are of another bench that follows its pipeline: a Feetech
STS3250 at eight loads, six gains and five trajectories, with the six friction models fitted and their scores published.
Terms of the catalogue are tried one after another by output error: one is taken where the simulation of recordings at a
gain that was held out is better by more than `GAIN`, the best first. All training recordings then give the values.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, final

import numpy as np
import torch
from torch import Tensor

from nsde_torch.arrays import Array
from nsde_torch.data.raw import RawRun
from nsde_torch.effects import Coordinate, Parameter, Port
from nsde_torch.errors import DataError
from nsde_torch.systems import Defaults, ResidualPort, System

from .benchmark import BenchmarkMetric, BenchmarkOutcome, PublicBenchmark, PublishedRow, Trace
from .files import Work, found, long_enough
from .named import diagnosed, ladder, words_of
from .output_error import Stretches, machine, output_error, simulated, times, with_units

HOME = "data/feetech/STS_3250"
REPOSITORY = "kscalelabs/sysid"
COMMIT = "140d9c5"
MODELS = ("m1", "m2", "m3", "m4", "m5", "m6")
LOGS = {"training": 462, "validation": 353}
PARTS = ("training", "validation", "validation_whole")
ROWS = 621  # of the shortest recording, to which the set cuts all of them
DUTY_PER_GAIN = 0.16383  # duty cycle per radian and unit of the gain, as the set measured it
VOLTS = 15.0  # what its recordings state, and its models were fitted with
HELD_OUT = 8  # gain
THINNED = 6  # of the recordings at other gains, one in so many chooses terms
DIAGNOSED = 20  # of all recordings for training, one in so many is diagnosed
ROWS_OF_A_STEP = 2  # of a diagnosed log: what was measured has 10 ms, and was interpolated
GAIN = 0.02
ITERATIONS = (8, 12)
WIDTH = 0.05  # speed [rad/s] at which dry friction is 76 % developed: two steps of the logged speed
CANDIDATES: dict[str, dict[str, float]] = {
    "input_delay": {"delay": 0.02},
    "coulomb_friction": {"size": 0.05, "width": WIDTH},
    "load_friction": {"coefficient": 0.1, "width": WIDTH},
    "viscous_friction": {"damping": 0.02},
    "quadratic_damping": {"damping": 0.01},
    "hysteresis": {"size": 0.05, "reach": 0.02},
}
"""Terms that are tried, and first values."""
_FIRST = {"stall_torque": 10.0, "speed_constant": 0.2}
Logs = Sequence[Mapping[str, Any]]
_TYPICAL = 0.03  # error [rad]
_SCORES = (0.0329, 0.0328, 0.0307, 0.0304, 0.0303, 0.0299)
GRAVITY = 9.80665
DUTY_LIMIT = 0.97
STEP = 0.005


@final
class ServoPendulum(System):
    """A pendulum on a servo. Motor, controller, weight and inertias are declared; the angle is 0 hanging."""

    name = "servo_pendulum"
    state_names = ("theta", "theta_dot")
    state_units = ("rad", "rad/s")
    input_names = ("goal", "gain", "enabled", "mass", "length")
    input_units = ("rad", "1/rad", "1", "kg", "m")
    position_derivatives = (("theta", "theta_dot", "world"),)
    sensor_noise = True
    ports = {Port.TORQUE: 1}
    quantities = {"gear_load": 1}
    coordinates = (
        Coordinate(
            "arm",
            "theta_dot",
            Port.TORQUE,
            "theta",
            kind="joint",
            unit="N m",
            words="the arm",
            load="gear_load",
        ),
    )
    residual_ports = {Port.TORQUE: ResidualPort(1, 0.1, "N m")}
    PARAMETERS = {
        "stall_torque": Parameter(5.0, "N m", low=0.0, help="torque at rest and a duty cycle of 1"),
        "speed_constant": Parameter(0.2, "s/rad", low=0.0, help="duty cycle that a speed takes"),
        "rotor_inertia": Parameter(0.01, "kg m2", low=0.0, scale=0.01, help="of motor and gears, at the arm"),
        "angle_offset": Parameter(0.0, "rad", scale=0.01, help="what the sensor reads of a hanging arm"),
    }
    defaults = Defaults(STEP, 50, (0.001, 0.05), 0.1, 1.0, "euler_maruyama")
    feature_names = ("sin_theta", "cos_theta", "theta_dot")
    feature_units = ("1", "1", "rad/s")

    def dynamics(self, t: float | Tensor, x: Tensor, u: Tensor, forces: Mapping[Port, Tensor]) -> Tensor:
        mass, length = u[:, 3:4], u[:, 4:5]
        inertia = (mass + _arm(length) / 3.0) * length * length + self.value("rotor_inertia")
        torque = self._motor(x, u) + self._weight(x, u)
        if Port.TORQUE in forces:
            torque = torque + forces[Port.TORQUE]
        return torch.cat((x[:, 1:], torque / inertia), 1)

    def quantity(self, name: str, x: Tensor, u: Tensor) -> Tensor:
        """What the gears carry between motor and arm (N, 1) [N m]: torque of the motor less that of the weight."""
        if name == "gear_load":
            return self._motor(x, u) - self._weight(x, u)
        return super().quantity(name, x, u)

    def features(self, x: Tensor) -> Tensor:
        """Sine and cosine of the angle, and the rate (N, 3)."""
        return torch.cat((torch.sin(x[:, :1]), torch.cos(x[:, :1]), x[:, 1:]), 1)

    def _motor(self, x: Tensor, u: Tensor) -> Tensor:
        duty = (u[:, 1:2] * (u[:, :1] - x[:, :1])).clamp(-DUTY_LIMIT, DUTY_LIMIT)
        return u[:, 2:3] * self.value("stall_torque") * (duty - self.value("speed_constant") * x[:, 1:])

    def _weight(self, x: Tensor, u: Tensor) -> Tensor:
        mass, length = u[:, 3:4], u[:, 4:5]
        turned = torch.sin(x[:, :1] - self.value("angle_offset"))
        return -(mass + 0.5 * _arm(length)) * GRAVITY * length * turned


def _arm(length: Tensor) -> Tensor:
    """Mass of the arm [kg], from the two that the set states: 36 g at 0.1 m, 50 g at 0.15 m."""
    return 0.008 + 0.28 * length


# The six friction models that BAM simulates a servo's pendulum with: a budget that may hold the arm at rest.
#
#     M1  c + b |v|                                              Coulomb and viscous
#     M2  M1 + s(v) c_s                    s(v) = exp(-|v / v_s|^alpha)                                         Stribeck
#     M3  M1 + k |tau_e - tau_m|                                                                        load-dependent
#     M4  M2 + (k + s(v) k_s) |tau_e - tau_m|
#     M5  M2 + |k_e tau_e - k_m tau_m| + s(v) |k_es tau_e - k_ms tau_m|                                    directional
#     M6  M5 + s(v) q tau^2 where the smaller of the two torques opposes the larger                          quadratic
#
# tau_m is the motor's torque, tau_e that of the weight. Friction takes what would stop the arm within a step,
# and no more than its budget. (Duclusaud, Passault, Padois, Ly, Extended friction models for the physics
# simulation of servo actuators, ICRA 2025.)


def budget(p: Mapping[str, float], motor: Array, weight: Array, speed: Array) -> Array:
    """Largest friction torque (N,) [N m]."""
    still = np.zeros_like(speed)
    if "dtheta_stribeck" in p:
        still = np.exp(-(np.abs(speed / p["dtheta_stribeck"]) ** p["alpha"]))
    out = p["friction_base"] + p["friction_viscous"] * np.abs(speed) + still * p.get("friction_stribeck", 0.0)
    if "load_friction_motor" in p:
        for extra, share in (("", np.ones_like(still)), ("_stribeck", still)):
            of_weight, of_motor = (p[f"load_friction_{side}{extra}"] for side in ("external", "motor"))
            out = out + share * np.abs(of_weight * weight - of_motor * motor)
    else:
        share = p.get("load_friction_base", 0.0) + still * p.get("load_friction_stribeck", 0.0)
        out = out + share * np.abs(weight - motor)
    if "load_friction_motor_quad" in p:
        opposed = np.sign(weight) != np.sign(motor)
        of_weight, of_motor = (p[f"load_friction_{side}_quad"] for side in ("external", "motor"))
        drives = np.abs(motor) > np.abs(weight)
        out = out + still * opposed * np.where(drives, of_weight * weight**2, of_motor * motor**2)
    result: Array = out
    return result


def swing(p: Mapping[str, float], x: Array, u: Array) -> Array:
    """Angles (B, T + 1) [rad] of pendulums on a servo, by the steps of BAM."""
    angle, speed = x[:, 0].copy(), x[:, 1].copy()
    mass, length = u[:, 0, 3], u[:, 0, 4]
    inertia = mass * length**2 + p["armature"]  # as the set was fitted: without the mass of the arm
    out = np.empty((len(x), u.shape[1] + 1))
    out[:, 0] = angle
    for k in range(u.shape[1]):
        goal, gain, on = u[:, k, :3].T
        duty = np.clip(gain * (goal - angle), -DUTY_LIMIT, DUTY_LIMIT)
        motor = on * p["kt"] / p["R"] * (VOLTS * duty - p["kt"] * speed)
        weight = -mass * GRAVITY * length * np.sin(angle + p["q_offset"])
        stops = inertia / STEP * speed + motor + weight
        friction = -np.sign(stops) * np.minimum(np.abs(stops), budget(p, motor, weight, speed))
        acceleration = (motor + weight + friction) / inertia
        speed = speed + STEP * acceleration
        angle = angle + STEP * speed + 0.5 * STEP**2 * acceleration
        out[:, k + 1] = angle
    return out


@final
class Bam(PublicBenchmark):
    name = "bam"
    title = "BAM: a position-controlled servo that swings a pendulum"
    repository = REPOSITORY
    files = (
        f"{HOME}/processed/*.json",
        f"{HOME}/processed/validation/*.json",
        *(f"{HOME}/friction_params/{model}.json" for model in MODELS),
    )
    protocol = (
        f"At commit {COMMIT}: identified on the {LOGS['training']} recordings in processed/, simulated from the first "
        f"angle and speed with the controller in the loop; mean absolute error of the angle over the first {ROWS} "
        "samples (3.1 s), as the published scores are. Then the same of the recordings in validation/, and over the "
        "whole of these."
    )
    metrics = tuple(BenchmarkMetric(part, "mrad", digits=1) for part in PARTS)
    published = tuple(
        PublishedRow(f"{m.upper()}, as published", {"training": 1e3 * v}, f"{REPOSITORY}, {HOME}/README.md")
        for m, v in zip(MODELS, _SCORES, strict=True)
    )
    minutes = 7

    def paths(self, folder: Path) -> list[Path]:
        home = folder / HOME if (folder / HOME).is_dir() else folder
        if folder.is_dir() and not (home / "processed").is_dir():
            raise DataError(
                f"`data.path={folder}` holds no {HOME}/processed. Name a checkout of {self.repository} at commit "
                f"{COMMIT}: newer ones hold the recordings in archives."
            )
        out = []
        for part, count in LOGS.items():
            inside = home / "processed" / ("" if part == "training" else part)
            logs = sorted(inside.glob("*.json"))
            if folder.is_dir() and len(logs) != count:
                raise DataError(
                    f"{inside} holds {len(logs)} recordings and not {count}. Check out {COMMIT} of {self.repository} "
                    "again."
                )
            out += logs
        models = [f"friction_params/{model}.json" for model in MODELS]
        return [*out, *found(home, models, repository=self.repository)]

    def run(self, paths: Sequence[Path], work: Work) -> BenchmarkOutcome:
        logs = []
        for k, path in enumerate(paths[: -len(MODELS)]):
            work.say("reading", k, len(paths))
            logs.append(_read(path))
        training, validation = logs[: LOGS["training"]], logs[LOGS["training"] :]
        others = [log for log in training if log["kp"] != HELD_OUT][::THINNED]
        held_out = [log for log in training if log["kp"] == HELD_OUT]

        named = work.stage("diagnosis", lambda: _diagnosed(training[::DIAGNOSED], work))

        def tried(effects: tuple[str, ...], first: Mapping[str, Any]) -> dict[str, Any]:
            def make() -> dict[str, Any]:
                values = _fitted(effects, first, others, ITERATIONS[0], work)
                error = _error(effects, values, held_out)
                return {"effects": list(effects), "values": values, "held_out": error}

            return work.stage("_".join(["model", *effects]), make)

        rungs = ladder(tried, CANDIDATES, first=_FIRST, error="held_out", gain=GAIN)
        taken = tuple(rungs[-1]["effects"])
        rows: dict[str, dict[str, float]] = {}
        parts = dict(zip(PARTS, ((training, ROWS), (validation, ROWS), (validation, None)), strict=True))
        for model, path in zip(MODELS, paths[-len(MODELS) :], strict=True):
            swung = partial(swing, _parameters(path))
            rows[f"{model.upper()}, published values, simulated here"] = {
                key: 1e3 * _mean(_batches(part, count), swung) for key, (part, count) in parts.items()
            }
        for made in (rungs[0], rungs[-1]):
            effects = tuple(made["effects"])

            def all_logs(effects: tuple[str, ...] = effects, first: Any = made["values"]) -> dict[str, Any]:
                return {"values": _fitted(effects, first, training, ITERATIONS[1], work)}

            last = work.stage("_".join(["final", *effects]), all_logs)["values"]
            name = " + ".join(["motor and weight", *effects])
            rows[f"ours, {name}"] = {
                key: 1e3 * _error(effects, last, part, count) for key, (part, count) in parts.items()
            }
        errors = [{"effects": m["effects"], "mrad": 1e3 * m["held_out"]} for m in rungs]
        return BenchmarkOutcome(
            rows,
            taken,
            with_units(_machine(taken, last), last),
            [
                *words_of(taken, "the motor with its controller and the weight"),
                f"Named by a diagnosis of {len(training[::DIAGNOSED])} recordings, their logged speeds with them "
                f"({named['verdict']}): {', '.join(named['named']) or 'nothing'}.",
            ],
            _traces(taken, last, validation),
            {"diagnosis": named, "held_out": errors},
        )


def _read(path: Path) -> dict[str, Any]:
    """States (n, 2), inputs (n - 1, 5), gain and trajectory of a recording."""
    try:
        log = json.loads(path.read_text(encoding="utf-8"))
        rows = log["entries"]
        long_enough(len(rows), ROWS, path)
        x = np.array([[row["position"], row["speed"]] for row in rows], dtype=np.float64)
        moving = np.array([[r["goal_position"], r["torque_enable"]] for r in rows[:-1]], dtype=np.float64)
        same = [float(log["kp"]) * DUTY_PER_GAIN, float(log["mass"]), float(log["length"])]
        step, kind = float(log["dt"]), str(log["trajectory"])
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{path} is no recording of a servo, or is cut off ({error!r}). Fetch it again."
        ) from None
    if abs(step - STEP) > 1e-9 or not (np.isfinite(x).all() and np.isfinite(moving).all()):
        raise DataError(
            f"{path} has steps of {step} s or holds what is no number; it is to be on {STEP} s. Fetch it again."
        )
    gain, mass, length = np.broadcast_to(np.array(same)[:, None], (3, len(moving)))
    u = np.stack([moving[:, 0], gain, moving[:, 1], mass, length], 1)
    return {"x": x, "u": u, "kp": int(log["kp"]), "kind": kind}


def _diagnosed(logs: Logs, work: Work) -> dict[str, Any]:
    """What a diagnosis finds missing in the declared physics."""
    step = ROWS_OF_A_STEP * STEP
    runs = []
    for k, log in enumerate(logs):
        x, u = log["x"][: ROWS - 1 : ROWS_OF_A_STEP], log["u"][: ROWS - 1 : ROWS_OF_A_STEP]
        runs.append(RawRun(f"recording {k}", times(len(x), step), x, u))
    seen = diagnosed(runs, system=ServoPendulum, parameters=_FIRST, say=work.say)
    named = [
        f"{name} {entry['value']:.4g} {entry['unit']}"
        for name, entry in seen["parameters"].items()
        if name.split(".")[0] in seen["added"]
    ]
    return {"verdict": seen["verdict"], "named": named or list(seen["added"])}


def _parameters(path: Path) -> dict[str, float]:
    """Parameters of a friction model of the set."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        p = {str(key): float(value) for key, value in content.items() if not isinstance(value, str)}
        missing = {"kt", "R", "armature", "q_offset", "friction_base", "friction_viscous"} - set(p)
    except (ValueError, TypeError, AttributeError) as error:
        raise DataError(
            f"{path} holds no parameters of a friction model ({error}). Fetch it again."
        ) from None
    if missing:
        raise DataError(f"{path} lacks {', '.join(sorted(missing))}. Fetch it again.")
    return p


def _batches(logs: Logs, count: int | None) -> list[tuple[Array, Array]]:
    """States and inputs of recordings of like length, the first `count` rows of each."""
    lengths = sorted({len(log["x"]) for log in logs}) if count is None else [count]
    out = []
    for n in lengths:
        like = [log for log in logs if count is not None or len(log["x"]) == n]
        out.append((np.stack([log["x"][:n] for log in like]), np.stack([log["u"][: n - 1] for log in like])))
    return out


def _mean(batches: Sequence[tuple[Array, Array]], path: Callable[[Array, Array], Array]) -> float:
    """Mean over recordings of the mean absolute error of each angle [rad] that is simulated from a first state."""
    return float(np.concatenate([np.abs(path(x[:, 0], u) - x[..., 0]).mean(1) for x, u in batches]).mean())


def _machine(effects: tuple[str, ...], values: Mapping[str, Any]) -> Any:
    first = {f"{name}.{key}": value for name in effects for key, value in CANDIDATES[name].items()}
    return machine(ServoPendulum, effects, {**first, **values})


def _fitted(
    effects: tuple[str, ...], first: Mapping[str, Any], logs: Logs, iterations: int, work: Work
) -> dict[str, Any]:
    """Values whose simulations have the smallest mean absolute error of the angle."""
    ((x, u),) = _batches(logs, ROWS)
    estimate = output_error(
        _machine(effects, first),
        Stretches(x, u, STEP),
        weights=np.array([1.0 / _TYPICAL, 0.0]),
        fixed=tuple(f"{name}.width" for name in effects if "width" in CANDIDATES[name]),
        groups=((0,),),
        side_by_side=True,
        iterations=iterations,
        stage=f"fitting {' + '.join(['motor and weight', *effects])}",
        say=work.say,
    )
    return dict(estimate.values)


def _error(
    effects: tuple[str, ...],
    values: Mapping[str, Any],
    logs: Logs,
    count: int | None = ROWS,
) -> float:
    """Mean absolute error of simulated angles [rad]."""
    system = _machine(effects, values)
    return _mean(_batches(logs, count), lambda x, u: simulated(system, x, u, dt=STEP)[..., 0])


def _traces(effects: tuple[str, ...], values: Mapping[str, Any], logs: Logs) -> list[Trace]:
    """One recording of each trajectory, the first one of the middle gain."""
    out = []
    for kind in sorted({log["kind"] for log in logs}):
        like = sorted((log for log in logs if log["kind"] == kind), key=lambda log: abs(log["kp"] - 16))[0]
        ((x, u),) = _batches([like], None)
        path = simulated(_machine(effects, values), x[:, 0], u, dt=STEP)
        title = f"{kind.replace('_', ' ')}, gain {like['kp']}, validation"
        out.append(Trace(title, "angle [rad]", times(x.shape[1], STEP), x[0, :, 0], path[0, :, 0]))
    return out
