"""The jobs of a sweep as its folders record them: overrides, status, and the numbers that they ended in."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from nsde_torch.plain_yaml import read_yaml

DONE, FAILED, UNFINISHED = "done", "failed", "unfinished"
_SCALE = ("system", "model", "loss")
_RESULTS = ("metrics.json", "policy.json")


@dataclass(frozen=True)
class SweepJob:
    """One job of a sweep."""

    folder: Path
    overrides: dict[str, str]  # what was set for it, by key
    status: str  # `done`, `failed` or `unfinished` (running, killed, or never started its work)
    reason: str = ""  # why it failed, one line
    # every number of its `metrics.json` (of a policy, `policy.json`), by dotted path
    metrics: dict[str, float] = field(default_factory=dict)
    scale: str = ""  # system, model and loss; validation scores of different ones do not compare


@dataclass(frozen=True)
class Group:
    """Jobs that differ in nothing but the seed, and what their numbers are together."""

    label: str
    jobs: tuple[SweepJob, ...]

    @property
    def scale(self) -> str:
        """System, model and loss of the jobs."""
        return self.jobs[0].scale

    def values(self, metric: str) -> list[float]:
        """The finite values of one metric over the jobs."""
        found = (job.metrics.get(metric, math.nan) for job in self.jobs)
        return [value for value in found if math.isfinite(value)]

    def mean(self, metric: str) -> float:
        """Mean over the seeds; not a number if no job has the metric."""
        values = self.values(metric)
        return fmean(values) if values else math.nan

    def spread(self, metric: str) -> float:
        """Sample standard deviation over the seeds; not a number for a single job."""
        values = self.values(metric)
        return stdev(values) if len(values) > 1 else math.nan


def read_jobs(sweep_dir: Path) -> list[SweepJob]:
    """Every job below a folder, in the order of their numbers."""
    records = sweep_dir.glob("**/.hydra/overrides.yaml")
    return sorted((_read_job(record.parent.parent) for record in records), key=_number)


def grouped(jobs: Sequence[SweepJob]) -> list[Group]:
    """Finished jobs together with those that differ in the seed alone; labels name only what varies."""
    varying = {
        key
        for job in jobs
        for key in job.overrides
        if len({other.overrides.get(key) for other in jobs}) > 1 and key != "seed"
    }
    members: dict[tuple[str, str], list[SweepJob]] = {}
    for job in jobs:
        if job.status == DONE:
            members.setdefault((job.scale, label(job, varying)), []).append(job)
    return [Group(name, tuple(group)) for (_, name), group in members.items()]


def label(job: SweepJob, keys: set[str]) -> str:
    """The overrides of a job that are worth naming."""
    return " ".join(f"{key}={value}" for key, value in job.overrides.items() if key in keys) or "all alike"


def numbers(content: Any, prefix: str = "") -> Iterator[tuple[str, float]]:
    """Every number of nested mappings and lists with its dotted path."""
    if isinstance(content, bool):
        return
    if isinstance(content, (int, float)):
        yield prefix, float(content)
    elif isinstance(content, Mapping):
        for name, value in content.items():
            yield from numbers(value, f"{prefix}.{name}" if prefix else str(name))
    elif isinstance(content, list):
        for index, value in enumerate(content):
            yield from numbers(value, f"{prefix}.{index}")


def _read_job(folder: Path) -> SweepJob:
    listed = read_yaml(folder / ".hydra" / "overrides.yaml") or []
    overrides = {key.lstrip("+"): value for key, _, value in (str(word).partition("=") for word in listed)}
    if (folder / "failed.json").is_file():
        return SweepJob(folder, overrides, FAILED, reason=_reason(folder / "failed.json"))
    metrics = next((folder / name for name in _RESULTS if (folder / name).is_file()), None)
    if metrics is None:
        return SweepJob(folder, overrides, UNFINISHED)
    try:
        content = json.loads(metrics.read_text(encoding="utf-8"))
    except json.JSONDecodeError:  # cut short: the process died while it wrote
        return SweepJob(folder, overrides, UNFINISHED)
    scale = " ".join(f"{key}={content[key]}" for key in _SCALE if isinstance(content.get(key), str))
    metrics_of = dict(numbers(content))
    spread = [value for name, value in metrics_of.items() if name.startswith("test.spread.")]
    if spread and not any(spread):  # one path: no interval, which is not one that holds nothing
        metrics_of = {name: v for name, v in metrics_of.items() if not name.startswith("test.coverage")}
    return SweepJob(folder, overrides, DONE, metrics=metrics_of, scale=scale)


def _reason(path: Path) -> str:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return " ".join(f"{content['error']}: {content['message']}".split())
    except (json.JSONDecodeError, KeyError, TypeError):
        return f"{path.name} is damaged"


def _number(job: SweepJob) -> tuple[int, str]:
    start = job.folder.name.split("_")[0]
    return (int(start) if start.isdigit() else 10**9, str(job.folder))
