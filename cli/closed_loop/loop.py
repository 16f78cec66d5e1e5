"""All stages of `nsde close-loop`; what is finished is not done again."""

import json
import time
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from nsde_torch.control import feasible
from nsde_torch.control.predictor import Predictor
from nsde_torch.control.reference import FlightPath, Reference
from nsde_torch.control.shapes import from_csv
from nsde_torch.diagnosis.decisions import Options
from nsde_torch.errors import DataError
from nsde_torch.px4.link.connection import LinkError
from nsde_torch.whole_files import json_text

from .. import build, track_build
from ..exit_status import FLIGHT_ENDED, EndedError
from ..hydra_command import say
from ..known_machine import diagnose_logs, diagnosis_content, effects_found, log_files
from .experiments import StoppedLoop, run_experiments
from .machines import LINK, MACHINES, FlyingMachine, needed, physics, true_effects

LOG, DIAGNOSIS, BEFORE, AFTER, TRUTH = "log", "diagnosis", "before", "after", "truth"
_LOGGED, _EXPERIMENT = 500, 700
"""Seeds of flights that are diagnosed, and of experiments, lie beyond those of flights that are compared."""
FLYING = ".flying"
"""Where a log is written until it counts: what a flight left that was stopped or refused is never diagnosed."""
LEAST = 0.5  # share of a path that a flight over a link must have flown to be diagnosed


