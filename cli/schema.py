"""Schemas of the configuration: every key with its default, unit, range and help.

The YAML files of `conf/` choose values; the names and types live here. `conf/train.yaml` starts from
`TrainConfig`; a choice whose keys are not those of its neighbours (`data=csv`, `data=simulated`) has a class
in `CHOICES`. A key that is not declared here is an error that names it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from nsde_torch.learning.options import LossOptions, TrainerOptions
from nsde_torch.models.options import (
    BlackboxOptions,
    EnsembleOptions,
    NodeOptions,
    NsdeOptions,
    SysidOptions,
)
from nsde_torch.sde.options import IntegratorOptions, TorchDiffEqOptions
from nsde_torch.systems.options import SystemOptions

from .keys import group, key, mirrors, of


@mirrors(SystemOptions)
class SystemConfig:
    """The machine. A value of null is the system's own: its class has the constants of the supplement."""


@dataclass
class RunChoice:
    """Which runs of a data set are held out, or scored on."""

    kind: str = key("???", "kind of the data set, set by data=")
    test: list[Any] | None = key(
        None, "runs to test on, by index or name; null: the last run (evaluate with data=: all)"
    )
    test_path: str | None = key(
        None, "file or folder of further runs to test on, recorded by sensors of another noise perhaps"
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
        "what to do when the kinematics disagree with the clock",
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
        [], "effects that the plant has and the model is not told of: names, or {NAME: {parameter: 1}}"
    )
    process_noise: float = key(1.0, "strength of the gusts, relative to the plant's own", low=0)
    sensor_noise: float = key(1.0, "strength of the measurement noise, relative to the plant's own", low=0)
    cache: str | None = key(
        None, "folder that keeps simulated runs; null: NSDE_CACHE or the user's cache folder"
    )
    options: dict[str, Any] = key({}, "further options of the system's recording, data.options.NAME=1")


@dataclass
class FileData(DataConfig):
    """Runs read from files."""

    path: str = key("???", "file or folder to read")
    dt: float | None = key(None, "step to resample to; null: the step of the data", unit="s", above=0)
    sensor_bias: dict[str, float] = key(
        {}, "what sensors read too much, {STATE: 0.01} in its unit, to take out"
    )
    sensor_delay: dict[str, float] = key(
        {},
        "by how much states are logged late, {STATE: 0.01}, or {p: 0.01} for p_x p_y p_z, to take out",
        unit="s",
    )
    sensor_lag: dict[str, float] = key(
        {}, "time constants of filters that states went through, {STATE: 0.02}, to undo", unit="s"
    )


@dataclass
class CsvData(FileData):
    """A folder with one CSV file per run."""

    kind: str = key("csv", "kind of the data set, set by data=")


@dataclass
class UlogData(FileData):
    """One PX4 log or a folder of them."""

    kind: str = key("ulog", "kind of the data set, set by data=")


@dataclass
class PublishedData(FileData):
    """The authors' published files."""

    kind: str = key("published", "kind of the data set, set by data=")


@dataclass
class ModelConfig:
    """What is learned."""

    kind: str = key("???", "kind of the model, set by model=")


@mirrors(NodeOptions)
class NodeModel(ModelConfig):
    """Neural ODE."""


@mirrors(NsdeOptions)
class NsdeModel(ModelConfig):
    """Neural SDE."""


@mirrors(BlackboxOptions)
class BlackboxModel(ModelConfig):
    """Neural SDE without physics."""


@mirrors(EnsembleOptions)
class EnsembleModel(ModelConfig):
    """Gaussian ensemble."""


@mirrors(SysidOptions)
class SysidModel(ModelConfig):
    """Least-squares system identification."""


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


