"""`nsde sweep-report`: rank the jobs of a sweep, and name those that failed and why."""

from __future__ import annotations

import argparse
import csv
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from fnmatch import fnmatch
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from nsde_torch.aligned import aligned
from nsde_torch.errors import ConfigError
from nsde_torch.plain_yaml import read_yaml
from nsde_torch.texts import rendered
from nsde_torch.whole_files import read_json

from ..exit_status import OK
from ..help import found_files
from ..hydra_command import TEXTS
from ..registry import PlainCommand

DONE, FAILED, UNFINISHED = "done", "failed", "unfinished"
_SCALE = ("system", "model", "loss")
# Ranked by the first of these that a job has; smaller is better.
SCORES = ("validation.score", "validation_score", "score")
# Shown beside the score: errors on the held-out runs; of a policy, its reward on the truth.
# A letter before .1, not 0.1.
COLUMNS = ("test.errors.model.*[a-z].1", "test.coverage.0.9.*[a-z].1", "truth_reward.mean")


def main(arguments: Sequence[str]) -> int:
    """Print the report of a sweep and write `sweep_report.json` and `sweep_report.csv` into its folder."""
    # a folder whose name begins with a dash is no option
    words = [f"./{word}" if word.startswith("-") and Path(word).is_dir() else word for word in arguments]
    options = _parser().parse_args(words)
    folder = Path(options.dir)
    if not folder.is_dir():
        raise ConfigError(f"`{folder}` is not a folder; give the folder of a sweep, multirun/DATE/TIME.")
    jobs = read_jobs(folder)
    if not jobs:
        raise ConfigError(f"no jobs in `{folder}`; a sweep is made by `nsde train -m ...`.")
    known = list(dict.fromkeys(name for job in jobs for name in job.metrics))
    if options.by and options.by not in known:
        names = ", ".join(sorted(known)) or "none at all"
        raise ConfigError(f"no job has the metric `{options.by}`; there are: {names}.")
    score = options.by or next((name for name in SCORES if name in known), SCORES[0])
    patterns = options.columns or COLUMNS
    columns = [name for name in known if name != score and any(fnmatch(name, p) for p in patterns)]
    # groups whose scores compare: all of them by a number that the user names
    scales: dict[str, list[Group]] = {}
    for group in sorted(grouped(jobs), key=lambda group: (_place(group.mean(score)), group.label)):
        scales.setdefault("" if options.by else group.jobs[0].scale, []).append(group)
    print(report(jobs, scales, score, columns))
    _write_json(folder / "sweep_report.json", jobs, scales, score, columns)
    _write_csv(folder / "sweep_report.csv", jobs)
    return OK


def complete(words: Sequence[str]) -> list[str]:
    """Completions of the last word: options and folders."""
    current = words[-1] if words else ""
    if current.startswith("-"):
        return [option for option in ("--by", "--columns", "--help") if option.startswith(current)]
    return found_files(current)


def _place(value: float | None) -> float:
    """By which scores are ranked: what has none comes last."""
    return math.inf if value is None or math.isnan(value) else value


def report(jobs: Sequence[SweepJob], scales: Scales, score: str, columns: Sequence[str]) -> str:
    rankings = []
    for scale, alike in scales.items():
        shown = [c for c in columns if any(c in g.jobs[0].metrics for g in alike)]
        best = min(alike[0].jobs, key=lambda job: _place(job.metrics.get(score)))
        rankings.append((scale, _ranking(alike, score, shown), best.folder))
    of = {status: [job for job in jobs if job.status == status] for status in (FAILED, UNFINISHED)}
    done = len(jobs) - len(of[FAILED]) - len(of[UNFINISHED])
    return rendered(TEXTS, "sweep.txt", count=len(jobs), done=done, scales=rankings, score=score, **of)


def _ranking(groups: Sequence[Group], score: str, columns: Sequence[str]) -> list[str]:
    head = ["rank", "jobs", score, *map(_short, columns), "what"]
    rows = [
        [str(rank), str(len(group.jobs)), *(_pair(group, name) for name in (score, *columns)), group.label]
        for rank, group in enumerate(groups, start=1)
    ]
    return aligned([head, *rows], left=len(head))


def _short(name: str) -> str:
    """Heads of the usual columns as words; any other number under its path."""
    found = re.fullmatch(r"test\.(errors\.model|coverage\.0\.9)\.([a-z_]+)\.([\d.]+)", name)
    if not found:
        return name
    return f"{found[2]} {found[3]} s" if "errors" in found[1] else f"90 % holds {found[2]} {found[3]} s"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="nsde sweep-report",
        description="Rank the jobs of a sweep over their seeds, and name those that failed and why.",
    )
    parser.add_argument("dir", metavar="DIR", help="folder of the sweep")
    parser.add_argument(
        "--by", metavar="METRIC", help="rank by this number of metrics.json (smaller is better)"
    )
    parser.add_argument(
        "--columns", metavar="PATTERN", nargs="+", help="numbers of metrics.json to show, * matches anything"
    )
    return parser


