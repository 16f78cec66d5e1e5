"""The result of a diagnosis: what was found, with values, as Python reads it and as `diagnosis.json` holds it.

All texts are made of the content of `diagnosis.json` (keys: docs/content/reference/diagnosis-json.md).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypedDict

from nsde_torch.data import DataSet
from nsde_torch.diagnosis.beyond_catalogue import zero_of_an_input
from nsde_torch.diagnosis.candidates import effect_of, values_of, without_motion
from nsde_torch.diagnosis.ceiling import Ceiling
from nsde_torch.diagnosis.cross_validation import HeldOut
from nsde_torch.diagnosis.decision import hosts, may_be_nothing
from nsde_torch.diagnosis.decisions import Options
from nsde_torch.diagnosis.effect_importance import (
    BY_RESIDUAL,
    BY_STEPS,
    Importance,
    ShownEffects,
    effect_importance,
    shown_effects,
)
from nsde_torch.diagnosis.evidence import NotShown, bonferroni, not_shown
from nsde_torch.diagnosis.explanation import Explanation, declared
from nsde_torch.diagnosis.outcome import Estimate, Found, Outcome
from nsde_torch.diagnosis.reading import Moments
from nsde_torch.diagnosis.residual_tests import Dependence
from nsde_torch.diagnosis.search import channels_of
from nsde_torch.diagnosis.shape import ChannelResidual, Shape, called, rates_width, symmetry
from nsde_torch.diagnosis.stages import NotDone, SoFar, StoppedError, declared_model
from nsde_torch.diagnosis.text import lines, rendered, short_lines, small, with_space
from nsde_torch.effects import effect_class, key_of
from nsde_torch.effects import expression_grammar as grammar
from nsde_torch.effects.by_run import ByRun, RunZero
from nsde_torch.effects.expression import Expression
from nsde_torch.effects.law import joined_name, split_name
from nsde_torch.models.identified import SysidSpec
from nsde_torch.recording.chain import Recorded
from nsde_torch.recording.fault import Detected
from nsde_torch.recording.faults import remedies
from nsde_torch.shown import data_frame, preformatted
from nsde_torch.sysid.feedback_test import FeedbackTest
from nsde_torch.sysid.result import Identification
from nsde_torch.systems import System
from nsde_torch.systems.parameters import own_name


@dataclass(frozen=True)
class Diagnosis:
    """What was found."""

    system: System  # declared system
    data: DataSet  # the data set
    runs: tuple[str, ...]  # names of its runs that were looked at
    recorded: Recorded  # recording chain, undone
    outcome: Outcome  # effects that were found, and the tests of the residuals
    errors: HeldOut  # errors on runs left out
    explanation: Explanation  # what is left, and what may explain it
    options: Options  # settings
    spec: SysidSpec  # what models of the system are made of
    seconds: dict[str, float] = field(default_factory=dict)  # time that stages took
    instrumented: Identification | None = None
    """Estimates with signals from outside the loop; None without any."""
    not_done: tuple[NotDone, ...] = ()  # stages that could not be computed or were left out
    so_far: SoFar | None = None  # that the diagnosis is not finished; None of one that is
    moments: Moments = field(
        default_factory=dict
    )  # where runs were cut in two, by their names (`within_runs`)

    def finished(self) -> Diagnosis:
        """The diagnosis, for work that goes on with it.

        Raises:
            KeyboardInterrupt: it was stopped.
        """
        if self.so_far is not None:
            raise StoppedError(self)
        return self

    @property
    def system_name(self) -> str:
        """Name that makes the system, `module:Class` for one of the user's own."""
        return self.spec.system

    @property
    def feedback(self) -> FeedbackTest:
        """What the data say of the loop that they were recorded in."""
        return self.outcome.test

    @property
    def verdict(self) -> str:
        """`no_effect`, `effect_found` or `unexplained`; a fault of the recording chain counts as found.

        `undecided` of a diagnosis that was stopped before what is left was tested.
        """
        if self.outcome.verdict == "no_effect" and self.faults:
            return "effect_found"
        return self.outcome.verdict

    @property
    def added(self) -> list[str]:
        """Names of everything that was found, the recording chain first."""
        return [fault.name for fault in self.faults] + [f.name for f in self.outcome.found]

    @property
    def faults(self) -> list[Detected]:
        """Faults of the recording chain that are longer than a step."""
        return [f for f in self.recorded.faults if not f.short]

    @property
    def effects(self) -> dict[str, dict[str, Any]]:
        """Effects that were found, with values: `{name: {parameter: value}}`, `module:Class` for one of the user's own.

        What `effects=` of `nsde_torch.train` and `nsde_torch.simulate` takes; without what differs between runs, which
        says nothing of a run that was not seen.
        """
        return {
            key_of(effect_class(f.name)): dict(values_of(effect_of(self.outcome.system, f.name)))
            for f in self.outcome.found
            if f.name not in self.of_runs
        }

    @property
    def of_runs(self) -> list[str]:
        """Names of what was found to differ between runs."""
        return [str(e.name) for e in self.outcome.system.effects if isinstance(e, ByRun)]

    @property
    def parameters(self) -> dict[str, Any]:
        """Parameters of everything that was found.

        `effect.name` -> `value`, `interval_90`, `bound`, `widened_by` (where it is not nothing), `unit`.
        """
        out: dict[str, Any] = {}
        for fault in self.faults:
            for name, (value, low, high, unit) in fault.values.items():
                ends = None if low is None else [low, high]
                none = None if ends else "without an interval"
                sensed = {"value": value, "interval_90": ends, "bound": none, "unit": unit}
                out[f"{fault.name}.{name}"] = sensed
        for f in self.outcome.found:
            for e in self.outcome.estimates(f.name):
                of_run = {"run": e.run, "against": e.against} if e.run else {}
                out[e.name] = {"value": e.value, **_interval(self, e), "unit": e.unit, **of_run}
        return out

    @property
    def declared_values(self) -> dict[str, float | list[float]]:
        """Parameters of the declared physics as they are with what was found."""
        values = {k: v.tolist() for k, (v, _) in self.outcome.system.declared_parameters().items()}
        return {k: v[0] if len(v) == 1 else v for k, v in values.items()}

    @property
    def sensor_faults(self) -> dict[str, dict[str, float]]:
        """What sensors were found to do to the states: arguments of `nsde_torch.read` that undo it."""
        return {name: self.recorded.values(name) for name in remedies()}

    @property
    def importance(self) -> dict[str, Importance]:
        """By effect, the most important first: the error on runs left out that returns without it."""
        return effect_importance(self.errors.own, inputs=self.errors.inputs)

    @property
    def shown(self) -> ShownEffects:
        """The few effects that matter, and the others; without those that are nothing but what differs between runs."""
        of_others = hosts(self.outcome)
        names = [
            f.name
            for f in self.outcome.found
            if not (f.name in of_others and may_be_nothing(self.outcome, f))
        ]
        return shown_effects(names, self.importance, self.outcome.decisions.wording)

    @property
    def in_short(self) -> str:
        """Names of everything that was found, effects with the evidence for them: `motor_lag (+812 nats)`."""
        # without some the filter diverges: what they bring has no number
        known = [f for f in self.outcome.found if math.isfinite(f.evidence.nats)]
        brought = {f.name: f" ({f.evidence.nats:+.0f} nats)" for f in known}
        return ", ".join(f"{name}{brought.get(name, '')}" for name in self.added)

    @property
    def width(self) -> float:
        """Length of the means over which residuals are reported [s]."""
        return rates_width(self.outcome.final)

    @property
    def report(self) -> str:
        """All that was found, in words and tables, as `nsde diagnose verbose=true` prints it."""
        return "\n".join(lines(self.content()))

    def __str__(self) -> str:
        return "\n".join(short_lines(self.content()))

    def __repr__(self) -> str:
        return (
            f"<Diagnosis of {self.system_name}: {self.verdict}; {', '.join(self.added) or 'nothing added'}>"
        )

    def _repr_html_(self) -> str:
        return preformatted(str(self))

    def to_frame(self) -> Any:
        """A `pandas.DataFrame` of the findings: `name`, `value`, `low`, `high` (None: no interval) and `unit`."""
        rows = [
            (name, p["value"], *(p["interval_90"] or (None, None)), p["unit"])
            for name, p in self.parameters.items()
        ]
        return data_frame(rows, ("name", "value", "low", "high", "unit"))

    def content(self) -> Content:
        """What `diagnosis.json` holds; its keys are in docs/content/reference/diagnosis-json.md."""
        return content(self)

    def save(self, folder: str | Path) -> Path:
        """Write `diagnosis.json`, `effects.yaml`, `report.html` and `plots/`.

        Args:
            folder: Where to; made where it is missing.

        Returns:
            The page `report.html`.
        """
        from nsde_torch.diagnosis.files import REPORT, DiagnosisFiles

        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        DiagnosisFiles(folder, system=self.system_name, note="found by nsde_torch.diagnose").write(self)
        return folder / REPORT


