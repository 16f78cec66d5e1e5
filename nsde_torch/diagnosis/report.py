"""`report.html`, one self-contained page that a field engineer reads in two minutes (`templates/report.html`).

A picture of all effects that were found shows the channel whose residual they reduced most against the variable whose
dependence they took away most; without an effect, what the residual depends on. A picture of one effect shows the
residual of one channel with it, and with its own term added back,

    without = residual(theta) + (term of the effect at theta)        all other parameters as they were fitted

(partial residuals; Larsen and McCleary, Technometrics 14, 1972), against the variable of which the term is most nearly
a function, or as a course of a few seconds in the run in which it is largest (a lag's). A picture of functions shows
how far they may be trusted by

    eta(z) = sqrt(1 - k(z)^T (K + e I)^-1 k(z)),        k(z, z') = exp(-|z - z'|^2 / 2 l^2)

the standard deviation of a Gaussian process at z given its values at the data, over that before (Rasmussen and
Williams, Gaussian Processes for Machine Learning, 2006, equation 2.26), with variables scaled to [-1, 1] over the range
of the data: 0 among the data and 1 far from them.
"""

from __future__ import annotations

import base64
import copy
import io
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nsde_torch.arrays import Array, Labels, Mask
from nsde_torch.diagnosis.ceiling import Ceiling
from nsde_torch.diagnosis.effect_importance import Importance, ShownEffects
from nsde_torch.diagnosis.files import picture_file
from nsde_torch.diagnosis.outcome import Outcome
from nsde_torch.diagnosis.residual_tests import Dependence
from nsde_torch.diagnosis.search import moved_channels
from nsde_torch.diagnosis.shape import (
    ChannelResidual,
    Rates,
    bins,
    called,
    is_plain,
    rates,
    spectrum,
    variable_units,
    white_parts,
)
from nsde_torch.diagnosis.text import rendered
from nsde_torch.diagnosis.time_series import script, time_series
from nsde_torch.effects import effect_class
from nsde_torch.plots import diagnosis as plots
from nsde_torch.sysid.physics import per_second
from nsde_torch.sysid.regression import Regression
from nsde_torch.systems.parameters import own_name
from nsde_torch.whole_files import write_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from nsde_torch.diagnosis.result import Content, Diagnosis

EFFECT = "effect_"  # what the name of a picture of one effect begins with
WITHOUT, WITH = "without it", "with it"
_CHANNELS, _UNEXPLAINED = 2, 4  # panels
_COURSE = 120  # points of a course in time
_REDUCED = 0.9  # of the residual before: what is below that was reduced
_FUNCTION = 0.5  # of a term's variance, which bins of a variable must hold to be its axis
_CONSTANT = 1e-6  # of a term's squared mean: variance below which it is a constant
_BINS = 20  # of a variable
_COURSE_S = 3.0  # length of a course
_GRID = {1: 200, 2: 60}  # points along each axis of the picture of functions
_LENGTH = 0.2  # l, of the half range of the data
_POINTS = 300  # of the data that are looked at
_ERROR = 1e-2  # e
_FAR = 0.5  # eta above which a place is far from the data


