"""Keys of the config groups that several commands share, and the choices of groups; made of the library's options."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from nsde_torch.control.options import (
    CircleOptions,
    EstimatorOptions,
    HoverOptions,
    LemniscateOptions,
    ProblemOptions,
    SafetyOptions,
    SetpointOptions,
    SolverOptions,
    WaypointOptions,
)
from nsde_torch.data.readers import READERS
from nsde_torch.models.options import MODELS
from nsde_torch.px4.options import Limits, SetpointLimits
from nsde_torch.recording.faults import RemedyOptions
from nsde_torch.sde.options import STEP_HOMES, IntegratorOptions, TorchDiffEqOptions
from nsde_torch.systems.names import SYSTEM_HOMES
from nsde_torch.systems.options import SystemOptions
from nsde_torch.training.options import LossOptions, TrainerOptions

from .keys import key, mirrors, of


def _choice(base: type, name: str, doc: str | None, *, kind: Any = None, options: type | None = None) -> type:
    """Keys of a choice: those of its group, a `kind` of its own if it has one, and every option of a library class."""
    space: dict[str, Any] = {"__doc__": doc, "__module__": __name__}
    if kind is not None:
        space |= {"__annotations__": {"kind": "str"}, "kind": kind}
    made = type(name, (base,), space)
    return dataclass(made) if options is None else mirrors(options)(made)


# --- system, model, loss, trainer, solver -----------------------------------------------------------------------------


@mirrors(SystemOptions)
class SystemConfig:
    """The machine. A value of null is the system's own: its class has the constants of the supplement."""


@dataclass
class ModelConfig:
    """What is learned."""

    kind: str = key("???", "kind of the model, set by model=")


@dataclass
class OwnModel(ModelConfig):
    """A kind of model of the user's own."""

    kind: str = key("???", "kind of the model: module:Class of your own")
    options: dict[str, Any] = key({}, "its options, model.options.NAME=1")


_MODELS: dict[str, type] = {
    **{
        name: _choice(ModelConfig, cls.__name__.replace("Options", "Model"), cls.__doc__, options=cls)
        for name, cls in MODELS.items()
    },
    "own": OwnModel,
}


@mirrors(LossOptions, without=("ball_radius",))
class LossConfig:
    """Weights and sizes of the losses; the radius of the ball is a constant of the machine."""

    kind: str = of(LossOptions, "kind", default="???")


@mirrors(TrainerOptions)
class TrainerConfig:
    """Optimisation."""


@mirrors(IntegratorOptions)
class SolverConfig:
    """The integrator."""


@mirrors(TorchDiffEqOptions)
class TorchDiffEqSolver(SolverConfig):
    """A method of torchdiffeq."""


# --- data -------------------------------------------------------------------------------------------------------------


@dataclass
class RunChoice:
    """Which runs of a data set are held out, or scored on."""

    kind: str = key("???", "kind of the data set, set by data=")
    test: list[Any] | None = key(
        None, "runs to test on, by index or name; null: the last run (evaluate with data=: all)"
    )
    test_path: str | None = key(
        None,
        "file or folder of further runs to test on, recorded by sensors of another noise perhaps",
        file=True,
    )


@dataclass
class DataConfig(RunChoice):
    """What every data set has."""

    validation: float = key(
        0.15, "share of the training runs' time that early stopping looks at", low=0.01, high=0.5
    )
    gap: float | None = key(
        None, "a longer pause between rows splits a run; null: 2.5 steps of the data", unit="s", above=0
    )
    clock: str = key(
        "rescale",
        "what to do when the kinematics disagree with the clock, or with a single rate",
        choices=("rescale", "trust", "refuse"),
    )
    instruments: list[str] = key(
        [],
        "logged columns that nothing inside the control loop moves: sticks, setpoints, data.instruments=[stick_roll]",
    )


@dataclass
class SimulatedData(DataConfig):
    """Runs made by a plant in the package."""

    kind: str = key("simulated", "kind of the data set, set by data=")
    durations: list[float] | None = key(None, "length of each run; null: the system's own", unit="s", above=0)
    seed: int = key(0, "seed of the simulated flights and their noise", low=0)
    effects: Any = key(
        [],
        "effects that the plant has and the model does not declare: names, or {NAME: {parameter: 1}}",
        file=True,
    )
    process_noise: float = key(1.0, "strength of the gusts, relative to the plant's own", low=0)
    sensor_noise: float = key(1.0, "strength of the measurement noise, relative to the plant's own", low=0)
    cache: str | None = key(
        None, "folder that keeps simulated runs; null: NSDE_CACHE or the user's cache folder", file=True
    )
    options: dict[str, Any] = key({}, "further options of the system's recording, data.options.NAME=1")