_DEPENDENCES = 12  # tests of structure that are listed
_SHORT = "shorter than a step of the log: taken into account, and not named"
TWINS = {"constant_force": ("sensor_bias",)}
"""Faults of the recording chain that no data of the log distinguish from an effect."""
JsonObject = dict[str, Any]


class Content(TypedDict, total=False):
    """What `diagnosis.json` holds."""

    schema: str
    so_far: JsonObject
    verdict: str
    added: list[str]
    summary: str
    warnings: list[JsonObject]
    not_done: list[JsonObject]
    guard: JsonObject
    findings: list[JsonObject]
    told: JsonObject
    aside: list[JsonObject]
    ranking: list[JsonObject]
    ties: list[JsonObject]
    not_shown: list[JsonObject]
    parameters: dict[str, JsonObject]
    declared_parameters: dict[str, JsonObject]
    residual: dict[str, JsonObject]
    structure: JsonObject
    unexplained: list[JsonObject]
    flexible: JsonObject
    errors: JsonObject
    feedback: JsonObject
    data: JsonObject
    alpha: float
    levels: dict[str, float]
    seed: int
    seconds: dict[str, float]
    model: JsonObject  # where training was asked for
    rehearsal: JsonObject  # where it was asked for


def content(found: Diagnosis) -> Content:
    """The content of `diagnosis.json`."""
    o, left, shown, errors = found.outcome, found.explanation, found.shown, found.errors
    functions, faults = ceiling_content(left.ceiling, o, left.channels), [f.name for f in found.faults]
    short = [(f.name, f.sentence, f.reason or _SHORT) for f in found.recorded.faults if f.short]
    short += [(name, sentence(o, name), _SHORT) for name in o.aside]
    hidden = [(h.name, f"{h.name} would explain something, and is not named.", h.reason) for h in o.hidden]
    out: Content = {"schema": "nsde_torch.diagnosis/1"}
    if found.so_far is not None:
        out["so_far"] = {**found.so_far.as_dict(), "declared": declared_model(found.spec)}
    out |= {
        "verdict": found.verdict,
        "added": found.added,
        "summary": summary(
            found.verdict,
            faults,
            shown,
            o,
            left.shapes,
            _functions_of(functions["rows"]),
            moments=found.moments,
            larger=errors.larger({name for f in o.found for name in f.moves}),
            channels=left.channels,
        ),
        "warnings": _warnings(found),
        "not_done": [asdict(one) for one in found.not_done],
        "guard": {**left.guard.as_dict(), "rejected": o.doubted},
        "findings": _findings(found),
        "told": {
            "by": BY_STEPS if errors.inputs else BY_RESIDUAL,
            "few": list(shown.few),
            "rest": [
                {"effect": f.name, "size": _size(o, f)} for n in shown.rest for f in o.found if f.name == n
            ],
            "rest_share": shown.share,
        },
        "aside": [{"effect": name, "sentence": said, "reason": why} for name, said, why in [*short, *hidden]],
        "ranking": ranking(o),
        "ties": _ties(found),
        "not_shown": [asdict(n) for n in _not_shown(o)],
        "parameters": found.parameters,
        "declared_parameters": {
            name: {"value": e.value, **_interval(found, e), "unit": e.unit, "shown": e.low is not None}
            for name, e in declared(o).items()
        },
        "residual": {c.name: c.as_dict() for c in left.channels},
        "structure": {
            "tests": {"before": len(o.before), "after": len(o.after)},
            "before": _dependences(o.before, found),
            "after": _dependences(o.after, found),
        },
        "unexplained": [_shape(s, found.runs) for s in left.shapes],
        "flexible": functions,
        "errors": {
            **errors.content,
            "measured_on": "runs left out" if errors.whole_runs else "the last part of the only run",
            "runs": list(errors.runs),
        },
        "feedback": _feedback(found),
        "data": {
            "kind": found.data.kind,
            "system": found.data.system_name,
            "runs": list(found.runs),
            "moments": {run: [list(one) for one in times] for run, times in found.moments.items()},
            "duration_s": sum(run.duration for run in found.recorded.runs),
            "clock_scale": found.recorded.clock,
            "dt_s": found.data.dt,
            "standing_share": left.standstill,
            "fingerprint": found.data.fingerprint,
            "done": [str(f) for f in found.data.summary.findings],
        },
        "alpha": found.options.alpha,
        "levels": dict(o.levels),
        "seed": found.options.seed,
        "seconds": found.seconds,
    }
    return out


