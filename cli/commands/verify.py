"""`nsde verify`: hold an exported controller against the one that it was made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from nsde_torch.errors import ExportError
from nsde_torch.whole_files import json_text

from ..hydra_command import Config, HydraCommand, Job
from ..keys import group, key
from ..schemas import ReferenceConfig

_ESTIMATED = 200  # states that the estimator of a file is given


@dataclass
class VerifyConfig:
    controller: str = key("???", "file that nsde export wrote; `nsde verify FILE` says the same", file=True)
    run: str = key("???", "run directory that it was made of, or `declared`", file=True)
    log: str | None = key(
        None,
        "log/flight_K.csv of nsde track: states of that flight, along reference=; null: states drawn along it",
        file=True,
    )
    states: int = key(1000, "states that the file and the controller in Python are given", low=1)
    adversarial: int = key(10000, "states that no sensor should send", low=0)
    seed: int = key(0, "seed of the draws", low=0)
    out: str | None = key(None, "JSON file for what was found; null: none", file=True)
    threads: int = key(1, "CPU threads of torch", low=1)
    reference: ReferenceConfig = group(ReferenceConfig, "where the states are taken from")


def _file_first(words: Sequence[str]) -> list[str]:
    """`nsde verify FILE` as `controller=FILE`."""
    first, *rest = words or ("",)
    alone = Path(first).exists() or (first[:1] != "-" and "=" not in first)
    return [f"controller={first}", *rest] if first and alone else list(words)


COMMAND = HydraCommand(
    name="verify", schema=VerifyConfig, groups={"reference": "lemniscate"}, words=_file_first
)


def run(config: Config, job: Job) -> None:
    """Verify one file; ExportError where it is damaged, of another model, or does not do what its model does."""
    import torch

    from nsde_torch.control.autopilots import EstimatorOptions, PredictivePilot
    from nsde_torch.control.loop import DECLARED, knowledge, percentiles
    from nsde_torch.export import verify
    from nsde_torch.export.container import C, hashes
    from nsde_torch.export.exported import ExportedController
    from nsde_torch.export.write import controller_of

    from .. import track_build
    from ..own_modules import see_own_modules

    see_own_modules(Path(config.run))
    out = verify.Verification()
    memory = verify.resident_mb()
    exported = ExportedController(config.controller)
    about = exported.record
    print(
        f"{config.controller}: {about['kind']}, {about['dtype']}, torch {about['versions']['torch']}, written "
        f"{about['written']}, content as its hash says"
    )
    known = knowledge(config.run, about["model"]["system"])
    found = hashes(known, None if config.run == DECLARED else Path(config.run))
    for name, value in found.items():
        if about["model"].get(name) != value:
            raise ExportError(
                f"{config.controller} was not made of {config.run}: its {name} is {about['model'].get(name)}, and "
                f"that of the run is {value}. Name the run that it was made of, or export anew."
            )
    reference = track_build.any_reference(config.reference, exported.known)
    with torch.no_grad():
        verify.warm(exported)
        out.memory_mb = (memory, verify.resident_mb())
    problem, solver, safety = exported.options, exported.solver, exported.safety
    controller = controller_of(
        known, problem=problem, solver=solver, safety=safety, dtype=exported.hover.dtype
    )
    if about["kind"] == C and about["dtype"] == "float32":
        out.allowed = verify.SINGLE_TOLERANCE
    period, count = about["period_s"], config.states
    samples = (
        verify.along(exported, reference, count, period=period, seed=config.seed)
        if config.log is None
        else verify.logged(Path(config.log), exported, reference, count, period=period)
    )
    verify.compare(exported, controller, samples, out, elapsed=period)
    print(
        f"{out.states} states: inputs differ by {out.worst:.2g} at most ({out.allowed:g} allowed), costs by "
        f"{100 * out.cost_ratio:.2g} %, {len(out.differing)} words of status differ"
    )
    print("  " + ", ".join(f"{n} {word}" for word, n in sorted(out.words.items(), key=lambda p: -p[1])))
    if exported.pilot is not None:
        pilot = PredictivePilot(
            controller,
            known,
            reference,
            period=period,
            sample=about["sample_s"],
            estimator=EstimatorOptions(**about["estimator"]),
        )
        some = min(count, _ESTIMATED)
        drawn = verify.along(exported, reference, some, period=pilot.period, seed=config.seed)
        verify.compare_estimators(exported, pilot, [x for x, _ in drawn], out)
        print(
            f"{out.estimated} states with estimators and plans of their own: inputs differ by "
            f"{out.estimated_worst:.2g} at most"
        )
    verify.attack(exported, reference, config.adversarial, out, seed=config.seed + 1)
    print(f"{out.adversarial} adversarial states: {len(out.unsafe)} answers not finite or out of bounds")
    clock, cpu = (percentiles(t) for t in (out.wall_ms, out.cpu_ms))
    print(f"time of a step: {_row(clock)}; of the processor alone: {_row(cpu)}")
    print(verify.histogram(out.cpu_ms))
    print(f"memory: {out.memory_mb[1] - out.memory_mb[0]:.0f} MB more after loading and the first steps")
    if config.out is not None:
        file = Path(config.out)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json_text(out.as_dict()), encoding="utf-8")
    if not out.passed:
        worst = max(out.worst, out.estimated_worst)
        examples = "; ".join([*out.differing[:3], *out.unsafe[:3]]) or f"inputs differ by {worst:.2g}"
        raise ExportError(f"{config.controller} must not be flown: {examples}. Export anew. ({job.took})")
    print(f"passed; {job.took}")


def _row(times: dict[str, float]) -> str:
    return ", ".join(f"{name} {value:.2f} ms" for name, value in times.items())
