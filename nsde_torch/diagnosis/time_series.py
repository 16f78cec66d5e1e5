"""The log over time for `report.html`, by run: states, inputs, what the physics leaves before and after, predictions.

Runs are thinned to what a screen shows: of each stretch of rows the smallest and the largest value, so that no spike is
lost. Values are 16-bit numbers between the ends of their channel; `templates/series.js` draws them with plotly.js, as
the package `plotly` ships it.
"""

from __future__ import annotations

import base64
import hashlib
import json
from importlib.metadata import distribution
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nsde_torch.arrays import Array
from nsde_torch.data.system_info import derivative_columns
from nsde_torch.diagnosis.search import dynamic_rows

if TYPE_CHECKING:
    from nsde_torch.data import Run
    from nsde_torch.diagnosis.result import Diagnosis

_ROWS = 16_000  # of all runs together
_FEWEST = 200  # of a run
_GAP = -32768  # no value
_SCRIPT = Path(__file__).parent / "templates" / "series.js"
_PLOTLY = "plotly/package_data/plotly.min.js"


def plotly_script() -> str:
    """What the package `plotly` ships; the package itself is not imported."""
    return Path(str(distribution("plotly").locate_file(_PLOTLY))).read_text(encoding="utf-8")


def script() -> str:
    """The script of the page: plotly.js, and what draws with it."""
    return f"{plotly_script()}\n{_SCRIPT.read_text(encoding='utf-8')}"


def script_hash() -> str:
    """What a Content-Security-Policy allows, so that this script runs and no other."""
    return "sha256-" + base64.b64encode(hashlib.sha256(script().encode()).digest()).decode()


def time_series(found: Diagnosis) -> str:
    """The log over time as JSON without a `<`, which may stand in a page."""
    system, data = found.system, found.data
    columns = (*system.state_names, *data.input_names)
    units = (*system.state_units, *system.input_units, *[""] * (len(data.input_names) - system.nu))
    groups: list[tuple[str, list[str]]] = []
    for k, (name, unit) in enumerate(zip(columns, units, strict=True)):
        if k not in (0, len(system.state_names)) and unit == groups[-1][0]:
            groups[-1][1].append(name)
        else:
            groups.append((unit, [name]))
    runs = [data[name] for name in found.runs]
    most = max(_FEWEST, _ROWS // len(runs))
    logs = [_encoded(columns, *_log(run, most)) for run in runs]
    left, charts = _left(found, most)
    ahead, predicted = _ahead(found)
    paths = (
        i for i, _ in derivative_columns(system).values() if system.quaternion is not None and len(i) == 3
    )
    content = {
        "runs": [
            {"name": r.name, "log": a, "left": b, "ahead": c}
            for r, a, b, c in zip(runs, logs, left, ahead, strict=True)
        ],
        "charts": [{"of": "log", "names": names, "unit": unit} for unit, names in groups]
        + charts
        + predicted,
        "path": [system.state_names[k] for k in next(paths, ())],
    }
    return json.dumps(content, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _log(run: Run, most: int) -> tuple[Array, Array]:
    """Times and states with inputs of a run, with a row of gaps after each stretch."""
    values = np.column_stack((run.x, run.u))
    share = most / max(len(run.t), 1)
    parts = [thinned(run.t[a:b], values[a:b], max(2, round(share * (b - a)))) for a, b in run.segments]
    gap = np.full((1, values.shape[1]), np.nan)
    t = [np.append(t, t[-1]) for t, _ in parts]
    return np.concatenate(t), np.concatenate([part for _, y in parts for part in (y, gap)])


def _left(found: Diagnosis, most: int) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """What the physics leaves of each run, before and after, and its charts; empty where it was not asked."""
    outcome, count = found.outcome, len(found.runs)
    if outcome.verdict == "undecided":
        return [{}] * count, []
    before = outcome.declared_rates
    both = {"before": before} | ({"after": outcome.rates} if outcome.found else {})
    out: list[dict[str, Any]] = []
    for k in range(count):
        rows = {name: seen.run == k for name, seen in both.items()}
        t = before.values["time"][rows["before"]]
        if not all(own.any() for own in rows.values()):
            out.append({})
            continue
        values = [
            np.interp(t, seen.values["time"][rows[name]], seen.residual[rows[name], number])
            for number in range(len(before.names))
            for name, seen in both.items()
        ]
        columns = [f"{channel} {name}" for channel in before.names for name in both]
        out.append(_encoded(columns, *thinned(t, np.stack(values, 1), most)))
    pairs = zip(before.names, before.units, strict=True)
    charts = [{"of": "left", "names": [f"{c} {name}" for name in both], "unit": unit} for c, unit in pairs]
    return out, charts


def _ahead(found: Diagnosis) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Predictions of each run by physics that was fitted to other runs, and their charts; empty without any."""
    made, system = found.errors.predictions, found.system
    out: list[dict[str, Any]] = [{} for _ in found.runs]
    if made is None:
        return out, []
    *_, last = made.predicted.values()
    every = (
        {"measured": made.measured} | made.predicted | {"low": last - made.width, "high": last + made.width}
    )
    rows = dynamic_rows(system)
    columns = [f"{system.state_names[c]} {name}" for c in rows for name in every]
    values = np.stack(list(every.values()), -1)[:, :, rows].reshape(*made.t.shape, -1)
    gap = np.full((len(values), 1, len(columns)), np.nan)  # after each
    values, t = np.concatenate((values, gap), 1), np.concatenate((made.t, made.t[:, -1:]), 1)
    # of a single run its last part was left out, under a name of its own
    names = found.errors.runs if found.errors.whole_runs else found.runs
    for number, name in enumerate(names):
        own = np.flatnonzero(made.run == number)[: _ROWS // t.shape[1]]
        if len(own):
            part = _encoded(columns, t[own].ravel(), values[own].reshape(-1, len(columns)))
            out[found.runs.index(name)] = part
    count = len(every)
    return out, [
        {"of": "ahead", "names": columns[count * k :][:count], "unit": system.state_units[c]}
        for k, c in enumerate(rows)
    ]


def thinned(t: Array, y: Array, most: int) -> tuple[Array, Array]:
    """About so many rows of t (n,) and y (n, k): of each stretch the smallest and the largest values, in turn."""
    width = -(-2 * len(t) // most)
    count = len(t) // width
    if width < 2 or not count:
        return t, y
    parts = y[: count * width].reshape(count, width, -1)
    ends = np.sort(np.stack((parts.argmin(1), parts.argmax(1))), axis=0)
    first, last = (np.take_along_axis(parts, place[:, None], axis=1)[:, 0] for place in ends)
    starts = np.arange(count) * width
    times = np.stack((t[starts], t[starts + width // 2]), 1).reshape(-1)
    return times, np.stack((first, last), 1).reshape(2 * count, -1)


def _encoded(names: Any, t: Array, y: Array) -> dict[str, Any]:
    out: dict[str, Any] = {"t": [float(f"{v:.7g}") for v in t.tolist()], "y": {}}
    for name, values in zip(names, y.T, strict=True):
        good = values[np.isfinite(values)]
        low, size = (float(good.min()), float(np.ptp(good)) / 65534) if len(good) else (0.0, 0.0)
        whole = np.round((values - low) / (size or 1.0)) - 32767
        packed = np.where(np.isfinite(values), whole, _GAP).astype("<i2").tobytes()
        out["y"][name] = [low, size, base64.b64encode(packed).decode()]
    return out
