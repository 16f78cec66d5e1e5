"""The work of `nsde diagnose`: read runs, look for what is missing, print, write, and train with it."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, open_dict

from . import effects_file
from .jobs import Job, guarded
from .train_job import fit

if TYPE_CHECKING:
    from nsde_torch.diagnosis import Diagnosis

MODEL = "model"


def task(config: DictConfig) -> float | None:
    """What Hydra calls."""
    return guarded(run, "diagnose", config)


def run(config: DictConfig, job: Job) -> None:
    """Diagnose a declared model.

    Args:
        config: The composed and checked configuration.
        job: Where to write.
    """
    # torch is imported here, not above: help and completion do without it.
    import nsde_torch
    from nsde_torch.diagnosis.files import EFFECTS, PLOTS, REPORT, RESULT, write_content, write_effects
    from nsde_torch.diagnosis.report import write_report
    from nsde_torch.diagnosis.text import lines

    from . import build
    from .stages import Stages

    started = time.perf_counter()
    build.settings(config, sweep=job.sweep)
    effects_file.expand(config.system)
    machine = build.system_options(config.system)
    system = machine.make()
    data = build.dataset(config.data, system)
    print(data.summary)
    stages = Stages()
    found = nsde_torch.diagnose(
        data,
        system=machine,
        alpha=config.alpha,
        max_effects=config.max_effects,
        candidates=None if config.candidates is None else list(config.candidates),
        also=list(config.also),
        test=None if config.data.test is None else list(config.data.test),
        test_data=build.test_data(config.data, system),
        seed=config.seed,
        say=stages,
    )
    stages.close()
    content = found.content()
    write_content(content, job.run_dir)
    note = f"found by nsde diagnose; use it with: nsde train system={config.system.name} system.effects=PATH"
    write_effects(found, job.run_dir, system=config.system.name, note=note)
    print()
    print("\n".join(lines(content)))
    if config.retrain and (found.effects or set(found.sensor_faults) & set(found.added)):
        print(f"\ntraining the model with {', '.join(found.added)}", flush=True)
        content["model"] = _train(config, job, found)
        write_content(content, job.run_dir)
    write_report(job.run_dir / REPORT, found, content)
    wrote = [RESULT, REPORT, f"{PLOTS}/", EFFECTS, *([f"{MODEL}/"] if "model" in content else [])]
    print(f"\ntook {time.perf_counter() - started:.0f} s; wrote {job.run_dir}: {', '.join(wrote)}")


def _train(config: DictConfig, job: Job, found: Diagnosis) -> dict[str, Any]:
    """Train the model of the configuration with the effects; an ordinary run directory."""
    from nsde_torch.effects.files import own_name

    for effect, values in found.effects.items():
        for key, value in values.items():
            effects_file.add_value(config.system, own_name(effect), key, value)
    for name, value in found.declared_values.items():
        effects_file.add_own(config.system, name, value)
    for fault, found_values in found.sensor_faults.items():
        if fault in config.data:  # simulated runs are made by sensors without one
            with open_dict(config.data[fault]):
                for name, value in found_values.items():
                    config.data[fault][name] = config.data[fault].get(name, 0.0) + value
    config.system.effects = [*config.system.effects, *found.effects]
    metrics = fit(config, job, job.run_dir / MODEL, about=_train_config(config))
    test = metrics.get("test", {})
    return {
        "path": MODEL,
        "test_runs": metrics["test_runs"],
        "errors": test.get("errors", {}).get("model", {}),
    }


def _train_config(config: DictConfig) -> dict[str, Any]:
    """The configuration as `nsde train` would have it."""
    from . import build
    from .schema import TrainConfig

    return {k: v for k, v in build.options(config).items() if k in TrainConfig.__dataclass_fields__}
