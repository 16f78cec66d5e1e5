"""Experiments: ask what is open, design within the limits, fly, report its evidence, diagnose with it, and so on.

What each finished step wrote is read again, not done again:

    experiment_1/design.json, plan.csv, design.png      the plan, with the nats that are expected of it
    experiment_1/refused.json                           questions that no plan answers, and what limits it
    log/experiment_1.csv, experiment_1/flight.json      the flight
    experiment_1/obtained.json                          the nats that it brought
    experiment_1/diagnosis/                             of all logs
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from nsde_torch.design import (
    DesignOptions,
    Question,
    Standing,
    design,
    obtained,
    open_questions,
    standing_of,
)
from nsde_torch.design.experiment import PLAN, RESULT, read_design
from nsde_torch.diagnosis.files import RESULT as DIAGNOSED
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.progress import Stages
from nsde_torch.whole_files import json_text

from ..known_machine import KnownMachine
from .limits import plan_limits
from .logs import diagnosis_content, log_files, machine_in, read_logs
from .told import asked, entry_of, expected_nats, experiment_lines, too_little

FLIGHT, OBTAINED, REFUSED = "flight.json", "obtained.json", "refused.json"
_OTHERS = ("odd_run", "unexplained_run")
"""Kinds of warnings of a diagnosis that speak of a run of another machine."""

Say = Callable[[str], None]


@dataclass(frozen=True)
class StoppedLoop:
    """Why there is no further experiment."""

    kind: str
    """`settled`, `budget`, `limits`, `other_machine` or `waiting` (for a log)."""
    sentence: str


@dataclass(frozen=True)
class ExperimentLoop:
    """What experiments need of the loop."""

    config: DictConfig
    folder: Path
    logs: Path
    kind: str | None
    """Of the logs; None chooses by their names."""
    fly: Callable[[Path, Path, int], dict[str, Any]] | None
    """Flies a plan and writes a log, and returns what was measured; None where a person does."""
    diagnose: Callable[[Path], None]
    """Diagnoses all logs into a folder."""
    say: Say


def run_experiments(loop: ExperimentLoop, diagnosis: Path) -> tuple[list[dict[str, Any]], StoppedLoop, Path]:
    """Experiments from a first diagnosis on, until nothing is open, the budget is spent, or none is informative.

    Returns:
        A record of each experiment, why there is no further one, and the folder of the last diagnosis.

    Raises:
        DataError: a log cannot be read as one of this machine.
    """
    done: list[dict[str, Any]] = []
    for number in range(1, loop.config.experiments + 1):
        content = diagnosis_content(diagnosis)
        now = standing_of(content)
        if now.settled:
            return done, settled(now), diagnosis
        place = loop.folder / f"experiment_{number}"
        place.mkdir(parents=True, exist_ok=True)
        known = machine_in(loop.logs, diagnosis, loop.config.plant.system, loop.kind)
        plan = _planned(loop, place, known, open_questions(content, known.system), number)
        if isinstance(plan, StoppedLoop):
            return done, plan, diagnosis
        waiting = _flown(loop, place, number)
        if waiting is not None:
            return done, waiting, diagnosis
        told = _read(loop, place, known, plan, content)
        loop.diagnose(place / "diagnosis")
        other = _other_machine(loop, place, content)
        if other is not None:
            return done, other, diagnosis
        diagnosis = place / "diagnosis"
        after = standing_of(diagnosis_content(diagnosis))
        done.append(entry_of(place, number, plan, told, now, after, _flight(place)))
        for line in experiment_lines(done[-1]):
            loop.say(line)
    now = standing_of(diagnosis_content(diagnosis))
    if now.settled:
        return done, settled(now), diagnosis
    spent = f"the budget of experiments={loop.config.experiments} is spent; {now.words}."
    return done, StoppedLoop("budget", f"{spent} A larger one goes on from here."), diagnosis


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
    loop: ExperimentLoop, place: Path, known: KnownMachine, questions: Sequence[Question], number: int
) -> dict[str, Any] | StoppedLoop:
    """The plan for the first question that a plan within the limits answers, or why there is none."""
    file = place / REFUSED
    refused: list[str] = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else []
    for question in questions[len(refused) :]:
        made = (place / RESULT).is_file()
        found = read_design(place) if made else _designed(loop, place, known, question, number)
        if isinstance(found, dict):
            told = expected_nats(found)
            if told >= loop.config.experiment.least_nats:
                return found
            found = too_little(found, told, loop.config)
            (place / RESULT).unlink()
        loop.say(found)
        refused.append(found)
        file.write_text(json.dumps(refused, indent=1), encoding="utf-8")
    return StoppedLoop("limits", " ".join(refused))


def _designed(
    loop: ExperimentLoop, place: Path, known: KnownMachine, question: Question, number: int
) -> dict[str, Any] | str:
    """A plan for a question; the limit that is in the way where none stays within them."""
    loop.say(f"\nexperiment {number}: {asked(question.content())}")
    e, stages = loop.config.experiment, Stages()
    machine: dict[str, Any] = {"clock": known.clock, "values": known.values}
    try:
        options = DesignOptions(
            duration=e.duration,
            limits=plan_limits(loop.config),
            **{k: e[k] for k in ("samples", "proposals", "generations", "rehearsals")},
            seed=loop.config.seed * 100 + number,
        )
        made = design(
            known.system, known.runs, question, options, **machine, baselines=e.baselines, say=stages
        )
    except ConfigError as error:
        return f"{asked(question.content())} {error}"
    finally:
        stages.close()
    made.save(place / ".unfinished")
    # `design.json` is last, because it says that the stage is finished
    for file in sorted((place / ".unfinished").iterdir(), key=lambda p: p.name == RESULT):
        file.replace(place / file.name)
    (place / ".unfinished").rmdir()
    loop.say(made.report)
    return read_design(place)


def _flown(loop: ExperimentLoop, place: Path, number: int) -> StoppedLoop | None:
    """Fly the plan, unless that is done; why there is no log, where there is none."""
    name = f"experiment_{number}"
    if loop.fly is None:
        if log_files(loop.logs, name):
            return None
        return StoppedLoop(
            "waiting",
            f"fly {place / PLAN} (a path: t, p_x, p_y, p_z, yaw), put the log into {loop.logs} as {name}.csv or "
            f"{name}.ulg, and start this command again",
        )
    if not (place / FLIGHT).is_file():
        found = loop.fly(place / PLAN, loop.logs / f"{name}.csv", number)
        (place / FLIGHT).write_text(json_text(found, indent=None), encoding="utf-8")
    return None


def _read(
    loop: ExperimentLoop,
    place: Path,
    known: KnownMachine,
    plan: Mapping[str, Any],
    content: Mapping[str, Any],
) -> dict[str, Any]:
    """The evidence of the flight, unless that is known.

    Raises:
        DataError: the logs hold no new run.
    """
    file = place / OBTAINED
    if file.is_file():
        found: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        return found
    data = read_logs(loop.logs, loop.config.plant.system, loop.kind, content)
    before = {run.name for run in known.runs}
    new = [run for run in data.runs if run.name not in before]
    if not new:
        raise DataError(f"{loop.logs} holds no run that the diagnosis before {place.name} did not have.")
    asked_for = plan["question"]
    told = obtained(
        known.system,
        known.runs,
        new,
        Question(tuple(map(tuple, asked_for["members"])), tuple(asked_for["parameters"])),
        clock=known.clock,
        values=known.values,
        expected=plan["expected"],
        trusted=True,  # whether it is of this machine the diagnosis of all runs says
    ).content()
    file.write_text(json_text(told) + "\n", encoding="utf-8")
    return told


def _other_machine(loop: ExperimentLoop, place: Path, before: Mapping[str, Any]) -> StoppedLoop | None:
    """Whether the diagnosis of all runs says that the experiment's is of another machine.

    Of a log that a person put in, every objection that was not there before counts. Nothing of such a log is kept as
    done: the next start reads what lies there then, or flies again.
    """
    warnings = [w for w in diagnosis_content(place / "diagnosis")["warnings"] if w["parameter"] is None]
    known = {w["kind"] for w in before.get("warnings", ())}
    said = [w for w in warnings if w["kind"] in _OTHERS and place.name in w["sentence"]]
    if loop.fly is None:
        said += [w for w in warnings if w["kind"] not in known]
    if not said:
        return None
    for file in (place / OBTAINED, place / "diagnosis" / DIAGNOSED):
        file.unlink(missing_ok=True)
    remedy = f"Put another log into {loop.logs}, and start this command again"
    if loop.fly is not None:
        (place / FLIGHT).unlink(missing_ok=True)
        for log in log_files(loop.logs, place.name):
            log.replace(place / log.name)
        remedy = f"Its log lies in {place} now; start this command again, and it is flown again"
    return StoppedLoop(
        "other_machine",
        f"the log of {place.name} is not of this machine, or the machine has changed, or the log is at fault. With it "
        f"among the others: {said[0]['sentence']}; {said[0]['remedy']}. {remedy}",
    )


def _flight(place: Path) -> dict[str, Any]:
    """What was measured in a flight of ours; nothing of one that a person flew."""
    file = place / FLIGHT
    found: dict[str, Any] = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    return found