def pictures(found: Diagnosis, content: Content) -> dict[str, Figure]:
    """Figures by name, as far as there is any.

    `effect_NAME` of each effect that matters, `residual`, `unexplained`, `flexible`, `held_out`, `errors`, `spectrum`;
    of a diagnosis that was stopped before what is left was tested, `spectrum` alone.
    """
    outcome = found.outcome
    if outcome.verdict == "undecided":  # what residuals may depend on was not asked
        return _spectra(found)
    panels = effect_panels(outcome, found.shown, found.importance, found.runs)
    out: dict[str, Figure] = {
        f"{EFFECT}{name}": plots.residual_views(
            [panel], title=f"{name}: what is left over without and with it, all else as fitted"
        )
        for name, panel in panels.items()
    }
    if outcome.found:
        views = effect_views(outcome, found.explanation.channels)
        if views:
            names = ", ".join(f.name for f in outcome.found)
            out["residual"] = plots.residual_views(
                views, title=f"What the physics leaves over, without and with {names}"
            )
    if outcome.structured:
        views = unexplained_views(outcome, notes=[s.note for s in found.explanation.shapes], runs=found.runs)
        if views:
            out["unexplained"] = plots.residual_views(
                views, title="What the residual depends on and no effect explains"
            )
    elif not outcome.found:
        views = unexplained_views(
            outcome, [d for d in outcome.before if is_plain(d.variable) and d.everywhere][:_CHANNELS]
        )
        if views:
            title = "What the physics leaves over, against what it depends on most: no more than chance"
            out["residual"] = plots.residual_views(views, title=title)
    flexible = ceiling_picture(outcome, found.explanation.ceiling)
    if flexible is not None:
        out["flexible"] = flexible
    errors = content["errors"]
    if outcome.found and errors["residual"]:
        out["held_out"] = _held_out(errors)
    if outcome.found and errors["horizons_s"]:
        out["errors"] = _errors(errors)
    return out | _spectra(found)


def _spectra(found: Diagnosis) -> dict[str, Figure]:
    shown = _most_reduced(found.explanation.channels)[: 2 * _CHANNELS]
    if not shown:
        return {}
    title = "Spectrum of the physics' residual, and the floor of white noise"
    return {
        "spectrum": plots.residual_spectra([_spectrum(found.outcome, c.name) for c in shown], title=title)
    }


def effect_views(outcome: Outcome, channels: Sequence[ChannelResidual]) -> list[plots.Panel]:
    """The channels that the effects reduced, each against the variable that its residual depended on most surely."""
    before, after = outcome.declared_rates, outcome.rates
    out: list[plots.Panel] = []
    if not len(before.residual):  # no stretch is as long as the means
        return out
    for c in _most_reduced(channels)[: 2 * _CHANNELS]:
        if out and c.after > _REDUCED * c.before:
            break
        picked = _telling(outcome.before, outcome.after, c.name)
        if picked is None:
            continue
        variable, unit, x = _axis(before, picked)
        number = before.names.index(c.name)
        clouds = {
            name: _cloud(x, seen.residual[:, number], seen.block)
            for name, seen in (("before", before), ("after", after))
            if len(seen.residual) == len(x)
        }
        out.append(plots.Panel(c.name, before.units[number], variable, unit, clouds))
    return out


def unexplained_views(
    outcome: Outcome,
    left: Sequence[Dependence] | None = None,
    *,
    notes: Sequence[str] = (),
    runs: Sequence[str] = (),
) -> list[plots.Panel]:
    """What the residual still depends on by some tests, one panel each; None takes those that found something.

    `notes` are words for the first of them, `runs` the names of the runs, by number.
    """
    seen = outcome.rates
    out: list[plots.Panel] = []
    if not len(seen.residual):
        return out
    done: set[tuple[str, str, int | None, float | None]] = set()
    for d, note in zip_longest(outcome.structured if left is None else left, notes, fillvalue=""):
        if not isinstance(d, Dependence) or d.sinusoid is not None:
            continue  # the picture of the spectrum shows an oscillation
        if len(out) == _UNEXPLAINED:
            break
        variable, unit, x = _axis(seen, d)
        this = (d.channel, variable, d.run, d.moment)
        if this in done:
            continue
        done.add(this)
        number = seen.names.index(d.channel)
        y, there = seen.residual[:, number], seen.run == d.run
        if d.run is None:
            clouds = {"residual": _cloud(x, y, seen.block)}
        elif d.moment is not None:
            clouds = {"residual": _course(x, y, there)}
            note = f"one moment: {called(runs[d.run])}, {d.moment:.1f} s"
        else:
            clouds = {
                called(runs[d.run]): _cloud(x[there], y[there], seen.block[there]),
                "other runs": _cloud(x[~there], y[~there], seen.block[~there]),
            }
        out.append(plots.Panel(d.channel, seen.units[number], variable, unit, clouds, note=note))
    return out


