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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import log
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig

from nsde_torch.design import DesignOptions, Question, Standing, design, obtained, open_questions, standing_of
from nsde_torch.design.experiment import PLAN, RESULT, read_design
from nsde_torch.diagnosis.files import RESULT as DIAGNOSED
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.progress import Stages
from nsde_torch.whole_files import json_text

from ..hydra_command import say
from ..known_machine import KnownMachine, diagnosis_content, log_files, machine_in, read_logs
from .machines import limit_key, plan_limits

if TYPE_CHECKING:
    from .loop import ClosedLoop

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
    for number in range(1, loop.config.experiments + 1):
        content = loop.found
        now = standing_of(content)
        if now.settled:
            return done, settled(now)
        place = loop.folder / f"experiment_{number}"
        place.mkdir(parents=True, exist_ok=True)
        known = machine_in(loop.logs, loop.diagnosis, loop.config.plant.system, loop.kind)
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
        after = standing_of(loop.found)
        flight = place / FLIGHT  # nothing is measured where a person flew
        flown = json.loads(flight.read_text(encoding="utf-8")) if flight.is_file() else {}
        done.append(entry_of(place, number, plan, told, now, after, flown))
        for line in experiment_lines(done[-1]):
            say(line)
    now = standing_of(loop.found)
    if now.settled:
        return done, settled(now)
    spent = f"the budget of experiments={loop.config.experiments} is spent; {now.words}."
    return done, StoppedLoop("budget", f"{spent} A larger one goes on from here.")


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
        say(found)
        refused.append(found)
        file.write_text(json.dumps(refused, indent=1), encoding="utf-8")
    return StoppedLoop("limits", " ".join(refused))


def _designed(
    loop: ClosedLoop, place: Path, known: KnownMachine, question: Question, number: int
) -> dict[str, Any] | str:
    """A plan for a question; the limit that is in the way where none stays within them."""
    say(f"\nexperiment {number}: {asked(question.content())}")
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
        found = loop.fly_plan(place / PLAN, loop.logs / f"{name}.csv", number)
        (place / FLIGHT).write_text(json_text(found, indent=None), encoding="utf-8")
    return None


def _read(
    loop: ClosedLoop, place: Path, known: KnownMachine, plan: Mapping[str, Any], content: Mapping[str, Any]
) -> dict[str, Any]:
    """The evidence of the flight, unless that is known; a DataError where the logs hold no new run."""
    file = place / OBTAINED
    if file.is_file():
        return json.loads(file.read_text(encoding="utf-8"))
    data = read_logs(loop.logs, loop.config.plant.system, loop.kind, content)
    before = {run.name for run in known.runs}
    new = [run for run in data.runs if run.name not in before]
    if not new:
        raise DataError(f"{loop.logs} holds no run that the diagnosis before {place.name} did not have.")
    asked_for, machine = plan["question"], {"clock": known.clock, "values": known.values}
    question = Question(tuple(map(tuple, asked_for["members"])), tuple(asked_for["parameters"]))
    # trusted: whether it is of this machine the diagnosis of all runs says
    how: dict[str, Any] = {**machine, "expected": plan["expected"], "trusted": True}
    told = obtained(known.system, known.runs, new, question, **how).content()
    file.write_text(json_text(told) + "\n", encoding="utf-8")
    return told


def _other_machine(loop: ClosedLoop, place: Path, before: Mapping[str, Any]) -> StoppedLoop | None:
    """Whether the diagnosis of all runs says that the experiment's is of another machine.

    Of a log that a person put in, every objection that was not there before counts. Nothing of such a log is kept as
    done: the next start reads what lies there then, or flies again.
    """
    warnings = [w for w in diagnosis_content(place / "diagnosis")["warnings"] if w["parameter"] is None]
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


def asked(question: Mapping[str, Any]) -> str:
    """The question in words."""
    if question["kind"] == "tie":
        return f"which is true, {' or '.join(question['names'])}?"
    return f"how large: {', '.join(question['parameters'])}?"


def expected_nats(plan: Mapping[str, Any]) -> float:
    """What is expected of a plan, whichever member is true; of parameters, of all together [nats]."""
    if plan["question"]["kind"] == "tie":
        return float(min(e["nats"]["mean"] for e in plan["expected"]))
    names, every = plan["question"]["parameters"], plan["expected"][0]["parameters"].items()
    wanted = [p for k, p in every if any(k == n or k.startswith(f"{n}[") for n in names)]
    known = ((p["standard_error"], p["expected_standard_error"]) for p in wanted)
    return float(sum(log(now / then) for now, then in known if then is not None))


def too_little(plan: Mapping[str, Any], told: float, config: DictConfig) -> str:
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
    place: Path,
    number: int,
    plan: Mapping[str, Any],
    told: Mapping[str, Any],
    before: Standing,
    after: Standing,
    flown: Mapping[str, Any],
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


def experiment_lines(entry: Mapping[str, Any]) -> list[str]:
    """What is printed of an experiment."""
    told, question = entry["obtained"], entry["question"]
    lines = [
        f"experiment {entry['number']}: {asked(question)}",
        f"  before: {entry['before']['words']}",
        *(f"  plan: {w}" for w in entry["plan"]["words"]),
    ]
    if entry["flight"]["trouble"]:
        lines.append(f"  the flight was not flown to its end: {entry['flight']['trouble']['text']}")
    if question["kind"] == "tie":
        wanted = ", ".join(f"{n:.1f} if {name}" for name, n in entry["expected_nats"].items())
        broken = "distinguished" if told["broken"] else "still indistinguishable"
        lines.append(
            f"  nats expected: {wanted}; obtained: {entry['nats_obtained']:.1f} for {told['speaks_for']} ({broken})"
        )
    else:
        lines.append(f"  nats expected: {entry['nats_expected']:.1f}; obtained: {entry['nats_obtained']:.1f}")
        for label, p in told["parameters"].items():
            wanted = p["expected_standard_error"]
            lines.append(
                f"    {label}: standard error {p['standard_error_before']:.2g} -> {p['standard_error']:.2g} {p['unit']}"
                + ("" if wanted is None else f" ({wanted:.2g} expected)")
            )
    if told.get("surprise"):
        lines.append(f"  {told['surprise']}")
    if told["doubt"] is not None:
        lines.append(f"  what was thought possible is not all: {told['doubt']}")
    return [*lines, f"  after: {entry['after']['words']}"]
