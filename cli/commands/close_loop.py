"""`nsde close-loop`: log, diagnosis, before, after; each stage is kept when it is finished.

Every flight is one on the simulated vehicle in virtual time. The controller knows the declared physics with the values
of the plant; after the diagnosis it also knows the effects that were found, with the values that were found, but for
lags and delays, which `delay` stands for. Flights before and after meet the same gusts, which are others than those of
the flights that were diagnosed.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nsde_torch.diagnosis.options import Options

from ..hydra_command import HydraCommand
from ..keys import group, key, of
from ..schemas.control import FlownPlantConfig, MpcConfig
from ..schemas.reference import ReferenceConfig

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from nsde_torch.control.reference import Reference
    from nsde_torch.px4.flight.predictive import PredictiveController

    from ..jobs import Job

RESULT, SETTINGS, PICTURE = "close_loop.json", "settings.json", "close_loop.png"
LOG, DIAGNOSIS, BEFORE, AFTER = "log", "diagnosis", "before", "after"


@dataclass
class CloseLoopConfig:
    """`nsde close-loop`."""

    logged: int = key(2, "flights that are diagnosed", low=1)
    flights: int = key(3, "pairs of flights that are compared, each pair in the same gusts", low=1)
    alpha: float = of(Options, "alpha")
    max_effects: int = of(Options, "max_effects")
    candidates: list[str] | None = of(
        Options, "candidates", help="effects to try, by name; null: all that the machine may have"
    )
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


COMMAND = HydraCommand(
    name="close-loop",
    help="Fly, find what the physics lacks, and fly again with it: tracking before and after",
    schema=CloseLoopConfig,
    module=__name__,
    groups={"reference": "lemniscate", "plant": "hexacopter", "mpc": "default"},
    values={"plant": {"effects": [{"linear_drag": {"drag": [0.6, 0.6, 0.2]}}]}},
    folder="close_loops/${now:%Y-%m-%d}/${now:%H-%M-%S}_${hydra:runtime.choices.reference}",
    paths=("out_dir",),
)


def run(config: DictConfig, job: Job) -> float | None:
    """Fly, diagnose, fly again.

    Args:
        config: The composed and checked configuration.
        job: Where to write.

    Returns:
        RMSE of the position after over before; None where a flight was not flown to its end.
    """
    # torch is imported here, not above: help and completion do without it.
    import torch

    from nsde_torch.control import feasible
    from nsde_torch.control.predictor import Predictor
    from nsde_torch.errors import ConfigError
    from nsde_torch.px4.flight.predictive import told

    from .. import track_build

    started = time.perf_counter()
    torch.set_num_threads(config.threads)
    if config.plant.kind != "simulated" or config.plant.dt is not None or config.plant.state_latency:
        raise ConfigError(
            "`nsde close-loop` flies plant=hexacopter or plant=quadrotor, without plant.dt and plant.state_latency."
        )
    _same_settings(config, job.run_dir)
    loop = ClosedLoop(config, job.run_dir)
    problem = track_build.problem(config.mpc)
    if config.reference.check:
        predictor = Predictor(loop.knowledge([]), dt=problem.dt)
        feasible.check(
            loop.reference, predictor, low=problem.low, high=problem.high, tilt=config.reference.tilt_limit
        )
    for k in range(config.logged):
        loop.flight(LOG, k, [])
    found = told(loop.diagnosis())
    for k in range(config.flights):
        loop.flight(BEFORE, k, [])
    if found:
        for k in range(config.flights):
            loop.flight(AFTER, k, found)
    content = loop.result(found)
    (job.run_dir / RESULT).write_text(json.dumps(content, indent=1, allow_nan=False), encoding="utf-8")
    loop.picture()
    print()
    print(text(content))
    wrote = [RESULT, PICTURE, f"{DIAGNOSIS}/", f"{LOG}/", f"{BEFORE}/", *([f"{AFTER}/"] if found else [])]
    print(f"\ntook {time.perf_counter() - started:.0f} s; wrote {job.run_dir}: {', '.join(wrote)}")
    ratio: float | None = content["ratio"]
    return ratio


def _same_settings(config: DictConfig, folder: Path) -> None:
    """What is in the folder is of this configuration, or nothing is.

    Raises:
        ConfigError: it is of another.
    """
    from nsde_torch.errors import ConfigError

    from .. import build

    settings = {k: v for k, v in build.options(config).items() if k not in ("out_dir", "threads")}
    file = folder / SETTINGS
    if file.is_file() and json.loads(file.read_text(encoding="utf-8")) != settings:
        raise ConfigError(f"`out_dir={folder}` holds a closed loop with other settings; name another folder.")
    file.write_text(json.dumps(settings, indent=1), encoding="utf-8")


class ClosedLoop:
    """The stages, on what is finished already.

    Args:
        config: The configuration.
        folder: Where to write.

    Raises:
        ConfigError: no multirotor, or options that it does not have.
    """

    def __init__(self, config: DictConfig, folder: Path) -> None:
        from nsde_torch.px4.flight.path import PathPoints

        from .. import build, track_build

        self.config, self.folder = config, folder
        self.reference: Reference = track_build.reference(config.reference)
        self.path = PathPoints(self.reference.path)
        self.system: str = config.plant.system or "hexacopter"
        self._effects = build.options(config.plant)["effects"]
        self._controllers: dict[str, PredictiveController] = {}
        self._body(0)  # what the machine cannot be is said before anything is flown

    def knowledge(self, effects: list[Any]) -> Any:
        """What the controller knows."""
        from nsde_torch.control.knowledge import DECLARED, knowledge

        return knowledge(DECLARED, self.system, effects=effects)

    def _body(self, seed: int) -> Any:
        from nsde_torch.px4.simulator.body import Body

        plant = self.config.plant
        return Body(
            self.system,
            seed=seed,
            effects=self._effects,
            declared_only=plant.declared_only,
            process_noise=plant.process_noise,
            latency=plant.latency,
        )

    def _controller(self, effects: list[Any]) -> PredictiveController:
        """Made once for all flights with the same knowledge."""
        from nsde_torch.control.controller import Controller
        from nsde_torch.px4.flight.predictive import PredictiveController

        from .. import track_build

        mpc, key = self.config.mpc, json.dumps(effects)
        if key not in self._controllers:
            controller = Controller(
                self.knowledge(effects),
                problem=track_build.problem(mpc),
                solver=track_build.solver(mpc),
                safety=track_build.safety(mpc),
                say=_say,
            )
            self._controllers[key] = PredictiveController(
                controller, self.reference, delay=self.config.delay, lead=self.config.lead
            )
        made = self._controllers[key]
        made.reset()
        return made

    def flight(self, stage: str, number: int, effects: list[Any]) -> None:
        """Fly once, unless that is done."""
        from nsde_torch.px4.simulator.simulated import fly_simulated

        file = self.folder / stage / f"flight_{number}.json"
        if file.is_file():
            return
        started = time.perf_counter()
        # flights that are compared come in pairs of the same seed; those that are diagnosed have others
        seed = self.config.seed * 1000 + number + (500 if stage == LOG else 0)
        report = fly_simulated(
            self._body(seed),
            self._controller(effects),
            self.path,
            seed=seed,
            period=self.config.mpc.period,
            sensor_noise=self.config.plant.sensor_noise,
            log=self.folder / stage / f"flight_{number}.csv",
        )
        file.parent.mkdir(parents=True, exist_ok=True)
        track = [[round(v, 6) for v in row] for row in report.track]
        content = {**report.as_dict(), "seed": seed, "track": track}
        file.write_text(json.dumps(content, allow_nan=False), encoding="utf-8")
        rmse = "not flown" if report.rmse is None else f"RMSE {100 * report.rmse:.1f} cm"
        trouble = "" if report.outcome.trouble is None else f"; {report.outcome.trouble.text}"
        _say(f"{stage} {number + 1}: {rmse}{trouble} ({time.perf_counter() - started:.0f} s)")

    def diagnosis(self) -> list[Any]:
        """Effects that the logged flights show, unless that is known."""
        import nsde_torch
        from nsde_torch.diagnosis.files import EFFECTS, REPORT, write_content, write_effects
        from nsde_torch.diagnosis.files import RESULT as FOUND
        from nsde_torch.diagnosis.report import write_report
        from nsde_torch.diagnosis.text import lines
        from nsde_torch.effects.files import read
        from nsde_torch.errors import DataError

        from ..stages import Stages

        folder = self.folder / DIAGNOSIS
        if not (folder / FOUND).is_file():
            if not list((self.folder / LOG).glob("*.csv")):
                raise DataError(f"no flight was logged: see {self.folder / LOG}.")
            folder.mkdir(parents=True, exist_ok=True)
            data = nsde_torch.read(self.folder / LOG, system=self.system, kind="csv")
            print(data.summary)
            c = self.config
            stages = Stages()
            found = nsde_torch.diagnose(
                data,
                system=self.system,
                alpha=c.alpha,
                max_effects=c.max_effects,
                candidates=None if c.candidates is None else list(c.candidates),
                seed=c.seed,
                say=stages,
            )
            stages.close()
            content = found.content()
            write_effects(found, folder, system=self.system, note="found by nsde close-loop")
            write_report(folder / REPORT, found, content)
            print()
            print("\n".join(lines(content)))
            # last, because it says that the stage is finished
            write_content(content, folder)
        _, effects = read(folder / EFFECTS)
        return [{name: given} for name, given in effects.items()]

    def _flown(self, stage: str) -> list[dict[str, Any]]:
        count = self.config.logged if stage == LOG else self.config.flights
        files = [self.folder / stage / f"flight_{k}.json" for k in range(count)]
        return [json.loads(f.read_text(encoding="utf-8")) for f in files if f.is_file()]

    def result(self, found: list[Any]) -> dict[str, Any]:
        """What `close_loop.json` holds."""
        from nsde_torch.diagnosis.files import RESULT as FOUND

        before = self._flown(BEFORE)
        after = self._flown(AFTER) if found else before  # nothing found: nothing to fly with
        told = json.loads((self.folder / DIAGNOSIS / FOUND).read_text(encoding="utf-8"))
        pairs = [
            {"seed": b["seed"], "before_m": b["rmse_m"], "after_m": a["rmse_m"]}
            for b, a in zip(before, after, strict=True)
        ]
        whole = all(f["tracked"] for f in (*before, *after))
        ratios = [p["after_m"] / p["before_m"] for p in pairs] if whole else []
        return {
            "system": self.system,
            "plant": {"effects": self._effects, "declared_only": self.config.plant.declared_only},
            "reference": {"name": self.path.name, "duration_s": self.path.duration},
            "verdict": told["verdict"],
            "told": found,
            "findings": [f["sentence"] for f in told["findings"]],
            "rmse_m": pairs,
            "before_mean_m": _mean([p["before_m"] for p in pairs]),
            "after_mean_m": _mean([p["after_m"] for p in pairs]),
            "ratio": _mean(ratios) if ratios else None,
            "better_in": sum(r < 1.0 for r in ratios),
            "pairs": len(pairs),
            "units": {"rmse_m": "m"},
        }

    def picture(self) -> None:
        """Paths and errors, before and after."""
        import numpy as np
        import torch

        from nsde_torch.plots import save
        from nsde_torch.plots.tracking import tracking

        flights = {"declared physics": self._flown(BEFORE), "with what was found": self._flown(AFTER)}
        t = np.arange(0.0, self.path.duration, 0.02)
        rows = {}
        for name, found in flights.items():
            tracks = [np.array(f["track"]) for f in found if f["tracked"]]
            if tracks:
                resampled = [np.stack([np.interp(t, x[:, 0], c) for c in x[:, 1:].T], 1) for x in tracks]
                rows[name] = np.stack(resampled, 1)
        if rows:
            wanted = self.reference.at(torch.from_numpy(t)).numpy()
            save(
                tracking(t, wanted, rows, title=f"The {self.path.name}, before and after"),
                self.folder / PICTURE,
            )


def _say(line: str) -> None:
    print(line, flush=True)


def _mean(values: list[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return sum(known) / len(known) if known and len(known) == len(values) else None


def text(content: dict[str, Any]) -> str:
    """The result in some lines."""
    lines = [*content["findings"]]
    if not lines:
        lines.append("Nothing is missing from the declared physics, as far as the flights show.")
    names = ", ".join(name for entry in content["told"] for name in entry)
    lines.append(f"The controller is told of: {names or 'nothing more than before'}.")
    for p in content["rmse_m"]:
        shown = [f"{100 * v:.1f} cm" if v is not None else "not flown" for v in (p["before_m"], p["after_m"])]
        lines.append(f"seed {p['seed']}: RMSE {shown[0]} before, {shown[1]} after")
    if content["ratio"] is not None:
        lines.append(
            f"mean {100 * content['before_mean_m']:.1f} cm -> {100 * content['after_mean_m']:.1f} cm "
            f"(x {content['ratio']:.2f}), better in {content['better_in']} of {content['pairs']}"
        )
    return "\n".join(lines)