def summary(
    verdict: str,
    faults: Sequence[str],
    shown: ShownEffects,
    outcome: Outcome,
    shapes: Sequence[Shape],
    functions: str = "",
    *,
    moments: Moments,
    smoothed: bool = False,
    larger: bool = False,
    channels: Sequence[ChannelResidual] = (),
) -> str:
    """The verdict in one or two sentences.

    `faults` are names of those of the recording chain, `shapes` what the residual still depends on; `functions` says
    what functions that explain more are of, where no test of structure says what is missing; `channels` what is left;
    `smoothed` whether states were smoothed before they were logged, `larger` whether the residual on runs left out is.
    """
    added, provisional = [*faults, *shown.few, *shown.rest], {f.name for f in outcome.found if f.provisional}
    moved, left = {name for f in outcome.found for name in f.moves}, outcome.structured
    rest = f"{left[0].channel} on {left[0].variable}" if left else ""
    if shapes:  # of those that say the same about equally surely, the one with the most to say
        best = max(shapes[:2], key=lambda s: (s.channel == left[0].channel, bool(s.note)))
        rest = ", ".join(filter(None, (f"{best.channel} on {best.variable}", best.note)))
    values = {
        "verdict": "doubted" if outcome.doubted else verdict,
        "added": added,
        "names": named([*faults, *shown.few], shown),
        # where no input answers there is no controller: of a smoothed open loop "a controller that saw more" was said
        "hidden": outcome.test.hidden if outcome.test.closed else {},
        "known": outcome.test.most_known,
        "smoothed": smoothed,
        "larger": larger,
        "blind": list(
            dict.fromkeys(n.effect for n in _not_shown(outcome) if n.smallest is None and not n.declared)
        ),
        "leads": [name for name in added if name in provisional],
        "found": outcome.found,
        "rest": rest,
        "elsewhere": bool(left) and left[0].channel not in moved,
        "functions": functions,
        "changes": ", ".join(
            f"in {run} {' and '.join(map(_moment, times))}" for run, times in moments.items()
        ),
        "not_believed": sorted(outcome.doubted_channels),
        "above": _far_above_noise(outcome, channels),
    }
    return rendered("summary.txt", values).strip()


