"""`report.html`: one self-contained page that a field engineer reads in two minutes."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nsde_torch.diagnosis.ceiling import CAPTION, ceiling_html
from nsde_torch.diagnosis.feedback_text import feedback_html
from nsde_torch.diagnosis.pictures import EFFECT, pictures, save_pictures
from nsde_torch.diagnosis.rehearsal_text import rehearsal_html
from nsde_torch.diagnosis.text import (
    OPEN_LOOP,
    between,
    chance,
    heading,
    in_order,
    interval,
    interval_head,
    least_squares,
    measured,
    notices,
    placed,
    signed,
    small_ones,
    unfinished,
    unseen,
    valued,
    without_it,
)
from nsde_torch.evaluation.report import number
from nsde_torch.sysid.standing import in_words
from nsde_torch.whole_files import write_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from nsde_torch.diagnosis.result import Diagnosis

_DPI = 100  # of the pictures
_RANKED, _DECIDED = 8, 6  # candidates and tests of structure that are listed
_LEFT = ("measured", "before", "after", "floor")

_STYLE = """
:root { color-scheme: light }
body { font: 16px/1.45 system-ui, sans-serif; color: #1a1a1a; background: #fff; max-width: 62rem; margin: 0 auto;
  padding: 1rem }
h1 { font-size: 1.3rem; margin: 0 0 .6rem } h2 { font-size: 1.1rem; margin: 2rem 0 .5rem }
.verdict { border-left: .5rem solid; padding: .6rem 1rem; background: #f6f6f6 }
.verdict b { display: block; font-size: 1.15rem } .effect_found { border-color: #0072B2 }
.no_effect { border-color: #009E73 } .unexplained { border-color: #D55E00 }
.undecided { border-color: #777 }
.finding { border: 1px solid #ddd; border-radius: .4rem; padding: .7rem 1rem; margin: .8rem 0 }
.finding h3 { font-size: 1rem; margin: 0 } .finding p { margin: .3rem 0 }
.lead { background: #fdf0d5; border-radius: .3rem; padding: 0 .4rem; font-weight: normal; font-size: .85rem }
figure { margin: 1rem 0; overflow-x: auto } figure img { width: 100%; min-width: 38rem; height: auto }
figcaption, .small { color: #555; font-size: .88rem }
.wide { overflow-x: auto } table { border-collapse: collapse; font-size: .9rem; font-variant-numeric: tabular-nums }
th, td { padding: .2rem .7rem .2rem 0; text-align: right; white-space: nowrap; border-bottom: 1px solid #e5e5e5 }
th:first-child, td:first-child { text-align: left } th { font-weight: 600; color: #555 }
details { margin: .6rem 0 } summary { cursor: pointer } ul { padding-left: 1.2rem } code { font-size: .92em }
"""

_CAPTIONS = {
    "residual": "Measured rate less that of the physics: means over {width:.2g} s (points), and their means with 90 % "
    "intervals. A good model lies on zero.",
    "unexplained": "What is left after everything that was found: points are means over {width:.2g} s.",
    "held_out": "Everything is fitted to the other runs and measured on {where}, step by step: what an effect "
    "brings shows here in a closed loop too. Left: the residual of mean rates, after over before. Right: the gain in "
    "log-likelihood of one-step predictions. Bars: 90 % intervals.",
    "errors": "Predictions from measured states, {how}, on {where}. Where a controller answers disturbances, so do "
    "these inputs: the errors tell how well this log is foretold, and not how right the effects are. Bars: 90 % "
    "interval of the difference.",
    "flexible": CAPTION,
    "spectrum": "Above the dashed floor more is left than white noise: gusts that last, or physics.",
}


def write_report(path: Path, found: Diagnosis, content: Mapping[str, Any]) -> None:
    """Write the page, and its pictures into `plots` beside it.

    Args:
        path: The page.
        found: The diagnosis.
        content: Its content, as `diagnosis.json` has it.
    """
    figures = pictures(found, content)
    save_pictures(figures, path.parent / "plots")
    write_whole(path, page(content, figures, width=found.width))


def page(content: Mapping[str, Any], figures: Mapping[str, Figure], *, width: float) -> str:
    """The page as HTML.

    Args:
        content: As `diagnosis.json` has it.
        figures: By name, as `pictures` makes them.
        width: Length of the means in the pictures [s].
    """
    data, errors = content["data"], content["errors"]
    told = {"width": width, "where": errors["measured_on"], "how": OPEN_LOOP}
    captions = {k: v.format(**told) for k, v in _CAPTIONS.items()}
    shown = {k: _figure(f, k, captions.get(k, _caption(k, width))) for k, f in figures.items()}
    parts = [
        f"<h1>Diagnosis of {escape(data['system'])}: {len(data['runs'])} runs, {data['duration_s']:.0f} s</h1>",
        *(f'<p class="finding"><b>Not finished.</b> {escape(said)}</p>' for said in unfinished(content)),
        f'<div class="verdict {content["verdict"]}"><b>{heading(content)}</b>'
        f"{escape(content['summary'])}{_gain(errors)}</div>",
        *(f'<p class="finding"><b>{title}.</b> {escape(said)}</p>' for title, said in notices(content)),
        *(
            _finding(f, content, shown.get(f"{EFFECT}{f['name']}", ""))
            for f in in_order(content)
            if f["kind"] != "recording"
        ),
        _small_ones(content),
        _recording(content),
        *(f"<p>{escape(a['sentence'])} This is {escape(a['reason'])}.</p>" for a in content["aside"]),
        shown.get("residual", ""),
        _unexplained(content, shown.get("unexplained", "")),
        ceiling_html(content, shown.get("flexible", ""), _table),
        shown.get("held_out", ""),
        _held_out(errors),
        shown.get("errors", ""),
        _errors(errors) if measured(content) else "",
        feedback_html(content),
        "<h2>What is left over, channel by channel</h2>",
        _residuals(content["residual"]),
        *(f"<p>{escape(sentence)}</p>" for sentence in in_words(data["standing_share"])),
        shown.get("spectrum", ""),
        _not_shown(content["not_shown"]),
        rehearsal_html(content, _table),
        _ranking(content["ranking"]),
        _declared(content),
        _structure(content),
        _data(content),
    ]
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>Diagnosis of {escape(data['system'])}</title><style>{_STYLE}</style></head><body>\n"
        + "\n".join(part for part in parts if part)
        + "\n</body></html>\n"
    )


def _caption(name: str, width: float) -> str:
    """The caption of the picture of one effect."""
    if not name.startswith(EFFECT):
        return ""
    return (
        f"Measured rate less that of the physics, means over {width:.2g} s: with everything that was found, and "
        "with the term of this effect added back. What it explains is the difference; a good model lies on zero."
    )


def _figure(figure: Figure, name: str, caption: str) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI)
    source = f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"
    image = f'<img alt="{escape(figure.get_suptitle())}" src="{source}">'
    return f"<figure>{image}<figcaption>{escape(caption)}</figcaption></figure>"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    body = "".join(f"<tr>{''.join(f'<td>{escape(c)}</td>' for c in row)}</tr>" for row in rows)
    return f'<div class="wide"><table><tr>{"".join(f"<th>{escape(h)}</th>" for h in head)}</tr>{body}</table></div>'


def _folded(title: str, body: str) -> str:
    return f"<details><summary>{escape(title)}</summary>{body}</details>"


def _gain(errors: Mapping[str, Any]) -> str:
    """The sentence under the verdict on what runs left out say."""
    gain = errors["one_step"]
    if gain is None or errors["before"] == errors["after"]:
        return ""
    parts = [
        f"{name} {number(left['before'])} to {number(left['after'])} {_unit(left['unit'])}"
        for name, left in errors["residual"].items()
        if abs(left["ratio"] - 1.0) > 0.02
    ]
    told = f"<br>Residual on {escape(errors['measured_on'])}: {escape('; '.join(parts))}." if parts else ""
    more = f" nats ({escape(between(gain))})" if gain["low_90"] is not None else " nats"
    return f"{told}<br>Log-likelihood of one-step predictions: {escape(signed(gain['nats']))}{more}."


def _held_out(errors: Mapping[str, Any]) -> str:
    """Residual and log-likelihood of runs left out by channel."""
    gain = errors["one_step"]
    if gain is None or errors["before"] == errors["after"]:
        return ""
    rows = []
    for name, more in gain["channels"].items():
        left = errors["residual"].get(name)
        cells = ["-"] * 4
        if left is not None:
            cells = [
                *(number(left[k]) for k in ("before", "after")),
                f"×{left['ratio']:.2g}",
                _unit(left["unit"]),
            ]
        rows.append([name, *cells, f"{signed(more['nats'])} ({between(more)})"])
    rows.append(["all", "", "", "", "", f"{signed(gain['nats'])} ({between(gain)})"])
    head = ["rate of", "left before", "left after", "ratio", "unit", "log-likelihood [nat] (90 % interval)"]
    return f"<h2>Before and after, on {escape(errors['measured_on'])}</h2>{_table(head, rows)}"


def _small_ones(content: Mapping[str, Any]) -> str:
    """Effects that matter little in one line, which opens to their cards."""
    rest = {r["effect"] for r in content["told"]["rest"]}
    cards = "".join(_finding(f, content) for f in content["findings"] if f["name"] in rest)
    line = small_ones(content) if rest else ""
    return _folded(f"{line[:1].upper()}{line[1:]}.", cards) if rest else ""


def _recording(content: Mapping[str, Any]) -> str:
    """Faults of the recording chain, in one card."""
    faults = [f for f in content["findings"] if f["kind"] == "recording"]
    if len(faults) < 2:
        return "".join(_finding(f, content) for f in faults)
    return "<h2>The recording</h2>" + "".join(_finding(f, content) for f in faults)


def _finding(finding: Mapping[str, Any], content: Mapping[str, Any], figure: str = "") -> str:
    reason = escape(finding["lead_reason"] or "")
    lead = f' <span class="lead">a lead: {reason}</span>' if finding["lead"] else ""
    text = f"<h3><code>{escape(finding['name'])}</code>{lead}</h3><p>{escape(finding['sentence'])}</p>"
    if finding["kind"] == "formula":
        looks = f" It looks like {escape(finding['looks_like'])}." if finding["looks_like"] else ""
        text += f"<p><code>{escape(finding['law'])}</code> [{_unit(finding['unit'])}, SI].{looks}<br>"
        text += f'<span class="small">LaTeX: <code>{escape(finding["latex"])}</code></span></p>'
    worth = without_it(finding, content)
    text += f"<p>{escape(worth[:1].upper())}{escape(worth[1:])}.</p>{figure}" if worth else figure
    own = {k: p for k, p in content["parameters"].items() if k.startswith(f"{finding['name']}.")}
    if own:
        rows = [_row(content, k.partition(".")[2], k, p) for k, p in own.items()]
        text += _table(["parameter", "value", interval_head(content), *least_squares(content)], rows)
    if finding["p"] is not None:
        text += f'<p class="small">Chance of this if it were not there: p {escape(chance(finding["p"]))}'
        text += (
            ", corrected for the number of effects tried.</p>" if finding["kind"] != "recording" else ".</p>"
        )
    own_gain = finding["held_out"]
    if own_gain is not None:
        ratios = ", ".join(f"{k} ×{v:.2g}" for k, v in own_gain["residual_ratio"].items())
        where = escape(content["errors"]["measured_on"])
        text += f'<p class="small">On {where}, beside everything else: log-likelihood '
        text += (
            f"{signed(own_gain['nats'])} nats ({escape(between(own_gain))}); residual {escape(ratios)}.</p>"
        )
    for tie in content["ties"]:
        if tie["effects"][0] == finding["name"]:
            others = ", ".join(f"<code>{escape(e)}</code>" for e in tie["effects"][1:])
            text += f"<p><b>Tie.</b> These data cannot tell it from {others}."
            text += f" To tell: {escape(tie['experiment'])}.</p>" if tie["experiment"] else "</p>"
    return f'<div class="finding">{text}</div>'


def _unexplained(content: Mapping[str, Any], figure: str) -> str:
    if not content["unexplained"]:
        return ""
    lines = "".join(f"<li>{escape(s['sentence'])}</li>" for s in content["unexplained"])
    text = f"<h2>What no effect of the catalogue explains</h2><ul>{lines}</ul>{figure}"
    if content["between_runs"] is not None:
        between = content["between_runs"]
        text += (
            f"<p>{escape(between['sentence'])} To take it out: <code>{escape(between['remedy'])}</code></p>"
        )
    if content["in_run"] is not None:
        sentence = escape(content["in_run"]["sentence"])
        text += f'<p><span class="lead">a lead, unverified</span> {sentence}</p>'
    return text


def _errors(errors: Mapping[str, Any]) -> str:
    horizons = [f"{h:g}" for h in errors["horizons_s"]]
    if not horizons:
        return "<p>No run is long enough to measure errors on.</p>"
    rows, same = [], errors["before"] == errors["after"]
    for name, before in errors["before"].items():
        after, ratio = errors["after"][name], errors["ratio"][name]
        cells = [f"{_value(before[h])} → {_value(after[h])} (×{_value(ratio[h], 2)})" for h in horizons]
        if same:
            cells = [_value(before[h]) for h in horizons]
        rows.append([f"{name} [{_unit(errors['units'][name])}]", *cells])
    how = f"{OPEN_LOOP[:1].upper()}{OPEN_LOOP[1:]}"
    title = f"{how}: errors on {errors['measured_on']}{'' if same else ', before → after'}"
    title += f" ({errors['starts']} starts)"
    return _folded(title, _table(["rms error", *(f"{h} s" for h in horizons)], rows))


def _residuals(residual: Mapping[str, Any]) -> str:
    rows = [
        [name, *(number(c[k]) for k in _LEFT), f"{c['explained']:.0%}", _unit(c["unit"])]
        for name, c in residual.items()
    ]
    head = ["rate of", "measured", "left before", "left after", "noise floor", "explained", "unit"]
    return _table(head, rows)


def _not_shown(entries: Sequence[Mapping[str, Any]]) -> str:
    if not entries:
        return ""
    how = {n["effect"]: escape(n["experiment"]) for n in entries}
    to_show = "<li>{}<br><span class='small'>To show it: {}.</span></li>"
    lines = "".join(to_show.format(escape(line), how[line.partition(":")[0]]) for line in unseen(entries))
    return (
        "<h2>What these data cannot show</h2><p>Not found says nothing of these: sizes below would go unnoticed.</p>"
        f"<ul>{lines}</ul>"
    )


def _ranking(ranking: Sequence[Mapping[str, Any]]) -> str:
    first = [r for r in ranking if r["round"] == 0]
    rows = [
        [
            r["effect"],
            f"{r['evidence_nats']:+.1f} ± {r['evidence_error']:.1f}",
            chance(r["p"]),
            "yes" if r["chosen"] else "",
        ]
        for r in first
        if r["p"] is not None
    ]
    rest = ", ".join(r["effect"] for r in first if r["p"] is None)
    head = ["first look", "evidence on runs left out [nat]", "p", "added"]
    text = _table(head, rows[:_RANKED]) if rows else ""
    if rest:
        text += f'<p class="small">Tried, of no use: {escape(rest)}.</p>'
    return _folded("All effects that were tried", text) if text else ""


def _declared(content: Mapping[str, Any]) -> str:
    rows = [_row(content, name, name, p) for name, p in content["declared_parameters"].items()]
    head = ["parameter", "value", interval_head(content), *least_squares(content)]
    return _folded("Declared parameters, fitted again", _table(head, rows)) if rows else ""


def _row(content: Mapping[str, Any], label: str, name: str, p: Mapping[str, Any]) -> list[str]:
    cells = [f"{valued(p)} {_unit(p['unit'])}", interval(p["interval_90"], p["bound"])]
    return [label, *cells, *least_squares(content, name)]


def _structure(content: Mapping[str, Any]) -> str:
    structure, level = content["structure"], content["levels"]["structure"]
    left = [d for d in structure["after"] if d["p"] < level]
    rows = [
        [d["channel"], placed(d), d["kind"], chance(d["p"]), f"{d['share']:.1%}"] for d in left[:_DECIDED]
    ]
    if not rows:
        text = f"<p>None of {structure['tests']['after']} tests finds a dependence (at a level of {level:g}).</p>"
    else:
        text = _table(["channel", "variable", "kind", "p", "share"], rows)
    return _folded("Structure that remains in the residual", text)


def _data(content: Mapping[str, Any]) -> str:
    data = content["data"]
    done = [*data["done"]]
    if data["clock_scale"] != 1.0:
        done.append(f"a logged second was taken for {data['clock_scale']:.4g} s")
    done += [f["sentence"] for f in content["findings"] if f["kind"] == "recording"]
    text = "".join(f"<li>{escape(line)}</li>" for line in done) or "<li>nothing amiss</li>"
    runs = ", ".join(data["runs"])
    seconds = ", ".join(f"{k} {v:.0f} s" for k, v in content["seconds"].items())
    return (
        f"<h2>Data</h2><ul>{text}</ul>"
        f'<p class="small">{escape(data["kind"])}, {1 / data["dt_s"]:.4g} Hz; runs: {escape(runs)}; fingerprint '
        f"{escape(data['fingerprint'][:12])}; alpha {content['alpha']:g}, seed {content['seed']}; took {seconds}.</p>"
    )


def _value(value: float | None, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}g}"


def _unit(unit: str) -> str:
    return "" if unit == "1" else unit.replace("s2", "s²").replace("m2", "m²")