@dataclass
class Files(DataConfig):
    """Where runs are read from."""

    path: str = key("???", "file or folder to read", file=True)
    dt: float | None = key(None, "step to resample to; null: the step of the data", unit="s", above=0)
    state_smoothing: str = key(
        "restore",
        "what to do with states that were smoothed before they were logged, and with inputs that were measured",
        choices=("restore", "keep"),
    )
    derived_rates: str = key(
        "infer", "what to do with rates that were made of positions", choices=("infer", "keep")
    )
    most_rows: int | None = key(
        None,
        "rows in all that are used of a longer log, in stretches spread over each run; null: as many as hold 1.5 "
        "million states and inputs",
        low=2,
    )
    stream_offsets: str = key(
        "undo", "what to do with streams whose offsets differ between runs", choices=("undo", "keep")
    )


@mirrors(RemedyOptions)
class FileData(Files):
    """Runs read from files, and what is to be taken out of them."""


@dataclass
class MappedData(FileData):
    """Runs read from logs through a mapping."""

    mapping: str | None = key(
        None,
        "YAML file that says what columns mean, as `nsde inspect` writes it; null: mapping.yaml beside the logs, else "
        "a proposal",
        file=True,
    )


@dataclass
class OwnData(FileData):
    """Runs that a reader of the user's own returns."""

    kind: str = key("???", "the reader: module:function of your own")
    options: dict[str, Any] = key({}, "its further arguments, data.options.NAME=1")


_DATA: dict[str, type] = {
    "simulated": SimulatedData,
    **{
        kind: _choice(
            MappedData if reader.mapped else FileData,
            f"{kind.title()}Data",
            reader.summary,
            kind=key(kind, "kind of the data set, set by data="),
        )
        for kind, reader in READERS.items()
    },
    "own": OwnData,
}


# --- reference --------------------------------------------------------------------------------------------------------


@dataclass
class ReferenceConfig:
    """Where to fly."""

    kind: str = key("???", "kind of the reference, set by reference=")
    check: bool = key(True, "refuse a reference that the machine cannot fly, by the model's account")
    tilt_limit: float = key(60.0, "largest tilt that the check lets pass", unit="deg", above=0, high=85)


@dataclass
class WaypointReference(ReferenceConfig):
    """A minimum-snap path through points."""

    kind: str = key("waypoints", "kind of the reference, set by reference=")
    points: Any = key("???", "positions and headings: [[x, y, z], [x, y, z, yaw], ...]", unit="m, deg")
    times: list[float] | None = key(
        None, "when to be there, from 0; null: as fast as the limits allow", unit="s", low=0
    )
    speed: float = of(WaypointOptions, "speed")
    tilt: float = of(WaypointOptions, "tilt")


@dataclass
class SetpointReference(ReferenceConfig):
    """A state to reach and to hold, of any machine."""

    kind: str = key("setpoint", "kind of the reference, set by reference=")
    states: Any = key({}, "values of states, {theta: 0}; others are 0, a quaternion level")
    duration: float = of(SetpointOptions, "duration")


@dataclass
class CsvReference(ReferenceConfig):
    """A minimum-snap path through the rows of a file; of another machine than a multirotor, states over time."""

    kind: str = key("csv", "kind of the reference, set by reference=")
    path: str = key(
        "???",
        "CSV file with p_x p_y p_z [m], and if there are yaw [rad] and t [s]; of other machines with t and states",
        file=True,
    )
    speed: float = of(WaypointOptions, "speed", help="largest speed, where the file has no times")
    tilt: float = of(WaypointOptions, "tilt", help="largest tilt, where the file has no times")


_REFERENCES: dict[str, type] = {
    **{
        kind: _choice(
            ReferenceConfig,
            f"{kind.title()}Reference",
            path.__doc__,
            kind=key(kind, "kind of the reference, set by reference="),
            options=path,
        )
        for kind, path in (
            ("circle", CircleOptions),
            ("lemniscate", LemniscateOptions),
            ("hover", HoverOptions),
        )
    },
    "setpoint": SetpointReference,
    "waypoints": WaypointReference,
    "csv": CsvReference,
}


# --- plant, mpc, link and limits of a flight --------------------------------------------------------------------------


@mirrors(Limits, without=("heartbeat", "patience"))
class LimitsConfig:
    """When something is wrong in flight; what is done about it is in the documentation of nsde fly."""

    fence: Any = of(Limits, "fence")
    rate: float = of(SetpointLimits, "rate")
    yaw_rate: float = of(SetpointLimits, "yaw_rate")
    throttle: list[float] = of(SetpointLimits, "throttle")


