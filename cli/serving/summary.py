"""What the page shows of a diagnosis."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nsde_torch.diagnosis.result import Content

SUMMARY, RESULT = "summary.json", "result"
_PICTURES = ("held_out.png", "residual.png", "unexplained.png", "flexible.png")


def page_summary(content: Content, plots: Collection[str]) -> dict[str, Any]:
    """What stands above the report of a diagnosis, with these files in `plots/`."""
    from nsde_torch.diagnosis import text  # loads torch
    from nsde_torch.evaluation.report import number

    errors = content["errors"]
    changed, keys = errors["before"] != errors["after"], [f"{h:g}" for h in errors["horizons_s"]]
    residual = [
        {
            "name": name,
            "unit": "" if left["unit"] == "1" else left["unit"],
            "before": number(left["before"]),
            "after": number(left["after"]),
            "ratio": f"{left['ratio']:.2g}",
        }
        for name, left in errors["residual"].items()
    ]
    predictions = [
        {
            "name": name,
            "unit": errors["units"][name],
            "cells": [[_short(before[h]), _short(errors["after"][name][h])] for h in keys],
        }
        for name, before in errors["before"].items()
    ]
    rest = {r["effect"] for r in content["told"]["rest"]}
    findings = [*text.in_order(content), *(f for f in content["findings"] if f["name"] in rest)]
    return {
        "verdict": content["verdict"],
        "heading": text.heading(content),
        "summary": content["summary"],
        "warnings": [*text.unfinished(content), *(said for _, said in text.notices(content))],
        "findings": [_finding(f, content, plots) for f in findings],
        "aside": [f"{a['sentence']} This is {a['reason']}." for a in content["aside"]],
        "unexplained": [u["sentence"] for u in content["unexplained"]],
        "measured_on": errors["measured_on"],
        "residual": residual if changed else [],
        "horizons": keys,
        "predictions": predictions,
        "changed": changed,
        "pictures": [name for name in _PICTURES if name in plots],
    }


def _finding(finding: Mapping[str, Any], content: Content, plots: Collection[str]) -> dict[str, Any]:
    from nsde_torch.diagnosis.files import picture_file
    from nsde_torch.diagnosis.text import chance, interval, valued, without_it

    name, worth = finding["name"], without_it(finding, content)
    picture = picture_file(f"effect_{name}")
    own = {k: p for k, p in content["parameters"].items() if k.startswith(f"{name}.")}
    return {
        "name": name,
        "sentence": finding["sentence"],
        "recording": finding["kind"] == "recording",
        "lead": (finding["lead_reason"] or "unverified") if finding["lead"] else "",
        "law": f"{finding['law']} [{finding['unit']}, SI]" if finding["kind"] == "formula" else "",
        "worth": f"{worth[:1].upper()}{worth[1:]}." if worth else "",
        "p": "" if finding["p"] is None else chance(finding["p"]),
        "parameters": [
            {
                "name": key.partition(".")[2],
                "value": valued(p),
                "interval": interval(p["interval_90"], p["bound"]),
                "unit": "" if p["unit"] == "1" else p["unit"],
            }
            for key, p in own.items()
        ],
        "ties": [
            {"effects": tie["effects"][1:], "experiment": tie["experiment"]}
            for tie in content["ties"]
            if tie["effects"][0] == name
        ],
        "picture": picture if picture in plots else "",
    }


def _short(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def save_summary(folder: Path, content: Content) -> None:
    plots = {path.name for path in (folder / RESULT / "plots").glob("*.png")}
    (folder / SUMMARY).write_text(json.dumps(page_summary(content, plots)), encoding="utf-8")
