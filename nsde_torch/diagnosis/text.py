"""A diagnosis in words, made of the content of `diagnosis.json`: for the terminal, and for the page (`templates`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape

from nsde_torch.diagnosis.effect_importance import BY_STEPS
from nsde_torch.diagnosis.stages import ERRORS, NO_TIME, NOT_YET, STOPPED
from nsde_torch.evaluation import report
from nsde_torch.evaluation.report import between_ends, number
from nsde_torch.sysid.standstill import in_words

if TYPE_CHECKING:
    from nsde_torch.diagnosis.result import Content

_UNFINISHED = (NO_TIME, NOT_YET, STOPPED)
_VERDICTS = {
    "no_effect": "Nothing is missing",
    "effect_found": "Found what is missing",
    "unexplained": "Something is missing that the catalogue does not name",
    "undecided": "Not decided yet",
    "doubted": "The fit is rejected",
}
_AXES = 3  # numbers of a run that are read by their order
_CELLS = "│"  # between the cells of a table in a template


def lines(content: Content, go_on: str = "resume=DIR") -> list[str]:
    """Lines of text; `go_on` is the key that goes on from a diagnosis that is not finished."""
    return rendered("long.txt", content, content=content, go_on=go_on).splitlines()


def short_lines(content: Content, go_on: str = "resume=DIR") -> list[str]:
    """What matters most of `lines`, in about fifteen: the verdict, findings with intervals, what data cannot show."""
    return rendered("short.txt", content, content=content, go_on=go_on).splitlines()


def rehearsal_lines(content: Content) -> list[str]:
    """What the same data would say of a machine that is known; no lines where nothing was rehearsed."""
    if "rehearsal" not in content:
        return []
    rows = rehearsed(content["rehearsal"])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    table = ["  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in rows]
    return ["", *sentences(content["rehearsal"]), *(f"  {row}" for row in table)]


def sentences(own: Mapping[str, Any]) -> list[str]:
    """What a rehearsal says, one thing a sentence."""
    return rendered("rehearsal.txt", own).splitlines()


def rehearsed(own: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Table of the parameters that were found again in a rehearsal, its head first; empty without any."""
    head = ("parameter", "simulated", "estimates", "90 % intervals that hold it", "unit")
    rows = []
    for label, p in own["parameters"].items():
        if again := ", ".join(f"{v:.4g}" for v in p["again"]):
            rows.append((label, f"{p['value']:.4g}", again, f"{p['hold']} of {p['intervals']}", p["unit"]))
    return [head, *rows] if rows else []


def heading(content: Content) -> str:
    """The verdict in a few words; that the fit is rejected comes before it."""
    return _VERDICTS["doubted" if content["guard"].get("rejected") else content["verdict"]]


def own_parameters(finding: Mapping[str, Any], content: Content) -> dict[str, Mapping[str, Any]]:
    """The parameters of a finding."""
    return {k: p for k, p in content["parameters"].items() if k.startswith(f"{finding['name']}.")}


def sizes(finding: Mapping[str, Any], content: Content) -> str:
    """The parameters of a finding with 90 % intervals, the axes of one together."""
    own: dict[str, list[Mapping[str, Any]]] = {}
    for name, p in own_parameters(finding, content).items():
        own.setdefault(name.removeprefix(f"{finding['name']}.").partition("[")[0], []).append(p)
    out = []
    for name, axes in own.items():
        against = f" against {axes[0]['against']}:" if axes[0].get("against") else ""
        values, rest = _by_run(axes)
        out.append(f"{name}{against} {', '.join(values)}{with_space(axes[0]['unit'])}{rest}")
    return "; ".join(out)


def _by_run(axes: Sequence[Mapping[str, Any]]) -> tuple[list[str], str]:
    """Values with intervals; of what differs between runs those of each run behind its name, the largest first.

    Where one run has something, those that may have nothing come last, together: a gust parts its run in three. Of more
    than three numbers of a run, those that are something are named by their place.
    """
    found: dict[str, list[Mapping[str, Any]]] = {}
    for p in axes:
        found.setdefault(p.get("run", ""), []).append(p)
    said = {
        k: [f"{valued(p)} ({interval(p['interval_90'], p['bound'])})" for p in v] for k, v in found.items()
    }
    if "" in found:
        return [", ".join(values) for values in said.values()], ""
    there = sorted(found, key=lambda run: -max(abs(p["value"]) for p in found[run]))
    nothing = [run for run in found if all(_may_be_nothing(p) for p in found[run])]
    few = nothing if 1 < len(nothing) < len(found) else []
    for run, numbers in found.items():
        shown = [k for k, p in enumerate(numbers) if not _may_be_nothing(p)]
        if len(numbers) > _AXES and 0 < len(shown) < len(numbers):  # of six motors the one that broke
            said[run] = [f"{said[run][k]} of number {k + 1}" for k in shown]
    listed = [f"{run} {' and '.join(said[run])}" for run in there if run not in few]
    return listed, f", indistinguishable from 0 in {', '.join(few)}" if few else ""


