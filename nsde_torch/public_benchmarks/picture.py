"""The picture of a benchmark: measured and simulated over time, and the error between them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from nsde_torch.plots.style import BLACK, VERMILLION, key, panels, save, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from nsde_torch.public_benchmarks.benchmark import BenchmarkOutcome, PublicBenchmark


def picture(benchmark: PublicBenchmark, outcome: BenchmarkOutcome, path: Path) -> None:
    """Draw the traces of a run into a file."""
    save(_figure(benchmark, outcome), path)


@styled
def _figure(benchmark: PublicBenchmark, outcome: BenchmarkOutcome) -> Figure:
    last = list(outcome.rows)[-1]
    figure, axes = panels(
        len(outcome.traces), 2, height=2.3 * len(outcome.traces) + 0.8, title=f"{benchmark.title}: {last}"
    )
    for row, trace in zip(axes.reshape(-1, 2), outcome.traces, strict=True):
        row[0].plot(trace.t, trace.measured, color=BLACK, linewidth=0.8, label="measured")
        row[0].plot(
            trace.t, trace.simulated, color=VERMILLION, linewidth=0.8, linestyle="--", label="simulated"
        )
        row[0].set_title(trace.title)
        row[0].set_ylabel(trace.label)
        row[1].plot(trace.t, trace.simulated - trace.measured, color=VERMILLION, linewidth=0.8)
        row[1].set_title("simulated minus measured")
        for ax in row:
            ax.set_xlabel("time [s]")
    key(figure, axes[0, 0])
    return figure