@dataclass
class TrainConfig:
    """`nsde train`."""

    seed: int = key(0, "seed of initial weights, batches and noise", low=0)
    device: str = key("cpu", "where tensors live: cpu, cuda or cuda:N")
    dtype: str = key("float32", "precision", choices=("float32", "float64"))
    threads: int = key(1, "CPU threads of torch; more seldom help and hurt on a busy machine", low=1)
    run_dir: str = key("???", "folder of this run")
    sweep_dir: str = key("???", "folder of a sweep (-m); its jobs lie inside")
    resume: str | None = key(None, "folder of an interrupted run to continue, with its configuration")
    system: SystemConfig = group(SystemConfig, "the machine")
    data: DataConfig = group(DataConfig, "where the runs come from")
    model: ModelConfig = group(ModelConfig, "what is learned")
    loss: LossConfig = group(LossConfig, "what a good model is")
    trainer: TrainerConfig = group(TrainerConfig, "how it is optimised")
    solver: SolverConfig = group(SolverConfig, "how paths are integrated")


@dataclass
class DiagnoseConfig:
    """`nsde diagnose`."""

    alpha: float = key(0.01, "chance of naming an effect where nothing is missing", above=0)
    max_effects: int = key(8, "most effects to add", low=0)
    candidates: list[str] | None = key(None, "effects to try, by name; null: all that the system may have")
    also: list[str] = key([], "effects of your own to try beside them, `module:Class`")
    retrain: bool = key(True, "train the model of the group `model` with what was found, into OUT_DIR/model")
    seed: int = key(0, "seed of resamples and of the training", low=0)
    device: str = key("cpu", "where the training's tensors live: cpu, cuda or cuda:N")
    dtype: str = key("float32", "precision of the training", choices=("float32", "float64"))
    threads: int = key(1, "CPU threads of torch; more seldom help and hurt on a busy machine", low=1)
    out_dir: str = key("???", "folder to write into")
    system: SystemConfig = group(SystemConfig, "the machine, with the physics that is declared")
    data: DataConfig = group(DataConfig, "where the runs come from")
    model: ModelConfig = group(ModelConfig, "what is trained with the effects")
    loss: LossConfig = group(LossConfig, "what a good model is")
    trainer: TrainerConfig = group(TrainerConfig, "how it is optimised")
    solver: SolverConfig = group(SolverConfig, "how paths are integrated")


@dataclass
class EvaluateConfig:
    """`nsde evaluate`."""

    run: Any = key("???", "run directory to evaluate, or several to compare: run=[A,B]")
    names: list[str] | None = key(None, "name of each run in tables and figures; null: its folder")
    seed: int = key(0, "seed of the sampled paths and of the bootstrap", low=0)
    device: str = key("cpu", "where tensors live: cpu, cuda or cuda:N")
    threads: int = key(1, "CPU threads of torch; more seldom help and hurt on a busy machine", low=1)
    particles: int = key(199, "paths sampled from each start", low=2)
    horizons: list[float] | None = key(
        None, "horizons; null: those of 0.1, 0.25, 0.5, 1 and 2 that fit", unit="s", above=0
    )
    bootstrap: int = key(2000, "resamples of the paired bootstrap", low=100)
    sensor_noise: str | None = key(
        None,
        "sensors that predictions of measurements assume: those of the training data, or those that the runs show; "
        "null: data with data.test_path, else train",
        choices=("train", "data"),
    )
    compile: bool = key(False, "compile the step: half a minute or more, which some thousand starts repay")
    out_dir: str = key("???", "folder to write into")
    data: RunChoice = group(RunChoice, "runs to score on; null: those that the first run was tested on")


@dataclass
class FiguresConfig:
    """`nsde figures`."""

    figures: list[str] = key(["all"], "figures to make: all, or of fig5, fig9, fig10 ... fig16")
    settings: str = key(
        "fast",
        "fast: a look in minutes; full: for the record (default trainings, all folds)",
        choices=("fast", "full"),
    )
    published: str | None = key(
        None, "folder of the authors' files (hexacopter/, cartpole/, ...); null: data of our own plants"
    )
    seeds: int | None = key(None, "models of each kind; null: 1 with fast, 3 with full settings", low=1)
    jobs: int = key(2, "trainings at a time, one thread each", low=1)
    policies: str | None = key(
        None, "folder of a study by benchmarks/bench_policy.py, for fig13 and fig14; null: not drawn"
    )
    seed: int = key(0, "seed of the particles", low=0)
    threads: int = key(1, "CPU threads of torch", low=1)
    out_dir: str = key(
        "???", "folder of figures, captions and trained models; finished models in it are used again"
    )


