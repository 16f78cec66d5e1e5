"""The stages of `nsde close-loop`: who flies, what is diagnosed, experiments, and the record.

Who flies is the simulated vehicle in virtual time, the plant of `nsde track`, a vehicle over MAVLink, or a person. A
controller knows the declared physics with the values of the plant, and the effects that it is given. Experiments ask
what is open, design within the limits, fly, report the evidence, diagnose with it, and so on. What each finished step
wrote is read again, not done again:

    log/, diagnosis/                                    flights of the declared physics, and what is found in them
    experiment_1/design.json, plan.csv, design.png      the plan, with the nats that are expected of it
    experiment_1/refused.json                           questions that no plan answers, and what limits it
    log/experiment_1.csv, experiment_1/flight.json      the flight
    experiment_1/obtained.json                          the nats that it brought
    experiment_1/diagnosis/                             of all logs
    before/, after/, truth/                             the flights that are compared
    close_loop.json, close_loop.png                     the record
"""

from __future__ import annotations

import json
import math
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf

from nsde_torch.control import feasible
from nsde_torch.control.controller import Controller
from nsde_torch.control.loop import DECLARED, knowledge, write_log
from nsde_torch.control.loop import fly as fly_plant
from nsde_torch.control.predictor import Predictor
from nsde_torch.control.reference import FlightPath, Reference
from nsde_torch.control.shapes import from_csv
from nsde_torch.design import DesignOptions, Question, Standing, design, obtained, open_questions, standing_of
from nsde_torch.design.experiment import PLAN, RESULT, read_design
from nsde_torch.diagnosis.decisions import Options
from nsde_torch.diagnosis.files import EFFECTS
from nsde_torch.diagnosis.files import RESULT as DIAGNOSED
from nsde_torch.effects.files import read
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.plots import save
from nsde_torch.plots.tracking import tracking
from nsde_torch.progress import Stages
from nsde_torch.px4.flight.cascade import PathPoints
from nsde_torch.px4.flight.controller import FlightController
from nsde_torch.px4.flight.flying import fly as fly_vehicle
from nsde_torch.px4.flight.predictive import PredictiveController, told
from nsde_torch.px4.flight.safety import MARGIN
from nsde_torch.px4.link.connection import LinkError
from nsde_torch.px4.options import FlightOptions, Limits
from nsde_torch.px4.simulator.simulated import fly_simulated
from nsde_torch.systems import Multirotor, System
from nsde_torch.systems.machines import plant_effects
from nsde_torch.systems.options import system_options
from nsde_torch.systems.registry import system_class
from nsde_torch.texts import rendered
from nsde_torch.whole_files import json_text, read_json

from . import build, fly_build, track_build
from .exit_status import FLIGHT_ENDED, EndedError
from .hydra_command import Job, say
from .known_machine import KnownMachine, diagnose_logs, known_machine, log_files, read_logs

LINK, HAND, PLANT = "link", "hand", "plant"
Json = Mapping[str, Any]


def needed(effects: list[Any], by: str) -> list[Any]:
    """Effects that a controller needs to know, in one order: those of the same share what is compiled."""
    known = effects if by == PLANT else told(effects)
    return sorted(known, key=lambda entry: str(next(iter(entry))))


def physics(config: DictConfig, effects: list[Any]) -> System:
    """What a controller knows that is given some effects; ConfigError for one that the machine cannot have."""
    known = knowledge(DECLARED, config.plant.system, effects=effects)
    assert isinstance(known, System)
    return known


