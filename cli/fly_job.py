"""The work of `nsde fly`: connect, fly, print, write."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig

from .jobs import Job, guarded

if TYPE_CHECKING:
    from nsde_torch.px4.flight import FlightReport

RESULT, LOG = "flight.json", "log"


def task(config: DictConfig) -> float | None:
    """What Hydra calls."""
    return guarded(run, "fly", config)


def run(config: DictConfig, job: Job) -> float | None:
    """Fly a reference once or several times.

    Args:
        config: The composed and checked configuration.
        job: Where to write.

    Returns:
        RMSE of the position over all flights [m]; None if the reference was not flown.

    Raises:
        NsdeError: nothing was flown, and why.
    """
    # torch is imported here, not above: help and completion do without it.
    import torch

    from nsde_torch.px4.flight import fly
    from nsde_torch.px4.link import open_link
    from nsde_torch.px4.offboard import FlightOptions
    from nsde_torch.px4.path import PathPoints

    from . import build, fly_build, link_build, track_build

    torch.set_num_threads(config.threads)
    # whatever can be refused is refused before anything is connected to
    reference = track_build.reference(config.reference)
    known = fly_build.known(config)
    asked = fly_build.check(config, reference, known)
    path = PathPoints(reference.path)
    limits, setpoints = link_build.limits(config.limits), link_build.setpoints(config.limits)
    options = FlightOptions(
        height=config.height, climb=config.climb, hold=config.hold, safe_hold=config.safe_hold
    )
    key = link_build.key(config.link)
    motors = fly_build.system_of(known).nu
    print(
        f"{path.name}: {path.duration:g} s, up to {asked.speed:.2f} m/s and {asked.tilt:.0f} deg of tilt",
        flush=True,
    )
    content: dict[str, Any] = {
        "run": config.run,
        "system": fly_build.system_of(known).name,
        "reference": {"name": path.name, "duration_s": path.duration, **reference.path.about},
        "link": build.options(config.link, "key_file"),
        "flights": [],
    }
    digits = len(str(config.repeats - 1))
    reports: list[FlightReport] = []
    # the solver is compiled and warm before the vehicle is spoken to
    controller = fly_build.runner(config, path, reference, _say)
    try:
        controller.wait()
        for k in range(config.repeats):
            started = time.perf_counter()
            with open_link(
                config.link.url, expose=config.link.expose, target=config.link.system, key=key
            ) as link:
                print(f"flight {k + 1} of {config.repeats} on {config.link.url}", flush=True)
                report = fly(
                    link,
                    controller,
                    path,
                    motors=motors,
                    log=job.run_dir / LOG / f"flight_{k:0{digits}d}.csv",
                    limits=limits,
                    setpoints=setpoints,
                    options=options,
                    say=_say,
                    rate=config.rate,
                )
            reports.append(report)
            content["flights"].append({**report.as_dict(), "took_s": time.perf_counter() - started})
            _write(job.run_dir, content)
            print(_line(report), flush=True)
            if report.outcome.trouble is not None:
                break
    finally:
        controller.close()
    print(f"wrote {job.run_dir}: {RESULT}" + (f", {LOG}/" if any(r.log for r in reports) else ""))
    return _verdict(reports)


def _say(line: str) -> None:
    print(line, flush=True)


def _line(report: FlightReport) -> str:
    """One flight in some lines."""
    o, found = report.outcome, report.as_dict()
    ends = "landed and disarmed" if o.landed else "NOT seen to land"
    if o.trouble is not None:
        ends += f"; {o.trouble.kind}: {o.trouble.text}"
    lines = [
        f"{'the reference was flown' if o.tracked else 'the reference was not flown to its end'}; {ends}"
    ]
    if report.rmse is not None:
        lines[0] += f"; RMSE {100 * report.rmse:.1f} cm, largest {100 * max(report.errors):.1f} cm"
    gap, age, solve = found["setpoint_gap_ms"], found["state_age_ms"], found["solve_ms"]
    if gap is not None:
        lines.append(
            f"  setpoints: {gap['count']}, gaps p50 {gap['p50']:.1f} ms, p99.9 {gap['p99.9']:.1f} ms, largest "
            f"{gap['max']:.1f} ms; state age p50 {age['p50']:.1f} ms, p99 {age['p99']:.1f} ms"
        )
    if solve is not None:
        lines.append(
            f"  plans: {solve['count']}, p50 {solve['p50']:.2f} ms, p99 {solve['p99']:.2f} ms; "
            + ", ".join(f"{n} {word}" for word, n in found["status"].items())
        )
    return "\n".join(lines)


def _write(folder: Path, content: dict[str, Any]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / RESULT).write_text(json.dumps(content, indent=1, allow_nan=False), encoding="utf-8")


def _verdict(reports: list[FlightReport]) -> float | None:
    """RMSE over all flights.

    Raises:
        LinkError: the flight was refused before it began.
    """
    from nsde_torch.px4.transport import LinkError

    last = reports[-1].outcome
    if last.trouble is not None and last.trouble.kind == "refused":
        raise LinkError(last.trouble.text)
    errors = [e for r in reports for e in r.errors]
    if not errors or not all(r.outcome.tracked for r in reports):
        return None
    return float((sum(e * e for e in errors) / len(errors)) ** 0.5)
