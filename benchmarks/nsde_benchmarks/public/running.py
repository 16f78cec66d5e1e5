"""A benchmark from its files to `benchmark.json`, a table and a picture."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nsde_torch.evaluation.report import table as aligned
from nsde_torch.lookup import class_by_name
from nsde_torch.plots.style import BLACK, VERMILLION, key, panels, save, styled

from .benchmark import BenchmarkMetric, BenchmarkOutcome, PublicBenchmark
from .files import Work, key_of
from .names import BENCHMARK_HOMES
from .output_error import silent

if TYPE_CHECKING:
    from matplotlib.figure import Figure


BENCHMARKS: dict[str, type[PublicBenchmark]] = {
    name: class_by_name(home, {}, PublicBenchmark, kind="benchmark", home="nsde_benchmarks.public.benchmark")
    for name, home in BENCHMARK_HOMES.items()
}


def benchmark_class(name: str) -> type[PublicBenchmark]:
    """Class of a set: a key of `BENCHMARKS`, or `module:Class` of the user's own; ConfigError: there is none."""
    return class_by_name(
        name, BENCHMARKS, PublicBenchmark, kind="benchmark", home="nsde_benchmarks.public.benchmark"
    )


@styled
def _figure(benchmark: PublicBenchmark, outcome: BenchmarkOutcome) -> Figure:
    last = list(outcome.rows)[-1]
    figure, axes = panels(
        len(outcome.traces), 2, height=2.3 * len(outcome.traces) + 0.8, title=f"{benchmark.title}: {last}"
    )
    for row, trace in zip(axes.reshape(-1, 2), outcome.traces, strict=True):
        thin = {"color": VERMILLION, "linewidth": 0.8}
        row[0].plot(trace.t, trace.measured, color=BLACK, linewidth=0.8, label="measured")
        row[0].plot(trace.t, trace.simulated, linestyle="--", label="simulated", **thin)
        row[0].set(title=trace.title, ylabel=trace.label, xlabel="time [s]")
        row[1].plot(trace.t, trace.simulated - trace.measured, **thin)
        row[1].set(title="simulated minus measured", xlabel="time [s]")
    key(figure, axes[0, 0])
    return figure


RESULT = "benchmark.json"
_SIDE_BY_SIDE = 4
PICTURE = "benchmark.png"
VERSION = 1
"""Raised when the stages of a set change their meaning: what was kept before is then refused."""


def run_benchmark(
    name: str,
    folder: str | Path,
    *,
    out_dir: str | Path,
    say: Callable[[str, int, int], None] = silent,
    tell: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Run a public benchmark; writes its result, and returns what `benchmark.json` holds.

    Args:
        name: Key of `BENCHMARKS`, or `module:Class` of your own.
        folder: Checkout of the repository of the set, or a folder with its files.
        out_dir: Where stages, `benchmark.json` and the picture go; what an interrupted run left there is used.

    Raises:
        ConfigError: there is no such set.
        DataError: files are missing, damaged, or of another set.
        CheckpointError: `out_dir` holds stages of other files.
    """
    benchmark = benchmark_class(name)()
    paths = benchmark.paths(Path(folder).expanduser())
    out = Path(out_dir)
    work = Work(out, key_of(benchmark.name, paths, {"version": VERSION}), say=say, tell=tell)
    outcome = benchmark.run(paths, work)
    content = content_of(benchmark, outcome, paths)
    out.mkdir(parents=True, exist_ok=True)
    text = json.dumps(content, indent=1, allow_nan=False)
    (out / RESULT).write_text(text + "\n", encoding="utf-8")
    if outcome.traces:
        save(_figure(benchmark, outcome), out / PICTURE)
    return content


def content_of(
    benchmark: PublicBenchmark, outcome: BenchmarkOutcome, paths: Sequence[Path]
) -> dict[str, Any]:
    ours = {
        name: {key: value if math.isfinite(value) else None for key, value in values.items()}
        for name, values in outcome.rows.items()
    }
    return {
        "benchmark": benchmark.name,
        "title": benchmark.title,
        "repository": benchmark.repository,
        "files": [path.name for path in paths],
        "protocol": benchmark.protocol,
        "units": {metric.key: metric.unit for metric in benchmark.metrics},
        "higher_is_better": [metric.key for metric in benchmark.metrics if metric.higher_is_better],
        "ours": ours,
        "published": [
            {"name": row.name, "values": dict(row.values), "source": row.source, "note": row.note}
            for row in benchmark.published
        ],
        "ratio_to_best_published": ratios(benchmark, outcome),
        "effects": list(outcome.effects),
        "parameters": dict(outcome.parameters),
        "found": list(outcome.sentences),
        "details": dict(outcome.details),
    }


def ratios(benchmark: PublicBenchmark, outcome: BenchmarkOutcome) -> dict[str, float]:
    """Our last row over the best comparable published value of each error; metrics that grow with quality left out."""
    last = list(outcome.rows.values())[-1]
    out = {}
    for metric in benchmark.metrics:
        comparable = [row.values for row in benchmark.published if row.comparable]
        known = [values[metric.key] for values in comparable if metric.key in values]
        if known and metric.key in last and not metric.higher_is_better and math.isfinite(last[metric.key]):
            out[metric.key] = last[metric.key] / min(known)
    return out


def table(content: Mapping[str, Any], metrics: Sequence[BenchmarkMetric]) -> list[str]:
    """Lines of a table: the published rows, then ours; four numbers side by side, the next ones below."""
    if len(metrics) > _SIDE_BY_SIDE:
        first, *rest = (
            table(content, metrics[k : k + _SIDE_BY_SIDE]) for k in range(0, len(metrics), _SIDE_BY_SIDE)
        )
        return [*first, *(line for part in rest for line in ("", *part))]
    heads = ["", *(f"{m.key} [{m.unit}]" if m.unit else m.key for m in metrics)]
    named = [
        (f"{r['name']} ({r['note']})" if r["note"] else r["name"], r["values"]) for r in content["published"]
    ]
    every = [*named, *content["ours"].items()]
    rows = [[name, *(_cell(values.get(m.key), m.digits) for m in metrics)] for name, values in every]
    head, _, *lines = aligned(heads, rows).splitlines()
    return [head, "-" * len(head), *lines]


def _cell(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def listing() -> list[str]:
    """Lines that say which sets there are, and what to fetch."""
    lines = []
    for name, cls in BENCHMARKS.items():
        lines += [
            f"{name}: {cls.title} (about {cls.minutes:g} min)",
            f"  fetch: {cls.repository}",
            f"  files: {', '.join(cls.files)}",
        ]
    return lines