@final
class VirtualVehicle:
    """The simulated vehicle with link, state machine and logs of a PX4, in virtual time; `delay` covers lags."""

    def __init__(self, config: DictConfig) -> None:
        self._config = config
        self._controllers: dict[str, Controller] = {}
        fly_build.body(config.plant, seed=0)  # what the machine cannot be is said before anything is flown

    def fly(self, path: FlightPath, effects: list[Any], *, seed: int, log: Path) -> dict[str, Any]:
        """Fly once from the place of take-off, with effects that the controller is given; the log is a CSV file.

        What was measured: `tracked`, `rmse_m`, `trouble`, `track` and more.
        """
        c = self._config
        body, controller = fly_build.body(c.plant, seed=seed), self._controller(path, effects)
        how = {"period": c.mpc.period, "sensor_noise": c.plant.sensor_noise}
        report = fly_simulated(body, controller, PathPoints(path), seed=seed, log=log, **how)
        return {**report.as_dict(), "track": report.track}

    def _controller(self, path: FlightPath, effects: list[Any]) -> FlightController:
        """The solver is made once for all flights with the same knowledge."""
        c, key = self._config, json.dumps(effects)
        if key not in self._controllers:
            self._controllers[key] = Controller(physics(c, effects), **track_build.planning(c.mpc), say=say)
        return PredictiveController(self._controllers[key], Reference(path), delay=c.delay, lead=c.lead)


@final
class TrackedPlant:
    """The plant of `nsde track`, motors commanded directly."""

    def __init__(self, config: DictConfig) -> None:
        self._config = config
        track_build.plant(config.plant, physics(config, []), seed=0)

    def fly(self, path: FlightPath, effects: list[Any], *, seed: int, log: Path) -> dict[str, Any]:
        """See `VirtualVehicle.fly`."""
        c, reference = self._config, Reference(path)
        known = physics(c, effects)
        plant = track_build.plant(c.plant, known, seed=seed)
        autopilot = track_build.autopilot(DECLARED, known, c, reference, batch=1, sample=plant.dt)
        late, span = c.plant.state_latency, path.duration
        flight = fly_plant(autopilot, plant, reference, state_latency=late, duration=span)
        (written,) = write_log([flight], known, log.parent)
        written.replace(log)
        lost, t, x = float(flight.lost[0]), flight.t, flight.x[:, 0]
        errors = (x[:, :3] - flight.ref[:, :3]).norm(dim=1)
        whole = math.isinf(lost)
        return {
            "tracked": whole,
            "trouble": None if whole else {"kind": "lost", "text": f"the machine was lost at {lost:.1f} s"},
            "rmse_m": float(errors.square().mean().sqrt()) if whole else None,
            "position_error_max_m": float(errors.max()) if whole else None,
            "track": torch.column_stack((t, x)).tolist(),
        }


@final
class LinkedVehicle:
    """A vehicle over MAVLink in real time, `nsde vehicle` or a PX4; ConfigError for limits that cannot be kept."""

    def __init__(self, config: DictConfig) -> None:
        self._config, self._connect = config, fly_build.connection(config.link)
        self._limits, self._setpoints = fly_build.limits(config.limits), fly_build.setpoints(config.limits)
        if config.experiments:
            check_inside(config.experiment, self._limits)
        system = physics(config, [])
        assert isinstance(system, Multirotor)
        self._motors = system.nu

    def fly(self, path: FlightPath, effects: list[Any], *, seed: int, log: Path) -> dict[str, Any]:
        """See `VirtualVehicle.fly`; EndedError: stopped, or the vehicle was taken from us or is not seen to stand."""
        c = self._config
        check_path(path, physics(c, []), self._limits, dt=track_build.problem(c.mpc).dt)
        # the solver is compiled and warm before the vehicle is spoken to
        runner = fly_build.predictive(
            c, path, run=DECLARED, system=c.plant.system, effects=effects, lead=c.lead
        )
        try:
            runner.wait()
            with self._connect() as link:
                # an experiment ends anywhere, and the next flight has its fence about where it takes off
                bounds: dict[str, Any] = {"limits": self._limits, "options": FlightOptions(come_back=True)}
                bounds |= {"setpoints": self._setpoints, "motors": self._motors}
                report = fly_vehicle(link, runner, PathPoints(path), log=log, **bounds, say=say)
        finally:
            runner.close()
        fly_build.check_end(report.outcome)
        return {**report.as_dict(), "track": report.track}


