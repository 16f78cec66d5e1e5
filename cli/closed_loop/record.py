"""The record of a closed loop: `close_loop.json`, its text and its picture."""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from nsde_torch.plots import save
from nsde_torch.plots.tracking import tracking

from .. import build
from .experiments import StoppedLoop, experiment_lines
from .loop import AFTER, BEFORE, TRUTH, ClosedLoop
from .machines import HAND, LINK

RESULT, PICTURE = "close_loop.json", "close_loop.png"
_DRAWN = {BEFORE: "declared physics", AFTER: "with what was found", TRUTH: "with the true effects"}


def record(loop: ClosedLoop, experiments: list[dict[str, Any]], stop: StoppedLoop | None) -> dict[str, Any]:
    """What `close_loop.json` holds of a loop that was flown; `stop` is None where no experiment was asked for."""
    told, diagnosed = loop.told, loop.found
    before = loop.flown(BEFORE)
    after = loop.flown(AFTER) if told else before  # nothing found: nothing to fly with
    truth = loop.flown(TRUTH)
    pairs = [
        {"seed": b["seed"], "before_m": b["rmse_m"], "after_m": a["rmse_m"]}
        for b, a in zip(before, after, strict=True)
    ]
    for pair, flown in zip(pairs, truth, strict=False):
        pair["truth_m"] = flown["rmse_m"]
    whole = bool(pairs) and all(f["tracked"] for f in (*before, *after))
    ratios = [p["after_m"] / p["before_m"] for p in pairs] if whole else []
    config = loop.config
    plant = build.options(config.plant)
    content: dict[str, Any] = {
        "system": config.plant.system,
        "by": config.by,
        # what a person flies, or is at the other end of a link, is not known
        "plant": None if config.by in (LINK, HAND) else {k: plant[k] for k in ("effects", "declared_only")},
        "reference": {"name": loop.reference.name, "duration_s": loop.reference.duration},
        "verdict": diagnosed["verdict"],
        "told": told,
        "findings": [f["sentence"] for f in diagnosed["findings"]],
        "experiments": experiments,
        "stopped": None if stop is None else {"kind": stop.kind, "sentence": stop.sentence},
        "rmse_m": pairs,
        "before_mean_m": _mean([p["before_m"] for p in pairs]),
        "after_mean_m": _mean([p["after_m"] for p in pairs]),
        "ratio": _mean(ratios) if ratios else None,
        "better_in": sum(r < 1.0 for r in ratios),
        "pairs": len(pairs),
        "not_to_the_end": [
            {"flight": f"{stage} {k + 1}", "trouble": f["trouble"]["text"] if f["trouble"] else None}
            for stage, flights in ((BEFORE, before), (AFTER, after if told else []), (TRUTH, truth))
            for k, f in enumerate(flights)
            if not f["tracked"]
        ],
        "units": {"rmse_m": "m", "nats": "nat"},
    }
    if truth:
        known = whole and all(f["tracked"] for f in truth)
        content["truth"] = loop.truth
        content["truth_mean_m"] = _mean([p["truth_m"] for p in pairs])
        content["after_over_truth"] = _mean([p["after_m"] / p["truth_m"] for p in pairs]) if known else None
    return content


def text(content: dict[str, Any]) -> str:
    """The record in some lines."""
    lines = []
    for entry in content["experiments"]:
        lines += [*experiment_lines(entry), ""]
    if content["stopped"] is not None:
        lines += [f"no further experiment: {content['stopped']['sentence']}", ""]
    lines += content["findings"]
    if not content["findings"]:
        lines.append("Nothing is missing from the declared physics, as far as the flights show.")
    names = ", ".join(name for entry in content["told"] for name in entry)
    lines.append(f"The controller now has: {names or 'nothing more than before'}.")
    for p in content["rmse_m"]:
        shown = [f"{_cm(p['before_m'])} before", f"{_cm(p['after_m'])} after"]
        if "truth_m" in p:
            shown.append(f"{_cm(p['truth_m'])} with the true effects")
        lines.append(f"seed {p['seed']}: RMSE {', '.join(shown)}")
    again = " Start the same command again, and it is flown again." if content["by"] == LINK else ""
    for f in content["not_to_the_end"]:
        lines.append(f"{f['flight']} was not flown to its end: {f['trouble']}.{again}")
    if content["ratio"] is not None:
        lines.append(
            f"mean {_cm(content['before_mean_m'])} -> {_cm(content['after_mean_m'])} "
            f"(x {content['ratio']:.2f}), better in {content['better_in']} of {content['pairs']}"
        )
    if (ratio := content.get("after_over_truth")) is not None:
        truth = _cm(content["truth_mean_m"])
        lines.append(f"{ratio:.2f} times the error of a controller with the true effects ({truth})")
    return "\n".join(lines)


def picture(loop: ClosedLoop, folder: Path) -> bool:
    """Paths and errors of the flights that are compared; whether there was anything to draw."""
    t = np.arange(0.0, loop.reference.duration, 0.02)
    rows = {}
    for stage, name in _DRAWN.items():
        tracks = [np.array(f["track"]) for f in loop.flown(stage) if f["tracked"]]
        if tracks:
            resampled = [np.stack([np.interp(t, x[:, 0], c) for c in x[:, 1:].T], 1) for x in tracks]
            rows[name] = np.stack(resampled, 1)
    if not rows:
        return False
    wanted = loop.reference.at(torch.from_numpy(t)).numpy()
    save(tracking(t, wanted, rows, title=f"The {loop.reference.name}, before and after"), folder / PICTURE)
    return True


def _cm(value: float | None) -> str:
    return "not flown" if value is None else f"{100 * value:.1f} cm"


def _mean(values: list[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return sum(known) / len(known) if known and len(known) == len(values) else None
