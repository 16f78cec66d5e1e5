"""A public measured set with its protocol: what files it needs, how it is scored, and what others reached on it.

No data and no code of a set is in this package; its files are fetched by the user, from the repository that is named.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from nsde_benchmarks.public.files import Work
from nsde_torch.arrays import Array


@dataclass(frozen=True)
class BenchmarkMetric:
    """One number of a protocol.

    Args:
        key: What it is called in tables and files.
        unit: Its unit; empty of a ratio.
        higher_is_better: Whether more is better, as of R2.
        digits: Decimals in tables.
    """

    key: str
    unit: str
    higher_is_better: bool = False
    digits: int = 3


@dataclass(frozen=True)
class PublishedRow:
    """What others reached.

    Args:
        name: The method.
        values: Value by key of the metric; those that were not published are left out.
        source: Repository and file, or paper, that states them.
        note: What has to be known of them: another split, a bound.
        comparable: Whether they are of the same data, so that ours may be divided by them.
    """

    name: str
    values: Mapping[str, float]
    source: str
    note: str = ""
    comparable: bool = True


@dataclass(frozen=True)
class Trace:
    """A curve of the picture: measured and simulated over time.

    Args:
        title: What it shows.
        label: Quantity and unit.
        t: Times (n,) [s].
        measured: (n,).
        simulated: (n,).
    """

    title: str
    label: str
    t: Array
    measured: Array
    simulated: Array


@dataclass(frozen=True)
class BenchmarkOutcome:
    """What a run of a benchmark found.

    Args:
        rows: Our models, in order: name -> value by key of the metric.
        effects: Names of the physical terms that were found missing in the declared physics.
        parameters: Value and unit by name.
        sentences: What was found, and what was not, in words.
        traces: Curves for the picture.
        details: Further plain values for `benchmark.json`.
    """

    rows: Mapping[str, Mapping[str, float]]
    effects: Sequence[str]
    parameters: Mapping[str, Any]
    sentences: Sequence[str]
    traces: Sequence[Trace]
    details: Mapping[str, Any] = field(default_factory=dict)


class PublicBenchmark(ABC):
    """One set.

    Attributes:
        name: What it is called on the command line.
        title: The machine, in a few words.
        repository: `owner/name` of the public repository with the files.
        files: What of it is needed, relative to the folder that the user names.
        protocol: Split and score, in one or two sentences.
        metrics: The numbers of the protocol.
        published: Rows of others.
        minutes: About how long it takes on one core.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    repository: ClassVar[str]
    files: ClassVar[tuple[str, ...]]
    protocol: ClassVar[str]
    metrics: ClassVar[tuple[BenchmarkMetric, ...]]
    published: ClassVar[tuple[PublishedRow, ...]]
    minutes: ClassVar[float]

    @abstractmethod
    def paths(self, folder: Path) -> list[Path]:
        """The files of the set below a folder.

        Raises:
            DataError: one is missing, or is not what it should be.
        """

    @abstractmethod
    def run(self, paths: Sequence[Path], work: Work) -> BenchmarkOutcome:
        """Read, identify, simulate and score.

        Args:
            paths: What `paths` returned.
            work: Progress, and results of stages that are kept.

        Raises:
            DataError: a file is damaged, or of another set.
        """