FlyingMachine = VirtualVehicle | TrackedPlant | LinkedVehicle
MACHINES: dict[str, type[FlyingMachine]] = {
    "vehicle": VirtualVehicle,
    PLANT: TrackedPlant,
    LINK: LinkedVehicle,
}
"""Who flies, by `by=`; a person flies no machine of ours."""


# within what an experiment is planned: fence and speeds that were asked for, no faster turns than are sent


def plan_limits(config: DictConfig) -> dict[str, list[float]]:
    """Lowest and highest value of each state of a plan, by its name."""
    fence = build.fence(config.experiment, "experiment")
    limits = {f"p_{axis}": list(pair) for axis, pair in zip("xyz", fence, strict=True)}
    for name in ("v_x", "v_y", "v_z", "w_x", "w_y", "w_z"):
        most = float(OmegaConf.select(config, limit_key(name, config)))
        limits[name] = [-most, most]
    return limits


def limit_key(state: str, config: DictConfig) -> str:
    """The key that bounds a state (`p_x`, `v_x`, `w_x`) of a plan: over a link no faster turns than are sent."""
    if state[0] != "w":
        return {"p": "experiment.fence", "v": "experiment.speed"}[state[0]]
    sent = "yaw_rate" if state == "w_z" else "rate"
    slower = config.by == "link" and config.limits[sent] < config.experiment.rate
    return f"limits.{sent}" if slower else "experiment.rate"


def check_inside(experiment: DictConfig, limits: Limits) -> None:
    """Refuse experiments that may leave what a flight is ended by; the ConfigError names both keys."""
    fence = build.fence(experiment, "experiment")
    for axis, (low, high), (lowest, highest) in zip("xyz", fence, limits.fence, strict=True):
        # a path nearer to the fence's top is refused before take-off
        highest -= MARGIN if axis == "z" else 0.0
        if low < lowest or high > highest + 1e-6:
            raise ConfigError(
                f"`experiment.fence` reaches from {low:g} to {high:g} m along {axis}, beyond `limits.fence`, where a "
                f"flight is ended: a flight may be planned from {lowest:g} to {highest:g} m. Make the first smaller, "
                "or the second larger."
            )
    if experiment.speed > limits.speed:
        raise ConfigError(
            f"`experiment.speed` is {experiment.speed:g} m/s, beyond `limits.speed` of {limits.speed:g} m/s, where a "
            "flight is ended."
        )


def check_path(path: FlightPath, machine: System, limits: Limits, *, dt: float) -> None:
    """Refuse a path that would be ended on the way; the ConfigError names the limit."""
    asked = feasible.envelope(Reference(path), Predictor(machine, dt=dt))
    for name, unit in (("tilt", "deg"), ("speed", "m/s")):
        most, limit = getattr(asked, name), getattr(limits, name)
        if most > limit:
            raise ConfigError(
                f"the path {path.name!r} asks for a {name} of up to {most:.2g} {unit}, and `limits.{name}={limit:g}` "
                f"ends a flight there. Start the same command again with a larger `limits.{name}`."
            )


# --- experiments: design, fly, read, diagnose, until nothing is open or the budget is spent ---------------------------

FLIGHT, OBTAINED, REFUSED = "flight.json", "obtained.json", "refused.json"
_OTHERS = ("odd_run", "unexplained_run")
"""Kinds of warnings of a diagnosis that speak of a run of another machine."""
_NAMED = 3
_NEAR = 0.7  # share of a limit from which it is named as one that binds


@dataclass(frozen=True)
class StoppedLoop:
    """Why there is no further experiment."""

    kind: str  # `settled`, `budget`, `limits`, `other_machine` or `waiting` (for a log)
    sentence: str