def _may_be_nothing(p: Mapping[str, Any]) -> bool:
    low, high = p["interval_90"] or (None, None)
    return low is not None and high is not None and low <= 0.0 <= high


def least_squares(content: Content, name: str | None = None) -> list[str]:
    """Heads of the columns of least squares (no name), or the cells of a parameter; none where the fit stands."""
    to_use = content["guard"].get("to_use")
    if not to_use:
        return []
    if name is None:
        return ["least squares: nearer", "90 % interval"]
    one = to_use.get(name)
    return ["-", "-"] if one is None else [valued(one), interval(one["interval_90"])]


def in_order(content: Content, *, all_of_them: bool = False) -> list[Mapping[str, Any]]:
    """Findings that are listed one by one: effects that matter, the most important first, then the recording.

    Those that matter little come last, if asked for.
    """
    by_name = {f["name"]: f for f in content["findings"] if f["kind"] != "recording"}
    recording = [f for f in content["findings"] if f["kind"] == "recording"]
    told = content["told"]
    rest = [by_name[r["effect"]] for r in told["rest"]] if all_of_them else []
    return [*(by_name[name] for name in told["few"]), *recording, *rest]


def without_it(finding: Mapping[str, Any], content: Content) -> str:
    """What returns on runs left out when an effect is left out; empty where nobody knows."""
    buys, where = finding["buys"], content["errors"]["measured_on"]
    if buys is None:
        return ""
    parts = []
    if buys["channel"] is not None:
        change = f"{number(buys['error_with'])} to {number(buys['error_without'])}"
        parts.append(f"the residual of {buys['channel']} goes from {change}{with_space(buys['unit'])}")
    # where physics diverge on runs left out their densities are no numbers
    nats = buys["nats"]
    if content["told"]["by"] == BY_STEPS and nats is not None and isfinite(nats):
        way = "falls" if nats >= 0 else "rises"
        parts.append(f"the log-likelihood {way} by {number(round(abs(nats), 1))} nats")
    share = f" ({buys['share']:.0%} of what all effects improve)" if 0 < buys["share"] < 1 else ""
    return f"without it, on {where}: {', '.join(parts)}{share}"


def small_ones(content: Content) -> str:
    """The effects that matter little, in one line."""
    told = content["told"]
    each = ", ".join(f"{r['effect']} ({r['size']})" for r in told["rest"])
    return (
        f"and {small(len(told['rest']))}, together {told['rest_share']:.1%} of what all effects improve on "
        f"{content['errors']['measured_on']}: {each}"
    )


def beside_leads(content: Content) -> str:
    """That declared values hold with what is provisional; empty where nothing is."""
    leads = [f["name"] for f in content["findings"] if f["lead"]]
    if not (leads and content["declared_parameters"]):
        return ""
    return (
        f"Values of declared parameters and their intervals hold beside {', '.join(leads)} as found, which "
        f"{'is' if len(leads) == 1 else 'are'} provisional: another effect in {'its' if len(leads) == 1 else 'their'} "
        "place moves them."
    )


def given_laws(content: Content) -> str:
    """Declared values that hold only if laws beyond the catalogue have the right form; empty where none does."""
    given = {name: p["given"] for name, p in content["declared_parameters"].items() if p.get("given")}
    if not given:
        return ""
    laws = list(dict.fromkeys(law for some in given.values() for law in some))
    values = content["declared_parameters"]
    each = ", ".join(f"{name} {valued(values[name])}{with_space(values[name]['unit'])}" for name in given)
    return (
        f"{each}: {'holds' if len(given) == 1 else 'hold'} only if {' and '.join(laws)} "
        f"{'has its' if len(laws) == 1 else 'have their'} true form; the data show what they do together."
    )