@dataclass
class PpoConfig:
    """Proximal policy optimisation (`nsde_torch.policy.PolicyOptions`)."""

    n_envs: int = key(32, "machines in the batch", low=1)
    rollout: int = key(200, "steps of each machine between updates", unit="steps", low=1)
    batch: int = key(640, "steps in a gradient step; divides ppo.n_envs times ppo.rollout", low=2)
    epochs: int = key(10, "passes over the steps of an update", low=1)
    lr: float = key(0.001, "learning rate at the start", above=0)
    lr_end: float = key(0.00001, "learning rate at the end; it falls linearly", above=0)
    gamma: float = key(0.99, "discount of the future, per step", above=0, high=1)
    gae_lambda: float = key(0.95, "weight of long advantages", low=0, high=1)
    clip: float = key(0.2, "how far the ratio of new to old probabilities may leave 1", above=0)
    entropy: float = key(0.0, "weight of the reward on broad actions", low=0)
    hidden: list[int] = key([64, 64], "widths of the networks of policy and value (tanh)", low=1)
    reward_scale: float = key(0.1, "factor on the rewards that the learner sees", above=0)
    evaluate_every: int = key(20000, "interactions between evaluations and checkpoints", low=1)
    episodes: int = key(200, "episodes of an evaluation", low=1)
    final_episodes: int = key(1000, "episodes of the last evaluation", low=1)


@dataclass
class PolicySystem:
    """The machine of a policy."""

    name: str = key("???", "name of a system that has a task: cartpole")


@dataclass
class PolicyConfig:
    """`nsde policy`."""

    environment: str = key("truth", "where the policy learns: truth, or the run directory of a model")
    truth: str = key(
        "plant",
        "the true machine: plant (this package's, as data=simulated) or published (that of the authors' data)",
        choices=("plant", "published"),
    )
    sensor_noise: float = key(1.0, "sensor noise of truth and model, relative to their own", low=0)
    propagation: str | None = key(
        None,
        "members of an ensemble: fixed (one for an episode) or redrawn (one for every step); null: as it was trained",
        choices=("fixed", "redrawn"),
    )
    steps: int = key(600000, "interactions with the environment", low=1)
    seed: int = key(0, "seed of networks, actions and first states", low=0)
    scored_against: list[str] = key(
        [], "folders of policies that learned on the same truth; the score is relative to them"
    )
    threads: int = key(1, "CPU threads of torch; more seldom help and hurt on a busy machine", low=1)
    run_dir: str = key("???", "folder of this run")
    sweep_dir: str = key("???", "folder of a sweep (-m); its jobs lie inside")
    resume: str | None = key(None, "folder of an interrupted run to continue, with its configuration")
    system: PolicySystem = group(PolicySystem, "the machine")
    ppo: PpoConfig = group(PpoConfig, "how it learns")


@dataclass
class PlantSystem:
    """The machine that a plant stands for."""

    name: str = key("???", "name of a system that has a plant")


@dataclass
class PlantConfig:
    """What the simulated machine holds."""

    effects: Any = key(
        [],
        "effects that nobody declares: names, module:Class of your own, or {NAME: {parameter: 1}}; a size that is not "
        "given is a typical one (`nsde effects` lists them)",
    )
    parameters: dict[str, Any] = key({}, "values of these effects, plant.parameters.EFFECT.NAME=1")
    declared_only: bool = key(
        False,
        "leave out the undeclared effects that the machine has anyway (multirotors: rotor drag, motor lag)",
    )
    process_noise: float = key(1.0, "strength of the gusts, relative to the machine's own", low=0)
    sensor_noise: float = key(1.0, "strength of the measurement noise, relative to the machine's own", low=0)
    battery: bool = key(False, "log the battery's voltage though no effect reads it (multirotors)")