def run_experiments(loop: ClosedLoop) -> tuple[list[dict[str, Any]], StoppedLoop]:
    """Experiments until nothing is open, affordable or informative: a record of each, and why there is no further."""
    done: list[dict[str, Any]] = []
    while True:
        content, number = loop.found, len(done) + 1
        now = standing_of(content)
        if now.settled:
            return done, settled(now)
        if number > loop.config.experiments:
            spent = f"the budget of experiments={loop.config.experiments} is spent; {now.words}."
            return done, StoppedLoop("budget", f"{spent} A larger one goes on from here.")
        place = loop.folder / f"experiment_{number}"
        place.mkdir(parents=True, exist_ok=True)
        name = loop.config.plant.system
        data = read_logs(loop.logs, name, loop.kind, content)
        known = known_machine(loop.diagnosis, content, system_options(name).make(), data)
        plan = _planned(loop, place, known, open_questions(content, known.system), number)
        if isinstance(plan, StoppedLoop):
            return done, plan
        waiting = _flown(loop, place, number)
        if waiting is not None:
            return done, waiting
        told = _read(loop, place, known, plan, content)
        loop.diagnose(place / "diagnosis")
        other = _other_machine(loop, place, content)
        if other is not None:
            return done, other
        loop.diagnosis = place / "diagnosis"
        flown = read_json(place / FLIGHT, {})  # nothing is measured where a person flew
        done.append(entry_of(place, number, plan, told, now, standing_of(loop.found), flown))
        say(experiment_text(done[-1]))


def settled(now: Standing) -> StoppedLoop:
    """Nothing is open."""
    rest = "".join(f"; {' or '.join(t)}: no input tells these apart" for t in now.beyond)
    if now.confounded:
        rest += (
            f"; the intervals of {', '.join(now.confounded)} are wide by what feedback may hide, which a further "
            "flight of this kind leaves: log what the controller saw"
        )
    sure, nothing = "nothing is tied, and what was found is sure", "nothing was found, and nothing is tied"
    return StoppedLoop("settled", (sure if now.found else nothing) + rest)


def _planned(
    loop: ClosedLoop, place: Path, known: KnownMachine, questions: Sequence[Question], number: int
) -> dict[str, Any] | StoppedLoop:
    """The plan for the first question that a plan within the limits answers, or why there is none."""
    refused: list[str] = read_json(place / REFUSED, [])
    for question in questions[len(refused) :]:
        made = (place / RESULT).is_file()
        found = read_design(place) if made else _designed(loop, place, known, question, number)
        if isinstance(found, dict):
            told = expected_nats(found)
            if told >= loop.config.experiment.least_nats:
                return found
            found = too_little(found, told, loop.config)
            (place / RESULT).unlink()
        say(found)
        refused.append(found)
        (place / REFUSED).write_text(json.dumps(refused, indent=1), encoding="utf-8")
    return StoppedLoop("limits", " ".join(refused))


def _designed(
    loop: ClosedLoop, place: Path, known: KnownMachine, question: Question, number: int
) -> dict[str, Any] | str:
    """A plan for a question; the limit that is in the way where none stays within them."""
    say(f"\nexperiment {number}: {asked(question.content())}")
    e, stages = loop.config.experiment, Stages()
    try:
        options = DesignOptions(
            duration=e.duration,
            limits=plan_limits(loop.config),
            **{k: e[k] for k in ("samples", "proposals", "generations", "rehearsals")},
            seed=loop.config.seed * 100 + number,
        )
        made = design(question=question, options=options, **known.given, baselines=e.baselines, say=stages)
    except ConfigError as error:
        return f"{asked(question.content())} {error}"
    finally:
        stages.close()
    made.save(place)
    say(made.report)
    return read_design(place)


