"""`nsde benchmark`: run a public measured set by its own protocol, beside the published rows.

`nsde benchmark NAME data.path=...` runs a set; without words, the command lists the sets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from nsde_torch.cli.exit_status import OK
from nsde_torch.cli.hydra_command import HydraCommand, Job
from nsde_torch.cli.keys import group, key

from .names import BENCHMARK_HOMES

if TYPE_CHECKING:
    from omegaconf import DictConfig


@dataclass
class BenchmarkData:
    """Where the files of the set are."""

    path: str = key("???", "checkout of the repository of the set, or a folder with its files", file=True)


@dataclass
class BenchmarkConfig:
    """`nsde benchmark`."""

    name: str = key("???", f"the set: {', '.join(BENCHMARK_HOMES)}, or module:Class of your own")
    threads: int = key(1, "CPU threads of torch", low=1)
    out_dir: str = key("???", "folder to write into; finished stages in it are used again", file=True)
    data: BenchmarkData = group(BenchmarkData, "its files")


class BenchmarkCommand(HydraCommand):
    """Takes the set as its first word too, and lists the sets where nothing is typed."""

    def main(self, arguments: Sequence[str]) -> int:
        if not arguments:
            from .running import listing

            print("\n".join(listing()))
            print("\nRun one with: nsde benchmark NAME data.path=FOLDER")
            return OK
        return super().main(arguments)


def _words(words: Sequence[str]) -> list[str]:
    """`emps` for `name=emps`."""
    first, *rest = words
    named = "=" not in first and not first.startswith("-")
    return [f"name={first}", *rest] if named else list(words)


COMMAND = BenchmarkCommand(
    name="benchmark",
    schema=BenchmarkConfig,
    folder="public_benchmarks/${name}",
    words=_words,
    examples=(
        ("", "which sets there are, and what to fetch"),
        ("emps data.path=sysid-neural-continuous/", "friction of a drive"),
        ("silverbox data.path=nsi-silverbox/", "a cubic spring, from positions alone"),
    ),
)


def run(config: DictConfig, job: Job) -> None:
    from nsde_torch.progress import Stages

    from .running import PICTURE, RESULT, benchmark_class, run_benchmark, table

    benchmark = benchmark_class(config.name)
    print(
        f"{benchmark.title} ({benchmark.repository}), about {benchmark.minutes:g} min\n{benchmark.protocol}"
    )
    stages = Stages()
    content = run_benchmark(config.name, config.data.path, out_dir=job.run_dir, say=stages)
    stages.close()
    print("\n" + "\n".join(table(content, benchmark.metrics)))
    for metric, ratio in content["ratio_to_best_published"].items():
        print(f"{metric}: {ratio:.2f} of the best published row")
    print("\n" + "\n".join(content["found"]))
    for name, entry in content["parameters"].items():
        interval = entry.get("interval_90")
        ends = f" ({interval[0]:.4g} to {interval[1]:.4g})" if interval else ""
        value = entry["value"]
        told = f"{value:.4g}" if isinstance(value, float) else ", ".join(f"{v:.4g}" for v in value)
        print(f"  {name} {told}{ends} {entry.get('unit', '')}".rstrip())
    print(f"\n{job.took}; wrote {job.run_dir}: {RESULT}, {PICTURE}, stages/")