@dataclass
class RecordingConfig:
    """Faults of the recording chain."""

    input_smoothing: float = key(0.0, "width of the centred moving average of the inputs", unit="s", low=0)
    input_delay: float = key(
        0.0, "time by which states are logged late, so that inputs seem to come early", unit="s", low=0
    )
    clock_scale: float = key(1.0, "physical seconds for each logged second", low=0.5, high=2)
    sensor_bias: dict[str, Any] = key({}, "what is added to a state, recording.sensor_bias.STATE=0.1")
    sensor_delay: dict[str, Any] = key(
        {},
        "by how much a state is logged late, recording.sensor_delay.STATE=0.02 (p for p_x p_y p_z)",
        unit="s",
    )
    sensor_lag: dict[str, Any] = key(
        {}, "time constant of a filter that a state goes through, recording.sensor_lag.STATE=0.02", unit="s"
    )
    frame_misalignment: list[float] = key(
        [0.0, 0.0, 0.0], "turn of the log's body frame against the machine's about x, y, z", unit="deg"
    )
    dropout: float = key(0.0, "share of the rows that is missing", low=0, high=0.5)


@dataclass
class ReplayConfig:
    """Interventions, with pilot=replay."""

    starts: int = key(400, "how many", low=1)
    duration: float = key(1.0, "how long commands of another time are replayed", unit="s", above=0)
    before: float = key(
        0.5,
        "how much of the flight is logged before each start: inputs that lags remember",
        unit="s",
        above=0,
    )


@dataclass
class SimulateConfig:
    """`nsde simulate`."""

    out: str = key("???", "folder of the data set: one CSV file per run, and nothing else")
    truth: str | None = key(None, "file that says what is in it; null: OUT.truth.json, beside the folder")
    overwrite: bool = key(False, "replace the CSV files of a folder that holds something, and the truth")
    seed: int = key(0, "seed of first states, inputs and noise", low=0)
    durations: list[float] | None = key(
        None, "length of each run on the clock of the log; null: the system's own", unit="s", above=0
    )
    dt: float | None = key(None, "step of the log; null: the system's own", unit="s", above=0)
    options: dict[str, Any] = key({}, "further options of the system's recording, options.NAME=1")
    pilot: str = key(
        "manual",
        "manual: the system's own recording, in which inputs may answer states; replay: interventions (multirotors): "
        "from states of such flights, commands of another time, in fresh gusts, marked by the column `intervention`",
        choices=("manual", "replay"),
    )
    threads: int = key(1, "CPU threads of torch", low=1)
    system: PlantSystem = group(PlantSystem, "the machine")
    plant: PlantConfig = group(PlantConfig, "what it holds")
    recording: RecordingConfig = group(RecordingConfig, "how it is logged")
    replay: ReplayConfig = group(ReplayConfig, "interventions, with pilot=replay")


@dataclass
class ReferenceConfig:
    """Where to fly."""

    kind: str = key("???", "kind of the reference, set by reference=")
    check: bool = key(True, "refuse a reference that the machine cannot fly, by the model's account")
    tilt_limit: float = key(60.0, "largest tilt that the check lets pass", unit="deg", above=0, high=85)


@dataclass
class CircleReference(ReferenceConfig):
    """A circle at constant speed, while the heading turns and comes back."""

    kind: str = key("circle", "kind of the reference, set by reference=")
    speed: float = key(3.6, "speed after the start", unit="m/s", above=0)
    duration: float = key(35.0, "length from rest to rest", unit="s", above=0)
    radius: float = key(2.2, "radius", unit="m", above=0)
    height: float = key(1.5, "height", unit="m")
    yaw: float = key(120.0, "farthest heading", unit="deg")
    ramp: float = key(6.0, "time to reach the speed, and to lose it", unit="s", above=0)