def _flown(loop: ClosedLoop, place: Path, number: int) -> StoppedLoop | None:
    """Fly the plan, unless that is done; why there is no log, where there is none."""
    name = f"experiment_{number}"
    if loop.machine is None:
        if log_files(loop.logs, name):
            return None
        return StoppedLoop(
            "waiting",
            f"fly {place / PLAN} (a path: t, p_x, p_y, p_z, yaw), put the log into {loop.logs} as {name}.csv or "
            f"{name}.ulg, and start this command again",
        )
    if not (place / FLIGHT).is_file():
        seed = loop.config.seed * 1000 + _EXPERIMENT + number
        log = loop.logs / f"{name}.csv"
        found = loop.fly(f"experiment {number}", from_csv(place / PLAN), [], seed, log)
        (place / FLIGHT).write_text(json_text(found, indent=None), encoding="utf-8")
    return None


def _read(loop: ClosedLoop, place: Path, known: KnownMachine, plan: Json, content: Json) -> dict[str, Any]:
    """The evidence of the flight, unless that is known; a DataError where the logs hold no new run."""
    file = place / OBTAINED
    if (there := read_json(file, None)) is not None:
        return there
    data = read_logs(loop.logs, loop.config.plant.system, loop.kind, content)
    before = {run.name for run in known.runs}
    new = [run for run in data.runs if run.name not in before]
    if not new:
        raise DataError(f"{loop.logs} holds no run that the diagnosis before {place.name} did not have.")
    asked_for = plan["question"]
    question = Question(tuple(map(tuple, asked_for["members"])), tuple(asked_for["parameters"]))
    # trusted: whether it is of this machine the diagnosis of all runs says
    how: dict[str, Any] = {"expected": plan["expected"], "trusted": True}
    told = obtained(flown=new, question=question, **known.given, **how).content()
    file.write_text(json_text(told) + "\n", encoding="utf-8")
    return told


def _other_machine(loop: ClosedLoop, place: Path, before: Json) -> StoppedLoop | None:
    """Whether the diagnosis of all runs says that the experiment's is of another machine.

    Of a log that a person put in, every objection that was not there before counts. Nothing of such a log is kept as
    done: the next start reads what lies there then, or flies again.
    """
    content = read_json(place / "diagnosis" / DIAGNOSED)
    warnings = [w for w in content["warnings"] if w["parameter"] is None]
    known = {w["kind"] for w in before.get("warnings", ())}
    said = [w for w in warnings if w["kind"] in _OTHERS and place.name in w["sentence"]]
    if loop.machine is None:
        said += [w for w in warnings if w["kind"] not in known]
    if not said:
        return None
    for file in (place / OBTAINED, place / "diagnosis" / DIAGNOSED):
        file.unlink(missing_ok=True)
    remedy = f"Put another log into {loop.logs}, and start this command again"
    if loop.machine is not None:
        (place / FLIGHT).unlink(missing_ok=True)
        for left in log_files(loop.logs, place.name):
            left.replace(place / left.name)
        remedy = f"Its log lies in {place} now; start this command again, and it is flown again"
    return StoppedLoop(
        "other_machine",
        f"the log of {place.name} is not of this machine, or the machine has changed, or the log is at fault. With it "
        f"among the others: {said[0]['sentence']}; {said[0]['remedy']}. {remedy}",
    )


# --- what is said of an experiment ------------------------------------------------------------------------------------


def asked(question: Json) -> str:
    """The question in words."""
    if question["kind"] == "tie":
        return f"which is true, {' or '.join(question['names'])}?"
    return f"how large: {', '.join(question['parameters'])}?"


def expected_nats(plan: Json) -> float:
    """What is expected of a plan, whichever member is true; of parameters, of all together [nats]."""
    if plan["question"]["kind"] == "tie":
        return float(min(e["nats"]["mean"] for e in plan["expected"]))
    names, every = plan["question"]["parameters"], plan["expected"][0]["parameters"].items()
    wanted = [p for k, p in every if any(k == n or k.startswith(f"{n}[") for n in names)]
    known = ((p["standard_error"], p["expected_standard_error"]) for p in wanted)
    return float(sum(math.log(now / then) for now, then in known if then is not None))


