"""The plan of an experiment in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_OFTEN = 0.8


def lines(content: Mapping[str, Any]) -> list[str]:
    """What `nsde design` prints, from the content of `design.json`."""
    q, plan = content["question"], content["plan"]
    tie = q["kind"] == "tie"
    out = [
        f"question: {'which is true' if tie else 'how large'}: "
        + (" or ".join(q["names"]) if tie else ", ".join(q["parameters"]))
    ]
    out += [f"note: {note}" for note in q["notes"]]
    start = ", ".join(f"{n} = {v:.3g}" for n, v in plan["start"].items())
    out += ["", f"the plan: {plan['duration_s']:.4g} s from {start}"]
    out += [f"  {words}" for words in plan["words"]]
    bounds = (
        f"{n} {v['low']:.4g} to {v['high']:.4g} {v['unit']} ({v['from']})"
        for n, v in content["limits"].items()
    )
    out += ["limits: " + "; ".join(bounds)]
    most = plan["largest_share_of_limits"]
    out += ["largest use of them in rehearsal: " + ", ".join(f"{n} {v:.0%}" for n, v in most.items())]
    out += ["", *(_of_tie(content) if tie else _of_parameters(content))]
    return out


def _of_tie(content: Mapping[str, Any]) -> list[str]:
    rows = [("designed", content["expected"]), *((b["name"], b["expected"]) for b in content["baselines"])]
    names = content["question"]["names"]
    width = max(len(name) for name, _ in rows)
    heads = [f"if {name} is true" for name in names]
    columns = [max(len(h), 24) for h in heads]
    usual = (
        f" of the plan, {content['baselines'][0]['rehearsals']} of the others" if content["baselines"] else ""
    )
    out = [
        f"expected evidence [nats], mean (90 %), of {content['rehearsals']} rehearsals{usual}; "
        f"{content['sure_nats']:g} break the tie (20 to 1)",
        "  ".join([" " * width, *(h.rjust(w) for h, w in zip(heads, columns, strict=True))]),
    ]
    for name, expected in rows:
        cells = [_nats(e["nats"]).rjust(w) for e, w in zip(expected, columns, strict=True)]
        out.append("  ".join([name.ljust(width), *cells]))
    least = min(e["separated"] for e in content["expected"])
    out.append(
        f"the plan breaks the tie in {least:.0%} of the rehearsals or more, whichever is true"
        if least >= _OFTEN
        else "within these limits and this length nothing that was tried breaks the tie reliably (the plan: in "
        f"{least:.0%} of the rehearsals where it is hardest): allow more (limits, hertz, duration), or the members are "
        "one law at the values that the runs show"
    )
    wide = content["beyond_limits"]
    if least < _OFTEN and wide is not None and wide["worth_nats"] > content["sure_nats"]:
        out.append(
            f"what limits it is limits.{wide['limit']}: an experiment that takes {wide['share']:.0%} of it would tell "
            f"{wide['worth_nats']:.1f} nats in the less favourable cases"
        )
    return out


def _nats(n: Mapping[str, float]) -> str:
    return f"{n['mean']:.1f} ({n['low_90']:.1f} to {n['high_90']:.1f})"


def _of_parameters(content: Mapping[str, Any]) -> list[str]:
    (expected,) = content["expected"]
    asked = content["question"]["parameters"]
    labels = [n for n in expected["parameters"] if any(n == a or n.startswith(f"{a}[") for a in asked)]
    others = [(b["name"], b["expected"][0]["parameters"]) for b in content["baselines"]]
    out = ["expected standard errors: now, after the plan, and after usual inputs of that length"]
    for label in labels:
        p = expected["parameters"][label]
        usual = ", ".join(f"{name} {_error(q[label])}" for name, q in others)
        out.append(
            f"  {label} [{p['unit']}]: {p['standard_error']:.3g} -> {_error(p)}"
            + (f"; {usual}" if usual else "")
        )
    return out


def _error(p: Mapping[str, Any]) -> str:
    e = p["expected_standard_error"]
    return "not known" if e is None else f"{e:.3g}"