class ClosedLoop:
    """The stages, on what is finished already in a folder."""

    def __init__(self, config: DictConfig, folder: Path) -> None:
        self.config, self.folder = config, folder
        if config.experiments:
            build.fence(config.experiment, "experiment")
        self.reference: Reference = track_build.reference(config.reference)
        self.logs = folder / LOG
        self.machine: FlyingMachine | None = MACHINES[config.by](config) if config.by in MACHINES else None
        # what a person flew may be of any kind; what we fly we log as CSV, with a .ulg beside it
        self.kind = "csv" if self.machine is not None else None

    def check(self) -> None:
        """Refuse a reference that the machine cannot fly."""
        problem, tilt = track_build.problem(self.config.mpc), self.config.reference.tilt_limit
        predictor = Predictor(physics(self.config, []), dt=problem.dt)
        feasible.check(self.reference, predictor, problem, tilt=tilt)

    def fly_logged(self) -> StoppedLoop | None:
        """The flights that are diagnosed; why there is none, where a person is to fly them."""
        if self.machine is None:
            if log_files(self.logs):
                return None
            self.logs.mkdir(parents=True, exist_ok=True)
            return StoppedLoop(
                "waiting",
                f"put logs of the machine into {self.logs} (CSV or ULog), and start this command again",
            )
        for k in range(self.config.logged):
            self._flight(LOG, k, [])
        if not log_files(self.logs):
            raise DataError(f"no flight was logged: see {self.logs}.")
        return None

    def find(self) -> tuple[list[dict[str, Any]], StoppedLoop | None]:
        """Diagnose, and close what is open by experiments; the evidence of each, and why there is no further one."""
        self.diagnosis = self.folder / DIAGNOSIS
        self.diagnose(self.diagnosis)
        if not self.config.experiments:
            return [], None
        done, stop = run_experiments(self)
        say(f"no further experiment: {stop.sentence}")
        return done, stop

    def diagnose(self, out: Path) -> None:
        """Diagnose all logs there are into a folder, unless that is done."""
        settings = build.shared(Options, self.config)
        diagnose_logs(self.logs, out, self.config.plant.system, self.kind, settings=settings)

    @property
    def found(self) -> dict[str, Any]:
        return diagnosis_content(self.diagnosis)

    @property
    def told(self) -> list[Any]:
        """What the controller knows: effects of the last diagnosis."""
        effects = effects_found(self.diagnosis)
        return effects if self.machine is None else needed(effects, self.config.by)

    def compare(self) -> None:
        """The flights before and after, in the same gusts, and those of a controller that knows the truth."""
        if self.machine is None:
            return
        stages = {BEFORE: [], AFTER: self.told} if self.told else {BEFORE: []}
        if self.config.truth:
            stages[TRUTH] = self.truth
        for stage, effects in stages.items():
            for k in range(self.config.flights):
                self._flight(stage, k, effects)

    @property
    def truth(self) -> list[Any]:
        """Effects of a controller that knows the simulated machine."""
        return needed(true_effects(self.config), self.config.by)

    def flown(self, stage: str) -> list[dict[str, Any]]:
        """What was measured in the flights of a stage that are compared."""
        files = [self.folder / stage / f"flight_{k}.json" for k in range(self.config.flights)]
        return [json.loads(f.read_text(encoding="utf-8")) for f in files if f.is_file()]

    def fly_plan(self, plan: Path, log: Path, number: int) -> dict[str, Any]:
        """Fly the path of an experiment with the declared physics, and say what was measured."""
        seed = self.config.seed * 1000 + _EXPERIMENT + number
        return self._fly(f"experiment {number}", from_csv(plan), [], seed, log)

    def _flight(self, stage: str, number: int, effects: list[Any]) -> None:
        """Fly the reference once, unless that is done with what the controller knows."""
        file = self.folder / stage / f"flight_{number}.json"
        if file.is_file():
            done = json.loads(file.read_text(encoding="utf-8"))
            # over a link the cause that ended a flight may have passed; elsewhere the same seed ends it again
            again = self.config.by == LINK and stage != LOG and not done["tracked"]
            if done["told"] == effects and not again:
                return
        # flights that are compared come in groups of the same seed; those that are diagnosed have others
        seed = self.config.seed * 1000 + number + (_LOGGED if stage == LOG else 0)
        log = self.folder / stage / f"flight_{number}.csv"
        found = self._fly(f"{stage} {number + 1}", self.reference.path, effects, seed, log)
        file.parent.mkdir(parents=True, exist_ok=True)
        content = {**found, "seed": seed, "told": effects}
        file.write_text(json_text(content, indent=None), encoding="utf-8")

    def _fly(self, name: str, path: FlightPath, effects: list[Any], seed: int, log: Path) -> dict[str, Any]:
        """Fly once, and put the log into its place; EndedError: too little was flown, or the vehicle is not ours."""
        assert self.machine is not None
        started = time.perf_counter()
        again = (
            f"It does not count, and what is finished is kept: start the same command again with "
            f"out_dir={self.folder}, and it is flown again."
        )
        unfinished = self.folder / FLYING / log.name
        for file in (unfinished, unfinished.with_suffix(".ulg")):
            file.unlink(missing_ok=True)
        try:
            found = self.machine.fly(path, effects, seed=seed, log=unfinished)
        except EndedError as error:
            raise EndedError(f"{name}: {error}. {again}", error.status) from error
        except LinkError as error:
            raise LinkError(f"{name}: {error}. {again}") from error
        trouble = "" if found["trouble"] is None else f"; {found['trouble']['text']}"
        flown = found["track"][-1][0] if found["track"] and unfinished.is_file() else 0.0
        least = LEAST if self.config.by == LINK and log.parent.name == LOG else 0.0
        if flown <= least * path.duration:
            raise EndedError(
                f"{name}: {flown:.2g} s of {path.duration:.3g} s were flown{trouble}. {again}", FLIGHT_ENDED
            )
        log.parent.mkdir(parents=True, exist_ok=True)
        for file in (unfinished, unfinished.with_suffix(".ulg")):
            if file.is_file():
                file.replace(log.parent / file.name)
        unfinished.parent.rmdir()
        rmse = "not flown" if found["rmse_m"] is None else f"RMSE {100 * found['rmse_m']:.1f} cm"
        say(f"{name}: {rmse}{trouble} ({time.perf_counter() - started:.0f} s)")
        return found