def too_little(plan: Json, told: float, config: DictConfig) -> str:
    """That no plan is informative, and which limits the best one comes close to."""
    near = [
        f"{name} ({'leaves' if share > 1 else f'takes {share:.0%} of'} {limit_key(name, config)} in rehearsal)"
        for name, share in sorted(plan["plan"]["largest_share_of_limits"].items(), key=lambda kv: -kv[1])
        if share >= _NEAR and name[:2] in ("p_", "v_", "w_")
    ][:_NAMED]
    path = plan["path_limits"] or {}
    for name, what in (("sideways", "acceleration_sideways"), ("up", "acceleration_up")):
        if path and path[f"largest_{name}"] >= 0.99 * path[what]:
            near.append(f"acceleration {name} ({path[what]:g} {path['unit']}, the most that a path asks for)")
    binds = ", ".join(near) or "its length"
    return (
        f"{asked(plan['question'])} No plan within the limits shows much: of the best one {told:.2g} nats are "
        f"expected, less than experiment.least_nats={config.experiment.least_nats:g}. What limits it: {binds}. "
        f"Allow more, or a longer experiment (experiment.duration={config.experiment.duration:g})."
    )


def entry_of(
    place: Path, number: int, plan: Json, told: Json, before: Standing, after: Standing, flown: Json
) -> dict[str, Any]:
    """What `close_loop.json` says of an experiment."""
    tie, kept = plan["question"]["kind"] == "tie", ("words", "duration_s", "largest_share_of_limits")
    brought = told["nats"][told["speaks_for"]] if tie else told["nats"]
    wanted = told["expected_nats"]
    return {
        "number": number,
        "question": plan["question"],
        "plan": {"file": f"{place.name}/{PLAN}", **{k: plan["plan"][k] for k in kept}},
        "expected_nats": (
            {e["if_true"]: e["nats"]["mean"] for e in plan["expected"]} if tie else expected_nats(plan)
        ),
        "obtained": dict(told),
        "nats_expected": expected_nats(plan) if wanted is None else wanted,
        "nats_obtained": brought,
        "flight": {k: flown.get(k) for k in ("tracked", "trouble", "rmse_m")},
        "before": before.content(),
        "after": after.content(),
    }


def experiment_text(entry: Json) -> str:
    """What is printed of an experiment."""
    return rendered(__file__, "experiment.txt", **entry, asked=asked(entry["question"]))


# --- all stages; what is finished is not done again -------------------------------------------------------------------

LOG, DIAGNOSIS, BEFORE, AFTER, TRUTH = "log", "diagnosis", "before", "after", "truth"
_LOGGED, _EXPERIMENT = 500, 700
"""Seeds of flights that are diagnosed, and of experiments, lie beyond those of flights that are compared."""
FLYING = ".flying"
"""Where a log is written until it counts: what a flight left that was stopped or refused is never diagnosed."""
LEAST = 0.5  # share of a path that a flight over a link must have flown to be diagnosed
SETTINGS = "settings.json"
_FREE = ("out_dir", "threads", "experiments", "truth", "link", "limits")
"""Keys that another start on the same folder may have otherwise."""


def close_loop(config: DictConfig, job: Job) -> float | None:
    """All stages into the folder of a job; see the command's `run`."""
    name, simulated, folder = config.plant.system, config.plant.kind == "simulated", job.run_dir
    if not simulated or name is None or not issubclass(system_class(name), Multirotor):
        raise ConfigError("`nsde close-loop` flies plant=hexacopter or plant=quadrotor.")
    if config.truth and config.by not in ("vehicle", PLANT):
        raise ConfigError(
            f"`truth` is known of simulated machines alone (by=vehicle, by=plant); by={config.by} flies another."
        )
    _same_settings(config, folder)
    loop = ClosedLoop(config, folder)
    track_build.envelope(config, loop.reference, physics(config, []))
    if (waiting := loop.fly_logged()) is not None:
        say(waiting.sentence)
        return None
    experiments, stop = loop.find()
    if stop is None or stop.kind != "waiting":
        loop.compare()
    content = record(loop, experiments, stop)
    (folder / RECORD).write_text(json_text(content), encoding="utf-8")
    drawn = picture(loop, folder)
    told = {"after_over_truth": None, **content, "experiments": list(map(experiment_text, experiments))}
    print("\n" + rendered(__file__, "close_loop.txt", **told))
    flown = [f"{s}/" for s in (LOG, BEFORE, AFTER, TRUTH) if (folder / s).is_dir()]
    planned = [f"experiment_{e['number']}/" for e in experiments]
    wrote = [RECORD, *([PICTURE] if drawn else []), f"{DIAGNOSIS}/", *planned, *flown]
    print(f"\n{job.took}; wrote {folder}: {', '.join(wrote)}")
    ratio: float | None = content["ratio"]
    return ratio