def _moment(between: tuple[float, float]) -> str:
    a, b = between
    return f"at {a:.2f} s" if a == b else f"between {a:.2f} and {b:.2f} s"


def named(first: Sequence[str], shown: ShownEffects) -> str:
    """Names of the findings; of several small effects their number."""
    rest = f"{shown.rest[0]}, a small one" if len(shown.rest) == 1 else small(len(shown.rest))
    return ", ".join(first) + (f" and {rest}" if shown.rest else "")


def _warnings(found: Diagnosis) -> list[dict[str, Any]]:
    objections = found.explanation.guard.objections
    guards = [{"kind": o.kind, "sentence": o.sentence, "remedy": o.remedy} for o in objections]
    general = [{"parameter": None, **one} for one in (*guards, *outlier_warnings(found), *_not_tried(found))]
    return [*general, *map(asdict, found.explanation.warned)]


def _not_tried(found: Diagnosis) -> list[dict[str, str]]:
    """That no friction and no force was a candidate, where nobody chose them."""
    sentence, remedy = without_motion(found.system) if found.options.candidates is None else ("", "")
    return [{"kind": "no_coordinate", "sentence": sentence, "remedy": remedy}] if sentence else []


def outlier_warnings(found: Diagnosis) -> list[dict[str, str]]:
    """Measurements that the likelihood left out."""
    joint = found.outcome.joint
    times = {} if joint is None else joint.final.at.outlier_times
    if not times:
        return []
    listed = "; ".join(
        f"{len(t)} of {found.runs[run]!r}, from t = {t[0]:.6g} to {t[-1]:.6g} s" for run, t in times.items()
    )
    return [
        {
            "kind": "outliers",
            "sentence": f"rows hold outliers that no noise of the others explains: {listed}. They were left out",
            "remedy": "look at the log there: a marker that jumps or an estimator that restarts is no motion",
        }
    ]


