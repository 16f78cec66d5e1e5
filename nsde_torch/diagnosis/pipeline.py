"""From measured runs and a declared model to the effects that it lacks, with the errors before and after.

The stages: undo the recording chain (`recording`), look for effects (`loop`), measure errors on runs left out
(`held_out`), and say what was found (`Diagnosis.content`, the content of `diagnosis.json`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from math import log
from pathlib import Path
from time import perf_counter as now
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nsde_torch.data import DataSet, Run
from nsde_torch.diagnosis.candidates import candidate_names
from nsde_torch.diagnosis.channels import ChannelResidual, channel_residuals
from nsde_torch.diagnosis.declared import Warned, better_reading, declared, warnings
from nsde_torch.diagnosis.estimates import Estimate, estimates
from nsde_torch.diagnosis.evidence import at_bounds
from nsde_torch.diagnosis.formula import Formula, formula
from nsde_torch.diagnosis.held_out import HeldOut, held_out
from nsde_torch.diagnosis.hidden import shown_by_instruments
from nsde_torch.diagnosis.in_run import InRun, in_run, odd_run
from nsde_torch.diagnosis.loop import Outcome, loop
from nsde_torch.diagnosis.not_shown import not_shown
from nsde_torch.diagnosis.options import Options
from nsde_torch.diagnosis.search import Search, effect_of
from nsde_torch.diagnosis.shape import Shape, called, shape, symmetry
from nsde_torch.diagnosis.structure import Dependence
from nsde_torch.diagnosis.summary import summary
from nsde_torch.diagnosis.text import lines
from nsde_torch.diagnosis.views import rates, rates_width
from nsde_torch.effects import Effect, effect_class, effects_of, key_of, register
from nsde_torch.errors import ConfigError, DataError
from nsde_torch.models.identified import SysidSpec
from nsde_torch.recording.faults.registry import remedies
from nsde_torch.recording.log import Detected, Recorded
from nsde_torch.recording.undo import instead_of_effects, undo
from nsde_torch.sysid.in_loop import adopted, identify_in_loop
from nsde_torch.sysid.instruments import with_columns
from nsde_torch.sysid.loop_test import LoopTest, tested
from nsde_torch.sysid.regression import Regression
from nsde_torch.sysid.result import Identification
from nsde_torch.sysid.steps import steps_of
from nsde_torch.systems import System
from nsde_torch.systems.parameters import own_name

Array = NDArray[np.float64]

_BOX_S = 0.01
_SHAPES = 6  # dependences that are described in words

_LITTLE = 0.1
_SHORT = "shorter than a step of the log: taken into account, and not named"

_REREAD = "this is the likely cause: write the columns like that, and diagnose again"

TWINS = {"constant_force": ("sensor_bias",)}
"""Faults of the recording chain that no data of the log can tell from an effect."""


@dataclass
class Diagnosis:
    """What was found.

    Args:
        system: Declared system.
        data: The data set.
        runs: Names of its runs that were looked at.
        recorded: Recording chain, undone.
        outcome: The loop.
        errors: Errors on runs left out.
        channels: Residuals before and after.
        options: Settings.
        seconds: Time that stages took.
        shapes: What the residual still depends on, in words.
        in_run: The effect that would explain it in the one run that it is in: a lead, unverified.
        formula: A sparse formula for it: a lead, unverified.
        warned: Declared parameters that tell of a fault of the columns.
        reading: How else the columns fit much better; None where no other way does.
        feedback: What the data say of the loop that they were recorded in.
        instrumented: Estimates with signals from outside the loop; None without any.
        system_name: Name that makes the system, `module:Class` for one of the user's own.
    """

    system: System
    data: DataSet
    runs: tuple[str, ...]
    recorded: Recorded
    outcome: Outcome
    errors: HeldOut
    channels: list[ChannelResidual]
    options: Options
    seconds: dict[str, float] = field(default_factory=dict)
    shapes: tuple[Shape, ...] = ()
    in_run: InRun | None = None
    formula: Formula | None = None
    warned: tuple[Warned, ...] = ()
    reading: str | None = None
    feedback: LoopTest = field(default_factory=LoopTest)
    instrumented: Identification | None = None
    system_name: str = ""

    @property
    def verdict(self) -> str:
        """`no_effect`, `effect_found` or `unexplained`; a fault of the recording chain counts as found."""
        if self.outcome.verdict == "no_effect" and self._faults:
            return "effect_found"
        return self.outcome.verdict

    @property
    def added(self) -> list[str]:
        """Names of everything that was found, the recording chain first."""
        return [fault.name for fault in self._faults] + [f.name for f in self.outcome.found]

    @property
    def effects(self) -> dict[str, dict[str, Any]]:
        """Effects that were found, with values: `{name: {parameter: value}}`, `module:Class` for one of the user's own.

        What `effects=` of `nsde_torch.train` and `nsde_torch.simulate` takes.
        """
        return {
            key_of(effect_class(f.name)): {
                k: v.tolist() if v.numel() > 1 else float(v)
                for k, (v, _) in effect_of(self.outcome.system, f.name).declared_parameters().items()
            }
            for f in self.outcome.found
        }

    @property
    def parameters(self) -> dict[str, Any]:
        """Parameters of everything that was found: `effect.name` -> `value`, `interval_90`, `bound`, `unit`."""
        return self._parameters()

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
    def report(self) -> str:
        """What was found, in words and tables, as `nsde diagnose` prints it."""
        return "\n".join(lines(self.content()))

    def __str__(self) -> str:
        return self.report

    def save(self, folder: str | Path) -> Path:
        """Write `diagnosis.json`, `effects.yaml`, `report.html` and `plots/`.

        Args:
            folder: Where to; made where it is missing.

        Returns:
            The page `report.html`.
        """
        from nsde_torch.diagnosis.files import save

        return save(self, folder)

    @property
    def _faults(self) -> list[Detected]:
        return [f for f in self.recorded.faults if not f.short]

    @property
    def width(self) -> float:
        """Length of the means over which residuals are told [s]."""
        return rates_width(self.outcome.final.regression)

    def content(self) -> dict[str, Any]:
        """What `diagnosis.json` holds; its keys are in docs/content/reference/diagnosis-json.md."""
        o = self.outcome
        return {
            "schema": "nsde_torch.diagnosis/1",
            "verdict": self.verdict,
            "added": self.added,
            "summary": summary(self.verdict, self.added, o, self.shapes, alpha=self.options.alpha),
            "warnings": self._warnings(),
            "findings": self._findings(),
            "aside": [
                *(
                    {"effect": f.name, "sentence": f.sentence, "reason": _SHORT}
                    for f in self.recorded.faults
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
            "ties": self._ties(),
            "not_shown": self._not_shown(),
            "parameters": self._parameters(),
            "declared_parameters": {
                name: {
                    "value": e.value,
                    "interval_90": None if e.low is None else [e.low, e.high],
                    "bound": e.bound,
                    "unit": e.unit,
                    "shown": e.low is not None,
                }
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
                for c in self.channels
            },
            "structure": {
                "tests": {"before": len(o.before), "after": len(o.after)},
                "before": [_dependence(d, len(o.before), self.runs) for d in o.before[:12]],
                "after": [_dependence(d, len(o.after), self.runs) for d in o.after[:12]],
            },
            "unexplained": [self._shape(s) for s in self.shapes],
            "in_run": self._in_run(),
            "formula": self._formula(),
            "errors": {
                **self.errors.content,
                "measured_on": "runs left out" if self.errors.whole_runs else "the last part of the only run",
                "runs": list(self.errors.runs),
            },
            "feedback": self._feedback(),
            "data": {
                "kind": self.data.kind,
                "system": self.data.system_name,
                "runs": list(self.runs),
                "duration_s": sum(run.duration for run in self.recorded.runs),
                "clock_scale": self.recorded.clock,
                "dt_s": self.data.dt,
                "fingerprint": self.data.fingerprint,
                "done": [str(f) for f in self.data.summary.findings],
            },
            "alpha": self.options.alpha,
            "seed": self.options.seed,
            "seconds": self.seconds,
        }

    def _warnings(self) -> list[dict[str, Any]]:
        odd: list[dict[str, Any]] = [
            {"parameter": w.parameter, "kind": w.kind, "sentence": w.sentence, "remedy": w.remedy}
            for w in self.warned
        ]
        if self.reading is None:
            return odd
        return [{"parameter": None, "kind": "reading", "sentence": self.reading, "remedy": _REREAD}, *odd]

    def _findings(self) -> list[dict[str, Any]]:
        faults = [
            {
                "name": f.name,
                "kind": "recording",
                "sentence": f.sentence,
                "p": f.p,
                "lead": False,
                "lead_reason": None,
                "held_out": None,
            }
            for f in self._faults
        ]
        effects = [
            {
                "name": f.name,
                "kind": "effect",
                "sentence": sentence(self.outcome, f.name, f.trial.held),
                "p": f.trial.p_corrected,
                "evidence_nats": f.trial.gain,
                "lead": bool(f.lead),
                "lead_reason": f.lead or None,
                "moves": list(f.moves),
                "held_out": self.errors.own[f.name].as_dict() if f.name in self.errors.own else None,
                "ties": list(f.ties),
                "separate": self._class(f.name).separate,
            }
            for f in self.outcome.found
        ]
        return [*faults, *effects]

    def _feedback(self) -> dict[str, Any]:
        if self.instrumented is None:
            return self.feedback.as_dict()
        told = self.instrumented.instrumented
        return {
            **self.feedback.as_dict(),
            "findings": self.instrumented.of_the_loop,
            "instruments": None if told is None else told.as_dict(),
        }

    def _class(self, name: str) -> type[Effect]:
        return type(effect_of(self.outcome.system, name))

    def _ties(self) -> list[dict[str, Any]]:
        out = [{"effects": [f.name, *f.ties], "experiment": f.experiment} for f in self._faults if f.ties]
        for f in self.outcome.found:
            twins = [t for t in TWINS.get(f.name, ()) if t != "sensor_bias" or self._springs()]
            if f.ties or twins:
                out.append({"effects": [f.name, *f.ties, *twins], "experiment": self._class(f.name).separate})
        return out

    def _shape(self, s: Shape) -> dict[str, Any]:
        return {
            "channel": s.channel,
            "variable": s.variable,
            "symmetry": s.symmetry or None,
            "extent": s.extent or None,
            "where": None if s.where is None else list(s.where),
            "period": s.period,
            "only_run": None if s.only_run is None else self.runs[s.only_run],
            "sentence": s.sentence,
        }

    def _in_run(self) -> dict[str, Any] | None:
        f = self.in_run
        if f is None:
            return None
        name = self.runs[f.run]
        return {
            "run": name,
            "effect": f.effect,
            "p": f.p,
            "parameters": {e.name: {"value": e.value, "unit": e.unit} for e in f.estimates},
            "sentence": f"In {called(name)} alone, {f.effect} would explain it: "
            + meaning(f.effect, f.estimates, f.held),
            "verified": False,
        }

    def _formula(self) -> dict[str, Any] | None:
        f = self.formula
        if f is None:
            return None
        return {
            "channel": f.channel,
            "unit": f.unit,
            "terms": [
                {"function": t.function, "coefficient": t.coefficient, "standard_error": t.error}
                for t in f.terms
            ],
            "text": f.text,
            "share": f.share,
            "by": f.by,
            "verified": False,
        }

    def _not_shown(self) -> list[dict[str, Any]]:
        found = [f.name for f in self.outcome.found]
        return [
            {
                "effect": n.effect,
                "parameter": n.parameter,
                "smallest": n.smallest,
                "usual": n.usual,
                "unit": n.unit,
                "experiment": n.separate,
            }
            for n in not_shown(self.outcome.rounds, found=found, alpha=self.options.alpha)
        ]

    def _springs(self) -> bool:
        """Whether a bias of the position would show as a constant force."""
        return "linear_spring" in self.system.effect_names

    def _parameters(self) -> dict[str, Any]:
        out: dict[str, Any] = {}
        for fault in self._faults:
            for name, (value, low, high, unit) in fault.values.items():
                interval = None if low is None else [low, high]
                out[f"{fault.name}.{name}"] = {
                    "value": value,
                    "interval_90": interval,
                    "bound": None,
                    "unit": unit,
                }
        for f in self.outcome.found:
            for e in self.outcome.estimates(f.name):
                interval = None if e.low is None else [e.low, e.high]
                held = e.name in f.trial.held
                out[e.name] = {
                    "value": 0.0 if held else e.value,
                    "interval_90": interval,
                    "bound": e.bound,
                    "unit": e.unit,
                }
        return out


def sentence(outcome: Outcome, effect: str, held: Sequence[str] = ()) -> str:
    """What an effect means, with its values; parameters that were held at nothing are nothing."""
    return meaning(effect, outcome.estimates(effect), held)


def meaning(effect: str, parameters: Sequence[Estimate], held: Sequence[str] = ()) -> str:
    """The sentence of an effect with these values."""
    values: dict[str, list[str]] = {}
    units: dict[str, str] = {}
    for e in parameters:
        name = own_name(e.name)
        values.setdefault(name, []).append(f"{0.0 if e.name in held else e.value:.3g}")
        units[name] = "" if e.unit == "1" else f" {e.unit}"
    words = {name: ", ".join(values[name]) + units[name] for name in values}
    text = effect_class(effect).sentence
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
                    "evidence_nats": t.gain,
                    "evidence_error": t.error,
                    "p": t.p_corrected,
                    "parameters": {e.name: e.value for e in estimates(t.regression, t.sure, t.name)},
                    "chosen": look.chosen is not None and t.name == look.chosen.name,
                }
            )
        rest = sorted((n for n in look.screened if n not in seen), key=lambda n: -look.screened[n])
        out += [
            {"round": number, "effect": n, "screening": look.screened[n], "p": None, "chosen": False}
            for n in rest
        ]
    return out


def _where(d: Dependence, runs: Sequence[str]) -> str | None:
    if d.swing is not None:
        return f"{d.swing:.4g} Hz"
    if d.run is None:
        return None
    name = called(runs[d.run])
    return f"{name} only" if d.moment is None else f"{name}, {d.moment:.1f} s"


def _dependence(d: Dependence, tests: int, runs: Sequence[str]) -> dict[str, Any]:
    return {
        "channel": d.channel,
        "variable": d.variable,
        "where": _where(d, runs),
        "p": min(1.0, d.p * tests),
        "share": d.share,
        "kind": symmetry(d) or "-",
    }


def diagnose(
    system: System,
    spec: SysidSpec,
    data: DataSet,
    runs: Sequence[Run],
    options: Options,
    *,
    closed_loop: bool | None = None,
    say: Callable[[str, int, int], None] = lambda stage, done, total: None,
) -> Diagnosis:
    """Diagnose a declared model.

    Args:
        system: Declared system with first values.
        spec: The same as the specification of a model.
        data: The data set.
        runs: Its runs to look at.
        options: Settings.
        closed_loop: Whether inputs answer the state; None asks the test of feedback. Where it is not False, errors
            under replayed inputs judge no effect.
        say: Told stage, number done and number in all.

    Raises:
        DataError: too few rows, or nothing moves.
        ConfigError: an option is out of range, or a candidate that the system cannot have.
    """
    if options.instruments:  # a column that is not there is told before any work
        with_columns(system, runs, options.instruments)
    started = now()
    seconds: dict[str, float] = {}
    own = {name: register(name) for name in options.also}  # first: they may read channels that no other does
    say("checking the recording chain", 0, 1)
    recorded = undone(data, runs, system, options)
    extended = with_channels(system, recorded.runs)
    if not extended:
        raise DataError("no run to diagnose.")
    system = system.reading(*logged_channels(system, extended))
    able = candidate_names(system)
    for name in options.candidates or ():
        if name not in able:
            raise ConfigError(
                f"`candidates` names {name!r}, which {system.name!r} cannot have beyond its declared physics and the "
                f"logged channels; it could have: {', '.join(able)}."
            )
    for key, name in own.items():
        if name not in able:
            raise ConfigError(
                f"`also` names {key!r}, which {system.name!r} cannot have: it acts on the port "
                f"{effect_class(name).port.value!r} and reads "
                f"{', '.join(effect_class(name).exogenous) or 'no channel'}."
            )

    def looking(some: Sequence[Run]) -> Search:
        moved = bool(recorded.delays or recorded.lags)
        return search_in(
            system, some, recorded.clock, options, inputs=not recorded.inputs_restored, moved=moved, say=say
        )

    def test(regression: Regression) -> LoopTest:
        if recorded.inputs_restored:
            return LoopTest(why_not="the inputs were logged as an average and know the future")
        return tested(regression, extended)

    def in_loop(physics: System) -> Identification:
        return identify_in_loop(physics, extended, clock=recorded.clock, instruments=options.instruments)

    def shown(physics: System, effect: str) -> bool:
        return bool(options.instruments) and shown_by_instruments(in_loop(physics), effect, options.alpha)

    search = looking(extended)
    seconds["recording"] = now() - started
    outcome = loop(search, system, max_effects=options.max_effects, test=test, shown=shown)
    if outcome.structured:
        say("checking the recording chain", 0, 1)
        moved = _moved(outcome, replace(recorded, runs=tuple(extended)), system, looking)
        if moved is not None:
            again_in = looking(moved.runs)
            other = loop(again_in, system, max_effects=options.max_effects, test=test, shown=shown)
            # else something else looks like it: an input of the other sign, say
            if _structure(other) < _LITTLE * _structure(outcome) and not _collapsed(other):
                recorded, extended, search, outcome = moved, list(moved.runs), again_in, other
    seconds["search"] = now() - started - seconds["recording"]

    def again(some: Sequence[Run]) -> Search:
        made = search_in(system, some, recorded.clock, options, say=say)
        made.held = set(search.held)
        return made

    feedback = outcome.test
    if closed_loop is None:
        closed_loop = feedback.closed_loop
    instrumented = None
    if options.instruments and not feedback.why_not:
        say("estimates from signals outside the loop", 0, 1)
        instrumented = in_loop(outcome.system)
        if instrumented.instrumented is not None and adopted(instrumented.instrumented, feedback):
            outcome.printed = instrumented
            vars(outcome).pop("system", None)  # its values are the instruments' from here on
    say("errors on runs left out", 0, 1)
    errors = held_out(
        (outcome.declared_system, outcome.system),
        spec,
        extended,
        make=again,
        clock=recorded.clock,
        seed=options.seed,
        without={f.name: outcome.without(f.name) for f in outcome.found},
        moved={f.name: f.moves for f in outcome.found},
        closed_loop=closed_loop,
        inputs=not recorded.inputs_restored,
    )
    seconds["errors"] = now() - started - sum(seconds.values())
    outcome.found = [replace(f, lead=f.lead or errors.against(f.name)) for f in outcome.found]
    residuals = channel_residuals(outcome.declared.regression, outcome.final.regression)
    regression, left = outcome.final.regression, outcome.structured
    seen, names = rates(regression, outcome.variables), tuple(run.name for run in runs)
    shapes = tuple(shape(regression, d, outcome.variables, seen, names) for d in left[:_SHAPES])
    odd = odd_run(left, shapes)
    warned = warnings(outcome, system)

    def fit(some: Sequence[Run]) -> Regression:
        return search_in(system, some, recorded.clock, options).quick(system)

    return Diagnosis(
        system,
        data,
        names,
        recorded,
        outcome,
        errors,
        residuals,
        options,
        seconds,
        shapes=shapes,
        in_run=None if odd is None else in_run(again([extended[odd]]), outcome.system, odd),
        formula=formula(regression, left, outcome.variables, names),
        warned=tuple(warned),
        reading=better_reading(system, extended, fit) if warned else None,
        feedback=feedback,
        instrumented=instrumented,
        system_name=spec.system,
    )


def _structure(outcome: Outcome) -> float:
    """Twice the log likelihood that what is left over would bring."""
    return sum(max(d.gain - d.functions, 0.0) for d in outcome.structured)


def _collapsed(outcome: Outcome) -> bool:
    """Whether a declared parameter stands at a bound."""
    return bool(at_bounds(outcome.declared.regression).any())


def _moved(
    outcome: Outcome, recorded: Recorded, system: System, looking: Callable[[Sequence[Run]], Search]
) -> Recorded | None:
    """The recording chain with a sensor that is late as a whole, where that explains more than effects do."""

    def misfits(some: Sequence[Run]) -> Array:
        return np.log([law.std for law in looking(some).quick(system).noises])

    final = outcome.final.regression
    with_effects = sum(log(law.std) for law in final.noises)
    return instead_of_effects(recorded, system, misfits, rows=len(final.series), other=with_effects)


def undone(data: DataSet, runs: Sequence[Run], system: System, options: Options) -> Recorded:
    """The recording chain undone, with the declared physics as its judge where kinematics cannot tell."""

    def misfit(some: Sequence[Run], clock: float) -> float:
        return sum(log(law.std) for law in search_in(system, some, clock, options).quick(system).noises)

    return undo(data, runs, system, alpha=options.alpha, misfit=misfit)


def search_in(
    system: System,
    runs: Sequence[Run],
    clock: float,
    options: Options,
    *,
    inputs: bool = True,
    moved: bool = False,
    say: Callable[[str, int, int], None] = lambda stage, done, total: None,
) -> Search:
    """A search in runs whose recording chain was undone.

    Args:
        system: Declared system.
        runs: The runs; columns behind the inputs are logged channels (`with_channels`), which the system reads.
        clock: Physical seconds per logged second.
        options: Settings.
        inputs: Whether the inputs are what acted (see `Search`).
        moved: Whether channels that were late have been moved.
        say: Told stage, number done and number in all.
    """
    box = max(1, int(_BOX_S / (runs[0].dt * clock) + 1e-6))
    steps = steps_of(
        system,
        runs,
        clock=clock,
        smooth=False,
        denoise=system.sensor_noise,
        shortest=max(box, 20),
        run_in=True,
    )
    return Search(
        steps,
        box=box,
        alpha=options.alpha,
        candidates=None
        if options.candidates is None
        else (*options.candidates, *map(register, options.also)),
        feedback=not system.sensor_noise,
        inputs=inputs,
        moved=moved,
        say=say,
    )


def logged_channels(system: System, runs: Sequence[Run]) -> tuple[str, ...]:
    """Logged columns, of all runs and without gaps, that an effect of the catalogue could read."""
    effects = effects_of(system.name, system.ports)
    names = {name for cls in effects.values() for name in cls.exogenous}
    return tuple(
        n
        for n in sorted(names - set(system.exogenous))
        if all(n in run.extra and np.isfinite(run.extra[n]).all() for run in runs)
    )


def with_channels(system: System, runs: Sequence[Run]) -> list[Run]:
    """Runs with their `logged_channels` behind the inputs."""
    have = logged_channels(system, runs)
    if not have:
        return list(runs)
    return [replace(run, u=np.column_stack((run.u, *(run.extra[n] for n in have)))) for run in runs]