def small(count: int) -> str:
    """How many effects are small, in words."""
    words = ("", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")
    number = words[count] if count < len(words) else str(count)
    return f"{number} small one{'s' if count > 1 else ''}"


def interval_head(content: Content) -> str:
    """Head of a column of intervals."""
    return "90 % interval, provisional" if "so_far" in content else "90 % interval"


def unfinished(content: Content, go_on: str = "resume=DIR") -> list[str]:
    """That a diagnosis is not finished, and what is not done, in a line; none of one that is."""
    so_far = content.get("so_far")
    if so_far is None:
        return []
    during, after = so_far["stopped_during"], so_far["stopped_after_min"]
    left = ", ".join(n["stage"] for n in content["not_done"] if n["why"] in _UNFINISHED)
    if after is not None:
        return [f"stopped after {after:g} min as asked: not done: {left}; go on with {go_on}"]
    how = f"so far: stopped during {during}; not done" if during else "so far; not done yet"
    return [f"{how}: {left}"]


def notices(content: Content) -> list[tuple[str, str]]:
    """Title and text that precede the findings: warnings, and stages without a result."""
    odd = [("Warning", f"{w['sentence']}. {sentence_case(w['remedy'])}.") for w in content["warnings"]]
    failed = [n for n in content.get("not_done", ()) if n["why"] not in _UNFINISHED]
    return [*odd, *(("Not done", f"{n['stage']}: {n['why']}.") for n in failed)]


def unseen(entries: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """By effect that the data cannot show: the smallest sizes that they would."""
    by_effect: dict[str, list[str]] = {n["effect"]: [] for n in entries}
    for n in sorted(entries, key=lambda n: str(n["parameter"])):
        least = n["smallest"]
        size = f"below {number(least)}{with_space(n['unit'])}" if least is not None else "at any size"
        if n.get("declared"):  # files of earlier versions lack it
            size = "at any size, as declared parameters do the same here"
        by_effect[n["effect"]].append(f"{n['parameter'].partition('.')[2]} {size}")
    return {effect: ", ".join(parts) for effect, parts in by_effect.items()}


def measured(content: Content) -> bool:
    """Whether errors on runs left out were asked for, and could be computed."""
    return ERRORS not in (n["stage"] for n in content.get("not_done", ()))


def changed(left: Mapping[str, Any]) -> str:
    """A residual before and after."""
    return f"{left['before']:.3g} -> {left['after']:.3g} (x{left['ratio']:.3g})"


def signed(nats: float) -> str:
    """A difference of log-likelihoods."""
    return f"{nats:+.1f}"


def between(entry: Mapping[str, Any]) -> str:
    """The interval of a difference of log-likelihoods."""
    if entry["low_90"] is None or entry["high_90"] is None:
        return "too few blocks"
    return f"{signed(entry['low_90'])} to {signed(entry['high_90'])}"


def chance(p: float) -> str:
    """A p value as people write it."""
    return f"{p:.1g}" if p >= 1e-4 else "< 0.0001"


_NO_INTERVAL = {None: "not shown by the data", "reference": "the reference of the others"}


def interval(ends: Sequence[float] | None, bound: str | None = None) -> str:
    """An interval in words; of one that ends at a bound of the search, the other end alone (`below`, `above`)."""
    if ends is None:
        return _NO_INTERVAL.get(bound, bound or "")
    if bound is not None:
        return f"{bound} {number(ends[1] if bound == 'below' else ends[0])}"
    return between_ends(ends)


def valued(parameter: Mapping[str, Any]) -> str:
    """The value of a parameter, with the digits that its interval has."""
    ends = parameter["interval_90"]
    bounded = ends is None or parameter.get("bound") is not None
    return number(parameter["value"], 0.0 if bounded else ends[1] - ends[0])


def with_space(unit: str) -> str:
    """A unit behind a number; nothing of a number without one."""
    return "" if unit == "1" else f" {unit}"


def unit(unit: str) -> str:
    """A unit as the page shows it."""
    return "" if unit == "1" else unit.replace("s2", "s²").replace("m2", "m²")


def sentence_case(text: str) -> str:
    """A text that begins with a capital."""
    return text[:1].upper() + text[1:]


def fmt(value: float | None, spec: str) -> str:
    """A number in a format of Python; a dash for none."""
    return "-" if value is None else format(value, spec)


def table(text: str) -> str:
    """Lines of cells, in aligned columns."""
    head, *rows = ([c.strip() for c in line.split(_CELLS)] for line in text.splitlines() if line.strip())
    return report.table(head, rows) + "\n"


def rendered(template: str, values: Mapping[str, Any], **more: Any) -> str:
    """A template of `templates`, filled in."""
    return _TEMPLATES.get_template(template).render(values, **more)


_TEMPLATES = Environment(
    loader=FileSystemLoader(Path(__file__).parent / "templates"),
    autoescape=select_autoescape(["html"]),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_FUNCTIONS = {name: f for name, f in vars().items() if callable(f) and not name.startswith("_")}
_TEMPLATES.filters.update(_FUNCTIONS)
_TEMPLATES.globals.update(_FUNCTIONS, standing=in_words, OPEN_LOOP="open-loop, inputs replayed from the log")
