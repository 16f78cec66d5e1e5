"""The content of `diagnosis.json`; its keys are in docs/content/reference/diagnosis-json.md."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from nsde_torch.diagnosis.begun import declared_model
from nsde_torch.diagnosis.buys import BY_RESIDUAL, BY_STEPS
from nsde_torch.diagnosis.ceiling import ceiling_content, wanted
from nsde_torch.diagnosis.decisions import Wording
from nsde_torch.diagnosis.declared import declared
from nsde_torch.diagnosis.dependence import Dependence
from nsde_torch.diagnosis.detectability import not_shown
from nsde_torch.diagnosis.estimates import Estimate, estimates
from nsde_torch.diagnosis.fitted import effect_of
from nsde_torch.diagnosis.law_content import law
from nsde_torch.diagnosis.multiplicity import bonferroni
from nsde_torch.diagnosis.outcome import Outcome
from nsde_torch.diagnosis.shape import Shape, called, symmetry
from nsde_torch.diagnosis.summary import summary
from nsde_torch.effects import Effect
from nsde_torch.effects.expression_grammar import is_law
from nsde_torch.effects.law import joined_name, split_name
from nsde_torch.sysid.longer_boxes import in_words
from nsde_torch.systems import System
from nsde_torch.systems.parameters import own_name

if TYPE_CHECKING:
    from nsde_torch.diagnosis.result import Diagnosis

_DEPENDENCES = 12  # tests of structure that are listed
_SHORT = "shorter than a step of the log: taken into account, and not named"

TWINS = {"constant_force": ("sensor_bias",)}
"""Faults of the recording chain that no data of the log can tell from an effect."""


def content(found: Diagnosis) -> dict[str, Any]:
    """What `diagnosis.json` holds; its keys are in docs/content/reference/diagnosis-json.md."""
    o, left = found.outcome, found.explanation
    wording, flexible = o.decisions.wording, ceiling_content(left.ceiling, o)
    return {
        "schema": "nsde_torch.diagnosis/1",
        **(
            {}
            if found.so_far is None
            else {"so_far": found.so_far.as_dict() | {"declared": declared_model(found.spec)}}
        ),
        "verdict": found.verdict,
        "added": found.added,
        "summary": summary(
            found.verdict,
            [f.name for f in found.faults],
            found.told,
            o,
            left.shapes,
            wanted(flexible["rows"]),
        ),
        "warnings": _warnings(found),
        "not_done": [one.as_dict() for one in found.not_done],
        "guard": found.explanation.guard.as_dict(),
        "findings": _findings(found),
        "told": _told(found),
        "aside": [
            *(
                {"effect": f.name, "sentence": f.sentence, "reason": f.reason or _SHORT}
                for f in found.recorded.faults
                if f.short
            ),
            *({"effect": n, "sentence": sentence(o, n), "reason": _SHORT} for n in o.aside),
            *(
                {
                    "effect": h.name,
                    "sentence": f"{h.name} would explain something, and is not named.",
                    "reason": h.reason,
                }
                for h in o.hidden
            ),
        ],
        "ranking": ranking(o),
        "ties": _ties(found),
        "not_shown": _not_shown(found),
        "parameters": parameters(found),
        "declared_parameters": {
            name: {"value": e.value, **_interval(found, e), "unit": e.unit, "shown": e.low is not None}
            for name, e in declared(o).items()
        },
        "residual": {
            c.name: {
                "unit": c.unit,
                "measured": c.measured,
                "before": c.before,
                "after": c.after,
                "floor": c.floor,
                "explained": c.explained,
            }
            for c in left.channels
        },
        "structure": {
            "tests": {"before": len(o.before), "after": len(o.after)},
            "before": [_dependence(d, len(o.before), found.runs, wording) for d in o.before[:_DEPENDENCES]],
            "after": [_dependence(d, len(o.after), found.runs, wording) for d in o.after[:_DEPENDENCES]],
        },
        "unexplained": [_shape(found, s) for s in left.shapes],
        "between_runs": _between_runs(found),
        "in_run": _in_run(found),
        "flexible": flexible,
        "errors": {
            **found.errors.content,
            "measured_on": "runs left out" if found.errors.whole_runs else "the last part of the only run",
            "runs": list(found.errors.runs),
        },
        "feedback": _feedback(found),
        "data": {
            "kind": found.data.kind,
            "system": found.data.system_name,
            "runs": list(found.runs),
            "duration_s": sum(run.duration for run in found.recorded.runs),
            "clock_scale": found.recorded.clock,
            "dt_s": found.data.dt,
            "standing_share": found.explanation.standing,
            "fingerprint": found.data.fingerprint,
            "done": [str(f) for f in found.data.summary.findings],
        },
        "alpha": found.options.alpha,
        "levels": dict(o.levels),
        "seed": found.options.seed,
        "seconds": found.seconds,
    }


def _warnings(found: Diagnosis) -> list[dict[str, Any]]:
    odd: list[dict[str, Any]] = [
        {"parameter": w.parameter, "kind": w.kind, "sentence": w.sentence, "remedy": w.remedy}
        for w in found.explanation.warned
    ]
    guards = [{"parameter": None, **one.as_dict()} for one in found.explanation.guard.objections]
    refused = found.explanation.refused
    if refused is not None:
        box = found.outcome.final.regression.dt
        guards.append({"parameter": None, "kind": "longer_boxes", **in_words(box, refused)})
    return [*guards, *odd]


def _findings(found: Diagnosis) -> list[dict[str, Any]]:
    faults = [
        {
            "name": f.name,
            "kind": "recording",
            "sentence": f.sentence,
            "p": f.p,
            "lead": False,
            "lead_reason": None,
            "held_out": None,
            "buys": None,
        }
        for f in found.faults
    ]
    buys = found.buys
    effects = [
        {
            "name": f.name,
            "kind": "formula" if is_law(f.name) else "effect",
            "sentence": sentence(found.outcome, f.name, f.trial.held),
            "p": f.trial.p_corrected,
            "evidence_nats": f.trial.nats,
            "lead": bool(f.provisional),
            "lead_reason": f.provisional or None,
            "moves": list(f.moves),
            "held_out": found.errors.own[f.name].as_dict() if f.name in found.errors.own else None,
            "buys": buys[f.name].as_dict() if f.name in buys else None,
            "ties": list(f.ties),
            "separate": _class(found, f.name).separate,
            **law(found.outcome, f),
        }
        for f in found.outcome.found
    ]
    return [*faults, *effects]


def _told(found: Diagnosis) -> dict[str, Any]:
    """The few effects that matter, and the others with their sizes."""
    told = found.told
    return {
        "by": BY_STEPS if found.errors.inputs else BY_RESIDUAL,
        "few": list(told.few),
        "rest": [{"effect": name, "size": _size(found, name)} for name in told.rest],
        "rest_share": told.share,
    }


def _size(found: Diagnosis, name: str) -> str:
    """How strong an effect is: what is nothing without it, with units."""
    held = next(f.trial.held for f in found.outcome.found if f.name == name)
    sizes = _class(found, name).null
    return _joined([e for e in found.outcome.estimates(name) if own_name(e.name) in sizes], held)


def _joined(parameters: Sequence[Estimate], held: Sequence[str]) -> str:
    """Values with units, those of one unit together."""
    by_unit: dict[str, list[str]] = {}
    for e in parameters:
        by_unit.setdefault(e.unit, []).append(f"{0.0 if e.name in held else e.value:.3g}")
    return "; ".join(", ".join(v) + ("" if unit == "1" else f" {unit}") for unit, v in by_unit.items())


def _feedback(found: Diagnosis) -> dict[str, Any]:
    if found.instrumented is None:
        return found.feedback.as_dict()
    told = found.instrumented.instrumented
    return {
        **found.feedback.as_dict(),
        "findings": found.instrumented.of_the_loop,
        "instruments": None if told is None else told.as_dict(),
    }


def _class(found: Diagnosis, name: str) -> type[Effect]:
    return type(effect_of(found.outcome.system, name))


def _ties(found: Diagnosis) -> list[dict[str, Any]]:
    out = [{"effects": [f.name, *f.ties], "experiment": f.experiment} for f in found.faults if f.ties]
    for f in found.outcome.found:
        law, coordinate = split_name(f.name)
        twins = [t for t in TWINS.get(law, ()) if t != "sensor_bias" or _springs(found, coordinate)]
        if f.ties or twins:
            out.append({"effects": [f.name, *f.ties, *twins], "experiment": _class(found, f.name).separate})
    return out


def _shape(found: Diagnosis, s: Shape) -> dict[str, Any]:
    return {
        "channel": s.channel,
        "variable": s.variable,
        "symmetry": s.symmetry or None,
        "extent": s.extent or None,
        "where": None if s.where is None else list(s.where),
        "period": s.period,
        "only_run": None if s.only_run is None else found.runs[s.only_run],
        "sentence": s.sentence,
    }


def _between_runs(found: Diagnosis) -> dict[str, Any] | None:
    zeros = found.explanation.between_runs
    if zeros is None:
        return None
    return {
        "state": zeros.state,
        "unit": zeros.unit,
        "runs": {
            run: {"value": value, "standard_error": error} for run, (value, error) in zeros.values.items()
        },
        "p": zeros.p,
        "tie": zeros.tie,
        "sentence": zeros.sentence,
        "remedy": zeros.remedy,
    }


def _in_run(found: Diagnosis) -> dict[str, Any] | None:
    f = found.explanation.in_run
    if f is None:
        return None
    name = found.runs[f.run]
    return {
        "run": name,
        "effect": f.effect,
        "p": f.p,
        "parameters": {e.name: {"value": e.value, "unit": e.unit} for e in f.estimates},
        "sentence": f"In {called(name)} alone, {f.effect} would explain it: "
        + meaning(found.outcome.declared_system, f.effect, f.estimates, f.held),
        "verified": False,
    }


def _not_shown(found: Diagnosis) -> list[dict[str, Any]]:
    names = [f.name for f in found.outcome.found]
    return [
        {
            "effect": n.effect,
            "parameter": n.parameter,
            "smallest": n.smallest,
            "usual": n.usual,
            "unit": n.unit,
            "experiment": n.separate,
        }
        for n in not_shown(
            found.outcome.rounds,
            found=names,
            alpha=found.outcome.levels["effects"],
            decisions=found.outcome.decisions,
            system=found.outcome.declared_system,
        )
    ]


def _springs(found: Diagnosis, coordinate: str) -> bool:
    """Whether a bias of the position would show as a constant force."""
    return joined_name("linear_spring", coordinate) in found.system.effect_names


def parameters(found: Diagnosis) -> dict[str, Any]:
    """Parameters of everything that was found.

    `effect.name` -> `value`, `interval_90`, `bound`, `widened_by` (where it is not nothing), `unit`.
    """
    out: dict[str, Any] = {}
    for fault in found.faults:
        for name, (value, low, high, unit) in fault.values.items():
            interval = None if low is None else [low, high]
            known = {"value": value, "interval_90": interval, "bound": None, "unit": unit}
            out[f"{fault.name}.{name}"] = known
    for f in found.outcome.found:
        for e in found.outcome.estimates(f.name):
            held = e.name in f.trial.held
            value = 0.0 if held else e.value
            out[e.name] = {"value": value, **_interval(found, e), "unit": e.unit}
    return out


def _interval(found: Diagnosis, e: Estimate) -> dict[str, Any]:
    if found.explanation.guard.objections:
        return {"interval_90": None, "bound": "not believed"}
    if e.low is None and found.outcome.unsettled:
        return {"interval_90": None, "bound": "not settled"}
    widened: dict[str, Any] = {"widened_by": e.widened} if e.widened and e.low is not None else {}
    if found.so_far is not None:
        widened["provisional"] = True
    return {"interval_90": None if e.low is None else [e.low, e.high], "bound": e.bound, **widened}


def sentence(outcome: Outcome, effect: str, held: Sequence[str] = ()) -> str:
    """What an effect means, with its values; parameters that were held at nothing are nothing."""
    return meaning(outcome.declared_system, effect, outcome.estimates(effect), held)


def meaning(system: System, effect: str, parameters: Sequence[Estimate], held: Sequence[str] = ()) -> str:
    """The sentence of an effect with these values."""
    values: dict[str, list[str]] = {}
    units: dict[str, str] = {}
    for e in parameters:
        name = own_name(e.name)
        values.setdefault(name, []).append(f"{0.0 if e.name in held else e.value:.3g}")
        units[name] = "" if e.unit == "1" else f" {e.unit}"
    words = {name: ", ".join(values[name]) + units[name] for name in values}
    cls = system.effect_class(effect)
    text = cls.sentence or f"What is added is {cls.formula}, {', '.join(f'{k} = {{{k}}}' for k in words)}."
    try:
        return text.format(**words)
    except (KeyError, IndexError):
        return text


def ranking(outcome: Outcome) -> list[dict[str, Any]]:
    """Every candidate of the first look, the likeliest first, and later looks where they added one."""
    out = []
    for number, look in enumerate(outcome.rounds):
        seen = set()
        for t in look.trials:
            seen.add(t.name)
            out.append(
                {
                    "round": number,
                    "effect": t.name,
                    "evidence_nats": t.nats,
                    "evidence_error": t.nats_error,
                    "p": t.p_corrected,
                    "parameters": {e.name: e.value for e in estimates(t.regression, t.spread, t.name)},
                    "chosen": look.chosen is not None and t.name == look.chosen.name,
                }
            )
        # `screening` is the likelihood ratio, twice the nats
        rest = sorted((n for n in look.screened if n not in seen), key=lambda n: -look.screened[n])
        out += [
            {"round": number, "effect": n, "screening": 2.0 * look.screened[n], "p": None, "chosen": False}
            for n in rest
        ]
    return out


def _where(d: Dependence, runs: Sequence[str]) -> str | None:
    if d.sinusoid is not None:
        return f"{d.sinusoid:.4g} Hz"
    if d.run is None:
        return None
    name = called(runs[d.run])
    return f"{name} only" if d.moment is None else f"{name}, {d.moment:.1f} s"


def _dependence(d: Dependence, tests: int, runs: Sequence[str], wording: Wording) -> dict[str, Any]:
    return {
        "channel": d.channel,
        "variable": d.variable,
        "where": _where(d, runs),
        "p": bonferroni(d.p, tests),
        "share": d.share,
        "kind": symmetry(d, wording) or "-",
    }