def _same_settings(config: DictConfig, folder: Path) -> None:
    """Refuse a folder with what is of another configuration."""
    settings = build.options(config, *_FREE)
    file = folder / SETTINGS
    before = read_json(file, settings)
    other = sorted(k for k in {*before, *settings} if before.get(k) != settings.get(k))
    if other:
        raise ConfigError(
            f"`out_dir={folder}` holds a closed loop with other settings ({', '.join(other)}): give those of "
            f"{file} to go on with it, or name another folder."
        )
    file.write_text(json.dumps(settings, indent=1), encoding="utf-8")


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
        return read_json(self.diagnosis / DIAGNOSED)

    @property
    def told(self) -> list[Any]:
        """What the controller knows: effects of the last diagnosis."""
        effects = [{name: given} for name, given in read(self.diagnosis / EFFECTS)[1].items()]
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
        """Effects of a controller that knows the simulated machine, which has them beside the declared physics."""
        given, plant = build.options(self.config.plant)["effects"], self.config.plant
        found = plant_effects(plant.system, effects=given, declared_only=plant.declared_only)
        return needed([{name: values} for name, values in found.items()], self.config.by)

    def flown(self, stage: str) -> list[dict[str, Any]]:
        """What was measured in the flights of a stage that are compared."""
        files = [self.folder / stage / f"flight_{k}.json" for k in range(self.config.flights)]
        return [read_json(f) for f in files if f.is_file()]

    def _flight(self, stage: str, number: int, effects: list[Any]) -> None:
        """Fly the reference once, unless that is done with what the controller knows."""
        file = self.folder / stage / f"flight_{number}.json"
        if done := read_json(file):
            # over a link the cause that ended a flight may have passed; elsewhere the same seed ends it again
            again = self.config.by == LINK and stage != LOG and not done["tracked"]
            if done["told"] == effects and not again:
                return
        # flights that are compared come in groups of the same seed; those that are diagnosed have others
        seed = self.config.seed * 1000 + number + (_LOGGED if stage == LOG else 0)
        log = self.folder / stage / f"flight_{number}.csv"
        found = self.fly(f"{stage} {number + 1}", self.reference.path, effects, seed, log)
        file.parent.mkdir(parents=True, exist_ok=True)
        content = {**found, "seed": seed, "told": effects}
        file.write_text(json_text(content, indent=None), encoding="utf-8")

    def fly(self, name: str, path: FlightPath, effects: list[Any], seed: int, log: Path) -> dict[str, Any]:
        """Fly once, and put the log into its place; EndedError: too little was flown, or the vehicle is not ours."""
        assert self.machine is not None
        started = time.perf_counter()
        again = (
            f"It does not count, and what is finished is kept: start the same command again with "
            f"out_dir={self.folder}, and it is flown again."
        )
        unfinished = self.folder / FLYING / log.name
        shutil.rmtree(unfinished.parent, ignore_errors=True)
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
        for file in unfinished.parent.iterdir():
            file.replace(log.parent / file.name)
        unfinished.parent.rmdir()
        found["track"] = [[round(float(v), 6) for v in row] for row in found["track"]]
        rmse = "not flown" if found["rmse_m"] is None else f"RMSE {100 * found['rmse_m']:.1f} cm"
        say(f"{name}: {rmse}{trouble} ({time.perf_counter() - started:.0f} s)")
        return found


