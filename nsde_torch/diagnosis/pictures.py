"""The pictures of a diagnosis: which channel against which variable, and the arrays to draw.

A picture of a found effect shows the channel whose residual it reduced most against the variable on which the residual
depended most surely before; without an effect, what the residual depends on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from nsde_torch.diagnosis.ceiling import ceiling_picture
from nsde_torch.diagnosis.channels import ChannelResidual, spectrum, white_parts
from nsde_torch.diagnosis.dependence import Dependence
from nsde_torch.diagnosis.effect_pictures import effect_panels
from nsde_torch.diagnosis.files import picture_file
from nsde_torch.diagnosis.outcome import Outcome
from nsde_torch.diagnosis.regressors import Regressors
from nsde_torch.diagnosis.shape import called, product_of
from nsde_torch.diagnosis.views import Rates, bins, factors, is_plain, rates
from nsde_torch.plots.diagnosis import (
    Cloud,
    Panel,
    ResidualSpectrum,
    before_after,
    errors_before_after,
    residual_spectra,
    residual_views,
)
from nsde_torch.sysid.explained import per_second
from nsde_torch.sysid.regression import Regression

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from nsde_torch.diagnosis.result import Diagnosis

Array = NDArray[np.float64]

EFFECT = "effect_"
"""What the name of a picture of one effect begins with."""

_CHANNELS, _UNEXPLAINED = 2, 4  # panels
_PLAIN, _PRODUCT = 0.05, 0.01  # chances between which a product is drawn and no plain variable
_COURSE = 120  # points of a course in time
_SURE = 1e-4  # chance below which a test is as sure as any
_REDUCED = 0.9  # of the residual before: what is below that was reduced


def pictures(found: Diagnosis, content: Mapping[str, Any]) -> dict[str, Figure]:
    """Figures by name, as far as there is any.

    `effect_NAME` of each effect that matters, `residual`, `unexplained`, `flexible`, `held_out`, `errors`, `spectrum`;
    of a diagnosis that was stopped before what is left was tested, `spectrum` alone.
    """
    outcome = found.outcome
    if outcome.verdict == "undecided":  # what residuals may depend on was not asked
        return _spectra(found)
    panels = effect_panels(outcome, found.told, found.buys, found.runs)
    out: dict[str, Figure] = {
        f"{EFFECT}{name}": residual_views(
            [panel], title=f"{name}: what is left over without and with it, all else as fitted"
        )
        for name, panel in panels.items()
    }
    if outcome.found:
        views = effect_views(outcome, found.explanation.channels)
        if views:
            names = ", ".join(f.name for f in outcome.found)
            out["residual"] = residual_views(
                views, title=f"What the physics leaves over, without and with {names}"
            )
    if outcome.structured:
        views = unexplained_views(outcome, notes=[s.note for s in found.explanation.shapes], runs=found.runs)
        if views:
            out["unexplained"] = residual_views(
                views, title="What the residual depends on and no effect explains"
            )
    elif not outcome.found:
        views = unexplained_views(
            outcome, [d for d in outcome.before if is_plain(d.variable) and d.everywhere][:_CHANNELS]
        )
        if views:
            title = "What the physics leaves over, against what it depends on most: no more than chance"
            out["residual"] = residual_views(views, title=title)
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
    title = "Spectrum of what the physics leaves over, and the floor of white noise"
    return {"spectrum": residual_spectra([_spectrum(found.outcome, c.name) for c in shown], title=title)}


def save_pictures(figures: Mapping[str, Figure], folder: Path) -> list[Path]:
    """Write the figures as PNG files of their names into a folder."""
    from nsde_torch.plots import save

    return [save(figure, folder / picture_file(name)) for name, figure in figures.items()]


def effect_views(outcome: Outcome, channels: Sequence[ChannelResidual]) -> list[Panel]:
    """The channels that the effects reduced, each against the variable that its residual depended on most surely."""
    before = rates(outcome.declared.regression, outcome.declared_variables)
    after = rates(outcome.final.regression, outcome.variables)
    out: list[Panel] = []
    if not len(before.residual):  # no stretch is as long as the means
        return out
    for c in _most_reduced(channels)[: 2 * _CHANNELS]:
        if out and c.after > _REDUCED * c.before:
            break
        picked = _telling(outcome.before, outcome.after, c.name)
        if picked is None:
            continue
        values = _axis(before, outcome.declared.regression, outcome.declared_variables, picked)
        if values is None:
            continue
        variable, unit, x = values
        number = before.names.index(c.name)
        clouds = {
            name: _cloud(x, seen.residual[:, number], seen.block)
            for name, seen in (("before", before), ("after", after))
            if len(seen.residual) == len(x)
        }
        out.append(Panel(c.name, before.units[number], variable, unit, clouds))
    return out


def unexplained_views(
    outcome: Outcome,
    left: Sequence[Dependence] | None = None,
    *,
    notes: Sequence[str] = (),
    runs: Sequence[str] = (),
) -> list[Panel]:
    """What the residual still depends on, one panel each.

    Args:
        outcome: What was concluded.
        left: Tests; None takes those that found something.
        notes: Words for the first of them.
        runs: Names of the runs, by number.
    """
    regression = outcome.final.regression
    seen = rates(regression, outcome.variables)
    out: list[Panel] = []
    if not len(seen.residual):
        return out
    done: set[tuple[str, str, int | None, float | None]] = set()
    for d, note in zip_longest(outcome.structured if left is None else left, notes, fillvalue=""):
        if not isinstance(d, Dependence) or d.sinusoid is not None:
            continue  # the picture of the spectrum shows a swing
        values = _axis(seen, regression, outcome.variables, d)
        if values is None or len(out) == _UNEXPLAINED:
            continue
        variable, unit, x = values
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
        out.append(
            Panel(
                d.channel,
                seen.units[number],
                variable,
                unit,
                clouds,
                note=note,
            )
        )
    return out


def _most_reduced(channels: Sequence[ChannelResidual]) -> list[ChannelResidual]:
    """Channels by how much of their residual the effects took away, compared with the floor."""
    return sorted(
        channels, key=lambda c: -(c.before**2 - c.after**2) / max(c.floor, 1e-12 + 1e-3 * c.before) ** 2
    )


def _telling(tests: Sequence[Dependence], after: Sequence[Dependence], channel: str) -> Dependence | None:
    """The sure test of a channel of which the effects took away most, whose variable can be an axis.

    A product is taken only where nothing else comes near.
    """
    stays = {(d.channel, d.variable): d.gain for d in after}
    own = [d for d in tests if d.channel == channel and d.variable != "run" and d.everywhere]
    plain = [d for d in own if is_plain(d.variable)]

    def order(d: Dependence) -> tuple[float, float]:
        return max(d.p * len(tests), _SURE), stays.get((channel, d.variable), 0.0) - d.excess

    first, product = (min(some, key=order, default=None) for some in (plain, own))
    if first is None or product is None:
        return product
    alone = first.p * len(tests) > _PLAIN and product.p * len(tests) < _PRODUCT
    return product if alone else first


def _axis(
    seen: Rates, regression: Regression, variables: Regressors, d: Dependence
) -> tuple[str, str, Array] | None:
    """Name, unit and values of a variable for a horizontal axis."""
    if is_plain(d.variable):
        name = d.variable
        return (
            name,
            seen.value_units.get(name, ""),
            seen.values[name],
        )
    if factors(d.variable) is None:
        return "number of the run", "", seen.run.astype(np.float64)
    pair = product_of(regression, seen.names.index(d.channel), d.variable, variables)
    first, _, second = pair.partition(" * ")
    units = [u for u in (seen.value_units.get(v, "1") for v in (first, second)) if u not in ("", "1")]
    return pair, " ".join(units), seen.values[first] * seen.values[second]


def _cloud(x: Array, y: Array, block: NDArray[np.int64]) -> Cloud:
    b = bins(x, y, block)
    return Cloud(x, y, b.centre, b.mean, b.error)


def _course(t: Array, y: Array, rows: NDArray[np.bool_]) -> Cloud:
    """The course in time of one run, without intervals."""
    x, y = t[rows], y[rows]
    some = np.linspace(0, max(len(x) - 1, 0), min(len(x), _COURSE)).round().astype(int)
    return Cloud(x, y, x[some], y[some], np.zeros(len(some)))


def _spectrum(outcome: Outcome, channel: str) -> ResidualSpectrum:
    """Amplitude densities [unit/sqrt(Hz)] from mean powers per step: S dt / dt^2, both sides of the band."""
    regression = outcome.final.regression
    number = regression.physics.names.index(channel)
    dt = regression.physics.steps.dt
    curves = (
        {"before": outcome.declared.regression, "after": regression}
        if outcome.found
        else {"residual": regression}
    )
    amplitudes = {}
    for name, r in curves.items():
        frequency, power = spectrum(r, number)
        amplitudes[name] = np.sqrt(2.0 * power[1:] / dt)
    push, sensor = white_parts(regression, number)
    floor = push + 4.0 * np.sin(np.pi * frequency[1:] * dt) ** 2 * sensor
    amplitudes["floor"] = np.sqrt(2.0 * floor / dt)
    return ResidualSpectrum(channel, per_second(regression.physics.units[number]), frequency[1:], amplitudes)


def _held_out(errors: Mapping[str, Any]) -> Figure:
    left, gain = errors["residual"], errors["one_step"]["channels"]
    ratios, nats = {}, {}
    for name, c in left.items():
        per = 1.0 / c["before"] if c["before"] > 0 else 0.0
        low, high = (None if c[k] is None else 1.0 + per * c[k] for k in ("low_90", "high_90"))
        ratios[name] = (c["ratio"], low, high)
        nats[name] = (gain[name]["nats"], gain[name]["low_90"], gain[name]["high_90"])
    return before_after(
        ratios, nats, title=f"What was found, on {errors['measured_on']}: residual, and one-step predictions"
    )


def _errors(errors: Mapping[str, Any]) -> Figure:
    horizons = errors["horizons_s"]

    def curves(table: Mapping[str, Mapping[str, float | None]]) -> dict[str, list[float | None]]:
        return {name: [row[f"{h:g}"] for h in horizons] for name, row in table.items()}

    return errors_before_after(
        horizons,
        curves(errors["before"]),
        curves(errors["after"]),
        curves(errors["difference"]["low_90"]),
        curves(errors["difference"]["high_90"]),
        errors["units"],
        title=f"Open-loop, inputs replayed from the log: error on {errors['measured_on']} (rms)",
    )