def _findings(found: Diagnosis) -> list[dict[str, Any]]:
    own, importance = found.errors.own, found.importance
    nothing = {"lead": False, "lead_reason": None, "held_out": None, "buys": None}
    faults = [
        {"name": f.name, "kind": "recording", "sentence": f.sentence, "p": f.p, **nothing}
        for f in found.faults
    ]
    effects = [
        {
            "name": f.name,
            "kind": "formula" if grammar.is_law(f.name) else "effect",
            "sentence": sentence(found.outcome, f.name),
            "p": f.evidence.p,
            "evidence_nats": f.evidence.nats,
            "lead": bool(f.provisional),
            "lead_reason": f.provisional or None,
            "moves": list(f.moves),
            "held_out": own[f.name].as_dict() if f.name in own else None,
            "buys": importance[f.name].as_dict() if f.name in importance else None,
            "ties": list(f.ties),
            "separate": effect_of(found.outcome.system, f.name).separate,
            "take_out": _take_out(found.outcome, f.name),
            **_law(found.outcome, f),
        }
        for f in found.outcome.found
    ]
    return [*faults, *effects]


def _size(outcome: Outcome, f: Found) -> str:
    """How strong an effect is: what is nothing without it, the values of one unit together."""
    by_unit: dict[str, list[str]] = {}
    for e in outcome.estimates(f.name):
        if own_name(e.name) in effect_of(outcome.system, f.name).null:
            by_unit.setdefault(e.unit, []).append(f"{e.value:.3g}")
    return "; ".join(", ".join(v) + with_space(unit) for unit, v in by_unit.items())


def _feedback(found: Diagnosis) -> dict[str, Any]:
    out = found.feedback.as_dict()
    if found.instrumented is not None:
        told = found.instrumented.instrumented
        out |= {"findings": found.instrumented.of_the_loop, "instruments": told and told.as_dict()}
    return out


def _ties(found: Diagnosis) -> list[dict[str, Any]]:
    out = [{"effects": [f.name, *f.ties], "experiment": f.experiment} for f in found.faults if f.ties]
    for f in found.outcome.found:
        law, coordinate = split_name(f.name)
        # a bias of the position would show as a constant force beside a spring
        spring = joined_name("linear_spring", coordinate) in found.system.effect_names
        twins = [t for t in TWINS.get(law, ()) if t != "sensor_bias" or spring]
        if f.ties or twins:
            separate = effect_of(found.outcome.system, f.name).separate
            out.append({"effects": [f.name, *f.ties, *twins], "experiment": separate})
    return out


def _shape(s: Shape, runs: Sequence[str]) -> dict[str, Any]:
    out = asdict(s) | {"symmetry": s.symmetry or None, "extent": s.extent or None}
    out |= {"where": s.where and list(s.where), "only_run": None if s.only_run is None else runs[s.only_run]}
    del out["note"]
    return out


def _take_out(outcome: Outcome, effect: str) -> str | None:
    """The option of a reader that takes out zeros that differ between runs; None for any other effect."""
    own = effect_of(outcome.system, effect)
    if not isinstance(own, RunZero) or own.at.position is None:
        return None
    state = outcome.system.state_names[own.at.position]
    each = ",".join(f"{e.run}:{{{state}:{e.value:.4g}}}" for e in outcome.estimates(effect))
    return f"data.sensor_bias={{{each}}}"


def _not_shown(o: Outcome) -> list[NotShown]:
    if o.joint is None:
        return []
    names, alpha = [f.name for f in o.found], o.levels["effects"]
    return not_shown(o.joint, found=names, alpha=alpha, decisions=o.decisions, system=o.declared_system)


def _interval(found: Diagnosis, e: Estimate) -> dict[str, Any]:
    regression = found.outcome.final
    channels = channels_of(regression, [regression.vector.labels.index(e.name)])
    if found.explanation.guard.doubts(channels):
        return {"interval_90": None, "bound": "rejected"}
    if e.low is None and found.outcome.unsettled:
        return {"interval_90": None, "bound": "not settled"}
    widened: dict[str, Any] = {"widened_by": e.widened} if e.widened and e.low is not None else {}
    # of a car whose laws of the steering were all provisional the wheel base was 0.285 (0.2836 to 0.2871) of 0.33
    beside = {c for f in found.outcome.found if f.provisional for c in f.moves}
    if found.so_far is not None or not beside.isdisjoint(channels):
        widened["provisional"] = True
    if laws := found.outcome.given_laws.get(e.name):
        widened["given"] = list(laws)
    return {"interval_90": None if e.low is None else [e.low, e.high], "bound": e.bound, **widened}


