"""The record of an exported file: what it was made of, and what its tensors are."""

import hashlib
import json
import os
import platform
import time
from collections.abc import Mapping
from dataclasses import asdict, fields
from math import inf
from pathlib import Path
from typing import Any

import torch

from nsde_torch.control.controller import REST, SafetyOptions, word_at_rest
from nsde_torch.control.problem import ProblemOptions
from nsde_torch.control.solve import SolverOptions
from nsde_torch.errors import ExportError
from nsde_torch.export import layout
from nsde_torch.export.step import ExportedStep
from nsde_torch.models import Model
from nsde_torch.models.run_directory import CONFIG, WEIGHTS, make_spec
from nsde_torch.systems import System, make_plant_system

FRAMES = "world ENU, body FLU, quaternion w x y z from body to world, SI units, radians"
TORCHSCRIPT, AOTI, C = "torchscript", "aoti", "c"


def record_of(
    step: ExportedStep, known: Model | System, *, kind: str, run: Path | None, period: float, latency: float
) -> dict[str, Any]:
    """What a controller is made of and what it was tuned for.

    That is the time between steps, `period` [s], and that from a measurement to the effect of the command that follows
    from it, `latency` [s]. The run directory of a model gives its hashes; None for declared physics.
    """
    system = known if isinstance(known, System) else known.system
    s, units = step.sizes, ", ".join(dict.fromkeys(system.state_units))
    stamp = os.environ.get("SOURCE_DATE_EPOCH")
    return {
        "kind": kind,
        "written": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(float(stamp) if stamp else None)),
        "versions": {"nsde_torch": version(), "torch": torch.__version__},
        "processor": _processor() if kind == AOTI else None,
        "dtype": str(step.dtype).removeprefix("torch."),
        "frames": FRAMES if system.quaternion is not None else "SI units, radians",
        "period_s": period,
        "sample_s": step.sample.dt,
        "step_s": step.options.dt,
        "latency_s": latency,
        "sizes": asdict(s),
        **{
            name: {
                k: list(map(asdict, getattr(layout, f"{name}_{k}")(s, units))) for k in ("inputs", "outputs")
            }
            for name in ("step", "predict")
        },
        "status": list(layout.status_words(word_at_rest(system))),
        "loops": asdict(step.loops),
        "hover": step.hover_u[0, 0].double().tolist(),
        "ports": {port.value: width for port, width in step.predictor.ports.items()},
        "state_names": list(system.state_names),
        "input_names": list(system.input_names),
        "problem": {k: None if v == inf else v for k, v in asdict(step.options).items()},
        "solver": {"name": "gauss_newton"} | {k: getattr(step.loops, k) for k in ("iterations", "tolerance")},
        "safety": asdict(step.safety),
        "model": {
            "spec": None if isinstance(known, System) else known.spec.as_dict(),
            "system": system.name,
            "parameters": {k: v.tolist() for k, (v, _) in system.all_declared().items()},
            **hashes(known, run),
        },
    }


def hashes(known: Model | System, run: Path | None) -> dict[str, str]:
    """What a model is recognised by: hashes of its files, or of the values of declared physics."""
    if run is not None:
        files = {"weights": WEIGHTS, "config": CONFIG}
        return {f"{k}_sha256": hashlib.sha256((run / f).read_bytes()).hexdigest() for k, f in files.items()}
    system = known if isinstance(known, System) else known.system
    values = {k: v.tolist() for k, (v, _) in sorted(system.all_declared().items())}
    text = json.dumps([system.name, system.effect_names, values])
    return {"weights_sha256": hashlib.sha256(text.encode()).hexdigest()}


def check(record: Mapping[str, Any]) -> None:
    """Refuse a record of other versions or another processor; an ExportError names what differs."""
    try:
        written = record["versions"]
        for name, own in (("nsde_torch", version()), ("torch", torch.__version__)):
            if _series(written[name]) != _series(own):
                raise ExportError(
                    f"it was written with {name} {written[name]}, and this is {own}. Export anew, or install that "
                    "version."
                )
        if record["kind"] == AOTI and record["processor"] != _processor():
            raise ExportError(
                f"it was compiled for {record['processor']}, and this is {_processor()}. Export it here with "
                "format=aoti."
            )
        if tuple(record["status"]) not in (layout.STATUS, layout.status_words(REST)):
            raise ExportError("it knows other words of a status than this version. Export anew.")
    except (LookupError, TypeError, AttributeError) as error:
        raise ExportError(f"its record lacks {error}. Export anew.") from error


def options_of(record: Mapping[str, Any]) -> tuple[ProblemOptions, SolverOptions, SafetyOptions]:
    """What the controller in a file was made with."""
    problem: dict[str, Any] = {
        k: tuple(v) if isinstance(v, list) else v for k, v in record["problem"].items()
    }
    if problem["fence"] is not None:
        problem["fence"] = tuple(tuple(w) for w in problem["fence"])
    for field in fields(ProblemOptions):
        if problem[field.name] is None and field.default == inf:
            problem[field.name] = inf
    solver, safety = SolverOptions(**record["solver"], compile="off"), SafetyOptions(**record["safety"])
    return ProblemOptions(**problem), solver, safety


def system_of(record: Mapping[str, Any]) -> System:
    """The machine's declared physics with the values of the model in a file; its learned part is in the file alone."""
    model = record["model"]
    if model["spec"] is None:
        return make_plant_system(model["system"], declared_only=True)
    return make_spec(model["spec"]).make_system(model["parameters"])


def version() -> str:
    """Version of this package."""
    from importlib import metadata

    return metadata.version("nsde_torch")


def _series(text: str) -> tuple[str, ...]:
    return tuple(text.split("+")[0].split(".")[:2])


def _processor() -> str:
    return f"{platform.system()} {platform.machine()} {torch.backends.cpu.get_cpu_capability()}"
