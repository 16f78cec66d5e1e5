"""The work of `nsde diagnose`: read runs, look for what is missing, print, write, and train with it."""

from __future__ import annotations

import json
import time
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, open_dict

from . import effects_file
from .jobs import Job, guarded
from .train_job import fit

if TYPE_CHECKING:
    from nsde_torch.data import DataSet, Run
    from nsde_torch.diagnosis.diagnose import Diagnosis
    from nsde_torch.systems import System

RESULT, EFFECTS, REPORT, MODEL = "diagnosis.json", "effects.yaml", "report.html", "model"
PLOTS = "plots"


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
    from nsde_torch.diagnosis.diagnose import Options, diagnose
    from nsde_torch.diagnosis.report import write_report
    from nsde_torch.diagnosis.text import lines
    from nsde_torch.effects import effect_class, key_of
    from nsde_torch.models.identified import SysidSpec

    from . import build
    from .stages import Stages

    started = time.perf_counter()
    build.settings(config, sweep=job.sweep)
    effects_file.expand(config.system)
    options = Options(
        alpha=config.alpha,
        max_effects=config.max_effects,
        candidates=None if config.candidates is None else tuple(config.candidates),
        also=tuple(config.also),
        seed=config.seed,
        instruments=tuple(config.data.instruments),
    )
    system = build.system(config.system)
    data = build.dataset(config.data, system)
    print(data.summary)
    spec = SysidSpec(
        config.system.name,
        dt=data.dt,
        horizon=system.defaults.horizon,
        effects=tuple(config.system.effects),
        declared=None if config.system.declared is None else tuple(config.system.declared),
        system_options=build.options(config.system)["options"],
    )
    stages = Stages()
    found = diagnose(system, spec, data, _runs(config, data, system), options, say=stages)
    stages.close()
    content = found.content()
    _write(job, content)
    effects_file.write(
        job.run_dir / EFFECTS,
        config.system.name,
        {key_of(effect_class(f.name)): values(found, f.name) for f in found.outcome.found},
        f"found by nsde diagnose; use it with: nsde train system={config.system.name} system.effects=PATH",
    )
    print()
    print("\n".join(lines(content)))
    if config.retrain and (found.outcome.found or set(_taken_out(found)) & set(found.added)):
        print(f"\ntraining the model with {', '.join(found.added)}", flush=True)
        content["model"] = _train(config, job, found)
        _write(job, content)
    write_report(job.run_dir / REPORT, found, content)
    wrote = [RESULT, REPORT, f"{PLOTS}/", EFFECTS, *([f"{MODEL}/"] if "model" in content else [])]
    print(f"\ntook {time.perf_counter() - started:.0f} s; wrote {job.run_dir}: {', '.join(wrote)}")


def _runs(config: DictConfig, data: DataSet, system: System) -> list[Run]:
    """Runs to look at: all, or those that `data.test` does not hold back for later."""
    from . import build

    if config.data.test is None and config.data.test_path is None:
        return list(data.runs)
    return list(build.split(config.data, data, system).train)


def _write(job: Job, content: dict[str, Any]) -> None:
    (job.run_dir / RESULT).write_text(json.dumps(content, indent=1, allow_nan=False), encoding="utf-8")


def values(found: Diagnosis, name: str) -> dict[str, Any]:
    effect = next(e for e in found.outcome.system.effects if e.name == name)
    values = effect.declared_parameters()  # type: ignore[operator]
    return {key: v.tolist() if v.numel() > 1 else float(v) for key, (v, _) in values.items()}


def _taken_out(found: Diagnosis) -> dict[str, dict[str, float]]:
    """What was taken out of the states, by key of `data`."""
    r = found.recorded
    return {"sensor_bias": r.biases, "sensor_delay": r.delays, "sensor_lag": r.lags}


def _train(config: DictConfig, job: Job, found: Diagnosis) -> dict[str, Any]:
    """Train the model of the configuration with the effects; an ordinary run directory."""
    from nsde_torch.effects import effect_class, key_of

    for f in found.outcome.found:
        for key, value in values(found, f.name).items():
            effects_file.add_value(config.system, f.name, key, value)
    for name, value in found.outcome.system.declared_parameters().items():
        effects_file.add_own(config.system, name, value[0])
    for fault, found_values in _taken_out(found).items():
        if fault in config.data:  # simulated runs are made by sensors without one
            with open_dict(config.data[fault]):
                for name, value in found_values.items():
                    config.data[fault][name] = config.data[fault].get(name, 0.0) + value
    config.system.effects = [
        *config.system.effects,
        *(key_of(effect_class(f.name)) for f in found.outcome.found),
    ]
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