def sentence(outcome: Outcome, effect: str) -> str:
    """What an effect means, with its values."""
    return meaning(outcome.declared_system, effect, outcome.estimates(effect))


def meaning(system: System, effect: str, parameters: Sequence[Estimate]) -> str:
    """The sentence of an effect of a machine with these values."""
    values: dict[str, list[str]] = {}
    units: dict[str, str] = {}
    for e in parameters:
        name = own_name(e.name)
        values.setdefault(name, []).append(f"{e.value:.3g}" + (f" in {e.run}" if e.run else ""))
        units[name] = with_space(e.unit) + (f" (against {e.against})" if e.against else "")
    words = {name: ", ".join(values[name]) + units[name] for name in values}
    cls = system.effect_class(effect)
    text = cls.sentence or f"What is added is {cls.formula}, {', '.join(f'{k} = {{{k}}}' for k in words)}."
    try:
        return text.format(**words)
    except (KeyError, IndexError):
        return text


def ranking(outcome: Outcome) -> list[dict[str, Any]]:
    """What every look at the catalogue says of every candidate, the likeliest first."""
    return [
        {
            "round": number,
            "effect": p.name,
            "evidence_nats": p.nats,
            "evidence_error": p.error,
            "p": p.p,
            "parameters": {f"{p.name}.{k}": v for k, v in values_of(effect_of(p.system, p.name)).items()},
            "chosen": p.name == round.chosen,
        }
        for number, round in enumerate(outcome.joint.rounds if outcome.joint is not None else ())
        for p in round.look
    ]


def _dependences(tests: Sequence[Dependence], found: Diagnosis) -> list[dict[str, Any]]:
    wording = found.outcome.decisions.wording
    return [
        {
            "channel": d.channel,
            "variable": d.variable,
            "where": _where(d, found.runs),
            "p": bonferroni(d.p, len(tests)),
            "share": d.share,
            "kind": symmetry(d, wording) or "-",
        }
        for d in tests[:_DEPENDENCES]
    ]


def _where(d: Dependence, runs: Sequence[str]) -> str | None:
    if d.sinusoid is not None:
        return f"{d.sinusoid:.4g} Hz"
    if d.run is None:
        return None
    name = called(runs[d.run])
    return f"{name} only" if d.moment is None else f"{name}, {d.moment:.1f} s"


def ceiling_content(
    found: Ceiling, outcome: Outcome, channels: Sequence[ChannelResidual] = ()
) -> dict[str, Any]:
    """The key `flexible` of `diagnosis.json`; `channels`: what is left, said where it is far above white noise."""
    rows = [
        {
            "row": r.row,
            "unit": r.unit,
            "rms": r.size,
            "nats": r.nats,
            "standard_error": r.error,
            "variables": list(r.variables),
        }
        for r in found.rows
    ]
    out: dict[str, Any] = {
        "why_not": found.why_not or None,
        "measured_on": "blocks of time left out",
        "explained": found.explained,
        "explained_90": found.explained_interval and list(found.explained_interval),
        "effects_nats": found.effects,
        "left_nats": found.left,
        "left_90": found.interval and list(found.interval),
        "left": bool(rows),
        "rows": rows,
    }
    left = outcome.structured[0].variable if outcome.structured else ""
    of = {"functions": _functions_of(rows), "structured": left, "above": _far_above_noise(outcome, channels)}
    said = rendered("ceiling.txt", out, found=bool(outcome.found), **of).splitlines()
    return out | {"sentence": said[0], "remedy": said[1] if rows else None}


def _far_above_noise(outcome: Outcome, channels: Sequence[ChannelResidual]) -> dict[str, Any]:
    """The channel of which most is left over white noise, and how many times it; empty where none is far above."""
    far = [c for c in channels if outcome.decisions.far_above_noise < c.times_noise < math.inf]
    most = max(far, key=lambda c: c.times_noise, default=None)
    return {} if most is None else {"channel": most.name, "times": most.times_noise}