@dataclass
class LemniscateReference(ReferenceConfig):
    """A figure of eight, while the heading swings."""

    kind: str = key("lemniscate", "kind of the reference, set by reference=")
    speed: float = key(3.4, "largest speed, where the branches cross", unit="m/s", above=0)
    duration: float = key(40.0, "length from rest to rest", unit="s", above=0)
    length: float = key(1.9, "half of its extent along x", unit="m", above=0)
    width: float = key(1.75, "its extent along y", unit="m", above=0)
    height: float = key(1.5, "height", unit="m")
    yaw: float = key(13.0, "farthest heading", unit="deg")
    ramp: float = key(6.0, "time to reach the speed, and to lose it", unit="s", above=0)


@dataclass
class HoverReference(ReferenceConfig):
    """Standing still."""

    kind: str = key("hover", "kind of the reference, set by reference=")
    duration: float = key(10.0, "how long", unit="s", above=0)
    height: float = key(1.5, "height", unit="m")
    yaw: float = key(0.0, "heading", unit="deg")


@dataclass
class WaypointReference(ReferenceConfig):
    """A minimum-snap path through points."""

    kind: str = key("waypoints", "kind of the reference, set by reference=")
    points: Any = key("???", "positions and headings: [[x, y, z], [x, y, z, yaw], ...]", unit="m, deg")
    times: list[float] | None = key(
        None, "when to be there, from 0; null: as fast as the limits allow", unit="s", low=0
    )
    speed: float = key(2.0, "largest speed, where times are not given", unit="m/s", above=0)
    tilt: float = key(30.0, "largest tilt, where times are not given", unit="deg", above=0, high=79)


@dataclass
class CsvReference(ReferenceConfig):
    """A minimum-snap path through the rows of a file."""

    kind: str = key("csv", "kind of the reference, set by reference=")
    path: str = key("???", "CSV file with p_x p_y p_z [m], and if there are yaw [rad] and t [s]")
    speed: float = key(2.0, "largest speed, where the file has no times", unit="m/s", above=0)
    tilt: float = key(30.0, "largest tilt, where the file has no times", unit="deg", above=0, high=79)


@dataclass
class FlownPlantConfig:
    """The machine that is flown."""

    kind: str = key("simulated", "set by plant=", choices=("simulated", "learned"))
    system: str | None = key(None, "name of a system that has a plant; null: that of the model")
    run: str | None = key(
        None, "run directory of the model that is flown with plant=learned; null: that of run="
    )
    effects: Any = key(
        [], "effects that the model is not told of, beside the machine's own: as in nsde simulate"
    )
    declared_only: bool = key(False, "leave out the undeclared effects that the machine has anyway")
    process_noise: float = key(1.0, "strength of the gusts, relative to the machine's own", low=0)
    sensor_noise: float = key(1.0, "strength of the measurement noise, relative to the machine's own", low=0)
    latency: float = key(0.02, "time from a command to its effect, beside the motors' lag", unit="s", low=0)
    state_latency: float = key(0.0, "age of a state when the controller gets it", unit="s", low=0)
    dt: float | None = key(None, "sample of the plant; null: the machine's", unit="s", above=0)


