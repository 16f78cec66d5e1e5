"""A plan as one reads it: `design.json`, `plan.csv`, `design.png`, and its words."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.errors import ConfigError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from nsde_torch.design.experiment import Experiment

RESULT, PLAN, PICTURE = "design.json", "plan.csv", "design.png"
_OFTEN = 0.8  # share of the rehearsals that break a tie from which a plan is called reliable
_STATES = 4  # that are drawn
_POINTS = 600  # of each


def save(experiment: Experiment, folder: str | Path) -> Path:
    """Write all files of a plan (`Experiment.save`)."""
    from nsde_torch.plots.style import save as save_figure

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps(experiment.content(), indent=1, allow_nan=False)
    (folder / RESULT).write_text(text + "\n", encoding="utf-8")
    write_plan(folder / PLAN, tuple(experiment.given), experiment.rows())
    save_figure(picture(experiment), folder / PICTURE)
    return folder


def write_plan(file: Path, names: tuple[str, ...], rows: Array) -> None:
    """Write a plan as CSV: times and what is given from then on, (n, 1 + columns)."""
    with file.open("w", encoding="utf-8", newline="\n") as out:
        out.write(",".join(("t", *names)) + "\n")
        out.writelines(",".join(f"{v:.9g}" for v in row) + "\n" for row in rows.tolist())


def read_design(folder: str | Path) -> dict[str, Any]:
    """Content of `design.json`.

    Raises:
        ConfigError: the folder holds none.
    """
    file = Path(folder) / RESULT
    if not file.is_file():
        raise ConfigError(f"{folder} holds no {RESULT}; `nsde design` writes one.")
    content: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return content


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
        nats = (e["nats"] for e in expected)
        said = (f"{n['mean']:.1f} ({n['low_90']:.1f} to {n['high_90']:.1f})" for n in nats)
        cells = [one.rjust(w) for one, w in zip(said, columns, strict=True)]
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


def picture(experiment: Experiment) -> Figure:
    """Inputs over time, states with their 90 % bands for each member, and the expected evidence of all plans."""
    from nsde_torch.plots.experiment import Course, Seen, experiment_figure

    e, units = experiment, experiment.units
    t = e.dt * np.arange(len(e.plan.table) + 1, dtype=np.float64)
    some = np.unique(np.linspace(0, len(t) - 1, min(len(t), _POINTS)).round().astype(int))
    inputs = np.concatenate((e.plan.table, e.plan.table[-1:]))
    unit = {"yaw": "rad", **units}
    given = [Course(f"{name} [{unit[name]}]", t, inputs[:, i]) for name, i in e.given.items()]
    seen = []
    for i in _telling(experiment):
        name = e.system.state_names[i]
        bands = []
        for r in e.plan.rehearsed:
            low, middle, high = np.quantile(r.states[:, some, i], [0.05, 0.5, 0.95], axis=0)
            bands.append((low, middle, high))
        seen.append(Seen(f"{name} [{units[name]}]", t[some], tuple(bands)))
    plans = [e.plan, *e.baselines]
    nats, q = None, e.question
    if not q.parameters:
        nats = {p.name: [p.nats(i) for i in range(len(q.names))] for p in plans}
    title = (
        f"An experiment to show {', '.join(q.parameters)}"
        if q.parameters
        else f"Which is true: {' or '.join(q.names)}?"
    )
    return experiment_figure(given, seen, q.names, nats, title=title)


def _telling(e: Experiment) -> list[int]:
    """States to draw: those in which members differ most beside what their parameters leave open."""
    spread = [r.states.std(0).mean(0) for r in e.plan.rehearsed]
    middle = [np.median(r.states, 0) for r in e.plan.rehearsed]
    apart = max((np.abs(a - b).max(0) for a in middle for b in middle), key=lambda d: float(d.sum()))
    order = np.argsort(-apart / np.maximum(np.mean(spread, 0), 1e-12))[:_STATES]
    return sorted(int(i) for i in order)
