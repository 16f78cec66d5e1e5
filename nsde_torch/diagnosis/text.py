"""A diagnosis as a terminal shows it."""

from collections.abc import Mapping, Sequence
from typing import Any

from nsde_torch.diagnosis.buys import BY_STEPS
from nsde_torch.diagnosis.ceiling import ceiling_lines, ceiling_rows
from nsde_torch.diagnosis.feedback_text import feedback_lines
from nsde_torch.diagnosis.not_done import ERRORS, NO_TIME, NOT_YET, STOPPED
from nsde_torch.diagnosis.summary import small
from nsde_torch.evaluation.report import between_ends, number, table
from nsde_torch.sysid.guard import doubts_the_fit
from nsde_torch.sysid.standing import in_words

_RANKED, _SENTENCES = 6, 4  # candidates and sentences that are listed
_FEW = 4  # findings, and effects that the data cannot show, that are listed in short
_UNFINISHED = (NO_TIME, NOT_YET, STOPPED)
_VERDICTS = {
    "no_effect": "Nothing is missing",
    "effect_found": "Found what is missing",
    "unexplained": "Something is missing that the catalogue does not name",
    "undecided": "Not decided yet",
    "doubted": "The fit is not believed",
}


def heading(content: Mapping[str, Any]) -> str:
    """The verdict in a few words; that the fit is not believed comes before it."""
    doubted = doubts_the_fit(o["kind"] for o in content["guard"]["objections"])
    return _VERDICTS["doubted" if doubted else content["verdict"]]


def lines(content: Mapping[str, Any], go_on: str = "resume=DIR") -> list[str]:
    """Lines of text from the content of `diagnosis.json`.

    Args:
        content: The content.
        go_on: The key that goes on from a diagnosis that is not finished.
    """
    out = [*unfinished(content, go_on), f"verdict: {content['verdict']}", content["summary"]]
    out += [line for title, said in notices(content) for line in ("", f"{title.lower()}: {said}")]
    for finding in in_order(content):
        out += _finding(finding, content)
    if content["told"]["rest"]:
        out += ["", f"{small_ones(content)}."]
    out += [line for a in content["aside"] for line in ("", f"{a['sentence']} This is {a['reason']}.")]
    for key, title in (("parameters", "parameter"), ("declared_parameters", "declared parameter")):
        if content[key]:
            rows = [
                [
                    name,
                    valued(p),
                    interval(p["interval_90"], p["bound"]),
                    *least_squares(content, name),
                    p["unit"],
                ]
                for name, p in content[key].items()
            ]
            out += [
                "",
                table([title, "value", interval_head(content), *least_squares(content), "unit"], rows),
            ]
    residual = [
        [
            name,
            *(number(c[k]) for k in ("measured", "before", "after", "floor")),
            f"{c['explained']:.0%}",
            c["unit"],
        ]
        for name, c in content["residual"].items()
    ]
    head = ["residual of the rate of", "measured", "before", "after", "floor", "explained", "unit"]
    out += ["", table(head, residual), *in_words(content["data"]["standing_share"])]
    out += _errors(content["errors"]) if measured(content) else []
    out += feedback_lines(content)
    ranked = [r for r in content["ranking"] if r["round"] == 0 and r["p"] is not None][:_RANKED]
    if ranked:
        rows = [
            [r["effect"], f"{r['evidence_nats']:+.1f}", f"{r['evidence_error']:.1f}", chance(r["p"])]
            for r in ranked
        ]
        out += [
            "",
            table(["first look at the catalogue", "evidence on runs left out [nat]", "+-", "p"], rows),
        ]
    structured = [d for d in content["structure"]["after"] if d["p"] < content["levels"]["structure"]]
    if structured:
        rows = [
            [d["channel"], placed(d), d["kind"], chance(d["p"]), f"{d['share']:.1%}"] for d in structured[:5]
        ]
        out += ["", table(["the residual still depends: channel", "variable", "kind", "p", "share"], rows)]
    if content["unexplained"]:
        out += ["", *(d["sentence"] for d in content["unexplained"][:_SENTENCES])]
    if content["between_runs"] is not None:
        between = content["between_runs"]
        out += ["", f"{between['sentence']} To take it out: {between['remedy']}"]
    if content["in_run"] is not None:
        out += ["", f"a lead, unverified: {content['in_run']['sentence']}"]
    out += ceiling_lines(content)
    head, rows = ceiling_rows(content)
    out += ["", table(head, rows)] if rows else []
    if content["not_shown"]:
        out += ["", "these data cannot show (smallest size that would be noticed):"]
        out += [f"  {text}" for text in unseen(content["not_shown"])]
    return out