def effect_panels(
    outcome: Outcome, shown: ShownEffects, importance: Mapping[str, Importance], runs: tuple[str, ...]
) -> dict[str, plots.Panel]:
    """By effect that matters: its picture; none of one that moves nothing that can be drawn."""
    regression = outcome.final
    seen = outcome.rates
    out: dict[str, plots.Panel] = {}
    for name in shown.few:
        channel = importance[name].channel if name in importance else ""
        channel = channel or next(iter(moved_channels(regression, name)), "")
        if channel not in seen.names or not len(seen.residual):
            continue
        number = seen.names.index(channel)
        bare = rates(_without_term(regression, name), outcome.variables)
        if not np.isfinite(bare.residual[:, number]).all():
            continue
        out[name] = _panel(seen, bare.residual[:, number], number, runs)
    return out


def _without_term(regression: Regression, effect: str) -> Regression:
    """The same residuals with the term of an effect added back; nothing is fitted again."""
    cls, theta = effect_class(effect), regression.theta.copy()
    labels = regression.vector.labels
    for j in regression.vector.of(effect):
        theta[j] = cls.null.get(own_name(labels[j]), theta[j])
    out = copy.copy(regression)
    bare = regression.physics.residual(regression.vector.inside(theta))
    out.residual = regression.single.summed(bare, regression.box)
    regression.physics.residual(regression.theta)  # its values are those of the last use
    return out


def _panel(seen: Rates, without: Array, number: int, runs: tuple[str, ...]) -> plots.Panel:
    left = seen.residual[:, number]
    term = without - left
    plain = {name: x for name, x in seen.values.items() if is_plain(name) and name != "time"}
    held = {name: _held(x, term) for name, x in plain.items()}
    variable = max(held, key=lambda n: held[n], default="")
    parts = {WITHOUT: without, WITH: left}
    if variable and held[variable] > _FUNCTION:
        clouds = {key: _cloud(plain[variable], y, seen.block) for key, y in parts.items()}
        unit, note = seen.value_units.get(variable, ""), ""
    else:
        run, rows = _largest(seen, term)
        t = seen.values["time"][rows]
        clouds = {key: plots.Cloud(t, y[rows], t, y[rows], np.zeros(len(t))) for key, y in parts.items()}
        variable, unit, note = "time", "s", called(runs[run])
    return replace(plots.Panel(seen.names[number], seen.units[number], variable, unit, clouds), note=note)


def _held(x: Array, term: Array) -> float:
    """Share of a term's variance that means in bins of a variable hold; a constant is a function of anything."""
    whole = float(term.var())
    if whole <= _CONSTANT * float(term.mean()) ** 2:
        return 1.0
    if not np.ptp(x) > 0:
        return 0.0
    edges = np.unique(np.quantile(x, np.linspace(0.0, 1.0, _BINS + 1)[1:-1]))
    place = np.searchsorted(edges, x)
    count = np.maximum(np.bincount(place), 1)
    mean = np.bincount(place, weights=term) / count
    return float(((mean - term.mean()) ** 2 * count).sum() / len(term)) / whole


def _largest(seen: Rates, term: Array) -> tuple[int, Labels]:
    """Number of a run, and the rows of the few seconds of it in which a term is largest."""
    power = {int(run): float(np.square(term[seen.run == run]).mean()) for run in np.unique(seen.run)}
    run = max(power, key=lambda r: power[r])
    rows = np.flatnonzero(seen.run == run)
    t = seen.values["time"][rows]
    places = np.floor((t - t[0]) / _COURSE_S).astype(np.int64)
    of_place = np.bincount(places, weights=np.square(term[rows]))
    rows = rows[places == int(of_place.argmax())]
    return run, rows[np.argsort(seen.values["time"][rows])]