@dataclass
class MpcConfig:
    """The controller."""

    solver: str = key("gauss_newton", "how plans are found", choices=("gauss_newton", "apg"))
    iterations: int = key(10, "most iterations of a solve", low=1)
    tolerance: float = key(
        0.005, "a plan is good enough when this share of its cost, or less, is left", low=0
    )
    deadline: float | None = key(
        None, "time for a solve; then the best plan so far is taken; null: none", unit="s", above=0
    )
    compile: str = key(
        "auto",
        "machine code of the solver, made once in some minutes (auto: where one machine is flown at a time)",
        choices=("auto", "on", "off"),
    )
    cache: str | None = key(None, "folder that keeps it; null: NSDE_CACHE or the user's cache folder")
    horizon: float = key(1.0, "length of a plan", unit="s", above=0)
    steps: int = key(20, "steps of a plan", low=1)
    period: float = key(0.02, "time between plans, a multiple of the plant's sample", unit="s", above=0)
    state_weights: list[float] = key(
        [100.0, 100.0, 200.0, 5.0, 5.0, 10.0, 1.0, 1.0, 100.0, 1.0, 1.0, 1.0],
        "Q: position, velocity, attitude, rates",
        low=0,
    )
    input_weight: float = key(1.0, "R, of every input", low=0)
    input_centre: float = key(0.0, "input that R measures from")
    rate_weight: float = key(0.0, "weight of changes of the inputs from step to step", low=0)
    speed_limit: float | None = key(None, "speed beyond which a plan pays; null: none", unit="m/s", above=0)
    tilt_limit: float | None = key(
        None, "tilt beyond which a plan pays; null: none", unit="deg", above=0, high=89
    )
    fence: Any = key(None, "lowest and highest p_x, p_y, p_z, [[-5,5],[-5,5],[0,4]]; null: none", unit="m")
    limit_weight: float = key(100.0, "weight of these soft limits", low=0)
    uncertainty_weight: float = key(0.0, "weight of the model's distance from its data", low=0)
    particles: int = key(1, "paths of a plan: 1 is the mean path, more are sampled", low=1)
    motor_latency: float | None = key(
        None,
        "time that motors add to the latency that is made up for; too little of it makes fast flights oscillate; "
        "null: 0.02, or 0 for a model that has the lag of its motors",
        unit="s",
        low=0,
    )
    force_time: float = key(
        0.5, "time constant of the push that is learned in flight, on the force; 0: none", unit="s", low=0
    )
    moment_time: float = key(0.0, "the same on the moment", unit="s", low=0)
    keep: float = key(
        0.5, "how long the last safe plan is flown when there is trouble; then hover", unit="s", low=0
    )
    jump: float = key(0.75, "step of the measured position that is not believed at once", unit="m", above=0)


@dataclass
class TrackConfig:
    """`nsde track`."""

    run: str = key(
        "???",
        "run directory of the model to plan with, `declared`: physics with the plant's values, or a file of nsde "
        "export (controller=FILE says the same)",
    )
    beside: list[str] = key([], "further controllers on the same flights: run directories (same mpc), or pid")
    machines: int = key(1, "flights, each with noise of its own", low=1)
    at_once: int | None = key(
        None, "machines in one batch; null: 1 up to 32 machines, else all of them (Monte Carlo)", low=1
    )
    duration: float | None = key(None, "length of a flight; null: that of the reference", unit="s", above=0)
    seed: int = key(0, "seed of the plant's noise", low=0)
    animation: str | None = key(None, "film of the first flight: gif or mp4", choices=("gif", "mp4"))
    threads: int = key(1, "CPU threads of torch; more make small solves slower", low=1)
    out_dir: str = key("???", "folder to write into")
    reference: ReferenceConfig = group(ReferenceConfig, "where to fly")
    plant: FlownPlantConfig = group(FlownPlantConfig, "what is flown")
    mpc: MpcConfig = group(MpcConfig, "the controller")


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
        None, "file with the signing key (64 hexadecimal digits, or a passphrase); null: no signing"
    )
    system: int | None = key(
        None,
        "MAVLink system id of the vehicle; null: the first that is heard (nsde vehicle: 1)",
        low=1,
        high=250,
    )


@dataclass
class LimitsConfig:
    """When something is wrong in flight; what is done about it is in the documentation of nsde fly."""

    fence: Any = key(
        [[-6.0, 6.0], [-6.0, 6.0], [-0.5, 6.0]],
        "lowest and highest x, y, z from the place of take-off",
        unit="m",
    )
    speed: float = key(7.0, "largest speed", unit="m/s", above=0)
    tilt: float = key(65.0, "largest tilt", unit="deg", above=0, high=89)
    battery: float = key(0.15, "lowest charge, as a share", low=0, high=1)
    voltage: float = key(0.0, "lowest voltage of the battery; 0: none", unit="V", low=0)
    estimate: float = key(0.2, "oldest state", unit="s", above=0, high=1)
    silence: float = key(1.0, "longest time without any message", unit="s", above=0, high=5)
    solver: float = key(0.3, "oldest plan", unit="s", above=0, high=2)
    jump: float = key(
        0.5, "largest step of the position that its velocity does not explain", unit="m", above=0
    )
    rate: float = key(6.0, "largest roll and pitch rate that is sent", unit="rad/s", above=0)
    yaw_rate: float = key(2.5, "largest yaw rate that is sent", unit="rad/s", above=0)
    throttle: list[float] = key(
        [0.05, 0.9], "lowest and highest throttle that is sent in flight", low=0, high=1
    )


