"""`nsde diagnose`: find the effect that the declared physics lacks, add it, and report the errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from nsde_torch.diagnosis.decisions import Options
from nsde_torch.systems.options import SystemOptions, system_options

from ..exit_status import INTERRUPTED, EndedError
from ..hydra_command import Config, HydraCommand, Job
from ..keys import group, key, of
from ..schemas import DataConfig, LossConfig, ModelConfig, SolverConfig, SystemConfig, TrainerConfig
from .train import GROUPS, fit

if TYPE_CHECKING:
    from nsde_torch.diagnosis import Diagnosis
    from nsde_torch.diagnosis.result import Content

MODEL = "model"


@dataclass
class DiagnoseConfig:
    alpha: float = of(Options, "alpha")
    max_effects: int = of(Options, "max_effects")
    candidates: list[str] | None = of(Options, "candidates")
    also: list[str] = of(Options, "also")
    retrain: bool = key(True, "train the model of the group `model` with what was found, into OUT_DIR/model")
    rehearse: bool = key(
        False,
        "simulate what was found and diagnose that: is it found again, do intervals hold, what would these data not "
        "show? Takes as long as so many diagnoses",
    )
    rehearsals: int = key(3, "logs of the machine that was found, with rehearse=true", low=1)
    max_minutes: float | None = of(Options, "max_minutes")
    verbose: bool = key(False, "print all that the report says, and the data's summary")
    resume: str | None = key(
        None,
        "folder of a diagnosis that did not come to its end, to go on with what it had selected, with its "
        "configuration",
        file=True,
    )
    seed: int = of(Options, "seed", help="seed of resamples and of the training")
    device: str = key("cpu", "where the training's tensors live: cpu, cuda or cuda:N")
    dtype: str = key("float32", "precision of the training", choices=("float32", "float64"))
    threads: int = key(
        1, "CPU threads; with two on a quiet machine, fits of long logs take two thirds of the time", low=1
    )
    out_dir: str = key("???", "folder to write into", file=True)
    system: SystemConfig = group(SystemConfig, "the machine, with the physics that is declared")
    data: DataConfig = group(DataConfig, "where the runs come from")
    model: ModelConfig = group(ModelConfig, "what is trained with the effects")
    loss: LossConfig = group(LossConfig, "what a good model is")
    trainer: TrainerConfig = group(TrainerConfig, "how it is optimised")
    solver: SolverConfig = group(SolverConfig, "how paths are integrated")


COMMAND = HydraCommand(
    name="diagnose",
    schema=DiagnoseConfig,
    groups=GROUPS,
    folder="diagnoses/${now:%Y-%m-%d}/${now:%H-%M-%S}_${hydra:runtime.choices.system}",
    result=("diagnosis.json", "a diagnosis"),
    examples=(
        ("system=hexacopter data=csv data.path=flights/", "what do these flights show that the model lacks?"),
        ("'system.effects=[motor_lag]'", "with physics that is known already"),
        ("'candidates=[linear_drag,quadratic_drag]'", "try these alone"),
        ("retrain=false", "do not train with what was found"),
        ("retrain=false rehearse=true", "would it be found again?"),
        ("max_minutes=10", "end after 10 minutes with what is known"),
        ("resume=diagnoses/first", "go on with one that did not come to its end"),
    ),
)


def run(config: Config, job: Job) -> None:
    import nsde_torch
    from nsde_torch.diagnosis.candidates import check_candidates
    from nsde_torch.diagnosis.files import EFFECTS, PLOTS, REPORT, RESULT, DiagnosisFiles
    from nsde_torch.diagnosis.text import lines, short_lines

    from .. import build
    from ..quoted import as_typed

    build.make_device(config.device)  # refused before hours of work, not after them
    machine = build.system_options(config.system)
    system = machine.make()
    check_candidates(system, config.candidates or (), config.also)
    data = build.dataset(config.data, system)
    print(data.summary if config.verbose else data.summary.short, flush=True)
    note = f"found by nsde diagnose; use it with: {_training(config, job)}"
    files = DiagnosisFiles(job.run_dir, system=config.system.name, note=note)
    found = nsde_torch.diagnose(
        data,
        system=machine,
        **build.shared(Options, config),
        **build.beside(config.data, system),
        resume=config.resume,
        so_far=files.write_so_far,
    )
    content = files.write(found)
    print()
    told = lines if config.verbose else short_lines
    print("\n".join(told(content, as_typed(paths={"resume": job.run_dir}))), flush=True)
    if found.so_far is not None:
        if found.so_far.after_min is None:
            raise KeyboardInterrupt
        return  # neither trained nor rehearsed with: that is no end of the search
    try:
        _follow(config, machine, job, found, content)
    except KeyboardInterrupt:  # the diagnosis is whole: there is nothing to resume
        message = f"interrupted. The diagnosis in {job.run_dir} is finished; {note.partition('; ')[2]}"
        raise EndedError(message, INTERRUPTED) from None
    wrote = [RESULT, REPORT, f"{PLOTS}/", EFFECTS, *([f"{MODEL}/"] if "model" in content else [])]
    print(f"\n{job.took}; wrote {job.run_dir}: {', '.join(wrote)}")
    if not config.verbose:
        print(f"{job.run_dir / REPORT} has all of it, and so does verbose=true")


def _follow(config: Config, machine: SystemOptions, job: Job, found: Diagnosis, content: Content) -> None:
    """Train and rehearse with what was found."""
    import nsde_torch
    from nsde_torch.diagnosis.files import REPORT, write_content
    from nsde_torch.diagnosis.report import write_report
    from nsde_torch.diagnosis.text import rehearsal_lines

    if config.retrain and (found.effects or set(found.sensor_faults) & set(found.added)):
        print(f"\ntraining the model with {', '.join(found.added)}", flush=True)
        content["model"] = _train(config, machine, job, found)
        write_content(content, job.run_dir)
    if config.rehearse:
        made = nsde_torch.rehearse(found, logs=config.rehearsals, seed=config.seed)
        content["rehearsal"] = made.content()
        write_content(content, job.run_dir)
        write_report(job.run_dir / REPORT, found, content)
        print("\n".join(rehearsal_lines(content)))


def _training(config: Config, job: Job) -> str:
    """The command that trains with what was found, on the same data where these are files."""
    from hydra.core.hydra_config import HydraConfig

    from ..own_modules import system_words
    from ..quoted import as_typed

    words = ["nsde", "train", *system_words(config.system.name)]
    paths: dict[str, object] = {"system.effects": job.run_dir / "effects.yaml"}
    if isinstance(path := config.data.get("path"), str):
        words.append(f"data={HydraConfig.get().runtime.choices['data']}")
        paths = {"data.path": path, **paths}
    return as_typed(*words, paths=paths)


def _train(config: Config, machine: SystemOptions, job: Job, found: Diagnosis) -> dict[str, Any]:
    """Train the model of the configuration with the effects; an ordinary run directory."""
    from .. import build

    # what was given stays as it is
    known = {**found.declared_values, **machine.values}
    machine = system_options(machine, effects=found.effects, parameters=known)
    for fault, values in found.sensor_faults.items():
        if fault in config.data:  # simulated runs are made by sensors without one
            given = build.options(config.data)[fault]
            config.data[fault] = given | {k: given.get(k, 0.0) + v for k, v in values.items()}
    metrics = fit(config, machine, job.run_dir / MODEL)
    errors = metrics.get("test", {}).get("errors", {}).get("model", {})
    return {"path": MODEL, "test_runs": metrics["test_runs"], "errors": errors}
