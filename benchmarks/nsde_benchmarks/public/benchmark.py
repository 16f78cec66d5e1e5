"""A public measured set with its protocol: what files it needs, how it is scored, and what others reached on it.

No data and no code of a set is in this package; its files are fetched by the user, from the repository that is named.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from nsde_torch.arrays import Array

from .files import Work, found


@dataclass(frozen=True)
class BenchmarkMetric:
    """One number of a protocol."""

    key: str  # what it is called in tables and files
    unit: str  # its unit; empty of a ratio
    higher_is_better: bool = False  # whether more is better, as of R2
    digits: int = 3  # decimals in tables


@dataclass(frozen=True)
class PublishedRow:
    """What others reached."""

    name: str
    values: Mapping[str, float]  # value by key of the metric; those that were not published are left out
    source: str  # repository and file, or paper, that states them
    note: str = ""  # what has to be known of them: another split, a bound
    comparable: bool = True  # whether they are of the same data, so that ours may be divided by them


@dataclass(frozen=True)
class Trace:
    """A curve of the picture: measured and simulated over time."""

    title: str  # what it shows
    label: str  # quantity and unit
    t: Array  # times (n,) [s]
    measured: Array  # (n,)
    simulated: Array  # (n,)


@dataclass(frozen=True)
class BenchmarkOutcome:
    """What a run of a benchmark found."""

    rows: Mapping[str, Mapping[str, float]]  # our models, in order: name -> value by key of the metric
    effects: Sequence[str]  # names of the physical terms that were found missing in the declared physics
    parameters: Mapping[str, Any]  # value and unit by name
    sentences: Sequence[str]  # what was found, and what was not, in words
    traces: Sequence[Trace]  # curves for the picture
    details: Mapping[str, Any] = field(default_factory=dict)  # further plain values for `benchmark.json`


class PublicBenchmark(ABC):
    """One set."""

    name: ClassVar[str]  # what it is called on the command line
    title: ClassVar[str]  # the machine, in a few words
    repository: ClassVar[str]  # `owner/name` of the public repository with the files
    files: ClassVar[tuple[str, ...]]  # what of it is needed, relative to the folder that the user names
    protocol: ClassVar[str]  # split and score, in one or two sentences
    metrics: ClassVar[tuple[BenchmarkMetric, ...]]
    published: ClassVar[tuple[PublishedRow, ...]]
    minutes: ClassVar[float]  # about how long it takes on one core

    def paths(self, folder: Path) -> list[Path]:
        """The files of the set below a folder; DataError where one is missing, or is not what it should be."""
        return found(folder, self.files, repository=self.repository)

    @abstractmethod
    def run(self, paths: Sequence[Path], work: Work) -> BenchmarkOutcome:
        """Read `paths`, identify, simulate and score; DataError where a file is damaged, or of another set."""