def ceiling_picture(outcome: Outcome, found: Ceiling) -> Figure | None:
    """What functions add to the row that they explain most of; None where nothing is left."""
    if found.functions is None or not found.rows:
        return None
    row, at = found.rows[0], outcome.variables.columns
    names = tuple(name for name in row.variables if name in at)[:2]
    if not names:
        return None
    columns = {name: at[name] for name in names}
    axes = [np.linspace(float(v.min()), float(v.max()), _GRID[len(names)]) for v in columns.values()]
    mesh = np.meshgrid(*axes)
    places = {name: m.reshape(-1) for name, m in zip(names, mesh, strict=True)}
    mean, spread = found.functions.force(places, row.port)
    data = np.stack(list(columns.values()), 1)
    eta = distance_from_data(data, np.stack(list(places.values()), 1))
    of, shape = variable_units(outcome.final.vector.system), mesh[0].shape
    named = tuple((name, of.get(name, "")) for name in names)
    force, error, far = mean.reshape(shape), np.sqrt(spread).reshape(shape), (eta > _FAR).reshape(shape)
    surface = plots.Surface(row.row, row.unit, named, tuple(axes), force, error, far, data)
    beside = "effects" if outcome.found else "the declared physics"
    return plots.flexible_surface(surface, title=f"What functions add to {row.row} beside {beside}")


def distance_from_data(data: Array, places: Array) -> Array:
    """eta (m,) of places (m, d) beside data (n, d), between 0 and 1."""
    low, high = data.min(0), data.max(0)
    half = np.maximum(0.5 * (high - low), 1e-300)
    some = data[np.linspace(0, len(data) - 1, min(len(data), _POINTS)).round().astype(int)]
    first, second = ((part - 0.5 * (low + high)) / half / _LENGTH for part in (some, places))
    among = np.exp(-0.5 * _squares(first, first)) + _ERROR * np.eye(len(first))
    towards = np.exp(-0.5 * _squares(first, second))
    known = np.einsum("nm,nm->m", towards, np.linalg.solve(among, towards))
    return np.asarray(np.sqrt(np.clip(1.0 - known, 0.0, 1.0)))


def _squares(one: Array, other: Array) -> Array:
    return np.asarray(np.square(one[:, None, :] - other[None, :, :]).sum(2))


def _most_reduced(channels: Sequence[ChannelResidual]) -> list[ChannelResidual]:
    """Channels by how much of their residual the effects took away, compared with the floor."""
    return sorted(
        channels, key=lambda c: -(c.before**2 - c.after**2) / max(c.floor, 1e-12 + 1e-3 * c.before) ** 2
    )


def _telling(tests: Sequence[Dependence], after: Sequence[Dependence], channel: str) -> Dependence | None:
    """The test of a channel on a variable that can be an axis, of which the effects took away most."""
    stays = {(d.channel, d.variable): d.gain for d in after}
    own = [d for d in tests if d.channel == channel and is_plain(d.variable) and d.everywhere]
    return max(own, key=lambda d: d.excess - stays.get((channel, d.variable), 0.0), default=None)


def _axis(seen: Rates, d: Dependence) -> tuple[str, str, Array]:
    """Name, unit and values of a variable for a horizontal axis."""
    if is_plain(d.variable):
        return d.variable, seen.value_units.get(d.variable, ""), seen.values[d.variable]
    if not d.pair:
        return "number of the run", "", seen.run.astype(np.float64)
    values, units = np.ones(len(seen.run)), []
    for factor in d.pair.split(" * "):
        name = factor.removeprefix("abs(").removesuffix(")")
        values = values * (seen.values[name] if name == factor else np.abs(seen.values[name]))
        units.append(seen.value_units.get(name, "1"))
    return d.pair, " ".join(u for u in units if u not in ("", "1")), values


def _cloud(x: Array, y: Array, block: Labels) -> plots.Cloud:
    b = bins(x, y, block)
    return plots.Cloud(x, y, b.centre, b.mean, b.error)