# --- the record: close_loop.json, its text and its picture ------------------------------------------------------------

RECORD, PICTURE = "close_loop.json", "close_loop.png"
_DRAWN = {BEFORE: "declared physics", AFTER: "with what was found", TRUTH: "with the true effects"}


def record(loop: ClosedLoop, experiments: list[dict[str, Any]], stop: StoppedLoop | None) -> dict[str, Any]:
    """What `close_loop.json` holds of a loop that was flown; `stop` is None where no experiment was asked for."""
    told, diagnosed = loop.told, loop.found
    before = loop.flown(BEFORE)
    after = loop.flown(AFTER) if told else before  # nothing found: nothing to fly with
    truth = loop.flown(TRUTH)
    pairs = [
        {"seed": b["seed"], "before_m": b["rmse_m"], "after_m": a["rmse_m"]}
        for b, a in zip(before, after, strict=True)
    ]
    for pair, flown in zip(pairs, truth, strict=False):
        pair["truth_m"] = flown["rmse_m"]
    whole = bool(pairs) and all(f["tracked"] for f in (*before, *after))
    ratios = [p["after_m"] / p["before_m"] for p in pairs] if whole else []
    config = loop.config
    plant = build.options(config.plant)
    content: dict[str, Any] = {
        "system": config.plant.system,
        "by": config.by,
        # what a person flies, or is at the other end of a link, is not known
        "plant": None if config.by in (LINK, HAND) else {k: plant[k] for k in ("effects", "declared_only")},
        "reference": {"name": loop.reference.name, "duration_s": loop.reference.duration},
        "verdict": diagnosed["verdict"],
        "told": told,
        "findings": [f["sentence"] for f in diagnosed["findings"]],
        "experiments": experiments,
        "stopped": None if stop is None else {"kind": stop.kind, "sentence": stop.sentence},
        "rmse_m": pairs,
        "before_mean_m": _mean([p["before_m"] for p in pairs]),
        "after_mean_m": _mean([p["after_m"] for p in pairs]),
        "ratio": _mean(ratios) if ratios else None,
        "better_in": sum(r < 1.0 for r in ratios),
        "pairs": len(pairs),
        "not_to_the_end": [
            {"flight": f"{stage} {k + 1}", "trouble": f["trouble"]["text"] if f["trouble"] else None}
            for stage, flights in ((BEFORE, before), (AFTER, after if told else []), (TRUTH, truth))
            for k, f in enumerate(flights)
            if not f["tracked"]
        ],
        "units": {"rmse_m": "m", "nats": "nat"},
    }
    if truth:
        known = whole and all(f["tracked"] for f in truth)
        content["truth"] = loop.truth
        content["truth_mean_m"] = _mean([p["truth_m"] for p in pairs])
        content["after_over_truth"] = _mean([p["after_m"] / p["truth_m"] for p in pairs]) if known else None
    return content


def picture(loop: ClosedLoop, folder: Path) -> bool:
    """Paths and errors of the flights that are compared; whether there was anything to draw."""
    t = np.arange(0.0, loop.reference.duration, 0.02)
    rows = {}
    for stage, name in _DRAWN.items():
        tracks = [np.array(f["track"]) for f in loop.flown(stage) if f["tracked"]]
        if tracks:
            resampled = [np.stack([np.interp(t, x[:, 0], c) for c in x[:, 1:].T], 1) for x in tracks]
            rows[name] = np.stack(resampled, 1)
    if not rows:
        return False
    wanted = loop.reference.at(torch.from_numpy(t)).numpy()
    save(tracking(t, wanted, rows, title=f"The {loop.reference.name}, before and after"), folder / PICTURE)
    return True


def _mean(values: list[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return sum(known) / len(known) if known and len(known) == len(values) else None