@dataclass
class FlownPlantConfig:
    """The machine that is flown."""

    kind: str = key("simulated", "set by plant=", choices=("simulated", "learned"))
    system: str | None = key(None, "name of a system that has a plant; null: that of the model")
    run: str | None = key(
        None, "run directory of the model that is flown with plant=learned; null: that of run=", file=True
    )
    effects: Any = key(
        [],
        "effects that the model does not declare, beside the machine's own: as in nsde simulate",
        file=True,
    )
    declared_only: bool = key(False, "leave out the undeclared effects that the machine has anyway")
    process_noise: float = key(1.0, "strength of the gusts, relative to the machine's own", low=0)
    sensor_noise: float = key(1.0, "strength of the measurement noise, relative to the machine's own", low=0)
    latency: float = key(0.02, "time from a command to its effect, beside the motors' lag", unit="s", low=0)
    state_latency: float = key(0.0, "age of a state when the controller gets it", unit="s", low=0)
    dt: float | None = key(None, "sample of the plant; null: the machine's", unit="s", above=0)


def _null(name: str, help: str) -> Any:
    """A setting of plans that is the machine's where it is null."""
    return of(ProblemOptions, name, default=None, help=help)


@dataclass
class MpcConfig:
    """The controller. Where null says two values, the first is a multirotor's."""

    solver: str = of(SolverOptions, "name")
    iterations: int = of(SolverOptions, "iterations")
    tolerance: float = of(SolverOptions, "tolerance")
    deadline: float | None = of(SolverOptions, "deadline")
    compile: str = of(SolverOptions, "compile")
    cache: str | None = of(SolverOptions, "cache")
    horizon: float = of(ProblemOptions, "horizon")
    steps: int = of(ProblemOptions, "steps")
    period: float = key(0.02, "time between plans, a multiple of the plant's sample", unit="s", above=0)
    state_weights: list[float] | None = _null(
        "state_weights",
        "Q of each error channel; null: the supplement's, and 10 for positions, 0.1 for velocities",
    )
    input_weight: Any = _null(
        "input_weight", "R, of every input, or [1,2] with a number for each; null: 1, and 0.1 at its end"
    )
    input_centre: Any = _null(
        "input_centre", "input that R measures from, or a number for each; null: 0, and the middle"
    )
    low: Any = _null(
        "low", "lowest input, or [-50,-20] with a number for each; null: 0, and what the machine says"
    )
    high: Any = _null("high", "highest input, or a number for each; null: 1, and what the machine says")
    rate_weight: float = of(ProblemOptions, "rate_weight")
    speed_limit: float | None = of(ProblemOptions, "speed_limit", default=None)
    tilt_limit: float | None = of(ProblemOptions, "tilt_limit", default=None)
    fence: Any = of(ProblemOptions, "fence")
    limit_weight: float = of(ProblemOptions, "limit_weight")
    uncertainty_weight: float = of(ProblemOptions, "uncertainty_weight")
    particles: int = of(ProblemOptions, "particles")
    motor_latency: float | None = key(
        None,
        "time that motors add to the latency that is made up for; too little of it makes fast flights oscillate; "
        "null: 0.02, or 0 for a model that has the lag of its motors",
        unit="s",
        low=0,
    )
    force_time: float = of(EstimatorOptions, "force_time")
    moment_time: float = of(EstimatorOptions, "moment_time")
    keep: float = of(SafetyOptions, "keep")
    jump: float = of(SafetyOptions, "jump")


@dataclass
class LinkConfig:
    """How the vehicle is reached."""

    url: str = key(
        "udpin:127.0.0.1:14540",
        "udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT, tcpin:HOST:PORT or serial:DEVICE:BAUD",
    )
    expose: bool = key(
        False, "listen on an interface that other machines reach; without a key anyone may fly"
    )
    key_file: str | None = key(
        None,
        "file with the signing key (64 hexadecimal digits, or a passphrase); null: no signing",
        file=True,
    )
    system: int | None = key(
        None,
        "MAVLink system id of the vehicle; null: the first that is heard (nsde vehicle: 1)",
        low=1,
        high=250,
    )


# --- choices ----------------------------------------------------------------------------------------------------------


CHOICES: dict[str, dict[str, type]] = {
    "data": _DATA,
    "model": _MODELS,
    "solver": {"torchdiffeq": TorchDiffEqSolver},
    "reference": _REFERENCES,
}
"""Choices with keys of their own: each kind of data, model and reference, and one of the user's own."""
# a configuration that a sweep sends to another process finds its class by name
globals().update({cls.__name__: cls for choices in CHOICES.values() for cls in choices.values()})

NAMES: dict[str, tuple[str, ...]] = {
    "system": tuple(SYSTEM_HOMES),
    "solver": tuple(name for name in STEP_HOMES if name not in CHOICES["solver"]),
}
"""Choices that set nothing but the key `name`, each to its own."""