def _course(t: Array, y: Array, rows: Mask) -> plots.Cloud:
    x, y = t[rows], y[rows]
    some = np.linspace(0, max(len(x) - 1, 0), min(len(x), _COURSE)).round().astype(int)
    return plots.Cloud(x, y, x[some], y[some], np.zeros(len(some)))


def _spectrum(outcome: Outcome, channel: str) -> plots.ResidualSpectrum:
    """Amplitude densities [unit/sqrt(Hz)] from mean powers per step: S dt / dt^2, both sides of the band."""
    regression = outcome.final
    number = regression.physics.names.index(channel)
    dt = regression.physics.steps.dt
    curves = {"residual": regression}
    if outcome.found:
        curves = {"before": outcome.declared, "after": regression}
    amplitudes = {}
    for name, r in curves.items():
        frequency, power = spectrum(r, number)
        amplitudes[name] = np.sqrt(2.0 * power[1:] / dt)
    push, sensor, _ = white_parts(regression, number)
    floor = push + 4.0 * np.sin(np.pi * frequency[1:] * dt) ** 2 * sensor
    amplitudes["floor"] = np.sqrt(2.0 * floor / dt)
    return plots.ResidualSpectrum(
        channel, per_second(regression.physics.units[number]), frequency[1:], amplitudes
    )


def _held_out(errors: Mapping[str, Any]) -> Figure:
    left, gain = errors["residual"], errors["one_step"]["channels"]
    ratios, nats = {}, {}
    for name, c in left.items():
        per = 1.0 / c["before"] if c["before"] > 0 else 0.0
        low, high = (None if c[k] is None else 1.0 + per * c[k] for k in ("low_90", "high_90"))
        ratios[name] = (c["ratio"], low, high)
        nats[name] = (gain[name]["nats"], gain[name]["low_90"], gain[name]["high_90"])
    return plots.before_after(
        ratios, nats, title=f"What was found, on {errors['measured_on']}: residual, and one-step predictions"
    )


def _errors(errors: Mapping[str, Any]) -> Figure:
    horizons = errors["horizons_s"]

    def curves(table: Mapping[str, Mapping[str, float | None]]) -> dict[str, list[float | None]]:
        return {name: [row[f"{h:g}"] for h in horizons] for name, row in table.items()}

    apart = errors["difference"]
    tables = errors["before"], errors["after"], apart["low_90"], apart["high_90"]
    before, after, low, high = (curves(table) for table in tables)
    title = f"Open-loop, inputs replayed from the log: error on {errors['measured_on']} (rms)"
    return plots.errors_before_after(horizons, before, after, low, high, errors["units"], title=title)


# ---- the page ------------------------------------------------------------------------------------------

_DPI = 100  # of the pictures


def write_report(path: Path, found: Diagnosis, content: Content, *, over_time: bool = True) -> None:
    """Write the page, and its pictures into `plots` beside it; `over_time` is whether it shows the log over time."""
    from nsde_torch.plots import save

    figures = pictures(found, content)
    for name, figure in figures.items():
        save(figure, path.parent / "plots" / picture_file(name))
    series, made = time_series(found) if over_time else "", found.errors.predictions
    horizon = made.horizon if made else None
    write_whole(path, page(content, figures, width=found.width, series=series, horizon=horizon))


def page(
    content: Content,
    figures: Mapping[str, Figure],
    *,
    width: float,
    series: str = "",
    horizon: float | None = None,
) -> str:
    """The page as HTML.

    Args:
        figures: What `pictures` makes, of means over `width` [s].
        series: `time_series`, with predictions over `horizon` [s]; None where it has none.
    """
    shown = {}
    for name, figure in figures.items():
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=_DPI)
        png = base64.b64encode(buffer.getvalue()).decode("ascii")
        shown[name] = {"alt": figure.get_suptitle(), "png": png}
    more = {"content": content, "figures": shown, "width": width, "series": series, "horizon": horizon}
    return rendered("report.html", content, **more, script=script)