def short_lines(content: Mapping[str, Any], go_on: str = "resume=DIR") -> list[str]:
    """What matters most of `lines`, in about fifteen: the verdict, findings with intervals, what the data cannot show.

    Args:
        content: The content of `diagnosis.json`.
        go_on: See `lines`.
    """
    out = [*unfinished(content, go_on), f"verdict: {content['verdict']}", content["summary"]]
    out += [f"{title.lower()}: {said}" for title, said in notices(content)]
    found = in_order(content)
    for finding in found[:_FEW]:
        worth = without_it(finding, content)
        out += ["", f"{finding['name']}{_mark(finding)}: {_sizes(finding, content)}", *_law(finding)]
        out += [f"  {worth}"] if worth else []
        out += _ties(finding, content)
    rest = [f["name"] for f in found[_FEW:]] + [r["effect"] for r in content["told"]["rest"]]
    out += ["", f"and {', '.join(rest)}"] if rest else []
    to_use = content["guard"].get("to_use") or {}
    values = [
        f"{name} {least_squares(content, name)[0]} ({interval(p['interval_90'])})"
        for name, p in to_use.items()
    ]
    out += ["", f"values of least squares, to be used: {', '.join(values)}"] if values else []
    left = content["errors"]["residual"] if measured(content) else {}
    residual = [f"{name} {changed(one)} {one['unit']}" for name, one in left.items()]
    if found and residual:
        out += ["", f"residual on {content['errors']['measured_on']}: {', '.join(residual[:_RANKED])}"]
    out += ceiling_lines(content)[:2]
    unseen_of = list(dict.fromkeys(n["effect"] for n in content["not_shown"]))
    if unseen_of:
        more = f" and {len(unseen_of) - _FEW} more" if len(unseen_of) > _FEW else ""
        out += ["", f"these data cannot show: {', '.join(unseen_of[:_FEW])}{more}"]
    return out


def _sizes(finding: Mapping[str, Any], content: Mapping[str, Any]) -> str:
    """The parameters of a finding with 90 % intervals, the axes of one together."""
    own: dict[str, list[Mapping[str, Any]]] = {}
    for name, p in content["parameters"].items():
        if name.startswith(f"{finding['name']}."):
            own.setdefault(name.removeprefix(f"{finding['name']}.").partition("[")[0], []).append(p)
    parts = []
    for name, axes in own.items():
        values = ", ".join(f"{valued(p)} ({interval(p['interval_90'], p['bound'])})" for p in axes)
        parts.append(f"{name} {values}" + ("" if axes[0]["unit"] == "1" else f" {axes[0]['unit']}"))
    return "; ".join(parts)


def least_squares(content: Mapping[str, Any], name: str | None = None) -> list[str]:
    """Heads of the columns of least squares (no name), or the cells of a parameter; none where the fit stands.

    Args:
        content: As `diagnosis.json` has it.
        name: Of the parameter.
    """
    to_use = content["guard"].get("to_use")
    if not to_use:
        return []
    if name is None:
        return ["least squares: use these", "90 % interval"]
    one = to_use.get(name)
    return ["-", "-"] if one is None else [valued(one), interval(one["interval_90"])]


