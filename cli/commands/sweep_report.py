"""`nsde sweep-report DIR`: rank the jobs of a sweep, and name those that failed and why."""

from __future__ import annotations

import argparse
import csv
import json
import math
import re
from collections.abc import Sequence
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from nsde_torch.aligned import aligned
from nsde_torch.errors import ConfigError

from .. import complete as completion
from ..exit_status import OK
from ..registry import PlainCommand
from ..sweep_jobs import DONE, FAILED, UNFINISHED, Group, SweepJob, grouped, read_jobs

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
    score = options.by or _score(jobs)
    if options.by and not any(options.by in job.metrics for job in jobs):
        names = ", ".join(sorted({name for job in jobs for name in job.metrics})) or "none at all"
        raise ConfigError(f"no job has the metric `{options.by}`; there are: {names}.")
    columns = _columns(jobs, options.columns or COLUMNS, score)
    groups = ranked(grouped(jobs), score)
    if options.by:  # the user says that this number compares
        groups = [replace(group, jobs=tuple(replace(j, scale="") for j in group.jobs)) for group in groups]
    print(report(jobs, groups, score, columns))
    _write_json(folder / "sweep_report.json", jobs, groups, score, columns)
    _write_csv(folder / "sweep_report.csv", jobs)
    return OK


def complete(words: Sequence[str]) -> list[str]:
    """Completions of the last word: options and folders."""
    current = words[-1] if words else ""
    if current.startswith("-"):
        return [option for option in ("--by", "--columns", "--help") if option.startswith(current)]
    return completion.files(current)


def ranked(groups: Sequence[Group], score: str) -> list[Group]:
    """Groups from the best mean score to the worst; those without one last."""

    def order(group: Group) -> tuple[bool, float, str]:
        mean = group.mean(score)
        return (math.isnan(mean), 0.0 if math.isnan(mean) else mean, group.label)

    return sorted(groups, key=order)


def report(jobs: Sequence[SweepJob], groups: Sequence[Group], score: str, columns: Sequence[str]) -> str:
    """The report as text."""
    count = {status: sum(job.status == status for job in jobs) for status in (DONE, FAILED, UNFINISHED)}
    lines = [f"{len(jobs)} jobs: " + ", ".join(f"{number} {status}" for status, number in count.items())]
    scales = by_scale(groups)
    for scale, alike in scales.items():
        where = f" among {scale}" if len(scales) > 1 else ""
        lines += ["", f"Ranked by {score}{where} (mean +- standard deviation over seeds, smaller is better)"]
        lines += _ranking(alike, score, [c for c in columns if any(c in g.jobs[0].metrics for g in alike)])
    if len(scales) > 1:
        lines += [
            "",
            "Scores of different systems, models and losses do not compare; for one ranking of all, name a number that "
            "does, for example --by test.crps.position.1",
        ]
    for status, title in (
        (FAILED, "Failed"),
        (UNFINISHED, "Unfinished (running, or killed; to continue one: nsde train resume=FOLDER)"),
    ):
        found = [job for job in jobs if job.status == status]
        if found:
            lines += ["", f"{title}:"]
            lines += [f"  {job.folder.name}" + (f": {job.reason}" if job.reason else "") for job in found]
    return "\n".join(lines)


def by_scale(groups: Sequence[Group]) -> dict[str, list[Group]]:
    """Groups whose scores compare, in their order."""
    out: dict[str, list[Group]] = {}
    for group in groups:
        out.setdefault(group.scale, []).append(group)
    return out


def _ranking(groups: Sequence[Group], score: str, columns: Sequence[str]) -> list[str]:
    head = ["rank", "jobs", score, *map(_short, columns), "what"]
    rows = [
        [str(rank), str(len(group.jobs)), *(_pair(group, name) for name in (score, *columns)), group.label]
        for rank, group in enumerate(groups, start=1)
    ]
    best = min(
        groups[0].jobs,
        key=lambda job: (math.isnan(job.metrics.get(score, math.nan)), job.metrics.get(score, 0.0)),
    )
    table = aligned([head, *rows], left=len(head))
    return [*(f"  {row}" for row in table), f"  best job: {best.folder}"]


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


def _score(jobs: Sequence[SweepJob]) -> str:
    known = {name for job in jobs for name in job.metrics}
    return next((name for name in SCORES if name in known), SCORES[0])


def _columns(jobs: Sequence[SweepJob], patterns: Sequence[str], score: str) -> list[str]:
    known = list(dict.fromkeys(name for job in jobs for name in job.metrics))
    return [name for name in known if name != score and any(fnmatch(name, pattern) for pattern in patterns)]


def _pair(group: Group, metric: str) -> str:
    mean, spread = group.mean(metric), group.spread(metric)
    if math.isnan(mean):
        return "-"
    return f"{mean:.4g}" if math.isnan(spread) else f"{mean:.4g} +- {spread:.2g}"


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _write_json(
    path: Path, jobs: Sequence[SweepJob], groups: Sequence[Group], score: str, columns: Sequence[str]
) -> None:
    content: dict[str, Any] = {
        "score": score,
        "ranking": [
            {
                "rank": rank,
                "among": scale,
                "label": group.label,
                "jobs": [job.folder.name for job in group.jobs],
                "mean": {name: _finite(group.mean(name)) for name in (score, *columns)},
                "standard_deviation": {name: _finite(group.spread(name)) for name in (score, *columns)},
            }
            for scale, alike in by_scale(groups).items()
            for rank, group in enumerate(alike, start=1)
        ],
        "failed": [{"job": job.folder.name, "reason": job.reason} for job in jobs if job.status == FAILED],
        "unfinished": [job.folder.name for job in jobs if job.status == UNFINISHED],
    }
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def _write_csv(path: Path, jobs: Sequence[SweepJob]) -> None:
    keys = list(dict.fromkeys(key for job in jobs for key in job.overrides))
    metrics = list(dict.fromkeys(name for job in jobs for name in job.metrics))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["job", "status", "reason", *keys, *metrics])
        for job in jobs:
            row = [job.folder.name, job.status, job.reason]
            row += [job.overrides.get(key, "") for key in keys]
            writer.writerow([*row, *(job.metrics.get(name, "") for name in metrics)])


COMMAND = PlainCommand(main, complete)
