"""`nsde fly`: fly a controller on a PX4 vehicle over MAVLink, with checks, limits and a log."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from nsde_torch.px4.options import FlightOptions
from nsde_torch.texts import rendered
from nsde_torch.whole_files import json_text

from ..hydra_command import TEXTS, Config, HydraCommand, Job, say
from ..keys import group, key, of
from ..quoted import from_file
from ..schemas import LimitsConfig, LinkConfig, MpcConfig, ReferenceConfig

if TYPE_CHECKING:
    from nsde_torch.px4.flight.flying import FlightReport

RESULT, LOG = "flight.json", "log"


@dataclass
class FlownSystem:
    """The machine that a flight takes the vehicle for."""

    name: str = key("???", "name of a multirotor that has a plant")
    effects: Any = key(
        [],
        "effects that run=declared knows: names, {NAME: {parameter: 1}}, or the file effects.yaml of a diagnosis",
        file=True,
    )


@dataclass
class FlyConfig:
    run: str = key(
        "???",
        "run directory of the model to plan with, a file of nsde export (controller=FILE says the same), `declared` "
        "physics with the plant's values, or pid",
        file=True,
    )
    height: float = of(FlightOptions, "height")
    climb_past: float = of(FlightOptions, "climb_past")
    climb: float = of(FlightOptions, "climb")
    hold: float = of(FlightOptions, "hold")
    come_back: bool = of(FlightOptions, "come_back")
    takeover: bool = of(FlightOptions, "takeover")
    check: bool = of(FlightOptions, "only_check")
    safe_hold: float = of(FlightOptions, "safe_hold")
    rate: float = key(100.0, "setpoints in a second", unit="Hz", low=50, high=250)
    delay: float = key(
        0.08,
        "time from a setpoint to its effect, over which the predictive controller looks ahead",
        unit="s",
        low=0,
    )
    lead: float | None = key(
        None,
        "how much earlier than needed rates are asked for, because they are reached late; null: 0.01 (pid: 0.1)",
        unit="s",
        low=0,
    )
    repeats: int = key(1, "flights, one after another", low=1)
    threads: int = key(1, "CPU threads of torch; more make small solves slower", low=1)
    out_dir: str = key("???", "folder to write into", file=True)
    system: FlownSystem = group(FlownSystem, "the machine, where run= is no model that knows it")
    reference: ReferenceConfig = group(ReferenceConfig, "where to fly, from the place of take-off")
    link: LinkConfig = group(LinkConfig, "how the vehicle is reached")
    limits: LimitsConfig = group(LimitsConfig, "when something is wrong")
    mpc: MpcConfig = group(MpcConfig, "the controller, unless run=pid")


COMMAND = HydraCommand(
    name="fly",
    schema=FlyConfig,
    groups={"system": "hexacopter", "reference": "lemniscate", "link": "default", "mpc": "default"},
    folder="flights/${now:%Y-%m-%d}/${now:%H-%M-%S}_${hydra:runtime.choices.reference}",
    result=("flight.json", "a flight"),
    words=from_file,
)


def run(config: Config, job: Job) -> float | None:
    """Fly a reference once or several times; RMSE of the position over all flights [m], None if it was not flown."""
    from nsde_torch.px4.flight.cascade import PathPoints
    from nsde_torch.px4.flight.flying import fly

    from .. import build, fly_build, track_build

    # whatever can be refused is refused before anything is connected to
    reference = track_build.reference(config.reference)
    known = fly_build.known(config)
    asked = track_build.envelope(config, reference, known)
    path = PathPoints(reference.path)
    limits, setpoints = fly_build.limits(config.limits), fly_build.setpoints(config.limits)
    options = FlightOptions(**build.shared(FlightOptions, config), only_check=config.check)
    connect = fly_build.connection(config.link)
    system = track_build.system_of(known)
    say(f"{path.name}: {path.duration:g} s, up to {asked.speed:.2f} m/s and {asked.tilt:.0f} deg of tilt")
    content: dict[str, Any] = {
        "run": config.run,
        "system": system.name,
        "reference": {"name": path.name, "duration_s": path.duration, **reference.path.about},
        "link": build.options(config.link, "key_file"),
        "flights": [],
    }
    digits = len(str(config.repeats - 1))
    reports: list[FlightReport] = []
    # the solver is compiled and warm before the vehicle is spoken to
    controller = fly_build.runner(config, path, reference)
    try:
        controller.wait()
        for k in range(config.repeats):
            started = time.perf_counter()
            with connect() as link:
                say(f"flight {k + 1} of {config.repeats} on {config.link.url}")
                report = fly(
                    link,
                    controller,
                    path,
                    motors=system.nu,
                    log=None if config.check else job.run_dir / LOG / f"flight_{k:0{digits}d}.csv",
                    limits=limits,
                    setpoints=setpoints,
                    options=replace(options, takeover=options.takeover and k == 0),  # the first one lands
                    say=say,
                    rate=config.rate,
                )
            if config.check:
                return _verdict([report])
            reports.append(report)
            content["flights"].append({**report.as_dict(), "took_s": time.perf_counter() - started})
            job.run_dir.mkdir(parents=True, exist_ok=True)
            (job.run_dir / RESULT).write_text(json_text(content), encoding="utf-8")
            say(rendered(TEXTS, "flight.txt", **report.as_dict(), begun=report.outcome.begun))
            if report.outcome.trouble is not None:
                break
    finally:
        controller.close()
    print(f"wrote {job.run_dir}: {RESULT}" + (f", {LOG}/" if any(r.log for r in reports) else ""))
    return _verdict(reports)


def _verdict(reports: list[FlightReport]) -> float | None:
    """RMSE over all flights; LinkError or EndedError where one was refused, went wrong, or was not seen to land."""
    from ..fly_build import check_end

    last = reports[-1].outcome
    if last.trouble is None and not last.begun:
        return None  # it was to be checked, and is fit to fly
    check_end(last, whole=True)
    errors = [e for r in reports for e in r.errors]
    if not errors:
        return None
    return float((sum(e * e for e in errors) / len(errors)) ** 0.5)