@dataclass
class FlownSystem:
    """The machine that a flight takes the vehicle for."""

    name: str = key("???", "name of a multirotor that has a plant")
    effects: Any = key(
        [],
        "effects that run=declared is told of: names, {NAME: {parameter: 1}}, or the file effects.yaml of a diagnosis",
    )


@dataclass
class FlyConfig:
    """`nsde fly`."""

    run: str = key(
        "???",
        "run directory of the model to plan with, a file of nsde export (controller=FILE says the same), `declared` "
        "physics with the plant's values, or pid",
    )
    height: float = key(1.5, "height of take-off", unit="m", above=0)
    climb: float = key(0.8, "speed of take-off", unit="m/s", above=0, high=3)
    hold: float = key(2.0, "time of hovering before the reference", unit="s", low=0)
    safe_hold: float = key(2.0, "time of hovering before landing when something is wrong", unit="s", low=0)
    rate: float = key(100.0, "setpoints in a second", unit="Hz", low=50, high=250)
    delay: float = key(
        0.08,
        "time from a setpoint to its effect, over which the predictive controller looks ahead",
        unit="s",
        low=0,
    )
    lead: float | None = key(
        None,
        "how much earlier than needed rates are asked for, because they are reached late; null: 0.05 (pid: 0.1)",
        unit="s",
        low=0,
    )
    repeats: int = key(1, "flights, one after another", low=1)
    threads: int = key(1, "CPU threads of torch; more make small solves slower", low=1)
    out_dir: str = key("???", "folder to write into")
    system: FlownSystem = group(FlownSystem, "the machine, where run= is no model that knows it")
    reference: ReferenceConfig = group(ReferenceConfig, "where to fly, from the place of take-off")
    link: LinkConfig = group(LinkConfig, "how the vehicle is reached")
    limits: LimitsConfig = group(LimitsConfig, "when something is wrong")
    mpc: MpcConfig = group(MpcConfig, "the controller, unless run=pid")


@dataclass
class ExportConfig:
    """`nsde export`."""

    run: str = key(
        "???", "run directory of the model to plan with, or `declared`: physics with the plant's values"
    )
    out: str = key("???", "file to write, controller.ts or controller.pt2")
    overwrite: bool = key(False, "replace a file that is there")
    format: str = key(
        "torchscript",
        "torchscript: for libtorch on any processor; aoti: machine code for processors of this kind, three times as "
        "fast (needs g++, takes minutes)",
        choices=("torchscript", "aoti"),
    )
    precision: str = key("float64", "arithmetic within", choices=("float32", "float64"))
    sample: float | None = key(
        None, "step of the prediction over the latency; null: the plant's sample", unit="s", above=0
    )
    threads: int = key(1, "CPU threads of torch", low=1)
    plant: FlownPlantConfig = group(FlownPlantConfig, "the machine that it is for: its name and latency")
    mpc: MpcConfig = group(MpcConfig, "the controller")


@dataclass
class VerifyConfig:
    """`nsde verify`."""

    controller: str = key("???", "file that nsde export wrote; `nsde verify FILE` says the same")
    run: str = key("???", "run directory that it was made of, or `declared`")
    log: str | None = key(
        None,
        "log/flight_K.csv of nsde track: states of that flight, along reference=; null: states drawn along it",
    )
    states: int = key(1000, "states that the file and the controller in Python are given", low=1)
    adversarial: int = key(10000, "states that no sensor should send", low=0)
    seed: int = key(0, "seed of what is drawn", low=0)
    out: str | None = key(None, "JSON file for what was found; null: none")
    threads: int = key(1, "CPU threads of torch", low=1)
    reference: ReferenceConfig = group(ReferenceConfig, "where the states are taken from")