def _functions_of(rows: Sequence[Mapping[str, Any]]) -> str:
    """What the functions are of, in words: `q and q_dot on force`; the first three variables alone."""
    if not rows:
        return "all that was measured"
    *names, last = rows[0]["variables"][:3]
    return f"{', '.join(names)} and {last} on {rows[0]['row']}" if names else f"{last} on {rows[0]['row']}"


def _law(outcome: Outcome, f: Found) -> dict[str, Any]:
    """Keys of a finding that only a law beyond the catalogue has; nothing for an effect of the catalogue."""
    effect = effect_of(outcome.system, f.name)
    if not isinstance(effect, Expression):
        return {}
    values = {name: float(value) for name, (value, _) in effect.declared_parameters().items()}
    return {
        "verified": not f.provisional,
        "law": grammar.valued(effect.law, values),
        "unit": effect.unit,
        "latex": grammar.latex(effect.law, values),
        "sympy": grammar.sympy_text(effect.law, values),
        "looks_like": zero_of_an_input(outcome.final.physics.steps, outcome.declared_system, effect)
        or looks_like(effect.law, values, outcome.declared_system),
    }


def looks_like(written: grammar.Written, values: dict[str, float], system: System) -> str | None:
    """What a law may be, by the kinds of its variables; None where nothing can be said."""
    every = list(grammar.nodes(written.right))
    names = {n.name for n in every if isinstance(n, grammar.Variable) and not n.logged}
    if len(written.right.parts) != 1:
        return _dry(names, system) if _calls(every, "sign") else None
    if not any(isinstance(n, grammar.Variable) for n in every):
        return "what is always there: a load, a leak, a bias of an actuator"
    if "time" in names:
        return "a drift: what wears, warms up or empties"
    positions = {p for p, _, _ in system.position_derivatives}
    speeds = {v for _, v, _ in system.position_derivatives} | {
        name
        for name, unit in zip(system.feature_names, system.feature_units, strict=True)
        if unit in ("m/s", "rad/s")
    }
    if names & set(system.input_names) and names & positions:
        return "a gain of the input that depends on the place"
    if names and names <= positions:
        return _of_place(every, names, written.sizes, values)
    if names and names <= speeds and _calls(every, "peak") and values[written.sizes[0]] < 0:
        return "a brake that is strongest at that speed, as eddy currents and what slips are"
    if len(names) > 1 and names <= speeds:
        return "a coupling of motions, as Coriolis and gyroscopic forces are, or drag across the motion"
    if len(names & speeds) == 1 and names <= positions | speeds and names & positions:
        raised = {
            n.base.name
            for n in every
            if isinstance(n, grammar.Power) and isinstance(n.base, grammar.Variable)
        }
        return None if names & speeds & raised else "friction that depends on the place"
    return None


def _dry(names: set[str], system: System) -> str | None:
    """What a sum of dry frictions may be, by the variables that they go with."""
    beside = names - {v for _, v, _ in system.position_derivatives}
    if beside and beside <= {p for p, _, _ in system.position_derivatives}:
        return "dry friction that depends on the place"
    return "dry friction that depends on the load" if beside and beside <= {*system.input_names} else None


def _of_place(
    every: list[grammar.Node], names: set[str], sizes: tuple[str, ...], values: dict[str, float]
) -> str | None:
    """What a force that depends on places alone may be."""
    if len(names) > 1:
        return "a spring between coordinates"
    if _calls(every, "pull"):
        return "what pulls to one place, or pushes away from it: a magnet, a detent"
    if _calls(every, "window"):
        return "a force between two places: a slope, a field"
    if _calls(every, "sign"):
        return "a spring under preload: it pushes to one place" if values[sizes[0]] < 0 else None
    hinge = _calls(every, "max", "min")
    if hinge is None:
        if _calls(every, "expm1"):
            return (
                "a spring that stiffens by the same factor over the same distance, as rubber and tendons do"
            )
        return None if any(isinstance(n, grammar.Call) for n in every) else "a spring that is not straight"
    # of a bare hinge: max(q - k, 0) is positive, min(q - k, 0) negative, and a spring pushes against either
    where = "above" if hinge.function == "max" else "below"
    return f"a stop or a spring that is met {where} that place" if values[sizes[0]] < 0 else None


def _calls(every: list[grammar.Node], *functions: str) -> grammar.Call | None:
    return next((n for n in every if isinstance(n, grammar.Call) and n.function in functions), None)