def _finding(finding: Mapping[str, Any], content: Mapping[str, Any]) -> list[str]:
    """What was found, what it buys, and what it cannot be told from."""
    out = ["", f"{finding['name']}{_mark(finding)}: {finding['sentence']}"]
    if finding["p"] is not None:
        out[-1] += f" (p {chance(finding['p'])})"
    worth = without_it(finding, content)
    return [*out, *_law(finding), *([f"  {worth}"] if worth else []), *_ties(finding, content)]


def _mark(finding: Mapping[str, Any]) -> str:
    return f" (a lead: {finding['lead_reason']})" if finding["lead"] else ""


def _law(finding: Mapping[str, Any]) -> list[str]:
    if finding["kind"] != "formula":
        return []
    looks = f"; it looks like {finding['looks_like']}" if finding["looks_like"] else ""
    return [f"  {finding['law']}  [{finding['unit']}, SI]{looks}"]


def _ties(finding: Mapping[str, Any], content: Mapping[str, Any]) -> list[str]:
    return [
        f"  cannot be told from {', '.join(tie['effects'][1:])}. To tell: {tie['experiment']}; `nsde design` plans "
        "such a run."
        for tie in content["ties"]
        if tie["effects"][0] == finding["name"]
    ]


def in_order(content: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Findings that are told one by one: effects that matter, the most important first, then the recording."""
    by_name = {f["name"]: f for f in content["findings"] if f["kind"] != "recording"}
    return [
        *(by_name[name] for name in content["told"]["few"]),
        *(f for f in content["findings"] if f["kind"] == "recording"),
    ]


def without_it(finding: Mapping[str, Any], content: Mapping[str, Any]) -> str:
    """What returns on runs left out when an effect is left out; empty where nobody knows."""
    buys, where = finding["buys"], content["errors"]["measured_on"]
    if buys is None:
        return ""
    parts = []
    if buys["channel"] is not None:
        change = f"{number(buys['error_with'])} to {number(buys['error_without'])}"
        unit = "" if buys["unit"] == "1" else f" {buys['unit']}"
        parts.append(f"the residual of {buys['channel']} goes from {change}{unit}")
    if content["told"]["by"] == BY_STEPS:
        way = "falls" if buys["nats"] >= 0 else "rises"
        parts.append(f"the log-likelihood {way} by {number(round(abs(buys['nats']), 1))} nats")
    share = f" ({buys['share']:.0%} of what all effects improve)" if 0 < buys["share"] < 1 else ""
    return f"without it, on {where}: {', '.join(parts)}{share}"


def small_ones(content: Mapping[str, Any]) -> str:
    """The effects that matter little, in one line."""
    told = content["told"]
    each = ", ".join(f"{r['effect']} ({r['size']})" for r in told["rest"])
    return (
        f"and {small(len(told['rest']))}, together {told['rest_share']:.1%} of what all effects improve on "
        f"{content['errors']['measured_on']}: {each}"
    )


def interval_head(content: Mapping[str, Any]) -> str:
    """Head of a column of intervals."""
    return "90 % interval, provisional" if "so_far" in content else "90 % interval"


def unfinished(content: Mapping[str, Any], go_on: str = "resume=DIR") -> list[str]:
    """That a diagnosis is not finished, and what is not done, in a line; none of one that is.

    Args:
        content: Of `diagnosis.json`.
        go_on: See `lines`.
    """
    so_far = content.get("so_far")
    if so_far is None:
        return []
    during, after = so_far["stopped_during"], so_far["stopped_after_min"]
    left = ", ".join(n["stage"] for n in content["not_done"] if n["why"] in _UNFINISHED)
    if after is not None:
        return [f"stopped after {after:g} min as asked: not done: {left}; go on with {go_on}"]
    how = f"so far: stopped during {during}; not done" if during else "so far; not done yet"
    return [f"{how}: {left}"]


def notices(content: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Title and text of what is to be read before the findings: warnings, and stages without a result."""
    odd = [("Warning", warning(w)) for w in content["warnings"]]
    failed = [n for n in content.get("not_done", ()) if n["why"] not in _UNFINISHED]
    return [*odd, *(("Not done", f"{n['stage']}: {n['why']}.") for n in failed)]


def warning(entry: Mapping[str, Any]) -> str:
    """What is odd about a declared parameter, and what to look at."""
    remedy = str(entry["remedy"])
    return f"{entry['sentence']}. {remedy[:1].upper()}{remedy[1:]}."


def placed(dependence: Mapping[str, Any]) -> str:
    """What is depended on, and where if not everywhere."""
    where = dependence["where"]
    return f"{dependence['variable']} ({where})" if where else str(dependence["variable"])


def unseen(entries: Sequence[Mapping[str, Any]]) -> list[str]:
    """One line for each effect that the data cannot show, with the smallest size that they would."""
    by_effect: dict[str, list[str]] = {}
    order = {effect: i for i, effect in enumerate(dict.fromkeys(n["effect"] for n in entries))}
    for n in sorted(entries, key=lambda n: (order[n["effect"]], n["parameter"])):
        own, unit = n["parameter"].partition(".")[2], "" if n["unit"] == "1" else f" {n['unit']}"
        size = "at any size" if n["smallest"] is None else f"below {number(n['smallest'])}{unit}"
        by_effect.setdefault(n["effect"], []).append(f"{own} {size}")
    return [f"{effect}: {', '.join(parts)}" for effect, parts in by_effect.items()]


def measured(content: Mapping[str, Any]) -> bool:
    """Whether errors on runs left out were asked for, and could be computed."""
    return ERRORS not in (n["stage"] for n in content.get("not_done", ()))


def _errors(errors: Mapping[str, Any]) -> list[str]:
    """What runs left out say: the residual and the log-likelihood of each step, then predictions."""
    return [*_held_out(errors), *_replayed(errors)]


def _held_out(errors: Mapping[str, Any]) -> list[str]:
    gain = errors["one_step"]
    if gain is None or errors["before"] == errors["after"]:
        return []
    rows = []
    for name, more in gain["channels"].items():
        left = errors["residual"].get(name)
        cells = ["-"] * 2 if left is None else [changed(left), left["unit"]]
        rows.append([name, *cells, signed(more["nats"]), between(more)])
    rows.append(["all", "", "", signed(gain["nats"]), between(gain)])
    head = [f"on {errors['measured_on']}: rate of", "residual", "unit", "log-likelihood [nat]"]
    return ["", table([*head, "90 % interval"], rows)]


def _replayed(errors: Mapping[str, Any]) -> list[str]:
    horizons: Sequence[float] = errors["horizons_s"]
    if not horizons:
        return ["", "no run is long enough to measure errors on"]
    rows = []
    for name, before in errors["before"].items():
        after, ratio = errors["after"][name], errors["ratio"][name]
        cells = [
            _number(before[h])
            if errors["before"] == errors["after"]
            else f"{_number(before[h])} -> {_number(after[h])} (x{_number(ratio[h])})"
            for h in (f"{x:g}" for x in horizons)
        ]
        rows.append([f"{name} [{errors['units'][name]}]", *cells])
    head = [f"error on {errors['measured_on']}", *(f"{h:g} s" for h in horizons)]
    return ["", f"{OPEN_LOOP}:", table(head, rows)]


OPEN_LOOP = "open-loop, inputs replayed from the log"
"""What predictions are whose inputs come from the log, whatever made them."""


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


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def chance(p: float) -> str:
    """A p value as people write it."""
    return f"{p:.1g}" if p >= 1e-4 else "< 0.0001"


def interval(ends: Sequence[float] | None, bound: str | None = None) -> str:
    """An interval in words; of one that ends at a bound of the search, the other end alone (`below`, `above`)."""
    if ends is None:
        return bound or "not shown by the data"
    if bound is not None:
        return f"{bound} {number(ends[1] if bound == 'below' else ends[0])}"
    return between_ends(ends)


def valued(parameter: Mapping[str, Any]) -> str:
    """The value of a parameter, with the digits that its interval has."""
    ends = parameter["interval_90"]
    bounded = ends is None or parameter.get("bound") is not None
    return number(parameter["value"], 0.0 if bounded else ends[1] - ends[0])