def _pair(group: Group, metric: str) -> str:
    mean, spread = group.mean(metric), group.spread(metric)
    if mean is None:
        return "-"
    return f"{mean:.4g}" if spread is None else f"{mean:.4g} +- {spread:.2g}"


def _write_json(
    path: Path, jobs: Sequence[SweepJob], scales: Scales, score: str, columns: Sequence[str]
) -> None:
    content: dict[str, Any] = {
        "score": score,
        "ranking": [
            {
                "rank": rank,
                "among": scale,
                "label": group.label,
                "jobs": [job.folder.name for job in group.jobs],
                "mean": {name: group.mean(name) for name in (score, *columns)},
                "standard_deviation": {name: group.spread(name) for name in (score, *columns)},
            }
            for scale, alike in scales.items()
            for rank, group in enumerate(alike, start=1)
        ],
        "failed": [{"job": job.folder.name, "reason": job.reason} for job in jobs if job.status == FAILED],
        "unfinished": [job.folder.name for job in jobs if job.status == UNFINISHED],
    }
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def _write_csv(path: Path, jobs: Sequence[SweepJob]) -> None:
    keys = [key for job in jobs for key in job.overrides] + [name for job in jobs for name in job.metrics]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, dict.fromkeys(["job", "status", "reason", *keys]))
        writer.writeheader()
        for j in jobs:
            own = {"job": j.folder.name, "status": j.status, "reason": j.reason}
            writer.writerow({**own, **j.overrides, **j.metrics})


# --- the jobs of a sweep as its folders record them: overrides, status, and the numbers that they ended in ------------


@dataclass(frozen=True)
class SweepJob:
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

    def values(self, metric: str) -> list[float]:
        """The finite values of one metric over the jobs."""
        found = (job.metrics.get(metric, math.nan) for job in self.jobs)
        return [value for value in found if math.isfinite(value)]

    def mean(self, metric: str) -> float | None:
        """Mean over the seeds; None if no job has the metric."""
        values = self.values(metric)
        return fmean(values) if values else None

    def spread(self, metric: str) -> float | None:
        """Sample standard deviation over the seeds; None for a single job."""
        values = self.values(metric)
        return stdev(values) if len(values) > 1 else None


Scales = Mapping[str, Sequence[Group]]


def read_jobs(sweep_dir: Path) -> list[SweepJob]:
    """Every job below a folder, in the order of their numbers."""
    records = sweep_dir.glob("**/.hydra/overrides.yaml")
    return sorted((_read_job(record.parent.parent) for record in records), key=_number)


def grouped(jobs: Sequence[SweepJob]) -> list[Group]:
    """Finished jobs together with those that differ in the seed alone; labels name only what varies."""
    every = {key for job in jobs for key in job.overrides} - {"seed"}
    varying = {key for key in every if len({job.overrides.get(key) for job in jobs}) > 1}
    members: dict[tuple[str, str], list[SweepJob]] = {}
    for job in jobs:
        if job.status == DONE:
            named = [f"{key}={value}" for key, value in job.overrides.items() if key in varying]
            members.setdefault((job.scale, " ".join(named) or "all alike"), []).append(job)
    return [Group(name, tuple(group)) for (_, name), group in members.items()]


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
    if failed := read_json(folder / "failed.json"):
        reason = " ".join(f"{failed['error']}: {failed['message']}".split())
        return SweepJob(folder, overrides, FAILED, reason=reason)
    content = None
    with suppress(json.JSONDecodeError):  # cut short: the process died while it wrote
        content = read_json(folder / "metrics.json", read_json(folder / "policy.json"))
    if content is None:
        return SweepJob(folder, overrides, UNFINISHED)
    scale = " ".join(f"{key}={content[key]}" for key in _SCALE if isinstance(content.get(key), str))
    metrics_of = dict(numbers(content))
    spread = [value for name, value in metrics_of.items() if name.startswith("test.spread.")]
    if spread and not any(spread):  # one path: no interval, which is not one that holds nothing
        metrics_of = {name: v for name, v in metrics_of.items() if not name.startswith("test.coverage")}
    return SweepJob(folder, overrides, DONE, metrics=metrics_of, scale=scale)


def _number(job: SweepJob) -> tuple[int, str]:
    start = job.folder.name.split("_")[0]
    return (int(start) if start.isdigit() else 10**9, str(job.folder))


COMMAND = PlainCommand(main, complete)