@dataclass
class VehicleConfig:
    """`nsde vehicle`."""

    hil: str | None = key(
        None,
        "be the simulator of a real PX4 instead, which connects here: tcpin:127.0.0.1:4560 (`--hil` says the same)",
    )
    seed: int = key(0, "seed of gusts and noise", low=0)
    duration: float | None = key(None, "how long to run; null: until Ctrl-C", unit="s", above=0)
    parameters: dict[str, Any] = key({}, "values of PX4's parameters, parameters.COM_OF_LOSS_T=0.5")
    threads: int = key(1, "CPU threads of torch", low=1)
    plant: FlownPlantConfig = group(FlownPlantConfig, "the machine that it flies")
    link: LinkConfig = group(LinkConfig, "how it is reached")


@dataclass
class CloseLoopConfig:
    """`nsde close-loop`."""

    logged: int = key(2, "flights that are diagnosed", low=1)
    flights: int = key(3, "pairs of flights that are compared, each pair in the same gusts", low=1)
    alpha: float = key(0.01, "chance of naming an effect where nothing is missing", above=0)
    max_effects: int = key(8, "most effects to add", low=0)
    candidates: list[str] | None = key(None, "effects to try, by name; null: all that the machine may have")
    delay: float = key(
        0.08, "time from a setpoint to its effect, over which the controller looks ahead", unit="s", low=0
    )
    lead: float = key(0.05, "how much earlier than needed rates are asked for", unit="s", low=0)
    seed: int = key(0, "seed of gusts and noise", low=0)
    threads: int = key(1, "CPU threads of torch", low=1)
    out_dir: str = key("???", "folder to write into; what is finished in it is not done again")
    reference: ReferenceConfig = group(ReferenceConfig, "where to fly, from the place of take-off")
    plant: FlownPlantConfig = group(
        FlownPlantConfig, "the machine, with effects that the controller is not told of"
    )
    mpc: MpcConfig = group(MpcConfig, "the controller")


# Choices whose keys are more than those of their group's class.
CHOICES: dict[str, dict[str, type]] = {
    "data": {"simulated": SimulatedData, "csv": CsvData, "ulog": UlogData, "published": PublishedData},
    "model": {
        "nsde": NsdeModel,
        "node": NodeModel,
        "blackbox_nsde": BlackboxModel,
        "ensemble": EnsembleModel,
        "sysid": SysidModel,
    },
    "solver": {"torchdiffeq": TorchDiffEqSolver},
    "reference": {
        "circle": CircleReference,
        "lemniscate": LemniscateReference,
        "hover": HoverReference,
        "waypoints": WaypointReference,
        "csv": CsvReference,
    },
}

COMMAND_SCHEMAS: dict[str, type] = {
    "train": TrainConfig,
    "diagnose": DiagnoseConfig,
    "figures": FiguresConfig,
    "evaluate": EvaluateConfig,
    "policy": PolicyConfig,
    "simulate": SimulateConfig,
    "track": TrackConfig,
    "fly": FlyConfig,
    "vehicle": VehicleConfig,
    "close-loop": CloseLoopConfig,
    "export": ExportConfig,
    "verify": VerifyConfig,
}


def register() -> None:
    """Tell Hydra of the schemas; they stand apart from the choices, in the group `schema`."""
    from hydra.core.config_store import ConfigStore

    store = ConfigStore.instance()
    for command, schema in COMMAND_SCHEMAS.items():
        store.store(group="schema", name=command, node=schema)
    for group_name, choices in CHOICES.items():
        for choice, schema in choices.items():
            store.store(group=f"schema/{group_name}", name=choice, node=schema)
