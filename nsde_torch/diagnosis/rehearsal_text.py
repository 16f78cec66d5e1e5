"""A rehearsed diagnosis in words: what the same data would say of a machine that is known."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any

from nsde_torch.diagnosis.text import unseen

Table = Callable[[Sequence[str], Sequence[Sequence[str]]], str]

_LISTED = 3  # effects that are not shown, in words
_HEAD = ("parameter", "simulated", "estimates", "90 % intervals that hold it", "unit")


def rehearsal_lines(content: Mapping[str, Any]) -> list[str]:
    """Lines for the terminal; none where nothing was rehearsed.

    Args:
        content: As `diagnosis.json` has it.
    """
    own = content.get("rehearsal")
    if own is None:
        return []
    out = ["", *sentences(own)]
    rows = _rows(own)
    if rows:
        widths = [max(len(row[i]) for row in (_HEAD, *rows)) for i in range(len(_HEAD))]
        for row in (_HEAD, *rows):
            out.append("  " + "  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip())
    return out


def rehearsal_html(content: Mapping[str, Any], table: Table) -> str:
    """The section of the page; empty where nothing was rehearsed.

    Args:
        content: As `diagnosis.json` has it.
        table: Makes a table from its head and rows.
    """
    own = content.get("rehearsal")
    if own is None:
        return ""
    text = "".join(f"<p>{escape(sentence)}</p>" for sentence in sentences(own))
    rows = _rows(own)
    return f"<h2>Rehearsed</h2>{text}{table(_HEAD, rows) if rows else ''}"


def sentences(own: Mapping[str, Any]) -> list[str]:
    """What a rehearsal says, one thing a sentence.

    Args:
        own: The key `rehearsal` of `diagnosis.json`.
    """
    if own["why_not"]:
        return [f"rehearsed: not possible: {own['why_not'].rstrip('.')}."]
    many = own["logs"]
    of = "what was found" if own["effects"] else "the declared physics"
    logs = "log was" if many == 1 else "logs were"
    out = [f"rehearsed: {many} {logs} simulated of {of} (inputs {own['inputs']}) and diagnosed again."]
    for name, count in own["effects"].items():
        parts = [f"found again, surely, in {count['sure']} of {many}"]
        parts += [f"as a lead in {count['lead']}"] if count["lead"] else []
        parts += [f"tied with another in {count['tied']}"] if count["tied"] else []
        out.append(f"{name}: {', '.join(parts)}.")
    if own["others"]:
        out.append(f"Named there, surely, and not simulated: {', '.join(own['others'])}.")
    if own["unexplained"]:
        out.append(f"Something stays unexplained in {own['unexplained']} of {many}.")
    if own["of_nothing"] is not None:
        named = ", ".join(own["of_nothing"])
        out.append(
            f"Of the declared physics alone these data would name {named}: be careful with that name."
            if named
            else "Of the declared physics alone nothing is named."
        )
    blind = unseen(own["not_shown"])
    if blind:
        more = f", and {len(blind) - _LISTED} more (`rehearsal.not_shown`)" if len(blind) > _LISTED else ""
        out.append(f"They would not show {'; '.join(blind[:_LISTED])}{more}.")
    if own["left_out"]:
        out.append(f"Not simulated: {'; '.join(own['left_out'])}.")
    return out


def _rows(own: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Rows of the table, one for each parameter that was found again."""
    return [
        (
            label,
            f"{p['value']:.4g}",
            ", ".join(f"{v:.4g}" for v in p["again"]),
            f"{p['hold']} of {p['intervals']}",
            p["unit"],
        )
        for label, p in own["parameters"].items()
        if p["again"]
    ]
