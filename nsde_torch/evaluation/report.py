"""What a person reads at the end of a training: tables as text."""

from collections.abc import Mapping, Sequence
from math import floor, inf, log10
from typing import Any

from nsde_torch.aligned import aligned

REPLAYED = "rms error, inputs replayed"
"""Head of a table of errors whose inputs are the log's own: in a closed loop they answer what disturbed."""
BASELINE_NAMES = {"constant_velocity": "constant velocity", "hold": "hold"}
NO_INTERVALS = "the model is deterministic: it has no intervals"
SHOWN_LEVELS = ("0.5", "0.9", "0.95")


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Rows in aligned columns, the first left, the others right."""
    rule = ["-" * max(map(len, column)) for column in zip(head, *rows, strict=True)]
    return "\n".join(aligned([head, rule, *rows]))


def number(value: float, width: float = 0.0) -> str:
    """Three significant digits, without an exponent where that is readable.

    Of a value with an interval of that width, the digits are those that two digits of half of it have, so that the
    value and the ends end at one place.
    """
    digits = 3
    if 0 < width < inf:
        place = floor(log10(width / 2)) - 1
        value = round(value, -place)
        digits = min(max(floor(log10(abs(value))) - place + 1, 1), 7) if value else 1
        if value and 1e-4 <= abs(value) < 1e5:
            return f"{value:.{min(max(-place, 0), 9)}f}"
    if value == 0:
        return "0"
    return f"{value:.{digits}g}" if 1e-4 <= abs(value) < 1e5 else f"{value:.{digits - 1}e}"


def listed(names: Sequence[str]) -> str:
    """Names of runs; of more than four the first and the last."""
    if len(names) > 4:
        return f"{names[0]} ... {names[-1]} ({len(names)} runs)"
    return ", ".join(names) or "nothing"


def between_ends(ends: Sequence[float]) -> str:
    """An interval, both ends to one place."""
    return " to ".join(number(end, ends[1] - ends[0]) for end in ends)


def parameter_table(parameters: Mapping[str, Mapping[str, Any]]) -> str:
    """Declared parameters with 90 % half-widths."""
    rows = []
    for name, p in parameters.items():
        pairs = zip(p["value"], p["half_width_90"], strict=True)
        none = " (no interval)" if "note" in p else " (not shown by the data)"
        cells = [
            number(v, 2 * (h or 0)) + (none if h is None else f" +- {number(h, 2 * h)}") for v, h in pairs
        ]
        rows.append([name, "  ".join(cells), p["unit"]])
    notes = dict.fromkeys(str(p["note"]) for p in parameters.values() if "note" in p)
    return "\n".join([table(["declared parameter", "value +- 90 %", "unit"], rows), *notes])


def error_table(test: Mapping[str, Any]) -> str:
    """Held-out errors of the model and the baselines at each horizon."""
    horizons = [f"{h:g}" for h in test["horizons_s"]]
    rows = [
        [f"{group} [{unit}]", name, *(number(test["errors"][key][group][h]) for h in horizons)]
        for group, unit in test["units"].items()
        for key, name in {"model": "model", **BASELINE_NAMES}.items()
    ]
    return table([what_error(test), "", *(f"{h} s" for h in horizons)], rows)


def coverage_table(test: Mapping[str, Any]) -> str:
    """Share of measurements inside the intervals, and the CRPS, at each horizon."""
    horizons = [f"{h:g}" for h in test["horizons_s"]]
    rows = []
    for group, unit in test["units"].items():
        for level in SHOWN_LEVELS:
            values = test["coverage"][level][group]
            rows.append([group, f"{float(level):.0%} interval", *(f"{values[h]:.0%}" for h in horizons)])
        rows.append([group, f"CRPS [{unit}]", *(number(test["crps"][group][h]) for h in horizons)])
    return table(["held out", "", *(f"{h} s" for h in horizons)], rows)


def short_table(test: Mapping[str, Any], *, noisy: bool) -> str:
    """Held-out errors of the model at each horizon, and how many measurements lie inside its 90 % intervals."""
    horizons = [f"{h:g}" for h in test["horizons_s"]]
    rows = []
    for group, unit in test["units"].items():
        errors, inside = test["errors"]["model"][group], test["coverage"]["0.9"][group].values()
        share = f"{sum(inside) / len(inside):.0%}" if noisy else "no intervals"
        rows.append([f"{group} [{unit}]", *(number(errors[h]) for h in horizons), share])
    return table([what_error(test), *(f"{h} s" for h in horizons), "in 90% interval"], rows)


def what_error(test: Mapping[str, Any]) -> str:
    """Head of a table of errors: whether the log's own inputs, or interventions, drove the predictions."""
    return "rms error" if test.get("inputs") == "interventional" else REPLAYED


def lookahead(smoothing: float, reach: float) -> str:
    """What the inputs of a rollout see of the future, in words; empty if nothing.

    That is by the width of the centred average that smoothed them, and the reach of the model's filter to a side [s].
    """
    parts, ahead = [], smoothing / 2
    if smoothing:
        text = f"inputs were smoothed by a centred {smoothing:.2g} s average"
        parts.append(f"{text}, so they see {ahead:.2g} s ahead")
    if reach:
        which = "the filter that restores them" if smoothing else "the model's filter"
        parts.append(f"{which} draws on commands up to {ahead + reach:.2g} s ahead")
    return "; ".join(parts)
